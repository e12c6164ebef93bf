"""Both renderers against 3D quadrature of G3R Eq. 2, written here without their code; invariances; limits."""

from collections.abc import Iterator

import numba
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from g3r.acquisition.planes import Planes, volume_planes
from g3r.acquisition.psf import psf_variance_mm2
from g3r.errors import InputError
from g3r.gaussians import GaussianCloud, find_overlaps, render
from g3r.geometry import RigidPose, VolumeGrid


def make_cloud(seed: int, n: int, sigma=(0.8, 2.0), spread_mm=2.5, origin=(40.0, -30.0, 20.0)) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    return GaussianCloud(
        torch.tensor(rng.normal(0, spread_mm, (n, 3))),
        torch.tensor(np.log(rng.uniform(*sigma, (n, 3)))),
        torch.tensor(rng.normal(size=(n, 4))),
        torch.tensor(rng.uniform(-0.4, 1.0, n)),
        np.array(origin),
    )


def make_planes(seed: int, n: int = 3, shape=(7, 6), psf: float = 1.0, origin=(40.0, -30.0, 20.0)) -> Planes:
    rng = np.random.default_rng(seed)
    spacing = rng.uniform(0.7, 1.1, (n, 2))
    return Planes(
        rotation=Rotation.random(n, rng=rng).as_matrix(),
        center_mm=np.array(origin) + rng.normal(0, 1, (n, 3)),
        spacing_mm=spacing,
        shape=np.tile(shape, (n, 1)),
        psf_var_mm2=psf * psf_variance_mm2(spacing, rng.uniform(2, 4, n)),
    )


def single(cloud: GaussianCloud) -> GaussianCloud:
    return GaussianCloud(*(p.float() for p in cloud.parameters), cloud.origin_mm)


def volume_at(cloud: GaussianCloud, points_mm: np.ndarray) -> np.ndarray:
    """V(x) of Eq. 3 at points [P, 3]."""
    mean, log_scale, wxyz, amplitude = (p.double().numpy() for p in cloud.parameters)
    total = np.zeros(len(points_mm))
    for j in range(len(mean)):
        axes = Rotation.from_quat(np.roll(wxyz[j], -1)).as_matrix()
        white = (points_mm - cloud.origin_mm - mean[j]) @ axes / np.exp(log_scale[j])
        total += amplitude[j] * np.exp(-0.5 * (white**2).sum(1))
    return total


