"""Detection of masks that end inside the brain, by the image beside them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion, generate_binary_structure

from g3r.acquisition.mask_extent import left_out_share
from g3r.acquisition.stacks import Stack

DISC = generate_binary_structure(2, 1)[:, :, None]


def head(pixels: int = 0, surroundings: float = 0.0, sigma: float = 0.03, shell_mm: float = 70.0) -> Stack:
    """A ball of radius 35 mm, a mask that is too large by some pixels of 1 mm, and surroundings up to a radius."""
    i, j, k = np.meshgrid(np.arange(160), np.arange(160), np.arange(12), indexing="ij", sparse=True)
    radius = np.sqrt((i - 80.0) ** 2 + (j - 80.0) ** 2 + (4 * (k - 5.5)) ** 2)
    brain = radius < 35
    image = np.where(brain, 1.0, np.where(radius < shell_mm, surroundings, 0.0))
    rng = np.random.default_rng(1)
    noisy = np.hypot(image + rng.normal(0, sigma, image.shape), rng.normal(0, sigma, image.shape))
    change = binary_dilation if pixels > 0 else binary_erosion
    mask = change(brain, DISC, iterations=abs(pixels)) if pixels else brain
    return Stack(image=noisy.astype(np.float32), mask=mask, affine=np.diag([1.0, 1.0, 4.0, 1.0]), thickness_mm=4.0)


@pytest.mark.parametrize("pixels", [0, 1, 4])
def test_a_mask_that_holds_the_brain_leaves_nothing_out(pixels: int) -> None:
    assert left_out_share(head(pixels)) == 0


@pytest.mark.parametrize("sigma", [0.03, 0.14])
@pytest.mark.parametrize("pixels", [-3, -4, -5])
def test_a_mask_inside_the_brain_leaves_out_what_is_beside_it(pixels: int, sigma: float) -> None:
    """At an SNR of 7, a tenth of the noise pixels is as bright as dark brain and must not hide the omitted part."""
    stack = head(pixels, sigma=sigma)
    used = stack.mask.any((0, 1))
    brain = head().mask[:, :, used]
    expected = 1 - stack.mask.sum() / brain.sum()
    assert 0.1 < left_out_share(stack) == pytest.approx(expected, abs=0.012)


def test_slices_without_a_mask_do_not_count() -> None:
    stack = head()
    mask = stack.mask.copy()
    mask[:, :, 3:8] = False
    assert left_out_share(Stack(image=stack.image, mask=mask, affine=stack.affine, thickness_mm=4.0)) == 0


@pytest.mark.parametrize("shell_mm", [38.0, 45.0, 200.0])
def test_surroundings_are_not_taken_for_brain(shell_mm: float) -> None:
    """Skull and mother lie beside a correct mask; only an isolated thin layer cannot be distinguished from brain."""
    share = left_out_share(head(surroundings=0.7, shell_mm=shell_mm))
    assert share == 0 or shell_mm < 41


def test_noise_is_not_taken_for_brain() -> None:
    assert left_out_share(head(sigma=0.25)) == 0
