"""The picture of sections: sides agree with their letters, rows and sizes are right, files are complete."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g3r.errors import InputError
from g3r.output.sections import save_sections

SHAPE = (40, 50, 30)
AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])


def ball(at: tuple[int, int, int] = (20, 25, 15), radius: int = 4) -> np.ndarray:
    index = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), -1)
    return (((index - np.array(at)) ** 2).sum(-1) < radius**2).astype(np.float32)


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("L")).astype(float)


def columns(image: np.ndarray) -> list[np.ndarray]:
    """The three panels of a one-row picture, found by thirds of equal mm scale (widths 80, 80, 100 mm)."""
    left, right = 0.06 * image.shape[1], 0.92 * image.shape[1]
    edges = left + (right - left) * np.cumsum([0, 80, 80, 100]) / 260
    return [image[int(0.15 * len(image)) : int(0.85 * len(image)), int(a) : int(b)] for a, b in pairwise(edges)]


def side(panel: np.ndarray) -> tuple[bool, bool]:
    """Side of the bright spot: (left of the centre, above the centre)."""
    rows, cols = np.nonzero(panel > 200)
    return cols.mean() < panel.shape[1] / 2, rows.mean() < panel.shape[0] / 2


def test_radiological_sides(tmp_path: Path) -> None:
    # bright in the right, anterior, superior part; large enough to cross all three central planes
    save_sections(tmp_path / "a.png", {"volume": ball((27, 33, 20), 13) * 100}, AFFINE)
    axial, coronal, sagittal = columns(pixels(tmp_path / "a.png"))
    assert side(axial) == (True, True)  # right on the left, anterior up
    assert side(coronal) == (True, True)  # right on the left, superior up
    assert side(sagittal) == (True, True)  # anterior on the left, superior up


@pytest.mark.parametrize("flip", [(0,), (0, 1), (2,)])
def test_the_header_decides_and_not_the_array(tmp_path: Path, flip: tuple[int] | tuple[int, int]) -> None:
    data = ball((27, 33, 20), 13) * 100
    affine = AFFINE.copy()
    for axis in flip:
        affine[:3, 3] += affine[:3, axis] * (SHAPE[axis] - 1)
        affine[:3, axis] *= -1
    mask = np.ones(SHAPE, bool)
    mask[0] = mask[:, 0] = mask[:, :, 0] = False  # an odd extent has the same middle from both ends
    save_sections(tmp_path / "a.png", {"v": data}, AFFINE, mask)
    save_sections(tmp_path / "b.png", {"v": np.flip(data, flip)}, affine, np.flip(mask, flip))
    np.testing.assert_allclose(pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png"), atol=1)


def test_permuted_axes(tmp_path: Path) -> None:
    data = ball((27, 33, 20), 13) * 100
    save_sections(tmp_path / "a.png", {"v": data}, AFFINE)
    save_sections(tmp_path / "b.png", {"v": data.transpose(2, 0, 1)}, AFFINE[:, [2, 0, 1, 3]])
    np.testing.assert_allclose(pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png"), atol=1)


def test_a_row_per_volume_and_a_bar_for_maps(tmp_path: Path) -> None:
    volumes = {"coarse": ball(), "density": 3 * ball(radius=9), "volume": ball(radius=9)}
    save_sections(tmp_path / "three.png", volumes, AFFINE, ball(radius=10), title="three rows")
    save_sections(tmp_path / "one.png", {"volume": ball()}, AFFINE, ball(radius=10))
    with Image.open(tmp_path / "three.png") as three, Image.open(tmp_path / "one.png") as one:
        assert 2.3 < three.height / one.height < 3
        assert np.asarray(three.convert("HSV"))[..., 1].max() > 200, "the density row is in colour"


def outline_of(path: Path) -> np.ndarray:
    """Pixels of a picture in the colour of the outline."""
    red, green, blue = np.moveaxis(np.asarray(Image.open(path).convert("RGB")).astype(int), -1, 0)
    return (blue > 120) & (blue > red + 60) & (green > red + 40)


def test_a_marked_part_is_outlined_where_it_lies(tmp_path: Path) -> None:
    """The outline surrounds the right, anterior, superior part, with the sides of the volume."""
    data = ball(radius=13) * 100
    save_sections(tmp_path / "plain.png", {"volume": data}, AFFINE)
    assert not outline_of(tmp_path / "plain.png").any()
    save_sections(tmp_path / "a.png", {"volume": data}, AFFINE, marked=ball((28, 34, 20), 12))
    found = outline_of(tmp_path / "a.png")
    assert 100 < found.sum() < 0.05 * found.size
    for panel in columns(found.astype(float) * 255):
        assert panel.max() > 200  # in each of the three sections
        assert side(panel) == (True, True)
    # oriented like the volume for any header
    save_sections(
        tmp_path / "b.png",
        {"volume": data.transpose(2, 0, 1)},
        AFFINE[:, [2, 0, 1, 3]],
        marked=ball((28, 34, 20), 12).transpose(2, 0, 1),
    )
    np.testing.assert_array_equal(outline_of(tmp_path / "b.png"), found)
    # in every row; no outline if nothing or everything is marked
    save_sections(tmp_path / "two.png", {"volume": data, "density": data}, AFFINE, marked=ball((28, 34, 20), 12))
    upper, lower = np.array_split(outline_of(tmp_path / "two.png"), 2)
    assert min(upper.sum(), lower.sum()) > 100
    for nothing in (np.zeros(SHAPE), np.ones(SHAPE)):
        save_sections(tmp_path / "none.png", {"volume": data}, AFFINE, marked=nothing)
        assert not outline_of(tmp_path / "none.png").any()


@pytest.mark.parametrize("value", [0.0, -5.0, 1e-30, 1e30, np.nan])
def test_constant_volumes_are_drawn(tmp_path: Path, value: float) -> None:
    save_sections(tmp_path / "a.png", {"volume": np.full(SHAPE, value)}, AFFINE, np.zeros(SHAPE))
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_one_voxel(tmp_path: Path) -> None:
    save_sections(tmp_path / "a.png", {"volume": np.ones((1, 1, 1))}, AFFINE)
    assert (tmp_path / "a.png").exists()


def test_wrong_shapes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one 3D grid"):
        save_sections(tmp_path / "a.png", {"a": ball(), "b": ball()[1:]}, AFFINE)
    with pytest.raises(ValueError, match="one 3D grid"):
        save_sections(tmp_path / "a.png", {}, AFFINE)
    with pytest.raises(ValueError, match="mask has shape"):
        save_sections(tmp_path / "a.png", {"a": ball()}, AFFINE, ball()[1:])
    with pytest.raises(InputError, match="cannot be written"):
        save_sections(tmp_path / "no" / "folder.png", {"a": ball()}, AFFINE)
    assert list(tmp_path.iterdir()) == []