def quadrature(cloud: GaussianCloud, planes: Planes) -> np.ndarray:
    """Eq. 2: each pixel as the integral of PSF times V on a dense product grid out to 6.5 sigma.

    Equidistant nodes converge exponentially for products of Gaussians: with nodes half the narrowest sigma of
    the product apart the error is exp(-2 pi^2 4), beyond double precision; the tails hold 1e-10.
    """
    sigma_cloud = float(cloud.log_scale.exp().min())
    pixels = []
    for k in range(len(planes)):
        axes = []
        for variance in planes.psf_var_mm2[k]:
            sigma = np.sqrt(variance)
            step = 0.5 / np.hypot(1 / sigma, 1 / sigma_cloud)
            nodes = np.arange(-np.ceil(6.5 * sigma / step), np.ceil(6.5 * sigma / step) + 1) * step
            weight = np.exp(-0.5 * nodes**2 / variance) * step / np.sqrt(2 * np.pi * variance)
            axes.append((nodes, weight))
        nodes = np.stack(np.meshgrid(*[a[0] for a in axes], indexing="ij"), -1).reshape(-1, 3)
        weight = np.einsum("i,j,k->ijk", *[a[1] for a in axes]).ravel()
        n_x, n_y = planes.shape[k]
        for i in range(n_x):
            for j in range(n_y):
                u = [(i - (n_x - 1) / 2) * planes.spacing_mm[k, 0], (j - (n_y - 1) / 2) * planes.spacing_mm[k, 1], 0.0]
                points = (nodes + u) @ planes.rotation[k].T + planes.center_mm[k]
                pixels.append(weight @ volume_at(cloud, points))
    return np.array(pixels)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_backends_agree_with_quadrature(seed: int):
    cloud, planes = make_cloud(seed, 4), make_planes(seed + 10, n=2, shape=(4, 3))
    expected = quadrature(cloud, planes)
    scale = np.abs(expected).max()
    reference = render(cloud, planes, backend="reference").numpy()
    assert np.abs(reference - expected).max() < 1e-6 * scale
    found = render(single(cloud), planes, cutoff_sigma=6.0).numpy()
    # float32 parameters and sums, polynomial exponential 2e-7, cut-off exp(-18) = 1.5e-8 per Gaussian
    assert np.abs(found - expected).max() < 3e-6 * scale
    default = render(single(cloud), planes).numpy()
    assert np.abs(default - expected).max() < 0.006 * float(cloud.amplitude.abs().sum())


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_the_printed_amplitude_is_off_by_the_factor_of_the_design(backend: str):
    """0.53 at sigma 1 mm, 0.8 mm pixels, 3 mm slices; quadrature sides with the exact form."""
    one = GaussianCloud(
        torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1), np.zeros(3)
    )
    planes = Planes(
        rotation=np.eye(3)[None],
        center_mm=np.zeros((1, 3)),
        spacing_mm=[[0.8, 0.8]],
        shape=[[1, 1]],
        psf_var_mm2=psf_variance_mm2([[0.8, 0.8]], np.array([3.0])),
    )
    exact = render(one, planes, backend=backend).item()
    printed = render(one, planes, backend=backend, attenuation="printed").item()
    assert exact / printed == pytest.approx(0.5295, abs=2e-4)
    assert quadrature(one, planes)[0] == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_without_psf_a_plane_samples_the_volume(backend: str):
    cloud, planes = make_cloud(3, 8), make_planes(3, psf=0.0, shape=(20, 15))
    expected = volume_at(cloud, planes.pixel_world_mm())
    if backend == "reference":
        np.testing.assert_allclose(render(cloud, planes, backend=backend), expected, rtol=0, atol=1e-12)
    else:
        found = render(single(cloud), planes, cutoff_sigma=6.0).numpy()
        assert np.abs(found - expected).max() < 3e-6 * np.abs(expected).max()


def test_a_volume_is_its_planes():
    cloud = make_cloud(4, 8)
    affine = np.diag([-1.0, 1.2, 0.9, 1])
    affine[:3, 3] = cloud.origin_mm + np.array([4, -5, -4])
    grid = VolumeGrid((9, 8, 7), affine)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    expected = volume_at(cloud, grid.world(index).transpose(2, 0, 1, 3).reshape(-1, 3))
    np.testing.assert_allclose(render(cloud, volume_planes(grid), backend="reference"), expected, atol=1e-12)


# -- invariances -----------------------------------------------------------------------------------


def images(cloud: GaussianCloud, planes: Planes) -> Iterator[tuple[np.ndarray, float]]:
    """Pixels of each backend and the tolerance that its arithmetic allows."""
    yield render(cloud, planes, backend="reference").numpy(), 1e-12
    yield render(single(cloud), planes, cutoff_sigma=6.0).numpy(), 3e-6


def assert_same_images(a: tuple[GaussianCloud, Planes], b: tuple[GaussianCloud, Planes]):
    for (first, tolerance), (second, _) in zip(images(*a), images(*b), strict=True):
        assert np.abs(first - second).max() < tolerance * max(1.0, np.abs(first).max())


