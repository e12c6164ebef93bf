"""Inputs of the prior network for one subject, and the base of Eq. 7, to which it adds its residual."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from g3r.acquisition.coverage import UNSEEN_POWER
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.gate import confidence_from_density

CERTAIN_LOGIT = 3.0
"""Logit of a voxel inside the masks or the template before the network's correction: a probability of 0.95."""


@dataclass(frozen=True, kw_only=True)
class PriorInputs:
    """Volumes [B, 1, I, J, K] of one grid, intensities normalised so that V_coarse's 99th percentile is 1.

    Attributes:
        coarse: V_coarse.
        density: M_rho >= 0, dimensionless, over whole slices.
        share: share of the density whose masks say brain, 0 to 1; None takes all of it as brain.
        sharp: V_sharp; needed with `use_sharp`.
        template: the template as fitted to the seen voxels, zero outside its brain; needed with `use_template`.
        outline: share of brain in the fitted template, 0 to 1; needed with `use_template`.
        gating: density that gate and F use instead of M_rho, to compare definitions of it; None takes `density`, from
            which the base is made in any case.
        gating_share: share of `gating` whose masks say brain; None takes all of it as brain.
    """

    coarse: Tensor
    density: Tensor
    share: Tensor | None = None
    sharp: Tensor | None = None
    template: Tensor | None = None
    outline: Tensor | None = None
    gating: Tensor | None = None
    gating_share: Tensor | None = None

    @property
    def read_density(self) -> Tensor:
        """The density that gate and F use as M_rho."""
        return self.density if self.gating is None else self.gating

    def shown(self, config: PriorNetworkConfig) -> list[Tensor]:
        """The volumes that F sees, in the order of its first layer.

        Raises:
            ValueError: a volume that the network needs is missing.
        """
        if config.use_sharp and self.sharp is None:
            raise ValueError("this network needs V_sharp")
        if config.use_template and (self.template is None or self.outline is None):
            raise ValueError("this network needs a fitted template")
        density, share = self.read_density, self.share if self.gating is None else self.gating_share
        of_brain = density if share is None else density * share
        given = [
            self.coarse,
            confidence_from_density(of_brain) if config.use_density else None,
            self.sharp if config.use_sharp else None,
            confidence_from_density(density) if config.use_density else None,
            self.template if config.use_template else None,
        ]
        return [one for one in given if one is not None]

    def base(self, config: PriorNetworkConfig) -> Tensor:
        """The base of the residual: the measured volume where slices looked, the template where none did."""
        measured = self.sharp if config.sharp_base else self.coarse
        assert measured is not None
        if not config.use_template:
            return measured
        assert self.template is not None
        return torch.lerp(measured, self.template, self._unseen())

    def base_logit(self, config: PriorNetworkConfig) -> Tensor:
        """The base of the brain logit: the masks where slices looked, the template's outline elsewhere."""
        share = torch.ones_like(self.density) if self.share is None else self.share
        if config.use_template:
            assert self.outline is not None
            share = torch.lerp(share, self.outline, self._unseen())
        return CERTAIN_LOGIT * (2 * share - 1)

    def _unseen(self) -> Tensor:
        return torch.exp(-UNSEEN_POWER * self.density)

    def flip(self, dims: list[int]) -> PriorInputs:
        """All volumes mirrored along some axes."""
        present = {field.name: getattr(self, field.name) for field in fields(self)}
        mirrored = {name: one.flip(dims) for name, one in present.items() if one is not None}
        return PriorInputs(**mirrored)
