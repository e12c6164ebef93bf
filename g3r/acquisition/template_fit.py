"""An atlas template fitted to the seen part of a head: the anatomy to expect where no slice looked.

An affine map and a coarse smooth deformation (a cubic B-spline lattice, Rueckert et al. 1999) bring the template to
the seen voxels; where nothing was seen, the deformation continues smoothly. The template's intensities are mapped by a
polynomial without constant term, so that the background stays zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from g3r.acquisition.atlas_template import PlacedHead
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.run.on_demand import torch

if TYPE_CHECKING:
    from torch import Tensor

WORKING_VOXEL_MM = 3.0
"""Voxels in which template and head are compared."""

BLUR_VOXELS = 0.4
"""Standard deviation, in working voxels, of the blur of both before they are compared."""

LATTICE_MM = 13.0
"""Distance of the control points of the deformation."""

AFFINE_STEPS, DEFORMATION_STEPS = 15, 35
STEP_MM = 0.8
"""First step of Adam, in mm at the rim of a head; it falls to a tenth."""

HEAD_RADIUS_MM = 45.0
"""Scales the affine map's entries to displacements at the rim."""

BENDING = 0.02
"""Weight of squared second differences of the control points, in units of their distance."""

OUTLINE = 0.3
"""Weight of the difference of outlines next to that of intensities, which are of order one."""


@dataclass(frozen=True, kw_only=True)
class TemplateFit:
    """A template as it fits a head, on the head's grid.

    Attributes:
        values: [I, J, K] float32 in the head's intensities, zero outside the template.
        inside: [I, J, K] float32 in [0, 1], share of brain.
        loss: weighted mean square difference of intensities and outlines at the end.
    """

    values: NDArray[np.float32]
    inside: NDArray[np.float32]
    loss: float


def fit_template(
    template: PlacedHead,
    head: NDArray[np.float32],
    share: NDArray[np.float32],
    density: NDArray[np.float32],
    grid: VolumeGrid,
    n_steps: tuple[int, int] = (AFFINE_STEPS, DEFORMATION_STEPS),
) -> TemplateFit:
    """A template brought to the seen part of a head by an affine map and a smooth deformation.

    Args:
        template: placed roughly on the head.
        head: [I, J, K] V_coarse or V_sharp, normalised (bright tissue is of order 1).
        share: [I, J, K] of brain in [0, 1], see `brain_share`.
        density: [I, J, K] M_rho, the weight of each voxel up to 1; 0 where no slice looked.
        grid: of the last three and of the result.
        n_steps: of the affine map alone, and of affine map and deformation.
    """
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # steps are so small that more threads wait for each other longer than they work
    try:
        with torch.inference_mode(False), torch.enable_grad():
            return _fitted(template, head * share, share, np.minimum(density, 1), grid, n_steps)
    finally:
        torch.set_num_threads(n_threads)


def _fitted(
    template: PlacedHead,
    head: NDArray[np.float32],
    share: NDArray[np.float32],
    seen: NDArray[np.float32],
    grid: VolumeGrid,
    n_steps: tuple[int, int],
) -> TemplateFit:
    working = grid.respaced(WORKING_VOXEL_MM)
    # means over seen voxels alone: the zeros of unseen ones are no evidence
    weight = _reduced(seen, grid, working)
    observed, outline = (_reduced(one * seen, grid, working) / weight.clamp_min(1e-3) for one in (head, share))
    weight = weight.clamp(0, 1)
    sharp = [template.volume, (template.volume > 0).astype(np.float32)]
    sigma = BLUR_VOXELS * WORKING_VOXEL_MM / template.grid.spacing_mm
    pair = torch.from_numpy(np.stack([gaussian_filter(one, sigma) for one in sharp]))[None]
    deformation = _Deformation(working, template.grid)
    affine_steps, total = n_steps[0], sum(n_steps)
    adams = [_Adam(deformation.affine)]
    loss = torch.zeros(())
    colour = torch.zeros(2)
    for step in range(total):
        if step == affine_steps:
            adams.append(_Adam(deformation.control))
        warped, inside = deformation.sample(pair)
        colour = _colour(warped.detach(), observed, weight * outline)
        difference = _coloured(warped, colour) - observed
        mismatch = (weight * (difference**2 + OUTLINE * (inside - outline) ** 2)).sum() / weight.sum().clamp_min(1e-6)
        loss = mismatch + BENDING * deformation.bending()
        loss.backward()
        for adam in adams:
            adam.step(STEP_MM * 0.1 ** (step / max(total - 1, 1)))
        deformation.control.grad = None
    with torch.no_grad():
        warped, inside = deformation.on(grid).sample(torch.from_numpy(np.stack(sharp))[None])
        values = _coloured(warped, colour).clamp_min(0)
    return TemplateFit(values=values.numpy(), inside=inside.numpy(), loss=float(mismatch.detach()))