def test_moving_the_whole_world_changes_nothing():
    cloud, planes = make_cloud(5, 10), make_planes(5)
    motion = RigidPose.from_rotvec([[0.7, -1.1, 0.4]], [[12.0, -30, 8]])
    turn = Rotation.from_matrix(motion.rotation[0])
    wxyz = cloud.quaternion_wxyz.numpy()
    turned = (turn * Rotation.from_quat(np.roll(wxyz, -1, axis=1))).as_quat()
    moved = GaussianCloud(
        torch.tensor(turn.apply(cloud.mean_mm.numpy())),
        cloud.log_scale,
        torch.tensor(np.roll(turned, 1, axis=1)),
        cloud.amplitude,
        motion.apply(cloud.origin_mm[None, None])[0, 0],
    )
    assert_same_images((cloud, planes), (moved, planes.moved(motion)))


def test_the_order_of_gaussians_does_not_matter():
    cloud, planes = make_cloud(6, 30), make_planes(6)
    assert_same_images(
        (cloud, planes), (cloud.take(torch.randperm(30, generator=torch.Generator().manual_seed(0))), planes)
    )


def test_q_and_minus_q_and_their_length_do_not_matter():
    cloud, planes = make_cloud(7, 10), make_planes(7)
    for factor in (-1.0, 3.7, -1e-3):
        other = GaussianCloud(
            cloud.mean_mm, cloud.log_scale, factor * cloud.quaternion_wxyz, cloud.amplitude, cloud.origin_mm
        )
        assert_same_images((cloud, planes), (other, planes))


def test_the_origin_is_only_a_number():
    cloud, planes = make_cloud(8, 10), make_planes(8)
    other = GaussianCloud(cloud.mean_mm + 3.0, *cloud.parameters[1:], cloud.origin_mm - 3.0)
    assert_same_images((cloud, planes), (other, planes))


def test_ten_metres_from_the_origin_no_digit_is_lost():
    near, far = np.zeros(3), np.array([1e4, -1e4, 1e4])
    cloud, planes = make_cloud(9, 10, origin=near), make_planes(9, origin=near)
    away = GaussianCloud(*cloud.parameters, far)
    moved = Planes(
        rotation=planes.rotation,
        center_mm=planes.center_mm + far,
        spacing_mm=planes.spacing_mm,
        shape=planes.shape,
        psf_var_mm2=planes.psf_var_mm2,
    )
    for (first, _), (second, _) in zip(images(cloud, planes), images(away, moved), strict=True):
        assert np.abs(first - second).max() < 1e-6 * np.abs(first).max()


def test_intensities_scale_with_the_peaks():
    cloud, planes = single(make_cloud(10, 10)), make_planes(10)
    plain = render(cloud, planes)
    for factor in (1e-6, 1e6, -1.0):
        torch.testing.assert_close(
            render(cloud.with_amplitude(cloud.amplitude * factor), planes),
            plain * factor,
            rtol=2e-5,
            atol=1e-6 * abs(factor),
        )


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_gain_and_twist_are_what_they_say(backend: str):
    cloud, planes = make_cloud(11, 10), make_planes(11)
    cloud = cloud if backend == "reference" else single(cloud)
    rng = np.random.default_rng(11)
    twist = rng.normal(0, 0.3, (len(planes), 6))
    gain = rng.uniform(0.5, 2, len(planes))
    turned = planes.rotation @ Rotation.from_rotvec(twist[:, :3]).as_matrix()
    by_hand = planes.with_pose(RigidPose(turned, planes.center_mm + twist[:, 3:]))
    expected = render(cloud, by_hand, backend=backend).numpy() * np.repeat(gain, np.diff(planes.offset))
    found = render(
        cloud,
        planes,
        backend=backend,
        twist=torch.tensor(twist, dtype=cloud.amplitude.dtype),
        log_gain=torch.tensor(np.log(gain), dtype=cloud.amplitude.dtype),
    )
    assert np.abs(found.numpy() - expected).max() < (1e-12 if backend == "reference" else 2e-5)


