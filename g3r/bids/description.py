"""Files at the top of the derivative data set: description, README and the list of files that validators ignore."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from g3r._version import __version__
from g3r.errors import InputError
from g3r.run.atomic_file import write_text

BIDS_VERSION = "1.10.0"

NAME = "g3r"

SOURCE = "raw"
"""Name of the input data set in BIDS URIs (`bids:raw:sub-01/...`)."""

DESCRIPTION, README, IGNORED = "dataset_description.json", "README.md", ".bidsignore"

LOGS, WORK = "logs", ".g3r"
"""Folders for the logs of processes, and for unfinished sessions (the work folder)."""

PASSED_BY = f"{LOGS}/\n{WORK}/\nfigures\n*_run.json\n*_slices.tsv\n*_xfm.txt\nparticipants_g3r.*\nindex.html\n"

TEXT = """# Fetal brain volumes by g3r

One volume for each session, reconstructed from stacks of thick slices. For research only, not for diagnosis.

- `*_rec-g3r_T2w`: the volume. `*_rec-g3r_desc-brain_mask`: the brain in it.
- `*_rec-g3r_desc-uncertainty_T2w`: expected absolute error of each voxel, in the volume's units.
- `*_rec-g3r_desc-priorshare_T2w`: how far a voxel rests on the prior, 0 (slices) to 1 (prior alone).
- `*_rec-g3r_desc-coverage_T2w`: how often slices covered it; 1 is one stack without gaps.
- `*_rec-g3r_desc-unseen_mask`: brain that no slice saw.
- `*_rec-g3r_run.json`, `*_rec-g3r_slices.tsv`: settings and figures of the run; a row for each slice.
- `*_from-scanner_to-standard_mode-image_xfm.txt`: for ITK and ANTs, to resample images in scanner space onto the
  volume. Every slice moved by itself: this is the robust mean of a stack's slices, or of all (`rec-g3r`).
- `figures/`: look at these first; `index.html` shows all of them, the worst first.
- `participants_g3r.tsv`: a row for each session. `logs/`: what each run said.

A query for volumes should ask for files without `desc`.
"""


def check_data_set(bids_dir: Path, out_dir: Path) -> None:
    """Refuse an output that is the input, or a data set that g3r did not make.

    Raises:
        InputError: see above.
    """
    if out_dir.resolve() == bids_dir.resolve():
        raise InputError(f"{out_dir}: is the input, too; pass another folder, such as derivatives/{NAME} in it")
    if out_dir.exists() and not out_dir.is_dir():
        raise InputError(f"{out_dir}: is a file; expected a folder, choose another")
    path = out_dir / DESCRIPTION
    if not path.exists():
        if out_dir.is_dir() and any(out_dir.glob("sub-*")):
            raise InputError(f"{out_dir}: holds sub-* and no {DESCRIPTION} of {NAME}; choose another folder")
        return
    if not _is_ours(read_object(path)):
        raise InputError(f"{path}: is of a data set that {NAME} did not make; choose another folder for the output")


def is_own_derivative(folder: Path) -> bool:
    """Whether the description of a data set names g3r as its maker; False if it cannot be read."""
    path = folder / DESCRIPTION
    try:
        return path.is_file() and _is_ours(read_object(path))
    except InputError:
        return False


def write_data_set(bids_dir: Path, out_dir: Path, command: str) -> None:
    """Write the files that every derivative data set has; existing ones are updated.

    Args:
        bids_dir: the input.
        out_dir: folder to write.
        command: command line, as given.

    Raises:
        InputError: the folder cannot be written.
    """
    description = {
        "Name": "Fetal brain volumes by g3r",
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "derivative",
        "GeneratedBy": [{"Name": NAME, "Version": __version__, "Description": f"Command: {command}"}],
        "SourceDatasets": [_source(bids_dir)],
        "DatasetLinks": {SOURCE: relative_url(bids_dir, out_dir)},
    }
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        write_text(out_dir / DESCRIPTION, as_json(description))
        write_text(out_dir / README, TEXT)
        write_text(out_dir / IGNORED, PASSED_BY)
    except OSError as error:
        raise InputError(f"{out_dir}: cannot be written ({error.strerror}); choose another OUT_DIR") from None


def relative_url(bids_dir: Path, out_dir: Path) -> str:
    """Relative URL from one folder to the other, so that both can be moved together and no folder above is named.

    Where neither holds the other and they do not lie side by side, it is the name of the data set alone: the way there
    leads through folders that may be named after a patient.
    """
    source, output = bids_dir.resolve(), out_dir.resolve()
    if source.parent in output.parents or output in source.parents:
        return Path(os.path.relpath(source, output)).as_posix()
    return source.name


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        InputError: the file cannot be read or holds something else.
    """
    try:
        # decoded as sidecars are: free text may be in any 8-bit encoding
        found = json.loads(path.read_bytes().decode("utf-8-sig", errors="replace"), strict=False)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is not JSON; mend or remove it") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: holds no object {{...}}; mend or remove it")
    return found


def as_json(value: dict[str, Any]) -> str:
    """The text of a JSON file."""
    return json.dumps(value, indent=2) + "\n"


def _is_ours(described: dict[str, Any]) -> bool:
    """Whether a description lists g3r in its GeneratedBy."""
    makers = described.get("GeneratedBy")
    return isinstance(makers, list) and any(isinstance(one, dict) and one.get("Name") == NAME for one in makers)


def _source(bids_dir: Path) -> dict[str, str]:
    """The entry of the input in `SourceDatasets`: a URI that `DatasetLinks` resolves, and its DOI if it has one."""
    path = bids_dir / DESCRIPTION
    described = read_object(path) if path.exists() else {}
    found = {"URL": f"bids:{SOURCE}:"}
    if isinstance(described.get("DatasetDOI"), str):
        found["DOI"] = described["DatasetDOI"]
    return found
