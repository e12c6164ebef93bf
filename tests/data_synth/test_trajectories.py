"""Motion in time: recorded and modelled."""

from pathlib import Path

import numpy as np
import pytest

from data_synth.trajectories import JERK_DEG, QUIET_DEG, load_trajectories, modelled_trajectory, timed_trajectory
from g3r.errors import InputError
from g3r.geometry import RigidPose


def test_recorded_trajectories(tmp_path: Path, rng: np.random.Generator) -> None:
    angle, shift = rng.normal(0, 0.1, (30, 3)), rng.normal(0, 2, (30, 3))
    np.savez(tmp_path / "t.npz", rot_0=angle, trans_0=shift)
    (recorded,) = load_trajectories(tmp_path / "t.npz")
    assert recorded.rotation.shape == (30, 3, 3)
    pose = timed_trajectory(20, 7.0, 2, rng, [recorded])
    in_time = pose.translation_mm[[*range(0, 20, 2), *range(1, 20, 2)]]
    steps = np.diff(in_time, axis=0)
    assert any(np.allclose(steps, np.diff(shift[k : k + 20], axis=0)) for k in range(11))


def test_the_model_has_quiet_steps_and_jerks(rng: np.random.Generator) -> None:
    steps = []
    for _ in range(60):
        walk = modelled_trajectory(100, rng)
        turn = RigidPose(walk.rotation[1:] @ walk.rotation[:-1].transpose(0, 2, 1), np.zeros((99, 3)))
        steps.append(np.rad2deg(np.linalg.norm(turn.rotvec_rad(), axis=1)))
    size = np.concatenate(steps)
    assert np.median(size) == pytest.approx(1.6 * QUIET_DEG, rel=0.2)
    assert 0.03 < (size > JERK_DEG / 2).mean() < 0.1


@pytest.mark.parametrize("content", ["nothing", "not an npz", "no pair"])
def test_damaged_trajectories(tmp_path: Path, content: str) -> None:
    path = tmp_path / "t.npz"
    if content == "not an npz":
        path.write_text("hello")
    elif content == "no pair":
        np.savez(path, rot_0=np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"expected"):
        load_trajectories(path)
