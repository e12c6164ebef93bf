"""Inherited sidecars: a JSON file in a folder above holds for all files whose names have its entities."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from g3r.acquisition.sidecar import READ_KEYS
from g3r.bids.description import as_json, read_object
from g3r.bids.names import parsed_name, parsed_stem


def inherited(stack: Path, bids_dir: Path) -> dict[str, Any] | None:
    """The sidecar keys of a stack that g3r reads, nearer files first; None if no file but its own has any.

    g3r-infer reads the file beside a stack itself. Other keys may name the patient and are not copied.

    Args:
        stack: a stack of the data set.
        bids_dir: the data set.

    Raises:
        InputError: a sidecar cannot be read.
    """
    name = parsed_name(stack)
    assert name is not None
    keys: dict[str, Any] = {}
    is_inherited = False
    folders = [folder for folder in stack.parents if folder == bids_dir or bids_dir in folder.parents]
    for folder in reversed(folders):
        found = []
        for path in folder.glob("*.json"):
            other = parsed_stem(path.stem)
            if other and other.words == name.words and other.entities.items() <= name.entities.items():
                found.append((len(other.entities), path))
        for n_entities, path in sorted(found):
            own = {key: value for key, value in read_object(path).items() if key in READ_KEYS}
            keys |= own
            is_inherited |= bool(own) and (folder != stack.parent or n_entities < len(name.entities))
    return keys if is_inherited else None


def with_sidecar(stack: Path, keys: dict[str, Any], folder: Path) -> Path:
    """A link to a stack in another folder, with a sidecar beside it; returns its path.

    Args:
        stack: file to link to.
        keys: content of the sidecar.
        folder: folder of the link.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    link = folder / stack.name
    link.unlink(missing_ok=True)
    try:
        link.symlink_to(os.path.abspath(stack))
    except OSError:  # some systems reserve links to administrators
        shutil.copyfile(stack, link)
    ending = ".nii.gz" if stack.name.endswith(".gz") else ".nii"
    (folder / f"{stack.name.removesuffix(ending)}.json").write_text(as_json(keys), encoding="utf-8")
    return link
