"""`g3r-bids` with the real g3r-infer: its derivative data set, as read by pybids and the BIDS validator."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import nibabel as nib
import numpy as np
import psutil
import pytest

from tests.bids.data_sets import add_session
from tests.cli.test_infer import files

QUICK = ("--", "--preset", "fast", "--resolution", "1.5", "--no-prior", "--thickness", "4")

XFM = "from-scanner_to-standard_mode-image_xfm.txt"

CODES = {"standard": 2, "scanner": 1}


def line(*words: object) -> list[str]:
    return [sys.executable, "-m", "g3r.cli.bids", *map(str, words), *QUICK]


def stacks(subject: Path, n: int) -> list[tuple[str, Path, Path]]:
    pairs = zip(files(subject, "stack")[:n], files(subject, "mask"), strict=False)
    return [(f"acq-haste_run-{k}", stack, mask) for k, (stack, mask) in enumerate(pairs, 1)]


def far_away(path: Path, folder: Path) -> Path:
    """The image at another place, as if of another scan."""
    image = nib.Nifti1Image.from_filename(path)
    affine = image.affine.copy()
    affine[0, 3] += 700
    nib.save(nib.Nifti1Image(np.asarray(image.dataobj), affine), folder / path.name)
    return folder / path.name


@pytest.fixture(scope="module")
def written(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A derivative inside the data set: sessions of three stacks, one stack, a truncated stack, two distant stacks."""
    raw = tmp_path_factory.mktemp("bids") / "data"
    add_session(raw, "01", "a", stacks(subject, 3), "plain")
    add_session(raw, "02", None, stacks(subject, 1), "mialsrtk")
    cut = files(subject, "stack")[0].read_bytes()[:3000]
    add_session(raw, "03", None, [("", cut, files(subject, "mask")[0])])
    (_, here, its_mask), (_, away, other_mask) = stacks(subject, 2)
    moved = [far_away(path, raw.parent) for path in (away, other_mask)]
    add_session(raw, "04", None, [("run-1", here, its_mask), ("run-2", moved[0], moved[1])])
    out = raw / "derivatives" / "g3r"
    done = subprocess.run(line(raw, out, "participant", "--jobs", 1), capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert done.stderr == ""
    return out


def test_a_session_is_there_whole_or_not_at_all(written: Path) -> None:
    names = {path.relative_to(written / "sub-01").as_posix() for path in (written / "sub-01").rglob("*.*")}
    begin = "ses-a/anat/sub-01_ses-a"
    images = ("T2w", *(f"desc-{what}" for what in ("brain_mask", "uncertainty_T2w", "coverage_T2w", "unseen_mask")))
    assert names == {
        *(f"{begin}_rec-g3r_{image}{ending}" for image in images for ending in (".nii.gz", ".json")),
        f"{begin}_rec-g3r_run.json",
        f"{begin}_rec-g3r_slices.tsv",
        f"{begin}_rec-g3r_{XFM}",
        *(f"{begin}_acq-haste_run-{n}_{XFM}" for n in (1, 2, 3)),
        *(f"ses-a/figures/sub-01_ses-a_rec-g3r_desc-{kind}_T2w.png" for kind in ("sections", "thumbnail")),
        "ses-a/figures/sub-01_ses-a_rec-g3r_desc-report_T2w.html",
    }
    assert not (written / "sub-03").exists()
    assert not (written / "sub-04").exists()
    with (written / "participants_g3r.tsv").open() as file:
        rows = {row["participant_id"]: row for row in csv.DictReader(file, delimiter="\t")}
    assert [row["verdict"] for row in rows.values()] == ["use", "check", "failed", "failed"]
    assert rows["sub-03"]["reasons"].startswith("sub-03_T2w.nii.gz: ")
    assert rows["sub-03"]["stacks"] == "n/a"
    assert "700 mm from sub-04_run-1_T2w.nii.gz" in rows["sub-04"]["reasons"]
    assert int(rows["sub-01"]["slices_used"]) <= int(rows["sub-01"]["slices"])
    record = json.loads((written / "sub-01/ses-a/anat/sub-01_ses-a_rec-g3r_run.json").read_text())
    assert record["verdict"] == "use"
    assert rows["sub-01"]["reasons"] == "; ".join(record["reasons"])
    assert rows["sub-02"]["reasons"].startswith("there is a single stack")


def test_pybids_finds_one_volume_for_each_session(written: Path) -> None:
    bids = pytest.importorskip("bids", reason="pybids is not installed")
    layout = bids.BIDSLayout(written, validate=False, is_derivative=True)
    assert sorted(layout.get_subjects()) == ["01", "02"]  # a failed session is not in the data set
    volumes = layout.get(reconstruction="g3r", suffix="T2w", extension=".nii.gz", desc=None)
    assert [one.filename for one in volumes] == ["sub-01_ses-a_rec-g3r_T2w.nii.gz", "sub-02_rec-g3r_T2w.nii.gz"]
    masks = layout.get(reconstruction="g3r", suffix="mask", desc="brain", extension=".nii.gz")
    assert len(masks) == 2
    said = volumes[0].get_metadata()
    assert said["SkullStripped"] is True
    assert said["Resolution"] == "1.5 x 1.5 x 1.5 mm"
    assert said["SpatialReference"] == "orig"
    sources = [source.removeprefix("bids:raw:") for source in said["Sources"]]
    link = json.loads((written / "dataset_description.json").read_text())["DatasetLinks"]["raw"]
    assert len(sources) == 6
    assert all((written / link / source).is_file() for source in sources)
    reference = masks[0].get_metadata()["SpatialReference"].removeprefix("bids::")
    assert (written / reference).is_file()


def test_the_form_code_and_the_transform_belong_together(written: Path) -> None:
    for anat in (written / "sub-01" / "ses-a" / "anat", written / "sub-02" / "anat"):
        record = json.loads(next(anat.glob("*_run.json")).read_text())["registration"]
        for path in anat.glob("*.nii.gz"):
            header = nib.Nifti1Image.from_filename(path).header
            assert int(header["sform_code"]) == int(header["qform_code"]) == CODES[record["space"]]
        assert bool(list(anat.glob("*_xfm.txt"))) == (record["space"] == "standard")


@pytest.mark.parametrize("number", [0, 1, 2])
def test_itk_puts_a_stack_where_the_volume_shows_it(subject: Path, written: Path, number: int) -> None:
    """Its own transform fits best, that of all stacks less well, and the headers alone do not fit."""
    import SimpleITK

    anat = written / "sub-01" / "ses-a" / "anat"
    volume, brain = (
        SimpleITK.ReadImage(str(next(anat.glob(f"*_rec-g3r_{end}.nii.gz"))), SimpleITK.sitkFloat32)
        for end in ("T2w", "desc-brain_mask")
    )
    stack, mask = (
        SimpleITK.ReadImage(str(files(subject, kind)[number]), SimpleITK.sitkFloat32) for kind in ("stack", "mask")
    )
    inside = SimpleITK.GetArrayFromImage(brain) > 0

    def scores(transform: object) -> tuple[float, float]:
        """Correlation in the brain, and Dice."""
        image, moved = (
            SimpleITK.GetArrayFromImage(SimpleITK.Resample(one, volume, transform)) for one in (stack, mask)
        )
        dice = 2 * (inside & (moved > 0.5)).sum() / (inside.sum() + (moved > 0.5).sum())
        return float(np.corrcoef(image[inside], SimpleITK.GetArrayFromImage(volume)[inside])[0, 1]), float(dice)

    read = [SimpleITK.ReadTransform(str(next(anat.glob(f"*_{x}_{XFM}")))) for x in (f"run-{number + 1}", "rec-g3r")]
    (own, own_dice), (mean, mean_dice), (none, _) = map(scores, (*read, SimpleITK.Transform()))
    assert own > mean > none
    # one rigid motion for a stack of moving slices of 4 mm: the correlation cannot be near 1
    assert own > 0.45
    assert own_dice > 0.95
    assert mean_dice > 0.88


def test_no_folder_of_this_machine_is_named(written: Path) -> None:
    above = str(written.parents[2])
    for path in written.rglob("*"):
        if path.suffix in (".json", ".tsv", ".txt", ".md") and not {"logs", ".g3r"} & set(path.parts):
            assert above not in path.read_text(), path.name


def test_the_bids_validator_accepts_it(written: Path) -> None:
    """The validator comes from `pip install bids-validator-deno` and makes no network requests."""
    validator = shutil.which("bids-validator-deno")
    if validator is None:
        pytest.skip("bids-validator-deno is not installed")
    done = subprocess.run([validator, "--format", "json", str(written)], capture_output=True, text=True, check=False)
    issues = json.loads(done.stdout)["issues"]["issues"]
    assert [one for one in issues if one["severity"] == "error"] == []
    assert done.returncode == 0


@pytest.mark.slow
def test_a_killed_process_is_gone_on_with(subject: Path, tmp_path: Path) -> None:
    add_session(tmp_path / "raw", "01", None, stacks(subject, 3))
    words = line(tmp_path / "raw", tmp_path / "out", "participant", "--jobs", 1)
    stage = tmp_path / "out" / ".g3r" / "sub-01" / "result.unfinished" / "stages" / "registration.npz"
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        until = time.monotonic() + 120
        while not stage.exists() and time.monotonic() < until and run.poll() is None:
            time.sleep(0.01)
        for child in psutil.Process(run.pid).children():
            child.kill()
        said = run.communicate(timeout=60)[0]
    assert run.returncode == 1
    assert "sub-01: failed: g3r-infer was ended by signal 9" in said
    assert not (tmp_path / "out" / "sub-01").exists()
    assert subprocess.run(words, check=False, capture_output=True).returncode == 0
    record = json.loads((tmp_path / "out" / "sub-01" / "anat" / "sub-01_rec-g3r_run.json").read_text())
    assert "registration" in record["resumed"]
    volume = nib.Nifti1Image.from_filename(tmp_path / "out" / "sub-01" / "anat" / "sub-01_rec-g3r_T2w.nii.gz")
    assert np.isfinite(np.asarray(volume.dataobj)).all()
