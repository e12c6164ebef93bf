"""Source of a stack's thickness and PSF: the option, the sidecar, or the header's spacing with a warning."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from g3r.acquisition.brain_mask import whole_image
from g3r.acquisition.psf import FWHM_PER_SIGMA, partial_fwhm_pixels, psf_variance_mm2
from g3r.acquisition.slice_profile import NOMINAL_FWHM_PIXELS, ProfileOrigin, SliceProfile
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack, load_stacks
from g3r.errors import InputError
from tests.acquisition.nifti_files import AXES, affine_of, arrays, write

SPACING_MM = (0.8, 0.9, 3.0)
"""Spacing of pixels and slices for `affine_of`."""

P = 0.7
WIDE = 1.2 / P


def load(
    folder: Path,
    sidecar: dict[str, object] | None = None,
    thickness_mm: float | None = None,
    profile: SliceProfile | None = None,
    order: tuple[int, ...] = (0, 1, 2),
) -> Stack:
    """A small stack from its files, whose axes may be in another order."""
    image, mask = arrays()
    affine = affine_of(AXES["oblique"], SPACING_MM)
    affine[:3, :3] = affine[:3, order]
    write(folder / "a.nii.gz", image.transpose(order), affine)
    write(folder / "m.nii.gz", mask.transpose(order).astype(np.uint8), affine)
    if sidecar is not None:
        (folder / "a.json").write_text(json.dumps(sidecar))
    return load_stack(folder / "a.nii.gz", folder / "m.nii.gz", thickness_mm, profile)


# -- thickness -------------------------------------------------------------------------------------


def test_the_sidecar_decides_where_no_option_does(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        stack = load(tmp_path, {"SliceThickness": 2.5, "SpacingBetweenSlices": 3})
    assert stack.thickness_mm == 2.5
    assert stack.origin == ProfileOrigin(thickness_from="sidecar")
    assert stack.spacing_mm[2] == pytest.approx(3)
    assert caplog.messages == ["a.nii.gz: thickness 2.5 mm (sidecar)"]


@pytest.mark.parametrize(("said_mm", "warns"), [(2.52, False), (2.56, True), (2.44, True)])
def test_the_option_wins_and_a_difference_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, said_mm: float, warns: bool
) -> None:
    with caplog.at_level(logging.WARNING):
        stack = load(tmp_path, {"SliceThickness": said_mm}, thickness_mm=2.5)
    assert (stack.thickness_mm, stack.origin.thickness_from) == (2.5, "option")
    expected = f"a.nii.gz: thickness 2.5 mm is taken as given; the scanner says {said_mm} mm (a.json)"
    assert caplog.messages == [expected] * warns


@pytest.mark.parametrize("sidecar", [None, {}, {"SpacingBetweenSlices": 3.0}])
def test_without_both_the_distance_of_slices_is_taken_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, sidecar: dict[str, object] | None
) -> None:
    with caplog.at_level(logging.WARNING):
        stack = load(tmp_path, sidecar)
    assert stack.thickness_mm == pytest.approx(3)
    assert stack.origin.thickness_from == "spacing"
    (warning,) = caplog.messages
    for word in ("a.nii.gz", "3.00 mm", "--thickness", "a.json"):
        assert word in warning


@pytest.mark.parametrize("thickness_mm", [None, 2.5])
@pytest.mark.parametrize("said_mm", [2.93, 3.07, 0.8])
def test_a_sidecar_of_other_slices_is_refused(tmp_path: Path, said_mm: float, thickness_mm: float | None) -> None:
    with pytest.raises(
        InputError, match=rf"^a\.json: SpacingBetweenSlices is {said_mm} mm; expected the 3 mm .*a\.nii"
    ):
        load(tmp_path, {"SliceThickness": 2.5, "SpacingBetweenSlices": said_mm}, thickness_mm)


@pytest.mark.parametrize("said_mm", [2.95, 3.05])
def test_rounding_in_a_sidecar_is_not_refused(tmp_path: Path, said_mm: float) -> None:
    assert load(tmp_path, {"SliceThickness": 2.5, "SpacingBetweenSlices": said_mm}).thickness_mm == 2.5


def test_each_stack_has_its_own(tmp_path: Path) -> None:
    names = ("a", "b", "c")
    for n, name in enumerate(names):
        write(tmp_path / f"{name}.nii.gz", arrays(n)[0], affine_of(AXES["RAS"]))
    (tmp_path / "b.json").write_text('{"SliceThickness": 2.5}')
    paths = [tmp_path / f"{name}.nii.gz" for name in names]
    stacks = load_stacks(paths, [whole_image] * 3, [2.0, None, None])
    assert [stack.origin.thickness_from for stack in stacks] == ["option", "sidecar", "spacing"]
    assert [stack.thickness_mm for stack in stacks] == pytest.approx([2.0, 2.5, 3.0])


def test_a_run_that_is_repeated_does_not_ask_the_sidecar(tmp_path: Path) -> None:
    earlier = SliceProfile(
        thickness_mm=2.5, in_plane_fwhm_pixels=(1.2, 1.5), origin=ProfileOrigin(thickness_from="sidecar")
    )
    for thickness_mm, source in ((None, "sidecar"), (2.0, "option")):
        stack = load(tmp_path, {"SliceThickness": 1.0, "PhaseResolution": 0.5}, thickness_mm, earlier)
        assert stack.thickness_mm == (thickness_mm or 2.5)
        assert stack.origin.thickness_from == source
        assert stack.in_plane_fwhm_pixels == (1.2, 1.5)


# -- in plane --------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", [0.5, 0.7, 1.0])
def test_the_width_is_that_of_the_lobe_of_a_k_space_filled_in_part(p: float) -> None:
    """The nominal width of 1.2 pixels is rounded from the lobe's 1.207, so one percent is allowed."""
    x = np.arange(-200_000, 200_001) * 1e-5  # pixels
    lobe = np.sinc(p * x) >= 0.5
    fwhm = np.ptp(x[lobe & (np.abs(p * x) < 1)])
    assert partial_fwhm_pixels(p) == pytest.approx(fwhm, rel=0.01)


