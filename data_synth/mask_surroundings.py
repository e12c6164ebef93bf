"""Surroundings of a fetal head: the mother and the fetal body as random labelled shapes on a coarse grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.mask_labels import Tissue
from data_synth.noise import lattice_noise

Array = NDArray[np.float64]

SPACING_MM = 2.5
HALF_MM = 190.0
"""Half the edge of the cube that holds the surroundings."""
INNER = (Tissue.FETAL_BODY, Tissue.LIVER, Tissue.LUNG, Tissue.FETAL_FLUID, Tissue.BONE)
ORGANS = (Tissue.ORGAN_A, Tissue.ORGAN_B, Tissue.ORGAN_C, Tissue.ORGAN_D, Tissue.FAT, Tissue.MUSCLE)


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """The mother and the rest of the fetus.

    Args:
        labels: [N, N, N] uint8 of `Tissue`.
        texture: [N, N, N] float32 noise of unit variance.
        affine: [4, 4] the head's frame (mm) from index.
        trunk_mm: [3] centre of the fetal trunk.
    """

    labels: NDArray[np.uint8]
    texture: NDArray[np.float32]
    affine: Array
    trunk_mm: Array


class _Canvas:
    """A cube of labels to paint shapes into."""

    def __init__(self, centre_mm: Array, rng: np.random.Generator) -> None:
        n = int(2 * HALF_MM / SPACING_MM)
        self.labels = np.zeros((n, n, n), np.uint8)
        self.first_mm = centre_mm - HALF_MM
        self.rng = rng
        self.noise = lattice_noise(self.labels.shape, 9.0, rng) + 0.5 * lattice_noise(self.labels.shape, 4.0, rng)

    def ellipsoid(self, centre: Array, radius: Array, turn: Array, rough: float = 0.0) -> tuple:
        """The canvas region of an ellipsoid, and its implicit function there (1 at the centre, 0 at the surface).

        Args:
            centre: [3] (mm).
            radius: [3] half axes (mm).
            turn: [3, 3] its axes as columns.
            rough: displacement of its surface by noise, as a share of its size.
        """
        reach = np.sqrt(((turn * radius) ** 2).sum(1)) * (1 + 2 * rough)
        low = np.clip(np.floor((centre - reach - self.first_mm) / SPACING_MM), 0, len(self.labels)).astype(int)
        high = np.clip(np.ceil((centre + reach - self.first_mm) / SPACING_MM) + 1, 0, len(self.labels)).astype(int)
        part = tuple(slice(a, max(a, b)) for a, b in zip(low, high, strict=True))
        scaled = (turn / radius).astype(np.float32)  # columns: axis / radius
        terms = []
        for axis in range(3):
            at = np.arange(part[axis].start, part[axis].stop) * SPACING_MM + self.first_mm[axis] - centre[axis]
            shape = [-1 if a == axis else 1 for a in range(3)]
            terms.append([at.reshape(shape).astype(np.float32) * scaled[axis, k] for k in range(3)])
        squared = sum((terms[0][k] + terms[1][k] + terms[2][k]) ** 2 for k in range(3))
        value = 1 - np.sqrt(squared)
        return part, value + np.float32(rough) * self.noise[part] if rough else value

    def put(self, tissue: int, centre: Array, radius: Array, turn: Array, *, rough: float = 0.0, on: int = -1) -> None:
        """Paint an ellipsoid; with `on`, only over that tissue."""
        part, value = self.ellipsoid(centre, radius, turn, rough)
        inside = value > 0
        if on >= 0:
            inside &= self.labels[part] == on
        self.labels[part][inside] = tissue

    def tube(self, tissue: int, start: Array, end: Array, radius: float, *, core: int = -1) -> None:
        """Paint a straight tube as one long ellipsoid, optionally with a core of another tissue."""
        axis = end - start
        length = float(np.linalg.norm(axis))
        turn = _axes_along(axis / max(length, 1e-6))
        radii = np.array([radius, radius, length / 2 + radius])
        self.put(tissue, (start + end) / 2, radii, turn)
        if core >= 0:
            self.put(core, (start + end) / 2, radii * [0.4, 0.4, 0.9], turn)


def draw_surroundings(base_mm: Array, radius_mm: float, rng: np.random.Generator) -> Surroundings:
    """Mother and fetal body about a head at the origin.

    Args:
        base_mm: [3] start of the neck.
        radius_mm: of the head.
        rng: source of randomness.
    """
    r = radius_mm
    bend = Rotation.from_rotvec([rng.uniform(-0.2, 1.0), 0, rng.normal(0, 0.3)]).as_matrix()
    down = bend @ np.array([0, 0, -1.0])
    size = rng.uniform(0.85, 1.15) * r * np.array([0.95, 0.8, 1.5])
    trunk = base_mm + down * (size[2] + 0.25 * r)
    middle = (trunk + down * 0.5 * size[2]) * rng.uniform(0.3, 0.7)
    canvas = _Canvas(middle, rng)
    mother, uterus = _mother(canvas, middle, down, r, rng)
    for _ in range(int(rng.integers(4, 14))):
        _maternal_body(canvas, mother, rng)
    _uterus(canvas, uterus, r, rng)
    canvas.put(Tissue.FETAL_BODY, trunk, size, bend)
    if rng.random() < 0.7:  # bowel, kidneys and other organs: as heterogeneous as a brain
        _mix(canvas, trunk, size - rng.uniform(1.5, 5), bend, rng)
    canvas.put(Tissue.LUNG, trunk - down * 0.45 * size[2], size * 0.55, bend, rough=0.1)
    canvas.put(Tissue.LIVER, trunk + down * 0.15 * size[2], size * [0.7, 0.6, 0.35], bend, rough=0.1)
    for _ in range(int(rng.integers(0, 5))):
        spot = trunk + bend @ (rng.uniform(-0.5, 0.5, 3) * size)
        canvas.put(Tissue.FETAL_FLUID, spot, rng.uniform(0.1, 0.25, 3) * r, bend)
    back = bend @ np.array([0, -0.7 * size[1], 0])
    canvas.tube(Tissue.BONE, base_mm + back * 0.5, trunk + back + down * size[2], 6.0, core=Tissue.FETAL_FLUID)
    canvas.tube(Tissue.FETAL_BODY, base_mm * 0.6, trunk, 0.55 * r)
    for _ in range(int(rng.integers(2, 9))):
        _limb(canvas, trunk, size, r, rng)
    n = canvas.labels.shape
    affine = np.diag([SPACING_MM, SPACING_MM, SPACING_MM, 1.0])
    affine[:3, 3] = canvas.first_mm
    texture = 0.7 * lattice_noise(n, 1.0, rng) + 0.7 * lattice_noise(n, float(rng.uniform(2, 5)), rng)
    return Surroundings(labels=canvas.labels, texture=texture, affine=affine, trunk_mm=trunk)


Ellipsoid = tuple[Array, Array, Array]
"""Centre [3] (mm), half axes [3] (mm), axes as columns [3, 3]."""


def _mother(
    canvas: _Canvas, middle: Array, down: Array, r: float, rng: np.random.Generator
) -> tuple[Ellipsoid, Ellipsoid]:
    """Paint fat, muscle and a patchwork of organs; return the ellipsoids of the mother and of the uterus."""
    turn = _axes_along(down)
    if rng.random() < 0.6:  # transverse lies occur, too
        turn = Rotation.from_rotvec(rng.normal(0, 0.6, 3)).as_matrix() @ turn
    gap = rng.uniform(2, 14, 3) + rng.choice([0.0, 1.0]) * rng.uniform(0, 45, 3)
    inner = np.array([1.15 * r, 1.15 * r, 2.2 * r]) + gap
    centre = middle + turn @ (rng.uniform(-0.6, 0.6, 3) * gap)
    uterus = (centre, inner, turn)
    body_turn = turn @ Rotation.random(rng=rng).as_matrix()
    around = rng.uniform(20, 100, 3)
    body = (centre + body_turn @ (rng.uniform(-0.6, 0.6, 3) * around), 0.9 * inner.max() + around, body_turn)
    fat, muscle = rng.uniform(4, 45), rng.uniform(4, 16)
    canvas.put(Tissue.FAT, *body)
    canvas.put(Tissue.MUSCLE, body[0], body[1] - fat, body_turn, rough=0.03)
    organs = (body[0], np.maximum(body[1] - fat - muscle, 5), body_turn)
    part, value = canvas.ellipsoid(*organs, 0.03)
    kinds = rng.permutation(ORGANS)
    first, second = (lattice_noise(value.shape, float(rng.uniform(5, 14)), rng) for _ in range(2))
    patch = np.select([first < -0.8, first < 0, second < 0, second < 0.9], kinds[:4], kinds[4])
    canvas.labels[part] = np.where(value > 0, patch, canvas.labels[part])
    return body, uterus


def _maternal_body(canvas: _Canvas, mother: Ellipsoid, rng: np.random.Generator) -> None:
    """Paint one maternal structure: bladder, organ, vessel, spine with canal, head-like ball or bowel loop."""
    centre, radius, turn = mother
    at = centre + turn @ (rng.uniform(-0.8, 0.8, 3) * radius)
    kind = rng.integers(6)
    some = Rotation.random(rng=rng).as_matrix()
    if kind == 0:
        canvas.put(Tissue.MATERNAL_FLUID, at, rng.uniform(8, 40, 3), some)
    elif kind == 1:
        canvas.put(int(rng.choice(ORGANS)), at, rng.uniform(8, 45, 3), some, rough=0.15)
    elif kind == 2:
        along = some[:, 0] * rng.uniform(40, 120)
        canvas.tube(Tissue.VESSEL, at - along, at + along, float(rng.uniform(3, 8)))
    elif kind == 3:
        along = some[:, 0] * rng.uniform(60, 150)
        canvas.tube(Tissue.MUSCLE, at - along + some[:, 1] * 20, at + along + some[:, 1] * 20, 18.0)
        canvas.tube(Tissue.BONE, at - along, at + along, 10.0, core=Tissue.MATERNAL_FLUID)
    elif kind == 4:
        _shell(canvas, at, rng.uniform(15, 45) * rng.uniform(0.8, 1.2, 3), some, rng)
    else:
        along = some[:, 0] * rng.uniform(15, 60)
        outer, core = rng.choice([*ORGANS, Tissue.MATERNAL_FLUID], 2)
        canvas.tube(int(outer), at - along, at + along, float(rng.uniform(8, 20)), core=int(core))


def _shell(canvas: _Canvas, at: Array, radius: Array, turn: Array, rng: np.random.Generator) -> None:
    """Paint a head-like ball: a dark shell about tissue without folds."""
    shell, fluid = rng.uniform(2, 5), rng.choice([0.0, 4.0])
    canvas.put(int(rng.choice([Tissue.BONE, Tissue.MUSCLE])), at, radius + shell, turn)
    canvas.put(Tissue.MATERNAL_FLUID, at, radius, turn)
    canvas.put(int(rng.choice([Tissue.DISTRACTOR, Tissue.PLACENTA])), at, radius - fluid, turn, rough=0.05)
    if rng.random() < 0.5:
        _mix(canvas, at, np.maximum(radius - fluid - 2, 5), turn, rng)


def _mix(canvas: _Canvas, at: Array, radius: Array, turn: Array, rng: np.random.Generator) -> None:
    """Paint an ellipsoid with patches of a few tissues.

    Args:
        canvas: to paint on.
        at: [3] its centre (mm).
        radius: [3] its half axes (mm).
        turn: [3, 3] its axes as columns.
        rng: source of randomness.
    """
    part, value = canvas.ellipsoid(at, radius, turn)
    kinds = rng.choice([*INNER, *ORGANS], 4)
    first, second = (lattice_noise(value.shape, float(rng.uniform(1.5, 6)), rng) for _ in range(2))
    patch = np.select([first < -0.6, first < 0.3, second < 0.5], kinds[:3], kinds[3])
    canvas.labels[part] = np.where(value > 0, patch, canvas.labels[part])


def _uterus(canvas: _Canvas, uterus: Ellipsoid, r: float, rng: np.random.Generator) -> None:
    """Paint the uterus: wall, fluid, mostly a placenta on one side, at times a head-like ball or thin tubes."""
    centre, inner, turn = uterus
    canvas.put(Tissue.UTERUS, centre, inner + rng.uniform(3, 14), turn, rough=0.02)
    canvas.put(Tissue.AMNIOTIC, centre, inner, turn, rough=0.04)
    if rng.random() < 0.85:
        side = Rotation.random(rng=rng).as_matrix()[:, 0]
        thick = rng.uniform(12, 45)
        part, value = canvas.ellipsoid(centre, inner, turn, 0.04)
        at = np.stack(np.meshgrid(*(np.arange(s.start, s.stop) for s in part), indexing="ij"), -1)
        along = (at * SPACING_MM + canvas.first_mm - centre) @ (side / np.linalg.norm(inner))
        inside = (value > 0) & (value < thick / inner.min() * np.clip(along.astype(np.float32) * 3, 0, 1))
        canvas.labels[part][inside] = Tissue.PLACENTA
    if rng.random() < 0.25:
        _shell(canvas, centre + turn @ (rng.uniform(-0.8, 0.8, 3) * inner), rng.uniform(0.5, 1.0, 3) * r, turn, rng)
    for _ in range(int(rng.integers(0, 7))):
        at = centre + turn @ (rng.uniform(-0.8, 0.8, 3) * inner)
        along = rng.normal(0, 10, 3)
        canvas.tube(int(rng.choice([Tissue.VESSEL, Tissue.FETAL_BODY])), at - along, at + along, rng.uniform(2.5, 6))


def _limb(canvas: _Canvas, trunk: Array, size: Array, r: float, rng: np.random.Generator) -> None:
    start = trunk + rng.uniform(-0.9, 0.9, 3) * size
    for _ in range(2):
        end = start + rng.normal(0, 0.6 * r, 3)
        canvas.tube(Tissue.FETAL_BODY, start, end, r * rng.uniform(0.13, 0.26), core=Tissue.BONE)
        start = end


def _axes_along(direction: Array) -> Array:
    """A rotation whose third column is a unit vector."""
    other = np.eye(3)[np.abs(direction).argmin()]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first), direction], axis=1)