class _Adam:
    """Adam (Kingma & Ba, ICLR 2015) for one tensor; that of `torch.optim` loads 70 MB of compilers first."""

    def __init__(self, leaf: Tensor) -> None:
        self.leaf, self.n_steps = leaf, 0
        self.mean, self.square = torch.zeros_like(leaf), torch.zeros_like(leaf)

    def step(self, size: float) -> None:
        """Move against the gradient, and clear it."""
        gradient = self.leaf.grad
        assert gradient is not None
        self.leaf.grad = None
        self.n_steps += 1
        self.mean.lerp_(gradient, 0.1)
        self.square.mul_(0.999).addcmul_(gradient, gradient, value=0.001)
        scale = (self.square / (1 - 0.999**self.n_steps)).sqrt_().add_(1e-8)
        with torch.no_grad():
            self.leaf.addcdiv_(self.mean, scale, value=-size / (1 - 0.9**self.n_steps))


class _Deformation:
    """World positions of a grid's voxels in the template, as a function of affine map and control points."""

    def __init__(self, grid: VolumeGrid, template_grid: VolumeGrid, shared: _Deformation | None = None) -> None:
        self.template_grid = template_grid
        axes = [np.arange(n) for n in grid.shape]
        origin, spacing = grid.affine[:3, 3], np.diag(grid.affine)[:3]
        place = [o + s * a for o, s, a in zip(origin, spacing, axes, strict=True)]
        if shared is None:
            self.low = np.array([p.min() for p in place])
            high = np.array([p.max() for p in place])
            self.center = (self.low + high) / 2
            self.n_spans = np.maximum(np.ceil((high - self.low) / LATTICE_MM).astype(int), 1)
            self.affine = torch.zeros(3, 4, requires_grad=True)
            shape = (3, *[int(n) + 3 for n in self.n_spans])
            self.control = torch.zeros(shape, requires_grad=True)
        else:
            self.low, self.center, self.n_spans = shared.low, shared.center, shared.n_spans
            self.affine, self.control = shared.affine, shared.control
        self.basis = [
            torch.from_numpy(_cubic_basis((p - low) / LATTICE_MM, int(n)).astype(np.float32))
            for p, low, n in zip(place, self.low, self.n_spans, strict=True)
        ]
        self.place = [torch.from_numpy((p - c).astype(np.float32)) for p, c in zip(place, self.center, strict=True)]

    def on(self, grid: VolumeGrid) -> _Deformation:
        """The same map at the voxels of another grid."""
        return _Deformation(grid, self.template_grid, shared=self)

    def bending(self) -> Tensor:
        """Mean squared second difference of the control points, relative to their distance."""
        total = torch.zeros(())
        for axis in range(1, 4):
            if self.control.shape[axis] > 2:
                total = total + (torch.diff(self.control, n=2, dim=axis) ** 2).mean()
        return total / LATTICE_MM

    def sample(self, pair: Tensor) -> tuple[Tensor, Tensor]:
        """Template intensity and mask [I, J, K] at the voxels."""
        x, y, z = self.place
        linear, shift = self.affine[:, :3] / HEAD_RADIUS_MM, self.affine[:, 3]
        moved = torch.einsum("cabd,ia,jb,kd->cijk", self.control, *self.basis)
        grids = torch.meshgrid(x, y, z, indexing="ij")
        index_from_world = self.template_grid.index_from_world
        world = [
            grids[c] + float(self.center[c]) + shift[c] + moved[c] + sum(linear[c, d] * grids[d] for d in range(3))
            for c in range(3)
        ]
        coordinates: list[Tensor] = []
        for axis in reversed(range(3)):
            a, b, c, offset = (float(one) for one in index_from_world[axis])
            at = a * world[0] + b * world[1] + c * world[2] + offset
            coordinates.append(2 * at / (self.template_grid.shape[axis] - 1) - 1)
        where = torch.stack(coordinates, dim=-1)[None]
        found = torch.nn.functional.grid_sample(pair, where, mode="bilinear", padding_mode="zeros", align_corners=True)
        return found[0, 0], found[0, 1]


def _cubic_basis(position: NDArray[np.float64], n_spans: int) -> NDArray[np.float64]:
    """Values [n, n_spans + 3] of the uniform cubic B-splines at positions in units of their distance."""
    from scipy.interpolate import BSpline  # the import takes a tenth of a second, and a preview fits no template

    knots = np.arange(-3, n_spans + 4, dtype=np.float64)
    inside = np.clip(position, 0, n_spans * (1 - 1e-12))
    return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray())


def _reduced(volume: NDArray[np.float32], grid: VolumeGrid, coarse: VolumeGrid) -> Tensor:
    """A volume on coarser voxels, averaged over about one of them."""
    sigma = BLUR_VOXELS * coarse.spacing_mm / grid.spacing_mm
    found = on_grid(gaussian_filter(volume, sigma), grid, coarse, outside=0.0)
    # the filter's tails are denormal numbers, on which a CPU takes a hundred times as long
    found[np.abs(found) < 1e-6] = 0
    return torch.from_numpy(found)


def _colour(template: Tensor, observed: Tensor, weight: Tensor) -> Tensor:
    """Coefficients of t and t^2 that bring the template's intensities to those observed, by least squares."""
    terms = torch.stack([template, template**2]).reshape(2, -1).double()
    weighted = terms * weight.reshape(-1)
    normal = weighted @ terms.T
    right = weighted @ observed.reshape(-1).double()
    damped = normal + 1e-3 * torch.diag(torch.diag(normal)) + 1e-9 * torch.eye(2, dtype=torch.float64)
    return torch.linalg.solve(damped, right).float()


def _coloured(template: Tensor, colour: Tensor) -> Tensor:
    return colour[0] * template + colour[1] * template**2
