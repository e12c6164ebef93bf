"""Gradients of leaves after a backward pass."""

from torch import Tensor


def gradient_of(leaf: Tensor) -> Tensor:
    """The gradient that a backward pass has left, which must be there."""
    assert leaf.grad is not None
    return leaf.grad
