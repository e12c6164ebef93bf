"""BIDS file names, split into entities (`run-1`) and words (`T2w`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ENTITY = re.compile(r"([a-zA-Z]+)-([a-zA-Z0-9+]+)")

NIFTI_ENDINGS = (".nii.gz", ".nii")


@dataclass(frozen=True)
class BidsName:
    """A parsed file name.

    Args:
        entities: label by key, in the order of the name.
        words: parts without a label; the last of them is the suffix.
    """

    entities: dict[str, str]
    words: tuple[str, ...]

    @property
    def scan(self) -> frozenset[tuple[str, str]]:
        """The entities that a scan shares with its derivatives; run-01 equals run-1."""
        return frozenset(
            (key, label.lstrip("0") or "0" if key == "run" and label.isdigit() else label)
            for key, label in self.entities.items()
            if key != "desc"
        )


def parsed_name(path: Path) -> BidsName | None:
    """The parts of the name of a NIfTI file; None if it is not a BIDS name."""
    ending = next((one for one in NIFTI_ENDINGS if path.name.endswith(one)), None)
    name = None if ending is None else parsed_stem(path.name.removesuffix(ending))
    return name if name is not None and "sub" in name.entities else None


def parsed_stem(stem: str) -> BidsName | None:
    """The parts of a name without its ending; it may lack a participant. None if it does not end in a suffix."""
    entities: dict[str, str] = {}
    words = []
    parts = stem.split("_")
    for part in parts:
        found = ENTITY.fullmatch(part)
        if found and found[1] in entities:
            return None
        if found:
            entities[found[1]] = found[2]
        else:
            words.append(part)
    return BidsName(entities, tuple(words)) if words and words[-1] == parts[-1] else None
