"""Pose inference: invariances of the predictions, and robust motions of stacks."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Slices
from g3r.acquisition.slice_images import slice_images
from g3r.acquisition.slicing import slices_from_stacks
from g3r.acquisition.stacks import Stack
from g3r.geometry import RigidPose
from g3r.pose_network.config import PoseNetworkConfig
from g3r.pose_network.inference import VIEWS, mean_pose, poses_of, slice_batch
from g3r.pose_network.model import PoseModel
from g3r.pose_network.network import PoseNetwork
from g3r.training.pose_scores import pose_errors, stack_motions

SHAPE = (2, 9, 9, 9)


@pytest.fixture(scope="module")
def network() -> PoseNetwork:
    torch.manual_seed(3)
    network = PoseNetwork(PoseNetworkConfig(channels=(4, 8, 8), width=32, n_blocks=2, n_heads=2)).eval()
    for part in (network.transformer, network.refining_transformer):
        torch.nn.init.normal_(part.vote.weight, std=0.3)
    network.set_template(torch.rand(SHAPE))
    return network


@pytest.fixture(scope="module")
def model(network: PoseNetwork) -> PoseModel:
    return PoseModel(network=network, weeks=(25.0, 31.0), training_data="nothing")


def blob_stack(rotation: np.ndarray, seed: int, shape: tuple[int, int, int] = (50, 46, 12)) -> Stack:
    """A stack of an egg with a bright spot, rotated in the scanner."""
    rng = np.random.default_rng(seed)
    affine = np.eye(4)
    affine[:3, :3] = rotation * [1.2, 1.2, 4.0]
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    world = index @ affine[:3, :3].T + affine[:3, 3]
    mask = ((world / [22, 26, 18]) ** 2).sum(-1) < 1
    spot = np.exp(-((world - [8, 10, 5]) ** 2).sum(-1) / 50)
    image = (1 + spot + 0.02 * rng.standard_normal(shape)).astype(np.float32)
    return Stack(image=image, mask=mask, affine=affine, thickness_mm=4.0, name=f"stack-{seed}")


@pytest.fixture(scope="module")
def slices() -> Slices:
    turns = Rotation.random(3, random_state=1).as_matrix()
    return slices_from_stacks([blob_stack(turn, seed) for seed, turn in enumerate(turns)])


def moved_headers(slices: Slices, motion: RigidPose) -> Slices:
    header = motion @ slices.header_pose
    return Slices(
        planes=slices.planes.with_pose(header),
        value=slices.value,
        mask=slices.mask,
        stack_id=slices.stack_id,
        slice_index=slices.slice_index,
        thickness_mm=slices.thickness_mm,
        header_pose=header,
    )


def assert_same(one: RigidPose, other: RigidPose, tolerance_mm: float) -> None:
    distance_mm, _ = pose_errors(one, other)
    assert distance_mm.max() < tolerance_mm


@pytest.mark.parametrize("angle_deg", [(0, 0, 90), (180, 0, 0), (20, -50, 130)])
def test_moving_all_headers_changes_nothing(model: PoseModel, slices: Slices, angle_deg: tuple[int, int, int]) -> None:
    motion = RigidPose.from_rotvec(np.deg2rad([angle_deg]), np.array([[30.0, -200.0, 7.0]]))
    before = model.predict(slices)
    assert len(before) == len(slices)
    assert_same(before, model.predict(moved_headers(slices, motion)), 1e-3)


def test_present_poses_do_not_matter(model: PoseModel, slices: Slices) -> None:
    other = slices.with_pose(RigidPose.identity(len(slices)))
    assert_same(model.predict(slices), model.predict(other), 1e-6)


def test_the_order_does_not_matter(model: PoseModel, slices: Slices) -> None:
    order = np.random.default_rng(0).permutation(len(slices))
    before = model.predict(slices).take(order)
    assert_same(before, model.predict(slices.take(order)), 1e-2)  # sums in a different order


def test_numbers_of_stacks_do_not_matter(model: PoseModel, slices: Slices) -> None:
    renamed = Slices(
        planes=slices.planes,
        value=slices.value,
        mask=slices.mask,
        stack_id=7 - 2 * slices.stack_id,
        slice_index=slices.slice_index,
        thickness_mm=slices.thickness_mm,
        header_pose=slices.header_pose,
    )
    assert_same(model.predict(slices), model.predict(renamed), 1e-3)


def test_cropping_does_not_matter(model: PoseModel, slices: Slices) -> None:
    """The pose refers to the slice's own frame, wherever its centre lies in the cropped image."""
    planes = slices.planes
    parts = [slice(*planes.offset[k : k + 2]) for k in range(len(slices))]
    width = planes.shape[:, 1]

    def padded(values: np.ndarray) -> np.ndarray:
        blank = [np.zeros(2 * n, values.dtype) for n in width]  # two rows more on one side, not in the mask
        return np.concatenate([np.concatenate([values[at], b]) for at, b in zip(parts, blank, strict=True)])

    translation_mm = np.stack([planes.spacing_mm[:, 0], 0 * width, 0 * width], 1)
    frame = RigidPose.from_rotvec(np.zeros((len(slices), 3)), translation_mm)
    header = slices.header_pose @ frame
    wider = dataclasses.replace(planes, shape=planes.shape + np.array([2, 0])).with_pose(header)
    other = dataclasses.replace(
        slices, planes=wider, value=padded(slices.value), mask=padded(slices.mask), header_pose=header
    )
    assert_same(model.predict(slices) @ frame, model.predict(other), 1e-3)


