"""--max-memory: memory stated beforehand; a plan below a limit, or one line of refusal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

import g3r.planning.memory_estimate
import g3r.planning.memory_limit
from g3r.acquisition.planes import Slices
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack, load_stack
from g3r.bench.command_run import CommandRun, run_infer
from g3r.cli import infer
from g3r.errors import InputError
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.prior_volume import prior_volume
from g3r.planning.memory_estimate import estimate_memory
from g3r.planning.memory_limit import MIN_PROJECTION_BYTES, PLANNED_HALO_VOXELS, plan_memory
from g3r.planning.memory_size import gigabytes, parsed_size
from g3r.planning.presets import PRESETS
from g3r.planning.stages import Stage
from g3r.planning.time_budget import TimeBudget
from g3r.prior.maps import Tiling
from g3r.run.kernel_cache import PACKAGE, kept_in
from tests.quick import QUICK_FIT

PREVIEW = replace(QUICK_FIT, resolution_mm=1.5)
PROCESS = 500_000_000
MB = 1_000_000


@pytest.fixture(scope="module")
def stacks(subject: Path) -> list[Stack]:
    return [load_stack(subject / f"stack-{n}.nii.gz", subject / f"mask-{n}.nii.gz", 4.0) for n in range(3)]


@pytest.fixture(scope="module")
def slices(stacks: list[Stack]) -> Slices:
    return slices_from_stacks(stacks)


def arguments(subject: Path, output: Path, *more: str) -> list[str]:
    return [
        "--stacks",
        *[str(subject / f"stack-{n}.nii.gz") for n in range(3)],
        "--masks",
        *[str(subject / f"mask-{n}.nii.gz") for n in range(3)],
        "--thickness",
        "4",
        "--resolution",
        "1.5",
        "--output",
        str(output),
        *more,
    ]


QUIETLY = ("--preset", "fast", "--threads", "1", "--quiet")


@pytest.fixture(scope="module")
def unlimited(subject: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[CommandRun, np.ndarray]:
    output = tmp_path_factory.mktemp("unlimited") / "out"
    return run_infer(arguments(subject, output, *QUIETLY), output), volume_in(output)


def volume_in(folder: Path) -> np.ndarray:
    return np.asarray(nib.Nifti1Image.from_filename(folder / "volume.nii.gz").dataobj)


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("1000000", MB),
        ("1500M", 1500 * MB),
        ("2G", 2000 * MB),
        ("2.5GB", 2500 * MB),
        (" 3 g ", 3000 * MB),
        ("750K", 750_000),
        ("0.5t", 500_000 * MB),
    ],
)
def test_sizes_as_people_write_them(text: str, size: int) -> None:
    assert parsed_size(text) == size


@pytest.mark.parametrize("text", ["", "G", "-2G", "2Gi", "2 4G", "0", "0.1", "1e9", "nan", "inf", "2P"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(ValueError, match="expected a number of bytes"):
        parsed_size(text)


def test_sizes_for_people_are_rounded_up() -> None:
    assert [gigabytes(n) for n in (1, 1.1e9, 1.101e9, 2.345e10)] == ["0.01 GB", "1.10 GB", "1.11 GB", "23.45 GB"]
    assert parsed_size(gigabytes(987_654_321)) >= 987_654_321  # the displayed size can be entered


def test_more_of_anything_needs_more(slices: Slices) -> None:
    def peak(**changed: object) -> int:
        return estimate_memory(slices, replace(PREVIEW, **changed), 1, PROCESS).peak  # type: ignore[arg-type]

    assert peak(resolution_mm=0.3) > peak(resolution_mm=0.4) > peak()
    assert peak() > peak(use_prior=False) > PROCESS
    few = slices.take(np.arange(0, len(slices), 2))
    assert (
        estimate_memory(few, PREVIEW, 1, PROCESS).stages[Stage.REGISTRATION]
        < estimate_memory(slices, PREVIEW, 1, PROCESS).stages[Stage.REGISTRATION]
    )
    threads = [estimate_memory(slices, PREVIEW, n, PROCESS).stages[Stage.REGISTRATION] for n in (1, 2, 4, 64)]
    assert threads == sorted(threads)
    assert threads[2] == threads[3]  # scattering uses at most four threads


def test_without_a_limit_nothing_changes(slices: Slices) -> None:
    plan = plan_memory(slices, PREVIEW, None, process_bytes=PROCESS)
    assert plan.settings == PREVIEW
    assert (plan.changes, plan.at_once) == ([], False)
    same = plan_memory(slices, PREVIEW, plan.estimate.peak, process_bytes=PROCESS)
    assert same.settings == PREVIEW
    assert same.changes == []


def test_whatever_is_planned_stays_below_the_limit_or_is_refused(slices: Slices) -> None:
    free = plan_memory(slices, PREVIEW, None, process_bytes=PROCESS).estimate.peak
    refused = []
    for limit in range(free, PROCESS - 10 * MB, -20 * MB):
        try:
            plan = plan_memory(slices, PREVIEW, limit, process_bytes=PROCESS)
        except InputError as error:
            refused.append(str(error))
            continue
        assert not refused  # a lower limit never fits once one was refused
        assert plan.estimate.peak <= limit
        assert plan.settings.resolution_mm == PREVIEW.resolution_mm  # the voxel size is not changed unasked
        assert bool(plan.changes) == (limit < free)
        if plan.settings.prior_whole_voxels == 0:
            assert plan.settings.prior_halo_voxels == PLANNED_HALO_VOXELS
    assert "--no-prior (" in refused[0]  # --no-prior needs less memory than the network
    assert "--no-prior" not in refused[-1]
    assert all("choose a coarser --resolution" in line for line in refused if "--no-prior" not in line)


def test_projections_are_given_up_where_the_fit_needs_most(slices: Slices) -> None:
    """With many Gaussians, their projections need the most memory."""
    many = replace(PREVIEW, gaussian_spacing_pixels=0.22, use_prior=False)
    free = plan_memory(slices, many, None, process_bytes=PROCESS).estimate
    assert free.stage == "fit to slices"
    plan = plan_memory(slices, many, free.peak - 60 * MB, process_bytes=PROCESS)
    kept = plan.settings.slice_stage.projection_bytes
    assert MIN_PROJECTION_BYTES <= kept < many.slice_stage.projection_bytes
    assert plan.settings.prior_stage.projection_bytes == kept
    assert any("projections kept in" in change for change in plan.changes)


@pytest.fixture
def fixed_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make statements independent of the memory of this process."""
    for module in (g3r.planning.memory_estimate, g3r.planning.memory_limit):
        monkeypatch.setattr(module, "held_bytes", lambda: PROCESS)


