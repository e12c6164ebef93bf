"""The anatomy that stacks show, and its name in messages."""

from __future__ import annotations

from typing import Final, Literal

Anatomy = Literal["fetal-brain", "generic"]

FETAL_BRAIN: Final = "fetal-brain"
GENERIC: Final = "generic"

ANATOMIES: tuple[Anatomy, ...] = (FETAL_BRAIN, GENERIC)

NAME_OF: dict[Anatomy, str] = {FETAL_BRAIN: "brain", GENERIC: "object"}
"""Names in sentences about a volume."""

NOTE_ON_OTHERS: Final = (
    "anatomy generic: no atlas, pose network or prior was used; the volume stays in scanner space, and its uncertainty "
    "was calibrated on fetal brains"
)
"""Note for run.json."""
