"""The filled share of k-space by the spectrum of slices."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.k_space_extent import FEWEST_PIXELS, filled_share
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack
from g3r.output.stack_record import StackRecord

SHAPE = (96, 80, 6)


def acquired(seed: int = 0, noise: float = 0.01) -> NDArray[np.float32]:
    """Slices of smooth tissues in air, with edges and noise, as magnitudes."""
    rng = np.random.default_rng(seed)
    texture = gaussian_filter(rng.standard_normal(SHAPE), (2, 2, 0))
    radius = np.linalg.norm(np.indices(SHAPE[:2]) / np.array(SHAPE[:2])[:, None, None] - 0.5, axis=0)
    tissue = (radius < 0.4)[..., None] * (1 + 0.5 * np.sign(texture))
    tissue = gaussian_filter(tissue, (0.5, 0.5, 0))
    return np.abs(tissue + noise * (rng.standard_normal(SHAPE) + 1j * rng.standard_normal(SHAPE))).astype(np.float32)


def zero_filled(image: NDArray[np.float32], factors: tuple[float, float]) -> NDArray[np.float32]:
    """The image on more and smaller pixels, as scanners interpolate: zeros around k-space."""
    k_space = np.fft.fftshift(np.fft.fft2(image, axes=(0, 1)), axes=(0, 1))
    shape = [round(n * factor) for n, factor in zip(image.shape, factors, strict=False)]
    filled = np.zeros((*shape, image.shape[2]), complex)
    first = [new // 2 - old // 2 for new, old in zip(shape, image.shape, strict=False)]
    filled[first[0] : first[0] + image.shape[0], first[1] : first[1] + image.shape[1]] = k_space
    found = np.fft.ifft2(np.fft.ifftshift(filled, axes=(0, 1)), axes=(0, 1))
    return np.abs(found).astype(np.float32) * np.float32(np.prod(factors))


@pytest.mark.parametrize("factor", [1.25, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("whole_numbers", [False, True])
def test_the_share_is_what_zero_filling_left(factor: float, whole_numbers: bool) -> None:
    image = zero_filled(acquired(), (factor, 1.0))
    if whole_numbers:
        image = np.rint(image * 300)
    assert filled_share(image, 0) == pytest.approx(1 / factor, abs=0.03)
    assert filled_share(image, 1) is None


def test_a_filter_of_the_scanner_counts_from_half_amplitude() -> None:
    """k-space along one axis ends at 0.7, with a ramp from 0.5: the amplitude is a half at 0.6."""
    image = acquired()
    frequency = np.abs(np.fft.fftfreq(SHAPE[0])) / 0.5
    ramp = np.clip((0.7 - frequency) / 0.2, 0, 1)
    image = np.abs(np.fft.ifft(np.fft.fft(image, axis=0) * ramp[:, None, None], axis=0)).astype(np.float32)
    assert filled_share(image, 0) == pytest.approx(0.6, abs=0.04)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_images_as_acquired_show_no_end(seed: int, noise: float) -> None:
    image = acquired(seed, noise)
    assert [filled_share(image, axis) for axis in (0, 1)] == [None, None]


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_and_odd_values_do_not_matter(scale: float) -> None:
    image = zero_filled(acquired(), (2.0, 1.0)) * np.float32(scale)
    image[:, 0], image[5, 1] = np.nan, np.inf
    assert filled_share(image, 0) == pytest.approx(0.5, abs=0.03)
    assert filled_share(np.full(SHAPE, np.nan), 0) is None


def test_images_that_say_nothing_show_no_end() -> None:
    assert filled_share(np.zeros(SHAPE, np.float32), 0) is None
    assert filled_share(np.ones(SHAPE, np.float32), 1) is None
    few = zero_filled(acquired()[: FEWEST_PIXELS // 4], (2.0, 1.0))
    assert filled_share(few, 0) is None
    # a brain that was cut out has edges of all frequencies
    image = zero_filled(acquired(), (2.0, 2.0))
    image[:40], image[150:] = 0, 0
    assert filled_share(image, 0) is None


def load(folder: Path, order: tuple[int, ...] = (0, 1, 2), sidecar: dict[str, object] | None = None) -> Stack:
    """An interpolated stack, 0.6 x 0.6 mm from 1.2 x 0.8, from files whose axes may be in another order."""
    image = zero_filled(acquired(), (2.0, 4 / 3))
    mask = np.zeros(image.shape, np.uint8)
    mask[60:130, 30:75] = 1
    affine = np.diag([0.6, 0.6, 3.0, 1.0])[:, [*order, 3]]
    for name, array in (("a", image), ("m", mask)):
        nib.Nifti1Image(array.transpose(order), affine).to_filename(folder / f"{name}.nii.gz")
    if sidecar is not None:
        (folder / "a.json").write_text(json.dumps(sidecar))
    return load_stack(folder / "a.nii.gz", folder / "m.nii.gz", 3.0)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (0, 2, 1)])
def test_an_interpolated_stack_has_the_psf_of_its_acquired_pixels(
    tmp_path: Path, order: tuple[int, ...], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        stack = load(tmp_path, order)
    first, second = stack.origin.filled_share
    assert first is not None
    assert second is not None
    assert (first, second) == (pytest.approx(0.5, abs=0.03), pytest.approx(0.75, abs=0.03))
    assert stack.in_plane_fwhm_pixels == (pytest.approx(1.2 / first), pytest.approx(1.2 / second))
    assert f"k-space filled to {first:g} x {second:g}" in caplog.text
    # the finer axis says how fine the volume can be
    slices = slices_from_stacks([stack])
    assert slices.typical_pixel_mm == pytest.approx((0.36 / second**2 * 3.0) ** (1 / 3), rel=1e-3)


def test_the_spectrum_wins_over_the_sidecar_and_is_kept_for_repeated_runs(tmp_path: Path) -> None:
    stack = load(tmp_path, sidecar={"PhaseResolution": 0.9, "PhaseEncodingDirection": "i"})
    assert stack.in_plane_fwhm_pixels[0] == pytest.approx(2.4, rel=0.06)
    assert stack.origin.phase_resolution == 0.9
    record = StackRecord(
        name="a", thickness_mm=3.0, in_plane_fwhm_pixels=stack.in_plane_fwhm_pixels, **vars(stack.origin)
    )
    assert record.profile().origin == stack.origin
    assert record.profile().in_plane_fwhm_pixels == stack.in_plane_fwhm_pixels


def test_nominal_pixels_are_as_large_as_they_are() -> None:
    image = np.ones((8, 8, 3), np.float32) + np.arange(8, dtype=np.float32)[:, None, None]
    stack = Stack(
        image=image,
        mask=image > 0,
        affine=np.diag([0.7, 0.9, 3.0, 1]),
        thickness_mm=2.5,
        in_plane_fwhm_pixels=(1.8, 1.2),
    )
    assert slices_from_stacks([stack]).typical_pixel_mm == pytest.approx((0.7 * 0.9 * 2.5) ** (1 / 3), rel=1e-12)
