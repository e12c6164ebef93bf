"""JSON sidecars: values that are read, values that are ignored, and refusals."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g3r.acquisition.psf import THICKNESS_RANGE_MM
from g3r.acquisition.sidecar import MAX_SIDECAR_BYTES, Sidecar, read_sidecar, sidecar_path
from g3r.errors import InputError

NUMBER_KEYS = ("SliceThickness", "SpacingBetweenSlices", "PhaseResolution")
DIRECTION_KEYS = ("PhaseEncodingDirection", "PhaseEncodingAxis", "InPlanePhaseEncodingDirectionDICOM")


def write(folder: Path, content: Any) -> Path:
    """Write a sidecar from an object, or from raw text or bytes."""
    path = folder / "a.json"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def read(folder: Path, content: Any) -> Sidecar:
    found = read_sidecar(write(folder, content))
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("image", "sidecar"),
    [
        ("sub-01_T2w.nii.gz", "sub-01_T2w.json"),
        ("a.b.nii", "a.b.json"),
        ("A.NII.GZ", "A.json"),
        ("pair.hdr", "pair.json"),
        ("pair.img.gz", "pair.json"),
        ("a.nii.nii.gz", "a.nii.json"),
        ("folder.nii/a.nii", "folder.nii/a.json"),
        ("no ending", "no ending.json"),
        ("", ".json"),
    ],
)
def test_the_sidecar_is_beside_its_image(image: str, sidecar: str) -> None:
    assert sidecar_path(image) == Path(sidecar)


def test_what_dcm2niix_writes(tmp_path: Path) -> None:
    content = {
        "Manufacturer": "Siemens",
        "SliceThickness": 3,
        "SpacingBetweenSlices": 3.3,
        "PhaseResolution": 0.7,
        "PhaseEncodingDirection": "j-",
        "InPlanePhaseEncodingDirectionDICOM": "COL",
        "SliceTiming": [],
    }
    assert read(tmp_path, content) == Sidecar(
        name="a.json", thickness_mm=3.0, spacing_mm=3.3, phase_resolution=0.7, phase_axis="j", dicom_phase_axis="j"
    )


def test_no_file_and_nothing_in_it_are_no_error(tmp_path: Path) -> None:
    assert read_sidecar(tmp_path / "a.json") is None
    assert read_sidecar(tmp_path / ("a" * 300 + ".json")) is None
    assert (
        read(tmp_path, {}) == read(tmp_path, dict.fromkeys((*NUMBER_KEYS, *DIRECTION_KEYS))) == Sidecar(name="a.json")
    )


@pytest.mark.parametrize(
    ("content", "axis", "of_slices_first"),
    [
        ({"PhaseEncodingDirection": "i"}, "i", "i"),
        ({"PhaseEncodingDirection": "k-"}, "k", "k"),
        ({"PhaseEncodingDirection": "j?"}, "j", "j"),
        ({"PhaseEncodingAxis": "j"}, "j", "j"),
        ({"PhaseEncodingDirection": "i-", "PhaseEncodingAxis": "j"}, "i", "i"),
        ({"PhaseEncodingDirection": "i", "InPlanePhaseEncodingDirectionDICOM": "COL"}, "i", "i"),
        ({"InPlanePhaseEncodingDirectionDICOM": "ROW"}, "i", None),
        ({"InPlanePhaseEncodingDirectionDICOM": "COL "}, "j", None),
        ({"InPlanePhaseEncodingDirectionDICOM": "COLUMN"}, "j", None),
        ({}, None, None),
    ],
)
def test_the_phase_encoding_axis(
    tmp_path: Path, content: dict[str, str], axis: str | None, of_slices_first: str | None
) -> None:
    """The DICOM value (ROW or COL) is used only if the file's axes are still those of the scanner's images."""
    found = read(tmp_path, content)
    assert found.phase_axis_of(2) == axis
    assert found.phase_axis_of(0) == of_slices_first


@pytest.mark.parametrize(
    "content",
    [
        b'\xef\xbb\xbf{"SliceThickness": 3}',  # byte order mark
        b'{"InstitutionName": "Universit\xe4t", "SliceThickness": 3}',  # Latin-1
        b'{"Comment": "two\nlines\tand a tab", "SliceThickness": 3}',
        b'{"SliceThickness": 2, "SliceThickness": 3.0}',  # JSON allows duplicate keys; the last one counts
        b'{"SliceThickness": 3, "EchoTime": NaN, "Other": "3", "SAR": -Infinity}',
    ],
)
def test_other_keys_and_codes_are_left_alone(tmp_path: Path, content: bytes) -> None:
    assert read(tmp_path, content).thickness_mm == 3.0


def refused(folder: Path, content: Any, *says: str) -> None:
    path = write(folder, content)
    with pytest.raises(InputError) as caught:
        read_sidecar(path)
    line = str(caught.value)
    assert line.startswith("a.json: ")
    assert len(line) < 400
    assert "\n" not in line
    for word in ("expected", "remove", *says):
        assert word in line, line


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        '{"SliceThickness": 3',
        "{'SliceThickness': 3}",
        "\0",
        '{"a": ' + "[" * 100_000,
        '{"a": ' + "9" * 5000 + "}",
    ],
    ids=["empty", "open", "cut", "quotes", "zero byte", "deep", "long number"],
)
def test_what_is_no_json_is_refused(tmp_path: Path, content: str) -> None:
    refused(tmp_path, content, "is not JSON")


@pytest.mark.parametrize("content", ["[]", "3", "null", '"SliceThickness"', "NaN"])
def test_what_is_no_object_is_refused(tmp_path: Path, content: str) -> None:
    refused(tmp_path, content, "expected an object")


@pytest.mark.parametrize(
    "value", ["NaN", "Infinity", "-Infinity", "1e999", "-1", "0", '"3"', "true", "[3]", "{}", "9" * 400]
)
@pytest.mark.parametrize("key", NUMBER_KEYS)
def test_what_is_no_number_that_can_be_is_refused(tmp_path: Path, key: str, value: str) -> None:
    refused(tmp_path, f'{{"{key}": {value}}}', key, "expected a number from")


@pytest.mark.parametrize(
    ("key", "value"),
    [("SliceThickness", 0.05), ("SliceThickness", 3000), ("SliceThickness", 0.003), ("PhaseResolution", 70)],
)
def test_other_units_are_refused(tmp_path: Path, key: str, value: float) -> None:
    refused(tmp_path, {key: value}, f"{key} is {value}")


@pytest.mark.parametrize("value", ["AP", "", "x", "+i", "i+", "ij", 1, ["i"], True])
@pytest.mark.parametrize("key", DIRECTION_KEYS)
def test_what_is_no_axis_is_refused(tmp_path: Path, key: str, value: object) -> None:
    refused(tmp_path, {key: value}, key)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.touch()
    os.truncate(path, MAX_SIDECAR_BYTES + 1)
    with pytest.raises(InputError, match=r"a\.json: has 10 MB; expected a JSON file of at most 10 MB"):
        read_sidecar(path)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").mkdir()
    with pytest.raises(InputError, match=r"a\.json: is a folder; expected the JSON file"):
        read_sidecar(tmp_path / "a.json")
    (tmp_path / "b.json").symlink_to("not fetched")
    with pytest.raises(InputError, match=r"b\.json: is a link to nothing; fetch"):
        read_sidecar(tmp_path / "b.json")
    (tmp_path / "c.json").symlink_to("c.json")
    with pytest.raises(InputError, match=r"c\.json: cannot be read"):
        read_sidecar(tmp_path / "c.json")
    os.mkfifo(tmp_path / "d.json")  # opening it would block for ever
    with pytest.raises(InputError, match=r"d\.json: is a pipe"):
        read_sidecar(tmp_path / "d.json")


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    path = write(tmp_path, {})
    monkeypatch.setattr(Path, "open", denied)  # root ignores file permissions
    with pytest.raises(InputError, match=r"a\.json: cannot be read \(Permission denied\); check"):
        read_sidecar(path)


def read_or_refused(path: Path) -> Sidecar | None:
    """The content of a sidecar, or None if it was refused with a proper message."""
    try:
        return read_sidecar(path)
    except InputError as error:
        line = str(error)
    assert line.startswith("a.json: ")
    assert "expected" in line
    assert line.isprintable()
    return None


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(-(10**400), 10**400)
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(["i", "j-", "k?", "ROW", "COL", 3, 3.3, 0.7, 1.0]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(st.dictionaries(st.sampled_from([*NUMBER_KEYS, *DIRECTION_KEYS, "Other"]), values))
@settings(
    max_examples=500, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_values_are_read_or_refused(tmp_path: Path, content: dict[str, Any]) -> None:
    found = read_or_refused(write(tmp_path, content))
    if found is None:
        return
    low, high = THICKNESS_RANGE_MM
    assert found.thickness_mm is None or low <= found.thickness_mm <= high
    assert found.spacing_mm is None or 0 < found.spacing_mm < np.inf
    assert found.phase_resolution is None or 0 < found.phase_resolution <= 1
    assert {found.phase_axis_of(axis) for axis in range(3)} <= {None, "i", "j", "k"}
    assert found.thickness_mm == content.get("SliceThickness")


@given(st.binary(max_size=60))
@settings(
    max_examples=300, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_bytes_are_read_or_refused(tmp_path: Path, content: bytes) -> None:
    assert read_or_refused(write(tmp_path, content)) in (None, Sidecar(name="a.json"))
