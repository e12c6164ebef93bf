"""The judgement of uncertainty distinguishes calibrated, ranked and constant statements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from g3r.evaluation.case import load_case
from g3r.fitting.voxel_correction import VoxelCorrectionSettings
from g3r.planning.presets import PRESETS
from g3r.reconstruct import GaussianReconstructor
from g3r.uncertainty.error_model import ErrorModel
from g3r.uncertainty.estimate import calibration
from studies.uncertainty.data import CHECK_SUBJECTS, FIT_SUBJECTS, predictors_of, relative_error
from studies.uncertainty.figure import draw_calibration
from studies.uncertainty.judgement import EXPONENTIAL_COVERAGE, check_record, check_text, judge


@pytest.fixture
def sample() -> tuple[np.ndarray, np.ndarray]:
    """Stated values over a range of a factor of 20, and exponentially distributed errors with these means."""
    rng = np.random.default_rng(0)
    stated = np.exp(rng.uniform(np.log(0.01), np.log(0.2), 40_000))
    return stated, rng.exponential(stated)


def test_the_truth_is_calibrated(sample: tuple[np.ndarray, np.ndarray]) -> None:
    found = judge(*sample)
    assert found["mean_error"] / found["mean_stated"] == pytest.approx(1, abs=0.02)
    assert found["coverage"] == pytest.approx(EXPONENTIAL_COVERAGE, abs=0.01)
    for one in found["bins"]:
        assert one["mean_error"] / one["stated"] == pytest.approx(1, abs=0.06)
        assert one["rms_error"] / one["stated"] == pytest.approx(np.sqrt(2), abs=0.12)
    assert 0.3 < found["spearman"] < 0.9
    assert 0.2 < found["gain_over_constant"] < 0.9


def test_half_as_much_is_seen(sample: tuple[np.ndarray, np.ndarray]) -> None:
    stated, size = sample
    found = judge(stated / 2, size)
    assert found["mean_error"] / found["mean_stated"] == pytest.approx(2, abs=0.04)
    assert found["coverage"][0] < 0.45


def test_a_constant_ranks_nothing_and_the_error_everything(sample: tuple[np.ndarray, np.ndarray]) -> None:
    stated, size = sample
    shuffled = judge(np.random.default_rng(1).permutation(stated), size)
    assert judge(np.full_like(size, 0.1), size)["spearman"] == 0
    assert shuffled["gain_over_constant"] == pytest.approx(0, abs=0.03)
    assert judge(size, size)["gain_over_constant"] == pytest.approx(1)
    assert judge(-size + 2 * size.max(), size)["gain_over_constant"] < 0


def test_error_does_not_depend_on_the_scale_of_the_volume() -> None:
    rng = np.random.default_rng(2)
    truth = rng.uniform(0.2, 1, (9, 9, 9)).astype(np.float32)
    volume = truth + 0.05 * rng.standard_normal(truth.shape).astype(np.float32)
    mask = np.ones(truth.shape, bool)
    once = relative_error(volume, truth, mask)
    np.testing.assert_allclose(relative_error(volume, 700 * truth, mask), once, atol=1e-5)
    np.testing.assert_allclose(relative_error(700 * volume, truth, mask), 700 * once, rtol=1e-3, atol=1e-2)
    assert abs(once.mean()) < 1e-6


def test_fit_and_check_share_no_volume_and_no_seed() -> None:
    fitted, checked = ([one.spec for one in chosen] for chosen in (FIT_SUBJECTS, CHECK_SUBJECTS))
    for what in ("volume", "seed"):
        assert not {getattr(spec, what) for spec in fitted} & {getattr(spec, what) for spec in checked}
    assert len({spec.name for spec in fitted}) == len(fitted)
    for subjects in (FIT_SUBJECTS, CHECK_SUBJECTS):  # with and without holes, from one stack and from three
        assert {(one.n_stacks, bool(one.holes)) for one in subjects} == {(1, True), (1, False), (3, True), (3, False)}
    never_trained_on = ("-operated", "sta24", "sta30", "sta34")
    assert all(spec.volume.endswith(never_trained_on) for spec in (*fitted, *checked))


def judged_subject(name: str, n_stacks: int, seed: int) -> SimpleNamespace:
    rng = np.random.default_rng(seed)
    n = 4000
    predictors = {
        "unmeasured": rng.uniform(0, 1, n),
        "from_prior": rng.exponential(0.02, n),
        "edge": rng.exponential(0.05, n),
        "texture": rng.exponential(0.03, n),
        "residual": 0.02 + rng.exponential(0.02, n),
        "depth_mm": rng.uniform(1, 30, n),
    }
    return SimpleNamespace(
        label=name,
        subject=SimpleNamespace(n_stacks=n_stacks),
        predictors=predictors,
        unseen=predictors["unmeasured"] > (0.9 if n_stacks == 1 else 1),
        error=rng.exponential(predictors["residual"]),
        psnr_db=28.0,
        median_mm=0.1,
        reliable=None,
        seconds=1.0,
        map_seconds=0.5,
        registered=True,
    )


def test_record_table_and_figure(tmp_path: Path) -> None:
    found = [judged_subject("a", 3, 0), judged_subject("b", 3, 1), judged_subject("c", 1, 2)]
    found.append(judged_subject("not registered", 3, 3))
    found[-1].registered = False  # has a row, but is not part of the figures of all subjects
    found[-1].error = 10 * found[-1].error
    record = check_record(found, ErrorModel(-0.1, {"log residual": 1.0}))  # type: ignore[arg-type]
    assert set(record["by_stacks"]) == {"1", "3"}
    assert record["by_stacks"]["3"]["mean_error"] < 0.1
    assert record["by_stacks"]["3"]["unseen"] is None  # there was no unseen part
    unseen = record["by_stacks"]["1"]["unseen"]
    assert unseen["mean_error"] == pytest.approx(np.abs(found[2].error[found[2].unseen]).mean())
    text = check_text({"with prior": {"preset": "p", "weights": "w", **record}})
    assert text.count("| with prior |") == 2 + 4
    assert "+ 1.00 log residual" in text
    draw_calibration(record, tmp_path / "new" / "figure.png")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["figure.png"]


def test_the_map_of_a_run_is_made_of_what_it_was_calibrated_on(subject: Path) -> None:
    """The correction on voxels changes the volume and the prior share, which both are predictors."""
    settings = replace(PRESETS["fast"], voxel_correction=VoxelCorrectionSettings(), resolution_mm=1.5)
    result = GaussianReconstructor(settings=settings).reconstruct(load_case(subject, 4.0).stacks)
    assert result.record.voxel_correction is not None
    assert result.uncertainty is not None
    expected = calibration()["with prior"].expected(predictors_of(result)) * result.intensity_scale
    np.testing.assert_allclose(result.uncertainty[result.mask], expected, rtol=0.01)