# -- small and empty scenes ------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_no_gaussian_renders_zero(backend: str):
    cloud, planes = single(make_cloud(12, 0)), make_planes(12)
    pixels = render(cloud, planes, backend=backend)
    assert pixels.shape == (planes.n_pixels,)
    assert (pixels == 0).all()


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_no_plane_renders_nothing(backend: str):
    assert render(single(make_cloud(13, 3)), make_planes(13).take([]), backend=backend).shape == (0,)


def test_one_gaussian_and_one_pixel():
    cloud, planes = make_cloud(14, 1), make_planes(14, n=1, shape=(1, 1))
    assert_same_images((cloud, planes), (cloud, planes))
    assert render(cloud, planes, backend="reference").item() == pytest.approx(quadrature(cloud, planes)[0], rel=1e-8)


def test_planes_that_meet_no_gaussian_are_zero_and_the_others_unharmed():
    cloud, planes = single(make_cloud(15, 10)), make_planes(15)
    away = planes.moved(RigidPose.from_rotvec([[0.0, 0, 0]], [[500.0, 0, 0]]))
    both = Planes(**{f: np.concatenate([getattr(p, f) for p in (away, planes)]) for f in planes.__dataclass_fields__})
    pixels = render(cloud, both)
    assert (pixels[: away.n_pixels] == 0).all()
    torch.testing.assert_close(pixels[away.n_pixels :], render(cloud, planes), rtol=1e-6, atol=1e-7)
    assert len(find_overlaps(cloud, away, 3.2)) == 0


@pytest.mark.parametrize("log_scale", [[-3.9, -3.9, -3.9], [4.6, 4.6, 4.6], [-3.5, 3.4, 0.0]])
@pytest.mark.parametrize("psf", [0.0, 1.0])
def test_extreme_shapes_agree_with_the_reference_and_have_finite_gradients(log_scale: list[float], psf: float):
    """Sigma 0.02 and 100 mm, and an axis ratio of 1000."""
    base, planes = make_cloud(16, 5, spread_mm=0.2), make_planes(16, psf=psf, shape=(15, 15))
    cloud = GaussianCloud(base.mean_mm, torch.tensor([log_scale] * 5).double(), *base.parameters[2:], base.origin_mm)
    expected = render(cloud, planes, backend="reference")
    leaves = [p.float().requires_grad_() for p in cloud.parameters]
    twist = torch.zeros(len(planes), 6, requires_grad=True)
    found = render(GaussianCloud(*leaves, cloud.origin_mm), planes, twist=twist, cutoff_sigma=6.0)
    # means in float32 are off by 1e-8 mm, over sigma 0.02 a relative 1e-6 times the distance in sigmas
    assert (found.detach() - expected).abs().max() < 1e-4 * max(1e-6, float(expected.abs().max()))
    found.square().sum().backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in (*leaves, twist))


def test_large_and_slanted_ellipses_of_several_strips_agree_with_the_reference():
    """Planes many times as wide as the sixteen pixels of a strip, cut by every border."""
    base = make_cloud(24, 12, spread_mm=15)
    rng = np.random.default_rng(24)
    cloud = GaussianCloud(
        base.mean_mm,
        torch.tensor(np.log(rng.uniform([0.3, 1, 4], [1, 4, 15], (12, 3)))),
        *base.parameters[2:],
        base.origin_mm,
    )
    for psf in (0.0, 1.0):
        planes = make_planes(24, n=4, shape=(70, 61), psf=psf)
        expected = render(cloud, planes, backend="reference").numpy()
        found = render(single(cloud), planes, cutoff_sigma=6.0).numpy()
        assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


# -- cut-off, pair lists, threads ------------------------------------------------------------------


@pytest.mark.parametrize("cutoff", [2.0, 3.2, 4.5])
def test_the_cut_off_bounds_the_error(cutoff: float):
    """A pixel misses of each Gaussian at most its observed height times exp(-cutoff^2 / 2)."""
    cloud, planes = make_cloud(17, 20), make_planes(17, shape=(25, 25))
    exact = render(cloud, planes, backend="reference").numpy()
    found = render(single(cloud), planes, cutoff_sigma=cutoff).numpy()
    heights = render(cloud.with_amplitude(cloud.amplitude.abs()), planes, backend="reference")
    assert heights.min() >= 0
    bound = float(cloud.amplitude.abs().sum()) * np.exp(-0.5 * cutoff**2) + 1e-6
    error = np.abs(found - exact).max()
    assert error < bound
    assert error > 1e-4 * bound  # it does cut