@pytest.mark.parametrize("view", VIEWS)
def test_a_slice_turned_over_is_the_same_slice(
    network: PoseNetwork, slices: Slices, view: tuple[int, int, int]
) -> None:
    """Flipped axes of a slice with the same pixels give the same place."""
    images = slice_images(slices, 3.0, 40)
    flips = tuple(slice(None, None, sign) for sign in view[:2])
    turned = dataclasses.replace(
        images,
        image=np.ascontiguousarray(images.image[:, flips[0], flips[1]]),
        position_mm=images.position_mm * view[2],
        header_rotation=images.header_rotation * np.array(view),
    )
    one, other = (poses_of(network, slice_batch([some])) for some in (images, turned))
    turn = RigidPose(np.broadcast_to(np.diag(view), (len(slices), 3, 3)), np.zeros((len(slices), 3)))
    assert_same(one @ turn, other, 1e-2)


def test_mean_pose_leaves_one_wrong_view_aside(rng: np.random.Generator) -> None:
    true = RigidPose(Rotation.random(7, random_state=0).as_matrix(), rng.normal(0, 20, (7, 3)))
    views = [RigidPose.from_rotvec(rng.normal(0, 0.02, (7, 3)), rng.normal(0, 0.5, (7, 3))) @ true for _ in range(3)]
    wrong = RigidPose.from_rotvec(np.full((7, 3), [0, 0, 2.5]), np.full((7, 3), 9.0)) @ true
    mean = mean_pose(
        np.stack([p.rotation for p in (*views, wrong)]), np.stack([p.translation_mm for p in (*views, wrong)])
    )
    _, angle_deg = pose_errors(mean, true)
    assert angle_deg.max() < 8


def test_scale_of_intensities_does_not_matter(model: PoseModel, slices: Slices) -> None:
    assert_same(model.predict(slices), model.predict(slices.scaled(1000.0)), 0.01)


def test_a_single_slice(model: PoseModel, slices: Slices) -> None:
    assert len(model.predict(slices.take([4]))) == 1


def test_time_is_used_if_known(network: PoseNetwork, slices: Slices) -> None:
    """In training the order of acquisition is known for some stacks only."""
    images = slice_images(slices, 3.0, 40)
    known = dataclasses.replace(images, time_rank=np.linspace(0, 1, len(slices)))
    with_time, without = (poses_of(network, slice_batch([some])) for some in (known, images))
    distance_mm, _ = pose_errors(with_time, without)
    assert distance_mm.max() > 1e-3


def test_stack_motions_ignore_a_minority(rng: np.random.Generator) -> None:
    stack_id = np.repeat([0, 1], 12)
    header = RigidPose(Rotation.random(2, random_state=2).as_matrix()[stack_id], rng.normal(0, 20, (24, 3)))
    motion = RigidPose(Rotation.random(2, random_state=3).as_matrix(), rng.normal(0, 30, (2, 3)))
    noise = RigidPose.from_rotvec(rng.normal(0, 0.02, (24, 3)), rng.normal(0, 0.5, (24, 3)))
    predicted = noise @ motion.take(stack_id) @ header
    wrong = np.array([1, 4, 7, 10, 13, 16, 19])  # upside down
    flipped = RigidPose.from_rotvec(np.full((7, 3), [np.pi, 0, 0]), np.zeros((7, 3)))
    rotation, shift = predicted.rotation.copy(), predicted.translation_mm.copy()
    rotation[wrong] = (flipped @ predicted.take(wrong)).rotation
    shift[wrong] = (flipped @ predicted.take(wrong)).translation_mm
    fitted = stack_motions(RigidPose(rotation, shift), header, stack_id)
    _, angle_deg = pose_errors(fitted, motion)
    assert angle_deg.max() < 2.0


def test_pose_errors() -> None:
    pose = RigidPose.from_rotvec(np.zeros((2, 3)), np.zeros((2, 3)))
    other = RigidPose.from_rotvec([[0, 0, 0.1], [0.0, 0, 0]], [[0, 0, 0], [3, 4, 0]])
    distance_mm, angle_deg = pose_errors(pose, other)
    np.testing.assert_allclose(distance_mm, [0.8 * 25 * np.sqrt(2) * 2 * np.sin(0.05), 5.0], rtol=1e-6)
    np.testing.assert_allclose(angle_deg, [np.rad2deg(0.1), 0.0], atol=1e-9)


def test_inference_needs_no_training_packages() -> None:
    code = (
        "import sys, g3r.pose_network.inference, g3r.pose_network.network, g3r.pose_network.model\n"
        "assert not {'lightning', 'torchio', 'pytorch_lightning'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
