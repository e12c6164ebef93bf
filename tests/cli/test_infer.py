"""`g3r-infer` as a process and from Python: outputs and record."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from g3r import GaussianReconstructor, load_stack
from g3r.acquisition.images import load_volume
from g3r.acquisition.stacks import Stack
from g3r.checkpoints.shipped import weights_path
from g3r.cli.infer_options import parsed_options
from g3r.cli.infer_task import check_files
from g3r.errors import InputError
from g3r.evaluation.pose_error import read_poses, slice_points, target_registration_error
from g3r.gaussians import GaussianCloud
from g3r.output.files import FULL_WEIGHT, MASK_NAMES, OUTPUT_NAMES, SLICE_COLUMNS
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import ReconstructionSettings
from tests.faults.small_case import BY_COMMAND, WHOLE
from tests.quick import QUICK_FIT

QUICK = ("--preset", "fast", "--resolution", "1.5", "--no-prior", "--thickness", "4", "--threads", "1", "--quiet")


def run(command: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", f"g3r.cli.{command}", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def files(subject: Path, kind: str) -> list[Path]:
    return [subject / f"{kind}-{n}.nii.gz" for n in range(3)]


def inputs(subject: Path) -> list[object]:
    return ["--stacks", *files(subject, "stack"), "--masks", *files(subject, "mask")]


@pytest.fixture(scope="module")
def reconstructed(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of g3r-infer for the subject."""
    folder = tmp_path_factory.mktemp("reconstructed") / "deep" / "out"
    before = {path: path.read_bytes() for path in subject.iterdir()}
    done = run("infer", *inputs(subject), *QUICK, "--output", folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert str(folder / "volume.nii.gz") in done.stdout
    assert {path: path.read_bytes() for path in subject.iterdir()} == before  # inputs are never written to
    return folder


def test_every_output_is_there_and_nothing_else(reconstructed: Path) -> None:
    assert {path.name for path in reconstructed.iterdir()} == WHOLE
    assert {*OUTPUT_NAMES} - {"prior_share.nii.gz", *MASK_NAMES} == WHOLE


def test_the_maps_are_images_of_the_head(subject: Path, reconstructed: Path) -> None:
    volume, mask = (nib.Nifti1Image.from_filename(reconstructed / f"{name}.nii.gz") for name in ("volume", "mask"))
    np.testing.assert_allclose(volume.header.get_zooms(), 1.5, rtol=1e-6)
    np.testing.assert_allclose(volume.affine, mask.affine)
    data, inside = np.asarray(volume.dataobj), np.asarray(mask.dataobj) > 0
    assert data.dtype == np.float32
    assert np.isfinite(data).all()
    # the image extends about one voxel beyond the mask
    assert (data[~binary_dilation(inside, iterations=3)] == 0).all()
    assert (data[inside] != 0).mean() > 0.99
    truth_mask = load_volume(subject / "truth-mask.nii.gz")
    true_mm3 = truth_mask.data.sum() * truth_mask.grid.voxel_volume_mm3
    assert inside.sum() * 1.5**3 == pytest.approx(true_mm3, rel=0.25)
    # the stacks' own intensities: the truth's bright end is 1000
    assert 500 < np.percentile(data[inside], 99) < 1500
    maps = [load_volume(reconstructed / f"{name}.nii.gz") for name in ("prior", "coarse", "density")]
    assert len({one.data.shape for one in maps}) == 1
    # without a network the Gaussians start from V_sharp: the same head as V_coarse, with more contrast
    head = binary_erosion(inside)  # slices also cover background; without a network all maps have the same grid
    sharp, coarse = (one.data[head] for one in maps[:2])
    assert np.corrcoef(sharp, coarse)[0, 1] > 0.9
    assert sharp.std() > 1.02 * coarse.std()
    assert 2.8 < np.median(maps[2].data[head]) < 3.2  # three gapless stacks


def test_the_slice_table_is_complete_and_its_poses_are_good(subject: Path, reconstructed: Path) -> None:
    with (reconstructed / "slices.tsv").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    assert tuple(rows[0]) == SLICE_COLUMNS
    assert tuple(SLICE_COLUMNS) == tuple(
        ["stack", "slice", "rx", "ry", "rz", "tx", "ty", "tz", "gain", "weight", "ncc", "reason"]
    )
    keys = [(int(row["stack"]), int(row["slice"])) for row in rows]
    masks = [np.asarray(nib.Nifti1Image.from_filename(path).dataobj) > 0 for path in files(subject, "mask")]
    assert keys == [(s, k) for s, m in enumerate(masks) for k in np.flatnonzero(m.sum((0, 1)) >= 12)]
    for row in rows:
        assert 0 < float(row["weight"]) <= 1
        assert 0.3 < float(row["gain"]) < 3
        assert -1 <= float(row["ncc"]) <= 1
        assert (row["reason"] != "-") == (float(row["weight"]) < FULL_WEIGHT)
    points = slice_points(files(subject, "mask"))
    error = target_registration_error(
        points, read_poses(subject / "poses.tsv"), read_poses(reconstructed / "slices.tsv")
    )
    assert error.median_mm < 1.5


def test_the_record_is_json_without_paths(subject: Path, reconstructed: Path) -> None:
    text = (reconstructed / "run.json").read_text()
    record = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    for path in (subject, reconstructed, Path.home(), Path(sys.prefix)):
        assert str(path) not in text
    assert record["n_gaussians"] == len(GaussianCloud.load(reconstructed / "gaussians.npz"))
    settings = record["settings"]
    volume_mm3 = np.prod(record["stacks"][0]["spacing_mm"][:2]) * record["stacks"][0]["thickness_mm"]
    spacing_mm = min(settings["gaussian_spacing_pixels"] * volume_mm3 ** (1 / 3), settings["max_gaussian_spacing_mm"])
    assert record["gaussian_spacing_mm"] == pytest.approx(spacing_mm, rel=1e-5)
    assert settings["resolution_mm"] == 1.5
    assert [stack["name"] for stack in record["stacks"]] == [path.name for path in files(subject, "stack")]
    assert all(seconds >= 0 for seconds in record["seconds"].values())
    assert record["peak_memory_bytes"] > 1e7
    assert record["command"]["preset"] == "fast"
    for key in ("versions", "warnings", "notes", "loss", "inactive_terms", "registration"):
        assert key in record
    assert record["registration"]["reliable"] is True
    assert record["registration"]["space"] in ("standard", "scanner")
    for stack in record["stacks"]:
        assert stack["quality"]["reliable"] is True
        assert stack["interleave"] in ((None,) if stack["n_segments"] == 1 else range(1, 8))
        assert 1 <= stack["n_segments"] <= stack["n_slices"]


def test_the_picture_is_a_picture(reconstructed: Path) -> None:
    from matplotlib.image import imread

    assert imread(reconstructed / "sections.png").std() > 0.05


def test_an_earlier_result_is_kept_unless_forced(subject: Path, reconstructed: Path, tmp_path: Path) -> None:
    (tmp_path / "volume.nii.gz").write_text("mine")
    (tmp_path / "notes.txt").write_text("mine too")
    for name in ("prior_share.nii.gz", "run.json"):
        (tmp_path / name).write_text("of a result with a prior")
    refused = run("infer", *inputs(subject), *QUICK, "--output", tmp_path)
    assert refused.returncode == 3
    assert "--force" in refused.stderr
    assert (tmp_path / "volume.nii.gz").read_text() == "mine"
    forced = run("infer", *inputs(subject), *QUICK, "--output", tmp_path, "--force")
    assert forced.returncode == 0, forced.stderr
    # no map of the other result is left behind
    assert {path.name for path in tmp_path.iterdir()} == WHOLE | {"notes.txt"}
    # the same seed on one thread gives the same volume
    np.testing.assert_array_equal(
        load_volume(tmp_path / "volume.nii.gz").data, load_volume(reconstructed / "volume.nii.gz").data
    )


def quick_settings() -> ReconstructionSettings:
    """Settings without the prior and with a short registration and fit."""
    return replace(
        QUICK_FIT,
        resolution_mm=1.5,
        use_prior=False,
        registration=replace(QUICK_FIT.registration, n_rounds=2),
        slice_stage=replace(QUICK_FIT.slice_stage, n_steps=5),
    )


@pytest.fixture(scope="module")
def given(subject: Path) -> list[Stack]:
    """The subject's stacks."""
    return [load_stack(s, m, 4.0) for s, m in zip(files(subject, "stack"), files(subject, "mask"), strict=True)]


@pytest.fixture(scope="module")
def plain(given: list[Stack]) -> ReconstructionResult:
    """Their reconstruction in one call."""
    return GaussianReconstructor(settings=quick_settings()).reconstruct(given)


def test_from_python_in_three_lines(plain: ReconstructionResult, tmp_path: Path) -> None:
    plain.save(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == WHOLE - BY_COMMAND
    assert plain.volume.shape == plain.grid.shape


def test_one_registration_serves_several_fits(given: list[Stack], plain: ReconstructionResult) -> None:
    reconstructor = GaussianReconstructor(settings=quick_settings())
    motion = reconstructor.register_stacks(given)
    again = reconstructor.reconstruct(given, motion)
    np.testing.assert_array_equal(again.volume, plain.volume)
    assert any("registration was given" in note for note in again.record.notes)
    with pytest.raises(InputError, match="registration of"):
        reconstructor.reconstruct(given[:2], motion)


@pytest.mark.parametrize("power", [-20, 20])
def test_intensities_scale_the_volume_and_nothing_else(
    given: list[Stack], plain: ReconstructionResult, power: int
) -> None:
    """Powers of two (about 1e-6 and 1e6) cause no rounding, so any difference shows a constant with a hidden unit."""
    factor = np.float32(2.0**power)
    scaled = GaussianReconstructor(settings=quick_settings()).reconstruct(
        [replace(stack, image=stack.image * factor) for stack in given]
    )
    np.testing.assert_array_equal(scaled.volume, plain.volume * factor)
    np.testing.assert_array_equal(scaled.slices.planes.center_mm, plain.slices.planes.center_mm)


@pytest.mark.parametrize("standard", [False, True])
def test_a_single_still_stack_keeps_its_header_poses_and_says_why(subject: Path, standard: bool) -> None:
    """All slices stay in line; together they are rotated only if the standard orientation is requested."""
    stack = load_stack(files(subject, "stack")[0], files(subject, "mask")[0], 4.0)
    settings = quick_settings()
    settings = replace(settings, registration=replace(settings.registration, standard_orientation=standard))
    result = GaussianReconstructor(settings=settings).reconstruct([stack])
    assert any("single stack" in note for note in result.record.notes)
    motion = result.slices.world_from_header()
    relative = motion.take([0]).inverse() @ motion if standard else motion
    np.testing.assert_allclose(relative.translation_mm, 0, atol=0.02)  # the tolerance of header geometry
    np.testing.assert_allclose(relative.rotvec_rad(), 0, atol=2e-4)
    assert result.record.registration is not None
    assert result.record.registration.space == ("standard" if standard else "scanner")
    quality = result.record.stacks[0].quality
    assert quality is not None
    assert quality.held_out_correlation is None
    assert np.isfinite(result.volume).all()
    assert result.volume[result.mask].std() > 0


def test_a_stack_without_usable_slices_is_named_and_the_others_go_on(subject: Path) -> None:
    stacks = [load_stack(s, m, 4.0) for s, m in zip(files(subject, "stack"), files(subject, "mask"), strict=True)]
    few = np.zeros_like(stacks[0].mask)
    few[20:23, 20:23, 5] = True
    settings = quick_settings()
    registration = replace(
        settings.registration, template=False, network=False, stacks=False, segments=False, n_rounds=1
    )
    settings = replace(settings, resolution_mm=2.5, registration=registration)
    result = GaussianReconstructor(settings=settings).reconstruct([replace(stacks[0], mask=few), stacks[1], stacks[2]])
    record = result.record
    assert [one.n_slices > 0 for one in record.stacks] == [False, True, True]
    assert record.stacks[0].interleave is None
    quality = record.stacks[0].quality
    assert quality is not None
    assert quality.reliable is False
    assert record.stacks[2].n_segments == 1
    assert any(stacks[0].name in line for line in record.warnings)


def test_a_dry_run_writes_nothing(subject: Path, tmp_path: Path) -> None:
    done = run("infer", *inputs(subject), *QUICK, "--output", tmp_path / "out", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("thickness 4 mm") == 3
    assert list(tmp_path.iterdir()) == []


def test_the_shipped_prior_is_used_by_default(subject: Path, tmp_path: Path) -> None:
    quick = [option for option in QUICK if option != "--no-prior"]
    done = run("infer", *inputs(subject), *quick, "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["prior"] is not None
    prior, coarse = (load_volume(tmp_path / "out" / f"{name}.nii.gz").data for name in ("prior", "coarse"))
    assert np.isfinite(prior).all()
    assert not np.array_equal(prior, coarse)
    share, mask = (load_volume(tmp_path / "out" / f"{name}.nii.gz").data for name in ("prior_share", "mask"))
    # pixels of 1.5 x 1.5 x 4 mm leave it much
    assert 0.5 < record["prior_weight"] <= share[mask > 0].min() + 1e-3 < share[mask > 0].mean() < 0.9
    assert share.max() == 1


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), {}),
        (("--ckpt", "cc0"), {"prior": "prior-cc0", "pose": "pose-cc0"}),
        (("--pose-ckpt", "cc0"), {"pose": "pose-cc0"}),
        (("--ckpt", "cc0", "--pose-ckpt", str(weights_path(None, "pose"))), {"prior": "prior-cc0", "pose": "pose"}),
    ],
)
def test_a_set_of_weights_is_named_once(
    subject: Path, tmp_path: Path, arguments: tuple[str, ...], expected: dict[str, str]
) -> None:
    options = parsed_options([*map(str, inputs(subject)), "--output", str(tmp_path / "out"), *arguments])
    networks = check_files(options, tmp_path / "out", replaces=False)
    assert {kind: file.path.stem for kind, file in networks.items()} == expected


def test_a_set_of_weights_by_its_name_in_python() -> None:
    reconstructor = GaussianReconstructor("cc0")
    assert reconstructor.networks.prior is not None
    assert reconstructor.networks.pose is not None
    assert (reconstructor.networks.prior.file_name, reconstructor.networks.pose.file_name) == (
        "prior-cc0.safetensors",
        "pose-cc0.safetensors",
    )