@pytest.mark.usefixtures("fixed_process")
def test_a_dry_run_states_it(subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def stated(*more: str) -> str:
        assert infer.main([*arguments(subject, tmp_path / "out", *more), "--dry-run", "--quiet"]) == 0
        (line,) = [line for line in capsys.readouterr().out.splitlines() if "of memory" in line]
        return line

    assert stated("--preset", "fast").startswith("needs about 1.")
    assert "most of it in uncertainty" in stated("--preset", "fast", "--resolution", "0.3")
    # with a time budget, memory is planned for the largest settings
    fine = ("--resolution", "0.3", "--no-prior")
    assert stated("--time-budget", "5", *fine) == stated("--preset", "accurate", *fine)
    assert not (tmp_path / "out").exists()


def test_a_small_limit_is_refused_in_one_line(
    subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = arguments(subject, tmp_path / "out")
    assert infer.main([*given, "--max-memory", "200M"]) == 3
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith("g3r-infer: --max-memory: needs at least ")
    assert line.endswith("the limit is 0.20 GB; choose a coarser --resolution, crop the masks, or raise --max-memory")
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit, match="2"):
        infer.main([*given, "--max-memory", "plenty"])
    assert "expected a number of bytes" in capsys.readouterr().err


def test_a_run_states_what_it_needs_and_needs_no_more(unlimited: tuple[CommandRun, np.ndarray]) -> None:
    run, _ = unlimited
    said = run.record.memory
    assert said is not None
    assert said.limit_bytes is None
    assert said.changes == []
    assert run.peak_bytes <= said.stated_bytes <= 1.5 * run.peak_bytes


def test_the_compiler_counts_where_it_has_work_to_do(
    slices: Slices, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    first = estimate_memory(slices, PREVIEW).peak
    folder = kept_in(PACKAGE / "gaussians")
    folder.mkdir()
    (folder / "kernels.one.nbi").touch()
    assert 50 * MB < first - estimate_memory(slices, PREVIEW).peak < 150 * MB


def test_a_preview_states_what_it_needs_without_torch_and_maps(subject: Path, tmp_path: Path) -> None:
    given = [word if word != "1.5" else "0.5" for word in arguments(subject, tmp_path / "out")]
    run = run_infer([*given, "--preset", "preview", "--threads", "1", "--quiet"], tmp_path / "out")
    said = run.record.memory
    assert said is not None
    assert run.peak_bytes <= said.stated_bytes <= 1.5 * run.peak_bytes


def test_a_limited_run_stays_below_it_and_gives_the_same_volume(
    subject: Path, unlimited: tuple[CommandRun, np.ndarray], tmp_path: Path
) -> None:
    run, volume = unlimited
    assert run.record.memory is not None
    limit = round(0.93 * run.record.memory.stated_bytes)
    output = tmp_path / "out"
    less = run_infer(arguments(subject, output, *QUIETLY, "--max-memory", str(limit)), output)
    assert less.peak_bytes < limit
    said = less.record.memory
    assert said is not None
    assert said.limit_bytes == limit
    assert said.stated_bytes <= limit
    assert said.changes
    assert set(said.changes) <= set(less.record.notes)
    difference = np.abs(volume_in(output) - volume)
    assert difference.max() < 1e-3 * volume.max()


@pytest.mark.slow
def test_a_time_budget_below_a_limit(subject: Path, unlimited: tuple[CommandRun, np.ndarray], tmp_path: Path) -> None:
    needs = unlimited[0].record.memory
    assert needs is not None
    limit = round(0.93 * needs.stated_bytes)
    output = tmp_path / "out"
    given = arguments(subject, output, "--time-budget", "0.1", "--threads", "1", "--quiet")
    run = run_infer([*given, "--max-memory", str(limit)], output)
    assert run.peak_bytes < limit
    said, budget = run.record.memory, run.record.time_budget
    assert said is not None
    assert budget is not None
    assert said.stated_bytes <= limit
    assert said.changes
    assert budget.seconds == 0.1


def test_a_time_budget_keeps_what_was_planned(slices: Slices) -> None:
    planned = replace(
        PRESETS["accurate"],
        use_prior=False,
        prior_whole_voxels=0,
        prior_tile_voxels=32,
        prior_stage=replace(PREVIEW.prior_stage, projection_bytes=30 * MB),
        slice_stage=replace(PREVIEW.slice_stage, projection_bytes=30 * MB),
    )
    ones = np.ones(len(slices))
    start = InitialVolumes.of(slices.scaled(1 / float(slices.masked_value.max())), ones, ones, 2.0)
    prior = prior_volume(start, ones, ones, None, None, n_views=1, tiling=Tiling())
    budget = TimeBudget.of(planned, 30.0)
    budget.for_registration()
    budget.for_prior(0.1)
    budget.for_fit_to_prior(prior, 0.1, 1000)
    settings = budget.settings
    assert settings.prior_stage.projection_bytes == settings.slice_stage.projection_bytes == 30 * MB
    assert (settings.prior_whole_voxels, settings.prior_tile_voxels) == (0, 32)