def test_pair_lists_with_a_margin_give_the_same_pixels_and_stay_valid():
    cloud, planes = single(make_cloud(18, 60, spread_mm=8)), make_planes(18, shape=(12, 12))
    tight, wide = find_overlaps(cloud, planes, 3.2), find_overlaps(cloud, planes, 4.2)
    assert len(tight) < len(wide)
    assert (np.diff(wide.start) >= np.diff(tight.start)).all()
    plain = render(cloud, planes)
    assert torch.equal(render(cloud, planes, pairs=tight), plain)
    assert torch.equal(render(cloud, planes, pairs=wide), plain)
    moved = GaussianCloud(cloud.mean_mm + 0.3, *cloud.parameters[1:], cloud.origin_mm)
    assert torch.equal(render(moved, planes, pairs=wide), render(moved, planes))


def test_two_thread_counts_agree():
    most = numba.config.NUMBA_NUM_THREADS
    if most < 2:
        pytest.skip("numba was started with one thread")
    cloud, planes = make_cloud(19, 200, spread_mm=6), make_planes(19, n=9, shape=(20, 20))
    before, results = numba.get_num_threads(), []
    try:
        for n_threads in (1, 2):
            numba.set_num_threads(n_threads)
            leaves = [p.float().requires_grad_() for p in cloud.parameters]
            pixels = render(GaussianCloud(*leaves, cloud.origin_mm), planes)
            pixels.square().sum().backward()
            results.append([pixels.detach(), *(leaf.grad for leaf in leaves)])
    finally:
        numba.set_num_threads(before)
    for one, two in zip(*results, strict=True):
        assert (one - two).norm() <= 1e-5 * one.norm()


@pytest.mark.parametrize(
    "options",
    [
        {"backend": "cuda"},
        {"attenuation": "wrong"},
        {"cutoff_sigma": 0.0},
        {"cutoff_sigma": 6.5},
        {"cutoff_sigma": float("nan")},
    ],
)
def test_unknown_options_are_refused(options):
    with pytest.raises(ValueError, match="expected"):
        render(single(make_cloud(20, 2)), make_planes(20), **options)


# -- the record ------------------------------------------------------------------------------------


def test_save_and_load(tmp_path):
    cloud = single(make_cloud(21, 12, origin=(1e4 + 1e-7, 0, -3)))
    cloud.save(tmp_path / "cloud.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.npz"]
    back = GaussianCloud.load(tmp_path / "cloud.npz")
    assert all(torch.equal(a, b) for a, b in zip(cloud.parameters, back.parameters, strict=True))
    np.testing.assert_array_equal(back.origin_mm, cloud.origin_mm)
    assert all(p.dtype == torch.float32 for p in back.parameters)


@pytest.mark.parametrize("kind", ["missing", "text", "cut off", "array", "other npz"])
def test_what_is_no_cloud_is_refused(tmp_path, kind: str):
    path = tmp_path / "cloud.npz"
    if kind == "text":
        path.write_text("hello")
    elif kind == "cut off":
        single(make_cloud(22, 50)).save(path)
        path.write_bytes(path.read_bytes()[:700])
    elif kind == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "other npz":
        np.savez(path, mean_mm=np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"cloud\.npz: not a cloud"):
        GaussianCloud.load(path)


def test_shapes_that_do_not_belong_together_are_refused():
    cloud = make_cloud(23, 3)
    with pytest.raises(ValueError, match="amplitude has shape"):
        cloud.with_amplitude(torch.zeros(2))
