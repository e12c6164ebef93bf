"""The part of the brain that no slice saw, and the sentence about it in terminal, run.json and picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MENTIONED_ABOVE = 0.005
"""Share of the brain from which on the unseen part is mentioned; slivers between thick slices are below."""
DO_NOT_USE_ABOVE = 0.3
"""Share of the brain above which the volume shows too much of other brains to be called a reconstruction."""


@dataclass(frozen=True, kw_only=True)
class UnseenPart:
    """The part of the brain that no slice saw.

    Attributes:
        share: of the brain's volume, 0 to 1.
        volume_ml: of the unseen part.
        shown: "estimate from other brains", "smooth continuation" (no template was used) or "blank".
        extent_known: False if the only field of view cuts the head and no template shows how large the head is; the
            share is then too small.
        usable: False if the share is so large, or so uncertain, that the volume must not be used.
        what: name of what the volume shows, as in "of the brain".
        share_by_areas: unseen share of the head by the areas of its slices, if the only field of view cuts it; else
            None.
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
        """Measure the unseen part.

        Args:
            unseen: [I, J, K] voxels of the brain that no slice saw.
            brain: [I, J, K] all voxels of the brain.
            voxel_volume_mm3: of both.
            shown: what the volume shows there.
            share_by_areas: unseen share by the areas of the slices, for a single stack whose field of view cuts the
                head; else None.
            has_template: whether an atlas template shows how large the brain is.
            what: name of what the volume shows.
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
