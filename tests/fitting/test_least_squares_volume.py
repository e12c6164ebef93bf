"""V_sharp: sharper than V_coarse, correct at the rim whatever lies beside the brain, in any units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.fitting import least_squares_volume as least_squares
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.fitting.least_squares_volume import least_squares_volume
from g3r.fitting.voxel_problem import VoxelProblemSettings

RADIUS_MM, THICKNESS_MM, VOXEL_MM = 18.0, 4.0, 1.5


def true_at(points_mm: np.ndarray, beside: float) -> np.ndarray:
    """A ball with a pattern of 12 mm, and uniform surroundings."""
    inside = np.linalg.norm(points_mm, axis=-1) < RADIUS_MM
    pattern = 1 + 0.4 * np.sin(2 * np.pi * points_mm / 12).prod(-1)
    return np.where(inside, pattern, beside)


def stack(normal: int, beside: float) -> Stack:
    """Slices that average the truth over their thickness, without motion and noise."""
    spacing = np.array([VOXEL_MM, VOXEL_MM, THICKNESS_MM])
    shape = (32, 32, 12)
    across = [axis for axis in range(3) if axis != normal]
    affine = np.eye(4)
    affine[:3, :3] = np.eye(3)[:, [*across, normal]] * spacing
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    world = index @ affine[:3, :3].T + affine[:3, 3]
    offsets = np.linspace(-0.5, 0.5, 9) * THICKNESS_MM
    image = np.mean([true_at(world + offset * np.eye(3)[normal], beside) for offset in offsets], axis=0)
    mask = np.linalg.norm(world, axis=-1) < RADIUS_MM
    return Stack(image=image.astype(np.float32), mask=mask, affine=affine, thickness_mm=THICKNESS_MM)


def volumes(beside: float, unit: float = 1.0) -> InitialVolumes:
    slices = slices_from_stacks([stack(normal, beside) for normal in range(3)]).scaled(unit)
    ones = np.ones(len(slices))
    return InitialVolumes.of(slices, ones, ones, VOXEL_MM, common_bias_field=False)


def error(volume: np.ndarray, made: InitialVolumes, low_mm: float, high_mm: float) -> float:
    """Root mean square in a shell, in units of the truth."""
    world = made.grid.world(np.stack(np.meshgrid(*map(np.arange, made.grid.shape), indexing="ij"), -1))
    shell = shell_of(made, low_mm, high_mm)
    return float(np.sqrt(((volume * made.scale - true_at(world, 0.0))[shell] ** 2).mean()))


def shell_of(made: InitialVolumes, low_mm: float, high_mm: float) -> np.ndarray:
    """Voxels at the given distances from the centre of the ball."""
    world = made.grid.world(np.stack(np.meshgrid(*map(np.arange, made.grid.shape), indexing="ij"), -1))
    radius = np.linalg.norm(world, axis=-1)
    return (radius >= low_mm) & (radius < high_mm)


@pytest.mark.parametrize("beside", [0.0, 2.0])
def test_it_is_sharper_than_the_mean_of_the_slices(beside: float) -> None:
    made = volumes(beside)
    ones = np.ones(len(made.slices))
    found = least_squares_volume(made, made.foreground.support(), ones, ones)
    for low, high in ((0.0, 12.0), (12.0, 15.0)):
        assert error(found, made, low, high) < 0.75 * error(made.coarse, made, low, high)


def test_what_lies_beside_the_brain_does_not_matter() -> None:
    rims = []
    for beside in (0.0, 2.0):
        made = volumes(beside)
        ones = np.ones(len(made.slices))
        rims.append(
            (least_squares_volume(made, made.foreground.support(), ones, ones) * made.scale)[
                shell_of(made, 14.0, 17.0)
            ].mean()
        )
    plain = [(one.coarse * one.scale)[shell_of(one, 14.0, 17.0)].mean() for one in map(volumes, (0.0, 2.0))]
    assert abs(rims[1] - rims[0]) < 0.65 * abs(plain[1] - plain[0])


def test_units_and_gains_do_not_matter() -> None:
    made = volumes(0.0)
    ones = np.ones(len(made.slices))
    found = least_squares_volume(made, made.foreground.support(), ones, ones)
    gain = np.where(np.arange(len(ones)) % 2, 1.5, 0.5)
    scaled = volumes(0.0, unit=1e4)
    by_gain = replace(made, slices=replace(made.slices, value=made.slices.value * gain[made.slices.planes.plane_id()]))
    assert scaled.scale == pytest.approx(1e4 * made.scale)
    np.testing.assert_allclose(
        least_squares_volume(scaled, made.foreground.support(), ones, ones), found, rtol=1e-3, atol=2e-3
    )
    np.testing.assert_allclose(
        least_squares_volume(by_gain, made.foreground.support(), gain.astype(float), ones), found, rtol=1e-3, atol=2e-3
    )


def test_a_slice_beside_its_place_makes_no_bright_crust(monkeypatch: pytest.MonkeyPatch) -> None:
    made = volumes(0.0)
    pose, away = made.slices.planes.pose, np.zeros((len(made.slices), 3))
    away[np.flatnonzero(made.slices.stack_id == 2)[6], 0] = 7.0
    moved = replace(made, slices=made.slices.with_pose(replace(pose, translation_mm=pose.translation_mm + away)))
    support = shell_of(made, 0, RADIUS_MM + 1.0)  # as seen by the other slices
    ones = np.ones(len(made.slices))

    def brightest_crust() -> float:
        volume = least_squares_volume(moved, support, ones, ones) * made.scale
        return float(volume[shell_of(made, RADIUS_MM, 40)].max())

    assert brightest_crust() < 1.7
    monkeypatch.setattr(least_squares, "CONTRADICTED", np.inf)
    assert brightest_crust() > 2.0


def noisy(made: InitialVolumes, noise: float, n_stacks: int = 3) -> InitialVolumes:
    """Initial volumes of fewer stacks, with noise of a given standard deviation in normalised intensities."""
    slices = made.slices.take(made.slices.stack_id < n_stacks)
    more = np.random.default_rng(0).normal(0, noise, slices.value.shape)
    slices = replace(slices, value=(slices.value + more).astype(np.float32))
    ones = np.ones(len(slices))
    return InitialVolumes.of(slices, ones, ones, VOXEL_MM, common_bias_field=False)


def test_noise_is_taken_out(monkeypatch: pytest.MonkeyPatch) -> None:
    made = noisy(volumes(0.0), 0.1)
    ones = np.ones(len(made.slices))

    def off() -> float:
        found = least_squares_volume(made, made.foreground.support(), ones, ones)
        return error(found, made, 0.0, RADIUS_MM - 3)

    usual = off()
    monkeypatch.setattr(least_squares, "SETTINGS", replace(least_squares.SETTINGS, total_variation=1e-6))
    assert usual < 0.7 * off()


def test_what_slices_of_a_single_stack_disagree_by_is_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """One slice in eight is far off. In a single stack that counts fully, with several stacks hardly at all."""
    asked: list[float] = []

    def for_noise(settings: VoxelProblemSettings, noise: float) -> VoxelProblemSettings:
        asked.append(noise)
        return settings

    monkeypatch.setattr(VoxelProblemSettings, "for_noise", for_noise)
    for n_stacks in (1, 3):
        made = noisy(volumes(0.0), 0.0, n_stacks)
        sign = np.random.default_rng(1).choice([-0.5, 0.5], made.slices.value.shape)
        value = made.slices.value + np.where(made.slices.planes.plane_id() % 8 == 3, sign, 0)
        off = replace(made, slices=replace(made.slices, value=value.astype(np.float32)))
        ones = np.ones(len(made.slices))
        least_squares_volume(off, made.foreground.support(), ones, ones)
    assert asked[0] > 2 * asked[1]
