"""Surroundings of the head of a scene, and their intensities."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.mask_labels import Tissue, draw_intensities
from data_synth.mask_surroundings import HALF_MM, SPACING_MM, draw_surroundings
from data_synth.noise import lattice_noise

BASE_MM = np.array([0.0, -15.0, -35.0])


@pytest.mark.parametrize("seed", range(3))
def test_a_mother_with_a_fetus_in_her(seed: int) -> None:
    made = draw_surroundings(BASE_MM, 38.0, np.random.default_rng(seed))
    share = np.bincount(made.labels.ravel(), minlength=len(Tissue)) / made.labels.size
    assert 0.1 < share[Tissue.OUTSIDE] < 0.97  # air
    for tissue in (Tissue.AMNIOTIC, Tissue.FETAL_BODY, Tissue.UTERUS, Tissue.FAT, Tissue.MUSCLE):
        assert share[tissue] > 1e-4, tissue
    assert np.isclose(made.texture.std(), 1, atol=0.5)
    # the head lies within the cube, and the trunk below it
    index = np.linalg.solve(made.affine[:3, :3], -made.affine[:3, 3])
    assert ((index > 0) & (index < 2 * HALF_MM / SPACING_MM)).all()
    assert made.trunk_mm[2] < BASE_MM[2]


def test_the_same_seed_gives_the_same_surroundings() -> None:
    first, second = (draw_surroundings(BASE_MM, 30.0, np.random.default_rng(9)).labels for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_fluid_is_bright_and_bone_dark_in_most_scans(rng: np.random.Generator) -> None:
    mean = np.median([draw_intensities(rng)[0] for _ in range(101)], axis=0)
    assert mean[Tissue.AMNIOTIC] > mean[Tissue.SCALP] > mean[Tissue.SKULL] > 0
    assert mean[Tissue.BRAIN] == 0 == mean[Tissue.OUTSIDE]


@pytest.mark.parametrize("step", [1.0, 4.0])
def test_noise_on_a_coarse_lattice_correlates_between_neighbours(step: float, rng: np.random.Generator) -> None:
    noise = lattice_noise((30, 31, 32), step, rng)
    assert noise.shape == (30, 31, 32)
    assert 0.5 < noise.std() < 1.5
    neighbours = np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]
    assert neighbours > 0.6 if step > 1 else neighbours < 0.9
