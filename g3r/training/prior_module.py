"""Training of the prior network."""

from typing import Any, cast

import torch
from torch import Tensor

from g3r.checkpoints.training_checkpoint import TRAINING_ENTRY
from g3r.errors import InputError
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.dgpn import DensityGatedPriorNetwork, PriorOutput
from g3r.prior.inputs import PriorInputs
from g3r.prior.model import VOXEL_MM_TOLERANCE, Prior
from g3r.training.annealed_module import AnnealedModule
from g3r.training.initial_weights import OPTION
from g3r.training.prior_batches import (
    DENSITY_KINDS,
    Batch,
    loss_weight,
    prior_inputs,
    prior_loss,
    random_cube_symmetry,
    weighted_l1,
)
from g3r.training.prior_validation import (
    PANEL_TAG,
    VALIDATED,
    ValidationScores,
    l1_by_confidence,
    panel,
    psnr_by_place,
    stack_numbers,
    stacks_suffix,
    validation_means,
)

DEFAULT_NETWORK = PriorNetworkConfig()
PLAIN = f"--model.density={DENSITY_KINDS[0]}"


class PriorModule(AnnealedModule):
    """Supervised training of V_prior against the true volume.

    Loss: `prior_loss`, weighted by `loss_weight`. Only voxels in the mask are used later, and V_coarse ends in a bright
    halo around it: with a larger weight of the background (0.1, and 1 within 3 voxels of the mask, was tried) the
    network learnt to trim the halo and nothing else.

    Args:
        network: see `PriorNetworkConfig`.
        learning_rate: peak rate of AdamW.
        weight_decay: weight decay of AdamW.
        warmup_steps: steps of linear warm-up.
        background_weight: loss weight outside the brain mask, 0 to 1; see `loss_weight`.
        augment_orientation: rotate and mirror each training batch by a random symmetry of the cube, so that
            the prior does not depend on the orientation in which a subject is reconstructed.
        density: definition of M_rho for gate and F, of `DENSITY_KINDS`. All but the first are for comparison: such a
            network cannot be exported.
        voxel_mm: isotropic voxel size of the training data; None takes the data module's `spacing_mm`.
        start_from: exported prior, or training checkpoint of one, with the initial weights; channels that it lacks
            start at zero, and so does the last layer if its prior has another base.

    Raises:
        ValueError: a rate or weight is out of range, or from the network.
    """

    model_type = Prior
    network: DensityGatedPriorNetwork

    def __init__(
        self,
        network: PriorNetworkConfig = DEFAULT_NETWORK,
        learning_rate: float = 1e-3,
        weight_decay: float = 1e-4,
        warmup_steps: int = 100,
        background_weight: float = 0.01,
        augment_orientation: bool = True,
        density: str = "coverage",
        voxel_mm: float | None = None,
        start_from: str | None = None,
    ) -> None:
        super().__init__(learning_rate, weight_decay, warmup_steps, start_from)
        if not 0 <= background_weight <= 1:
            raise ValueError(f"got {background_weight=}")
        if density not in DENSITY_KINDS:
            raise ValueError(f"got {density=}, expected one of {', '.join(DENSITY_KINDS)}")
        self.density = density
        self.keep_hyperparameters(network)
        self.network = DensityGatedPriorNetwork(network)
        self._learnt_at_mm: dict[str, float] = {}
        self.background_weight = background_weight
        self.augment_orientation = augment_orientation
        self.voxel_mm = voxel_mm
        self._panels: dict[int, Tensor] = {}
        self.weeks = [0.0] * network.template_shape[0]

    def forward(self, given: PriorInputs) -> PriorOutput:
        """Return V_prior and the brain's logit, [B, 1, I, J, K] (G3R Eq. 7)."""
        return cast(PriorOutput, self.network(given))

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one batch; log it, the error by confidence, and V_coarse's."""
        if self.augment_orientation:
            batch = random_cube_symmetry(batch)
        weight = loss_weight(batch, self.background_weight)
        found = self(prior_inputs(batch, self.density))
        loss = prior_loss(found, batch, weight)
        n_samples = batch["truth"].shape[0]
        self.log("train/loss", loss, prog_bar=True, batch_size=n_samples)
        with torch.no_grad():
            for name, value in l1_by_confidence(found.volume, batch).items():
                self.log(f"train/l1_prior_{name}", value, batch_size=n_samples)
            self.log("train/l1_prior", weighted_l1(found.volume, batch["truth"], weight), batch_size=n_samples)
            self.log("train/l1_coarse", weighted_l1(batch["coarse"], batch["truth"], weight), batch_size=n_samples)
        return loss

    def n_samples(self, batch: Batch) -> int:
        """Number of patches of a batch."""
        return int(batch["truth"].shape[0])

    def on_validation_epoch_start(self) -> None:
        """Forget the last epoch's scores and images."""
        if self.voxel_mm is None:  # `validate` alone fits nothing
            self.take_voxel_size()
        assert self.voxel_mm is not None
        self._scores, self._panels = ValidationScores(self.voxel_mm), {}

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the prior of every sample in its mask, and V_sharp and V_coarse for comparison."""
        prior = self(prior_inputs(batch, self.density)).volume.to(batch["truth"].dtype)
        volumes = {"prior": prior, **{name: batch[name] for name in VALIDATED[1:]}}
        self._scores.add(volumes, batch, loss_weight(batch, self.background_weight))
        for b, n in enumerate(stack_numbers(batch)):
            if n not in self._panels:
                gate = self.network.gate if self.network.config.use_gate else None
                self._panels[n] = panel({k: x[b : b + 1] for k, x in batch.items()}, prior[b : b + 1], gate)

    def on_validation_epoch_end(self) -> None:
        """Log mean L1, PSNR (dB), SSIM and gain, over all and by number of stacks; log the images."""
        # summed over the processes, so that all of them log and keep the same values
        sums, squares = (self._over_processes(one) for one in (self._scores.sums, self._scores.squares))
        for name, value in {**validation_means(sums), **psnr_by_place(squares)}.items():
            self.log(f"val/{name}", value, prog_bar=name == "psnr_gain")
        for n, image in sorted(self._panels.items()):
            self.log_image(f"val/{stacks_suffix(n).removeprefix('_') or 'volume'}: {PANEL_TAG}", image)

    def _over_processes(self, sums: Tensor) -> Tensor:
        """The sum over all processes."""
        gathered = self.all_gather(sums.to(self.device, torch.float32))
        assert isinstance(gathered, Tensor)
        return gathered.sum(0) if gathered.ndim > sums.ndim else gathered

    def setup(self, stage: str) -> None:
        """Take the atlas template from the data module.

        Raises:
            InputError: the template is on another grid than the network's.
        """
        self.take_template()

    def begin_with(self, path: str) -> Prior:
        """Take the initial weights; the last layer starts at zero where the residual is added to something else."""
        other = super().begin_with(path)
        assert isinstance(other, Prior)
        self._learnt_at_mm[OPTION] = other.voxel_mm
        mine, theirs = self.network.config, other.network.config
        if (mine.sharp_base, mine.use_template) != (theirs.sharp_base, theirs.use_template):
            head = self.network.refiner.head
            torch.nn.init.zeros_(head.weight)
            torch.nn.init.zeros_(head.bias)  # type: ignore[arg-type]
        return other

    def on_fit_start(self) -> None:
        """Take initial weights and, once a checkpoint to go on with is loaded, the data module's voxel size."""
        super().on_fit_start()
        self.take_voxel_size()

    def take_voxel_size(self) -> None:
        """Take the voxel size from the data module.

        Raises:
            InputError: the voxel size is unknown or differs from the data's, or the initial weights were trained on
                another one.
        """
        settings = self.describe_data()
        spacing_mm = settings.get("spacing_mm", getattr(getattr(self.trainer, "datamodule", None), "spacing_mm", None))
        if self.voxel_mm is None:
            if spacing_mm is None:
                raise InputError("model.voxel_mm: not given, and the data module has no spacing_mm; pass either")
            self.voxel_mm = float(spacing_mm)
        elif spacing_mm is not None and abs(self.voxel_mm - float(spacing_mm)) > VOXEL_MM_TOLERANCE:
            raise InputError(
                f"model.voxel_mm: {self.voxel_mm} mm, but the data are made at {spacing_mm} mm; leave it out"
            )
        for name, voxel_mm in self._learnt_at_mm.items():
            if abs(voxel_mm - self.voxel_mm) > VOXEL_MM_TOLERANCE:
                raise InputError(
                    f"{name}: was trained on voxels of {voxel_mm:g} mm, the data have {self.voxel_mm:g} mm; "
                    f"leave it out, or pass --data.spacing_mm {voxel_mm:g}"
                )

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check the density, and note the voxel size, which `take_voxel_size` compares with the data's.

        Raises:
            InputError: the checkpoint is of another training.
        """
        super().on_load_checkpoint(checkpoint)
        entry = checkpoint[TRAINING_ENTRY]
        before, now = (one.get("comparison_only") or PLAIN for one in (entry, self.own_description()))
        if before != now:
            raise InputError(f"ckpt_path: was trained with {before}, now it is {now}; resume with {before}")
        if entry["voxel_mm"] is not None:
            self._learnt_at_mm["ckpt_path"] = float(entry["voxel_mm"])

    def own_description(self) -> dict[str, Any]:
        """Values that a `Prior` needs besides its weights."""
        own = {"voxel_mm": self.voxel_mm, "weeks": self.weeks}
        # g3r-infer passes the coverage to every prior
        return (
            own if self.density == DENSITY_KINDS[0] else {**own, "comparison_only": f"--model.density={self.density}"}
        )
