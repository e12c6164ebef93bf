"""What the stacks show, and what it is called where people are told of it."""

from __future__ import annotations

from typing import Final, Literal

Anatomy = Literal["fetal-brain", "generic"]

FETAL_BRAIN: Final = "fetal-brain"
GENERIC: Final = "generic"

ANATOMIES: tuple[Anatomy, ...] = (FETAL_BRAIN, GENERIC)

NAME_OF: dict[Anatomy, str] = {FETAL_BRAIN: "brain", GENERIC: "object"}
"""In sentences on a volume."""

NOTE_ON_OTHERS: Final = (
    "anatomy generic: no atlas, pose network or prior was used; the volume stays in scanner space, and its uncertainty "
    "was calibrated on fetal brains"
)
"""For run.json."""
