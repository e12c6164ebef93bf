"""The mean cloud of several fits on different lattices; ends by the clock and by a stop request."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.fitting.fit_context import FitContext
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.lattice_mean import SPACINGS, fit_lattices, mean_cloud
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.fitting.prior_targets import fit_to_prior
from g3r.fitting.prior_volume import prior_volume
from g3r.fitting.slice_stage import SliceFit, SliceStageSettings
from g3r.fitting.slice_targets import SliceModel, slice_target
from g3r.gaussians import GaussianCloud, render
from g3r.gaussians.seeding import seed_cloud
from g3r.prior.maps import DEFAULT_TILING
from g3r.run.deadline import Deadline, LoopRecord
from tests.fitting.scene import BALL, GRID, make_slices, true_volume

SPACING_MM = 2.4
N_STEPS = 20
STAGE = PriorStageSettings(n_steps=6)


@pytest.fixture(scope="module")
def prior() -> PriorVolume:
    slices = make_slices()
    ones = np.ones(len(slices))
    volumes = InitialVolumes.of(slices, ones, ones, 1.0, common_bias_field=False)
    return prior_volume(volumes, ones, ones, None, None, n_views=1, tiling=DEFAULT_TILING)


def fitted(prior: PriorVolume, n_lattices: int, **options: Any) -> SliceFit:
    weight, context = np.ones(len(prior.volumes.slices)), FitContext(rng=np.random.default_rng(0), **options)
    first = fit_to_prior(prior, spacing_mm=SPACING_MM, stage=STAGE, context=FitContext(rng=context.rng))
    return fit_lattices(
        first,
        prior,
        slice_target(prior, weight, SliceModel(surroundings=False)),
        n_lattices,
        weight=weight,
        distillation=False,
        prior_stage=STAGE,
        slice_stage=SliceStageSettings(n_steps=N_STEPS, prior_error=0.0),
        context=context,
    )


def shown(cloud: GaussianCloud) -> np.ndarray:
    return volume_from_pixels(render(cloud, volume_planes(GRID)).numpy(), GRID)


def error(volume: np.ndarray, scale: float) -> float:
    return float(np.sqrt(((scale * volume - true_volume())[BALL] ** 2).mean()))


def test_the_mean_cloud_shows_the_mean_volume_and_errs_less(prior: PriorVolume) -> None:
    fit = fitted(prior, 4)
    each = [shown(cloud) for cloud in (fit.cloud, *fit.further)]
    together = shown(mean_cloud(fit))
    assert len(each) == 4
    np.testing.assert_allclose(together, np.mean(each, axis=0), atol=2e-5 * true_volume().max())
    assert error(together, prior.scale) < 0.97 * np.mean([error(one, prior.scale) for one in each])


def test_lattices_differ_in_place_and_spacing(prior: PriorVolume) -> None:
    fit = fitted(prior, 3)
    sizes = np.array([len(cloud) for cloud in (fit.cloud, *fit.further)])
    np.testing.assert_allclose(sizes / sizes[0], np.array(SPACINGS) ** -3, rtol=0.25)
    still = seed_cloud(np.ones(GRID.shape, np.float32), BALL, GRID, SPACING_MM)
    shifted = seed_cloud(np.ones(GRID.shape, np.float32), BALL, GRID, SPACING_MM, (0.5, 0.0, 0.0))
    edge_mm = SPACING_MM * 2 ** (1 / 3)
    x = (shifted.mean_mm[:, 0].min() - still.mean_mm[:, 0].min()) / edge_mm
    assert float(x) % 0.5 == pytest.approx(0.0, abs=1e-4)
    assert len(shifted) == pytest.approx(len(still), rel=0.1)


def test_a_single_lattice_is_the_fit_itself(prior: PriorVolume) -> None:
    fit, several = fitted(prior, 1), fitted(prior, 3)
    assert not fit.further
    for one, other in zip(mean_cloud(fit).parameters, several.cloud.parameters, strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())


def test_progress_counts_all_fits(prior: PriorVolume) -> None:
    told: list[tuple[int, int]] = []
    fitted(prior, 3, progress=lambda done, total: told.append((done, total)))
    done = [one for one, _ in told]
    assert {total for _, total in told} == {3 * N_STEPS}
    assert done == sorted(done)
    assert done[-1] == 3 * N_STEPS


def test_the_clock_decides_how_many_there_are_and_a_later_run_repeats_it(prior: PriorVolume) -> None:
    record = LoopRecord()
    fit = fitted(prior, 4, deadline=Deadline.after(-1.0))
    assert not fit.further  # the first fit is always made
    late = Deadline(loop_record=record)
    assert len(fitted(prior, 3, deadline=late).further) == 2
    again = Deadline(end_s=-np.inf, loop_record=LoopRecord(record.loops, repeating=True))
    assert len(fitted(prior, 3, deadline=again).further) == 2


@pytest.mark.parametrize("stopped_in", [0, 1, 2])
def test_a_fit_in_which_the_run_is_stopped_counts_for_nothing_unless_it_is_the_first(
    prior: PriorVolume, stopped_in: int
) -> None:
    n_done = 0

    def count(done: int, total: int) -> None:
        nonlocal n_done
        n_done = done

    stop_at = stopped_in * N_STEPS + N_STEPS // 2
    fit = fitted(prior, 4, progress=count, deadline=Deadline(is_stopped=lambda: n_done >= stop_at))
    assert len(fit.further) == max(0, stopped_in - 1)
    assert (len(fit.history) == N_STEPS) == (stopped_in > 0)


def test_a_run_stopped_before_has_a_fit_of_no_step(prior: PriorVolume) -> None:
    fit = fitted(prior, 3, deadline=Deadline(is_stopped=lambda: True))
    assert not fit.history
    assert not fit.further
