"""How much of the brain no slice saw, in words that everyone is told: terminal, run.json and picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MENTIONED_ABOVE = 0.005
"""Share of the brain from which on the unseen part is mentioned; slivers between thick slices are not."""
DO_NOT_USE_ABOVE = 0.3
"""Share of the brain from which on the volume shows more of other brains than may be called a reconstruction."""


@dataclass(frozen=True, kw_only=True)
class UnseenPart:
    """The part of the brain that no slice saw.

    Attributes:
        share: of the brain's volume, 0 to 1.
        volume_ml: of it.
        shown: "estimate from other brains", "smooth continuation" (no template was used) or "blank".
        extent_known: False where the only field of view cuts the head and no template says how large the head is; the
            share is then too small.
        usable: False where the share is so large, or so little known, that the volume must not be used.
        what: the volume shows, as in "of the brain".
        share_by_areas: of the head, as the areas of its slices say where the only field of view cuts it; else None.
    """

    share: float
    volume_ml: float
    shown: str
    extent_known: bool
    usable: bool
    what: str = "brain"
    share_by_areas: float | None = None

    @classmethod
    def of(
        cls,
        unseen: NDArray[np.bool_],
        brain: NDArray[np.bool_],
        voxel_volume_mm3: float,
        *,
        shown: str,
        share_by_areas: float | None = None,
        has_template: bool = True,
        what: str = "brain",
    ) -> UnseenPart:
        """Measure it.

        Args:
            unseen: [I, J, K] voxels of the brain that no slice saw.
            brain: [I, J, K] all of it.
            voxel_volume_mm3: of both.
            shown: what the volume shows there.
            share_by_areas: that no slice saw, by the areas of the slices of a single stack whose field of view cuts the
                head; None where there is no such stack.
            has_template: whether an atlas template says how large the brain is.
            what: the volume shows.
        """
        share = float(unseen.sum()) / max(int(brain.sum()), 1)
        extent_known = share_by_areas is None or has_template
        return cls(
            share=share,
            volume_ml=float(unseen.sum()) * voxel_volume_mm3 / 1000,
            shown=shown,
            extent_known=extent_known,
            usable=extent_known and share <= DO_NOT_USE_ABOVE,
            what=what,
            share_by_areas=share_by_areas,
        )

    def line(self) -> str | None:
        """The sentence for terminal, run.json and picture; None where next to nothing is unseen."""
        if not self.extent_known:
            tens = 10 * round(10 * (self.share_by_areas or 0.0))
            return (
                f"the field of view cuts the head: about {tens} % of the {self.what} lies beyond, by the areas of "
                "slices, and no atlas template was fitted that would show it; do not use this volume"
            )
        if self.share < MENTIONED_ABOVE:
            return None
        verb = "was left blank" if self.shown == "blank" else f"is shown as {_with_article(self.shown)}"
        percent = f"{100 * self.share:.0f} %" if self.share >= 0.01 else f"{100 * self.share:.1f} %"
        text = f"{percent} of the {self.what} was not seen by any slice ({self.volume_ml:.0f} ml): it {verb}"
        return text if self.usable else f"{text}; do not use this volume"


def _with_article(words: str) -> str:
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"
