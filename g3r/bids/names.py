"""File names of BIDS, taken apart: entities (`run-1`) and words (`T2w`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ENTITY = re.compile(r"([a-zA-Z]+)-([a-zA-Z0-9+]+)")

NIFTI_ENDINGS = (".nii.gz", ".nii")


@dataclass(frozen=True)
class BidsName:
    """A file name.

    Args:
        entities: label by key, in the order of the name.
        words: parts without a label; the last of them is the suffix.
    """

    entities: dict[str, str]
    words: tuple[str, ...]

    @property
    def scan(self) -> frozenset[tuple[str, str]]:
        """The entities that a scan and what was made of it share; run-01 is run-1."""
        return frozenset(
            (key, label.lstrip("0") or "0" if key == "run" and label.isdigit() else label)
            for key, label in self.entities.items()
            if key != "desc"
        )


def parsed_name(path: Path) -> BidsName | None:
    """The parts of the name of a NIfTI file; None where it is not named as BIDS wants it."""
    ending = next((one for one in NIFTI_ENDINGS if path.name.endswith(one)), None)
    name = None if ending is None else parsed_stem(path.name.removesuffix(ending))
    return name if name is not None and "sub" in name.entities else None


def parsed_stem(stem: str) -> BidsName | None:
    """The parts of a name without its ending, which need not name a participant; None where it ends in no suffix."""
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
