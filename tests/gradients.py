"""Gradients of leaves after a backward pass."""

from torch import Tensor


def gradient_of(leaf: Tensor) -> Tensor:
    """The gradient of a leaf, which must exist."""
    assert leaf.grad is not None
    return leaf.grad
