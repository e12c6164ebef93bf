"""`g3r-simulate` as a process."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.cli import main
from data_synth.export import check_output
from data_synth.phantom import fetal_brain_phantom
from g3r._version import __version__

FILES = {
    *(f"{kind}-{n}.nii.gz" for kind in ("stack", "mask") for n in range(2)),
    "truth.nii.gz",
    "truth-mask.nii.gz",
    "poses.tsv",
    "poses.json",
    "simulation.json",
}


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "data_synth.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("volume")
    made = fetal_brain_phantom(22, 1.6)
    nib.save(nib.Nifti1Image(made.t2, made.affine), folder / "t2.nii.gz")
    nib.save(nib.Nifti1Image(made.mask.astype(np.uint8), made.affine), folder / "mask.nii.gz")
    return folder / "t2.nii.gz", folder / "mask.nii.gz"


def test_a_subject_from_a_volume(volume: tuple[Path, Path], tmp_path: Path) -> None:
    output = tmp_path / "new" / "case"
    options = "--stacks 2 --resolution 1.2 --thickness 3 --gap 0.5 --motion moderate --seed 3"
    done = run("--volume", volume[0], "--mask", volume[1], "--output", output, *options.split())
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert str(output) in done.stdout
    assert {path.name for path in output.iterdir()} == FILES
    assert [path.name for path in output.parent.iterdir()] == ["case"]  # nothing left beside it

    with (output / "poses.tsv").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    centers = {(p["stack"], p["slice"]): p for p in json.loads((output / "poses.json").read_text())}
    n_slices = 0
    for stack in range(2):
        image = nib.Nifti1Image.from_filename(output / f"stack-{stack}.nii.gz")
        assert image.get_data_dtype() == np.int16
        np.testing.assert_allclose(np.array(image.header.get_zooms()), [1.2, 1.2, 3.5], atol=1e-5)
        assert nib.Nifti1Image.from_filename(output / f"mask-{stack}.nii.gz").shape == image.shape
        n_slices += image.shape[2]
    assert len(rows) == len(centers) == n_slices
    moved = 0.0
    for row in rows:  # both files put an off-centre point of a slice at the same place
        key = (int(row["stack"]), int(row["slice"]))
        image = nib.Nifti1Image.from_filename(output / f"stack-{key[0]}.nii.gz")
        index = np.array([3.0, 7.0, key[1]])
        header = image.affine[:3, :3] @ index + image.affine[:3, 3]
        motion = Rotation.from_rotvec([float(row[c]) for c in ("rx", "ry", "rz")])
        by_table = motion.apply(header) + [float(row[c]) for c in ("tx", "ty", "tz")]
        local = [*((index[:2] - (np.array(image.shape[:2]) - 1) / 2) * 1.2), 0.0]
        by_list = np.array(centers[key]["rotation"]) @ local + centers[key]["center"]
        np.testing.assert_allclose(by_table, by_list, atol=1e-4)
        moved = max(moved, float(np.linalg.norm(by_table - header)))
    assert moved > 1
    truth = np.asarray(nib.Nifti1Image.from_filename(output / "truth.nii.gz").dataobj)
    mask = np.asarray(nib.Nifti1Image.from_filename(output / "truth-mask.nii.gz").dataobj) > 0
    assert abs(np.percentile(truth[mask], 99.5) - 1000) < 5
    assert json.loads((output / "simulation.json").read_text())["seed"] == 3


def test_a_phantom_and_what_is_already_there(tmp_path: Path) -> None:
    output = tmp_path / "case"
    arguments = ("--phantom", 20, "--output", output, "--stacks", 1, "--thickness", 5, "--motion", "none")
    assert run(*arguments).returncode == 0
    before = (output / "stack-0.nii.gz").read_bytes()

    refused = run(*arguments, "--seed", 1)
    assert refused.returncode == 3
    assert refused.stderr.count("\n") == 1
    assert "--force" in refused.stderr
    assert (output / "stack-0.nii.gz").read_bytes() == before

    (output / "out").mkdir()
    (output / "out" / "volume.nii.gz").write_bytes(b"a reconstruction")
    (output / "stack-7.nii.gz").write_bytes(b"of an earlier simulation with more stacks")
    assert run(*arguments, "--seed", 1, "--force").returncode == 0
    assert (output / "stack-0.nii.gz").read_bytes() != before
    assert (output / "out" / "volume.nii.gz").read_bytes() == b"a reconstruction"
    assert not (output / "stack-7.nii.gz").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["case"]


def test_what_an_empty_disk_holds_is_in_nobodys_way(tmp_path: Path) -> None:
    for name in ("lost+found", ".unfinished"):  # ".unfinished" is made by the run itself
        (tmp_path / name).mkdir()
    check_output(tmp_path, replace=False)


def test_force_does_not_delete_other_things(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    done = run("--phantom", 20, "--output", tmp_path, "--force")
    assert done.returncode == 3
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize("case", ["missing", "text", "other grid", "age", "thickness"])
def test_bad_input_is_one_line_and_exit_3(case: str, volume: tuple[Path, Path], tmp_path: Path) -> None:
    text = tmp_path / "text.nii.gz"
    text.write_text("this is no image")
    small = tmp_path / "small.nii.gz"
    nib.save(nib.Nifti1Image(np.ones((4, 4, 4), np.uint8), np.eye(4)), small)
    arguments: dict[str, list[object]] = {
        "missing": ["--volume", tmp_path / "none.nii.gz", "--mask", volume[1]],
        "text": ["--volume", text, "--mask", volume[1]],
        "other grid": ["--volume", volume[0], "--mask", small],
        "age": ["--phantom", 90],
        "thickness": ["--phantom", 22, "--thickness", 0],
    }
    done = run(*arguments[case], "--output", tmp_path / "out")
    assert done.returncode == 3, done.stderr
    assert done.stderr.startswith("g3r-simulate: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments", ["", "--output x", "--volume v --output x", "--phantom 22 --output x --motion wild"]
)
def test_usage_errors_are_exit_2(arguments: str) -> None:
    assert run(*arguments.split()).returncode == 2


@pytest.mark.parametrize(
    ("failure", "code", "says"), [(KeyboardInterrupt(), 130, "interrupted"), (MemoryError(), 4, "out of memory")]
)
def test_ctrl_c_and_little_memory_end_in_one_line(
    failure: BaseException,
    code: int,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def failing(*arguments: object, **options: object) -> None:
        raise failure

    monkeypatch.setattr("data_synth.simulator.simulate_stacks", failing)
    output = tmp_path / "out"
    assert main(["--phantom", "20", "--output", str(output)]) == code
    said = capsys.readouterr().err
    assert said.startswith(f"g3r-simulate: {says}")
    assert said.count("\n") == 1
    assert not output.exists()


def test_version() -> None:
    done = run("--version")
    assert done.returncode == 0
    assert __version__ in done.stdout


def test_help_is_light() -> None:
    code = (
        "import sys\nfrom data_synth.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as stop:\n    assert stop.code == 0\n"
        "assert not {'torch', 'torchio', 'lightning', 'monai', 'numba', 'scipy', 'numpy'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--phantom" in done.stdout


def test_the_simulator_needs_no_training_packages() -> None:
    code = "import sys, data_synth.simulator\nassert not {'torch', 'torchio', 'lightning', 'monai'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