def test_variances_follow_the_widths_of_the_axes() -> None:
    variance = psf_variance_mm2([[0.8, 0.9]], [3.0], (1.2, 2.0))
    np.testing.assert_allclose(np.sqrt(variance) * FWHM_PER_SIGMA, [[0.96, 1.8, 3.0]])
    np.testing.assert_array_equal(
        psf_variance_mm2([0.8, 0.9], 3.0), psf_variance_mm2([0.8, 0.9], 3.0, NOMINAL_FWHM_PIXELS)
    )


@pytest.mark.parametrize(
    ("order", "direction", "expected"),
    [
        ((0, 1, 2), "i", (WIDE, 1.2)),
        ((0, 1, 2), "j-", (1.2, WIDE)),
        ((0, 1, 2), "k", (1.2, 1.2)),
        ((2, 0, 1), "i", (1.2, 1.2)),  # slices along the first axis of the file
        ((2, 0, 1), "j", (WIDE, 1.2)),
        ((2, 0, 1), "k", (1.2, WIDE)),
        ((0, 2, 1), "i", (WIDE, 1.2)),
        ((0, 2, 1), "j", (1.2, 1.2)),
        ((0, 2, 1), "k", (1.2, WIDE)),
        ((1, 0, 2), "i", (WIDE, 1.2)),
    ],
)
def test_the_phase_encoding_axis_is_followed_through_the_axes_of_the_file(
    tmp_path: Path,
    order: tuple[int, ...],
    direction: str,
    expected: tuple[float, float],
    caplog: pytest.LogCaptureFixture,
) -> None:
    sidecar = {"SliceThickness": 2.5, "PhaseResolution": P, "PhaseEncodingDirection": direction}
    with caplog.at_level(logging.WARNING):
        stack = load(tmp_path, sidecar, order=order)
    assert stack.in_plane_fwhm_pixels == expected
    is_slice_axis = expected == NOMINAL_FWHM_PIXELS
    assert stack.origin.phase_axis == (None if is_slice_axis else direction[0])
    assert stack.origin.phase_resolution == P
    assert [f"phase encoding along {direction[0]}, which counts the slices" in line for line in caplog.messages] == (
        [True] * is_slice_axis
    )
    # the wider axis is the same in space for every order of axes in the file
    (sigma,) = np.unique(np.sqrt(slices_from_stacks([stack]).planes.psf_var_mm2), axis=0)
    spacing = np.array([*stack.spacing_mm[:2], 2.5])
    np.testing.assert_allclose(sigma * FWHM_PER_SIGMA, np.array([*expected, 1.0]) * spacing)


def test_the_word_of_dicom_serves_files_as_dcm2niix_wrote_them(tmp_path: Path) -> None:
    sidecar = {"SliceThickness": 2.5, "PhaseResolution": P, "InPlanePhaseEncodingDirectionDICOM": "COL"}
    assert load(tmp_path, sidecar).in_plane_fwhm_pixels == (1.2, WIDE)
    assert load(tmp_path, sidecar, order=(2, 0, 1)).in_plane_fwhm_pixels == NOMINAL_FWHM_PIXELS


