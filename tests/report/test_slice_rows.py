"""Motion plot of the page: signs, millimetres, degrees and names of axes; slices in the order of time."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g3r.acquisition.interleave import acquisition_order
from g3r.geometry import RigidPose
from g3r.output.files import SLICE_COLUMNS
from g3r.output.record import RunRecord
from g3r.report.page import SHIFT_AXES, TURN_AXES, report_html
from g3r.report.slice_rows import SliceRows
from tests.report.records import record, stack

CENTER_MM = np.array([10.0, -20.0, 30.0])
"""Centre of the head in the volume's space."""

MEANS = {"scanner": RigidPose.identity(1), "standard": RigidPose.from_rotvec([[0.3, -0.8, 1.2]], [[15.0, -4.0, 8.0]])}
"""Mean motion from the scanner's to the volume's space."""

SHIFT_MM, TURN_DEG = np.array([3.0, -2.0, 1.0]), 10.0
"""Shift to the right, backwards and up."""

RIGHT, ANTERIOR, SUPERIOR = np.eye(3)
TURNS = {
    "pitch (about right)": (RIGHT, ANTERIOR, SUPERIOR),
    "roll (about anterior)": (ANTERIOR, SUPERIOR, RIGHT),
    "yaw (about superior)": (SUPERIOR, ANTERIOR, -RIGHT),
}
"""Positive rotations: axis, a landmark relative to the head's centre, and the direction in which it moves."""


def rows_of(motion: RigidPose) -> SliceRows:
    n = len(motion)
    full = np.ones(n)
    return SliceRows(
        stack=np.zeros(n, int), number=np.arange(n), motion=motion, weight=full, ncc=full, reason=("-",) * n
    )


def record_of(mean: RigidPose | None) -> RunRecord:
    """The record of a run in standard space, or in scanner space without a mean motion."""
    one = record()
    matrix = None if mean is None else mean.matrix[0].tolist()
    assert one.registration is not None
    return replace(one, registration=replace(one.registration, standard_from_scanner=matrix))


@pytest.mark.parametrize("space", MEANS)
@pytest.mark.parametrize("name", TURN_AXES)
def test_a_head_that_moved_in_one_slice(name: str, space: str) -> None:
    """The second of three slices saw the head shifted and rotated; its motion maps its pixels to the volume."""
    axis, landmark, goes = TURNS[name]
    mean = MEANS[space]
    center = mean.inverse().apply(CENTER_MM[None])[0]  # the mean position of the head's centre in the scanner
    turn = Rotation.from_rotvec(TURN_DEG * axis, degrees=True).as_matrix()
    assert (turn @ landmark) @ goes > 0.1, "the turn goes the other way"

    # the slice saw a point of the head at x' = turn (x - center) + center + shift, and x is its place in the volume
    back = RigidPose(turn.T[None], (center - turn.T @ (center + SHIFT_MM))[None])
    usual = center + 40 * landmark
    met = turn @ (usual - center) + center + SHIFT_MM
    motion = mean @ back
    np.testing.assert_allclose(motion.apply(met[None]), mean.apply(usual[None]), atol=1e-9)

    rows = rows_of(RigidPose.concatenated([mean, motion, mean]))
    shift_mm, turn_deg = rows.head_motion(record_of(None if space == "scanner" else mean), CENTER_MM)
    np.testing.assert_allclose(shift_mm, [np.zeros(3), SHIFT_MM, np.zeros(3)], atol=1e-6)
    np.testing.assert_allclose(turn_deg, [np.zeros(3), TURN_DEG * axis, np.zeros(3)], atol=1e-6)


def test_slices_in_the_order_of_time() -> None:
    """Stack after stack, each by its own interleave, for any order of the table."""
    interleaves = (3, None, 2)
    numbers = (range(7), range(5), range(3, 9))  # the first slices of the last stack show no brain
    stacks = [replace(stack(f"{n}.nii.gz"), interleave=step) for n, step in enumerate(interleaves)]
    keys = [(n, number) for n, those in enumerate(numbers) for number in those]
    np.random.default_rng(0).shuffle(keys)
    rows = replace(
        rows_of(RigidPose.identity(len(keys))),
        stack=np.array([n for n, _ in keys]),
        number=np.array([number for _, number in keys]),
    )
    found = [keys[k] for k in rows.acquisition_key(record(*stacks)).tolist()]
    assert found[:7] == [(0, number) for number in (0, 3, 6, 1, 4, 2, 5)]
    assert found == [
        (n, number)
        for n, (step, those) in enumerate(zip(interleaves, numbers, strict=True))
        for number in acquisition_order(10, step or 1).tolist()
        if number in those
    ]


def test_the_page_draws_it_with_its_name(finished: Path, tmp_path: Path) -> None:
    """One slice saw the head 4 mm to the right: only that line rises, at the time of the slice."""
    folder = shutil.copytree(finished, tmp_path / "run")
    plain = json.loads((folder / "run.json").read_text())
    plain["registration"]["standard_from_scanner"] = None
    for one in plain["stacks"]:
        one["interleave"] = 2
    (folder / "run.json").write_text(json.dumps(plain))
    head, *lines = (folder / "slices.tsv").read_text().splitlines()
    table = [dict(zip(head.split("\t"), line.split("\t"), strict=True)) for line in lines]
    first = [row for row in table if row["stack"] == "0"]
    for row in table:
        row |= dict.fromkeys(("rx", "ry", "rz", "tx", "ty", "tz"), "0") | {"weight": "1"}
    moved = first[1]
    moved["tx"] = "-4"  # motion from the header's place to the right place
    text = "\n".join("\t".join(row[name] for name in SLICE_COLUMNS) for row in table)
    (folder / "slices.tsv").write_text(f"{head}\n{text}\n")

    shifts, turns = re.findall(r'<figure class="chart">.*?</figure>', report_html(folder), flags=re.DOTALL)
    assert re.findall(r'class="key axis-\d">([^<]*)<', shifts) == list(SHIFT_AXES) == ["right", "anterior", "superior"]
    assert re.findall(r'class="key axis-\d">([^<]*)<', turns) == list(TURN_AXES) == list(TURNS)
    lines_of = [re.findall(rf'<polyline class="axis-{axis}" points="([^"]*)"', shifts)[0] for axis in range(3)]
    right, anterior, superior = (
        np.array([float(point.split(",")[1]) for point in points.split()]) for points in lines_of
    )
    in_time = sorted((int(row["slice"]) for row in first), key=lambda number: (number % 2, number))
    place = in_time.index(int(moved["slice"]))
    assert len(right) == len(first)
    others = np.delete(right, place)
    assert np.ptp(others) == np.ptp(anterior) == np.ptp(superior) == 0
    assert right[place] < others[0] - 20, "up in the picture is to the right"
    ticks = {words: float(y) for y, words in re.findall(r'<text class="tick" x="38" y="([\d.]+)">([^<]*)<', shifts)}
    assert right[place] == pytest.approx(0.2 * (ticks["0"] - 4) + 0.8 * (ticks["+5"] - 4), abs=0.2)
