"""The lesion study: the measure is 1 for the truth and 0 for no lesion; lesions have the right place and size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_synth.atlas import TruthVolume
from g3r.errors import InputError
from studies.lesions.figure import draw_lesions_kept, save_sections
from studies.lesions.kept import VARIANTS, tables
from studies.lesions.runs import LesionRun, LesionSubject
from studies.lesions.volumes import (
    BRIGHT_LEVEL,
    DARK_LEVEL,
    DIAMETER_MM,
    VENTRICLE_LABEL,
    Lesion,
    draw_lesions,
    kept,
    with_lesions,
)

SHAPE = (52, 60, 50)


@pytest.fixture(scope="module")
def head() -> tuple[TruthVolume, np.ndarray]:
    """A grey ball with a brighter core and two ventricles, in voxels of 1.2 mm."""
    index = np.stack(np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in SHAPE], indexing="ij"), -1) * 1.2
    radius = np.linalg.norm(index, axis=-1)
    mask = radius < 29
    labels = np.zeros(SHAPE, np.float32)
    for side in (-1, 1):
        labels[np.linalg.norm(index - [7 * side, 0, 0], axis=-1) < 4] = VENTRICLE_LABEL
    data = np.where(mask, 500.0, 0).astype(np.float32)
    data[labels > 0] = 1000
    affine = np.diag([1.2, 1.2, 1.2, 1.0])
    affine[:3, 3] = -1.2 * (np.array(SHAPE) - 1) / 2
    return TruthVolume(name="ball", data=data, mask=mask, affine=affine), labels


@pytest.fixture(scope="module")
def lesions(head: tuple[TruthVolume, np.ndarray]) -> list[Lesion]:
    truth, labels = head
    return draw_lesions(truth, labels, 1000.0, np.random.default_rng(0), n_of_each=1)


def test_truth_keeps_everything_and_a_blank_nothing(lesions: list[Lesion]) -> None:
    for lesion in lesions:
        assert kept(lesion.change, lesion) == pytest.approx(1)
        assert kept(np.zeros(SHAPE), lesion) == 0
        assert kept(0.3 * lesion.change, lesion) == pytest.approx(0.3)
        assert kept(lesion.change + 100.0, lesion) == pytest.approx(1)  # a constant offset does not count


def test_a_lesion_elsewhere_is_not_kept(lesions: list[Lesion]) -> None:
    bright = next(one for one in lesions if one.kind == "bright")
    assert abs(kept(np.roll(bright.change, 12, 2), bright)) < 0.1


def test_spheres_have_their_size_and_level(head: tuple[TruthVolume, np.ndarray], lesions: list[Lesion]) -> None:
    truth, _ = head
    changed = with_lesions(truth, lesions)
    for kind, level in (("bright", BRIGHT_LEVEL), ("dark", DARK_LEVEL)):
        lesion = next(one for one in lesions if one.kind == kind)
        index = np.round(np.linalg.inv(truth.affine) @ [*lesion.center_mm, 1])[:3].astype(int)
        assert changed.data[tuple(index)] == pytest.approx(1000 * level, rel=1e-5)
        # the change relative to the contrast, summed over voxels, is the volume
        way = 1000 * level - truth.data
        share = np.divide(lesion.change, way, out=np.zeros_like(way), where=way != 0)
        assert share.sum() * 1.2**3 == pytest.approx(np.pi / 6 * DIAMETER_MM**3, rel=0.1)
        assert not (lesion.where & ~truth.mask).any()


def test_one_ventricle_grows(head: tuple[TruthVolume, np.ndarray], lesions: list[Lesion]) -> None:
    truth, labels = head
    change = next(one for one in lesions if one.kind == "ventricle").change
    sides = [np.abs(change[: SHAPE[0] // 2]).sum(), np.abs(change[SHAPE[0] // 2 :]).sum()]
    assert min(sides) < 0.1 * max(sides)
    assert change.min() >= 0
    assert (change > 100).sum() > 1.5 * (labels > 0).sum() / 2
    assert not change[~truth.mask].any()


def test_lesions_repeat_with_their_seed(head: tuple[TruthVolume, np.ndarray], lesions: list[Lesion]) -> None:
    again = draw_lesions(*head, 1000.0, np.random.default_rng(0), n_of_each=1)
    for one, other in zip(lesions, again, strict=True):
        np.testing.assert_array_equal(one.change, other.change)


def test_no_room_is_said(head: tuple[TruthVolume, np.ndarray]) -> None:
    with pytest.raises(InputError, match="no room"):
        draw_lesions(*head, 1000.0, np.random.default_rng(0), n_of_each=60)
    with pytest.raises(InputError, match="no ventricle"):
        draw_lesions(head[0], np.zeros(SHAPE), 1000.0, np.random.default_rng(0))


def test_table_has_ratio_and_every_lesion() -> None:
    kept_of = dict(zip(VARIANTS, (0.8, 0.76, 0.9), strict=True))
    rows = {str(n): {"lesions": [{"subject": "a", "n_stacks": n, "kind": "dark", "kept": kept_of}]} for n in (3, 1)}
    text = tables({"preset": "p", "weights": "w", "rows": rows})["lesions"]
    assert text.count("| dark sphere, 6 mm |") == text.count("| 0.95 | 0.95 | 0.85 |") == 2
    assert text.count("| a | ") == 2


def test_the_figure_shows_sections_that_a_run_has_kept(
    head: tuple[TruthVolume, np.ndarray], lesions: list[Lesion], tmp_path: Path
) -> None:
    subject = LesionSubject("a", head[0], tuple(lesions), {})
    volumes = dict.fromkeys(VARIANTS, head[0].data)
    run = LesionRun(
        subject=subject, n_stacks=3, volumes=volumes, kept=dict.fromkeys(VARIANTS, [0.5] * len(lesions)), seconds=1.0
    )
    save_sections(run, tmp_path / "out" / "sections-3.npz")
    draw_lesions_kept("a", {3: tmp_path / "out" / "sections-3.npz"}, VARIANTS, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").is_file()
    with np.load(tmp_path / "out" / "sections-3.npz") as shown:
        assert shown["bright/truth"].max() > 0.9 * BRIGHT_LEVEL * 1000
        assert shown["dark/with prior/kept"] == 0.5