def test_a_line_says_what_is_known_in_plane(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        load(tmp_path, {"PhaseResolution": P, "PhaseEncodingDirection": "j"}, 2.5)
        load(tmp_path, {"PhaseResolution": P}, 2.5)
    assert caplog.messages == [
        "a.nii.gz: thickness 2.5 mm (option), in-plane FWHM 1.2 x 1.71 pixels, phase resolution 0.7 along j",
        "a.nii.gz: thickness 2.5 mm (option), phase resolution 0.7 of an unknown axis, not used",
    ]


@pytest.mark.parametrize("sidecar", [None, {"SliceThickness": 2.5}, {"PhaseResolution": 1, "PhaseEncodingAxis": "i"}])
def test_without_a_phase_resolution_the_psf_is_nominal(tmp_path: Path, sidecar: dict[str, object] | None) -> None:
    stack = load(tmp_path, sidecar, 2.5)
    assert stack.in_plane_fwhm_pixels == NOMINAL_FWHM_PIXELS == (1.2, 1.2)


@pytest.mark.parametrize("widths", [(1.2,), (1.2, 0.0), (1.2, np.nan), (np.inf, 1.2), (1.2, 1.2, 1.2)])
def test_widths_that_cannot_be_are_refused(widths: tuple[float, float]) -> None:
    image, mask = arrays()
    with pytest.raises(InputError, match=r"a\.nii: in-plane FWHM of .*expected two numbers from 0\.1 to 20"):
        Stack(
            image=image,
            mask=mask,
            affine=affine_of(AXES["RAS"]),
            thickness_mm=3.0,
            name="a.nii",
            in_plane_fwhm_pixels=widths,
        )


# -- a real scan -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(shared_data: Path) -> list[Path]:
    """Three stacks of a real subject, with the sidecars of dcm2niix."""
    folder = shared_data / "real" / "sub-01"
    if not folder.is_dir():
        pytest.skip(f"no real subject at {folder}")
    return sorted(folder.glob("*_T2w.nii.gz"))


def masks_of(paths: list[Path]) -> list[Path]:
    return [path.with_name(path.name.replace(".nii.gz", "_desc-brain_mask.nii.gz")) for path in paths]


def test_real_sidecars_are_read(real: list[Path], caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        stacks = load_stacks(real, masks_of(real))
    assert [stack.thickness_mm for stack in stacks] == [3.0] * 3
    assert [stack.origin.phase_axis for stack in stacks] == ["i", "j", "i"]
    assert all(stack.origin.thickness_from == "sidecar" for stack in stacks)
    assert [stack.origin.phase_resolution for stack in stacks] == [P] * 3
    for stack, phase_axis in zip(stacks, (0, 1, 0), strict=True):
        # the spectrum ends there, too; the scanner's filter takes a tenth
        share = stack.origin.filled_share[phase_axis]
        assert share is not None
        assert share == pytest.approx(0.9 * P, abs=0.02)
        assert stack.origin.filled_share[1 - phase_axis] is None
        assert stack.in_plane_fwhm_pixels[phase_axis] == pytest.approx(1.2 / share)
        assert stack.in_plane_fwhm_pixels[1 - phase_axis] == 1.2
    assert not caplog.messages


def test_real_stacks_without_their_sidecars(real: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    copies = [Path(shutil.copy(path, tmp_path)) for path in real]
    with caplog.at_level(logging.WARNING):
        stacks = load_stacks(copies, masks_of(real))
    assert [stack.thickness_mm for stack in stacks] == pytest.approx([3.3] * 3, rel=1e-3)
    assert all("taken as the distance of slices, 3.30 mm" in line for line in caplog.messages)
    assert len(caplog.messages) == 3


def test_real_images_hold_nothing_beyond_the_phase_resolution(real: list[Path]) -> None:
    """Only along the axis that the sidecar names does the spectrum end at 0.7 of the highest frequency."""
    for path, phase in zip(real, (0, 1, 0), strict=True):
        data = np.asarray(nib.Nifti1Image.from_filename(path).dataobj, dtype=np.float64)
        power = []
        for axis in (phase, 1 - phase):
            lines = np.moveaxis(data, axis, -1) * np.hanning(data.shape[axis])
            spectrum = (np.abs(np.fft.rfft(lines)) ** 2).mean((0, 1))
            frequency = np.linspace(0, 1, len(spectrum))
            power.append(spectrum[frequency > 0.75].mean() / spectrum[(frequency > 0.4) & (frequency < 0.6)].mean())
        assert power[0] < 0.01  # the noise between lines of the image
        assert power[1] > 0.1
