"""Training of the prior network."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from g3r.errors import InputError
from g3r.prior.checkpoint import VOXEL_MM_TOLERANCE, load_prior
from g3r.prior.dgpn import DensityGatedPriorNetwork
from g3r.prior.gate import DensityGate, confidence_from_density
from g3r.training.annealed_module import AnnealedModule, describe_data

Batch = Mapping[str, Tensor]
"""{"coarse", "density", "sharp", "truth", "mask"}, each float32 [B, 1, I, J, K], intensities "p99-coarse-v1".

`n_stacks`, int64 [B], is optional: scores are also logged by the number of stacks where it is there. Other
entries are left as they are."""

VALIDATED = ("prior", "sharp", "coarse")
"""Volumes that are scored: the network's, and what it starts from."""
METRICS = ("l1", "psnr", "ssim")
MAX_STACKS = 12
"""More count as so many."""
PANEL_TAG = "coarse, sharp, confidence, gate, prior, truth, 4 x error"

EXPORT_KEY = "g3r_prior"
"""Where a training checkpoint keeps what `g3r-export` needs, in plain values."""


class PriorModule(AnnealedModule):
    """Supervised training of V_prior against the true volume.

    Loss: mean absolute error, weighted 1 in the brain mask and `background_weight` elsewhere. Only what lies
    in the mask is used later, and V_coarse ends in a bright halo around it: with a background that counted
    more (0.1, and 1 within 3 voxels of the mask, was tried) the network learnt to trim the halo and nothing
    else. The little that is left keeps the output bounded there.

    Args:
        channels: see `ResidualRefiner`.
        units: see `ResidualRefiner`.
        tail_channels: see `ResidualRefiner`.
        alpha: gate at high density.
        beta: gate at zero density.
        use_gate: False sets G = 1 (an ablation).
        use_density: False hides the density from F (an ablation).
        use_sharp: False leaves V_sharp out: Eq. 7 as printed (an ablation).
        sharp_base: True adds the residual to V_sharp (an ablation).
        learning_rate: peak rate of AdamW.
        weight_decay: of AdamW.
        warmup_steps: steps of linear warm-up.
        background_weight: loss weight outside the brain mask, 0 to 1.
        augment_orientation: turn and mirror each training batch by a random symmetry of the cube, so that
            the prior does not depend on the orientation in which a subject is reconstructed.
        voxel_mm: isotropic voxel size of the training data; None takes the data module's `spacing_mm`.
        start_from: prior file whose weights to begin with; channels that it lacks begin at zero, and so does
            the last layer if its prior has another base.

    Raises:
        ValueError: from the network, or a rate or weight out of range.
        InputError: `start_from` cannot be read, or is of a network of another size.
    """

    def __init__(
        self,
        channels: Sequence[int] = (32, 64, 96),
        units: Sequence[int] = (1, 2, 3),
        tail_channels: int = 8,
        alpha: float = 0.05,
        beta: float = 1.0,
        use_gate: bool = True,
        use_density: bool = True,
        use_sharp: bool = True,
        sharp_base: bool = False,
        learning_rate: float = 1e-3,
        weight_decay: float = 1e-4,
        warmup_steps: int = 100,
        background_weight: float = 0.01,
        augment_orientation: bool = True,
        voxel_mm: float | None = None,
        start_from: str | None = None,
    ) -> None:
        super().__init__(learning_rate, weight_decay, warmup_steps)
        if not 0 <= background_weight <= 1:
            raise ValueError(f"got {background_weight=}")
        self.save_hyperparameters()
        self.network = DensityGatedPriorNetwork(
            channels, units, tail_channels, alpha, beta, use_gate, use_density, use_sharp, sharp_base
        ).to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        self._learnt_at_mm: dict[str, float] = {}
        if start_from is not None:
            self._learnt_at_mm["model.start_from"] = take_weights(self.network, start_from)
        self.background_weight = background_weight
        self.augment_orientation = augment_orientation
        self.voxel_mm = voxel_mm
        self._training_data = "not recorded"
        self._sums = torch.zeros(0)
        self._panels: dict[int, Tensor] = {}

    def forward(self, v_coarse: Tensor, m_rho: Tensor, v_sharp: Tensor | None = None) -> Tensor:
        """Return V_prior; see `DensityGatedPriorNetwork.forward`."""
        return self.network(v_coarse, m_rho, v_sharp)

    # ---- training -------------------------------------------------------------------------------------

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the weighted L1 error of one batch and log it beside V_coarse's."""
        if self.augment_orientation:
            batch = random_cube_symmetry(batch)
        weight = loss_weight(batch["mask"], self.background_weight)
        loss = weighted_l1(self(batch["coarse"], batch["density"], batch["sharp"]), batch["truth"], weight)
        n_samples = batch["truth"].shape[0]
        self.log("train/l1_prior", loss, prog_bar=True, batch_size=n_samples)
        coarse_loss = weighted_l1(batch["coarse"], batch["truth"], weight)
        self.log("train/l1_coarse", coarse_loss, batch_size=n_samples)
        return loss

    def n_samples(self, batch: Batch) -> int:
        """Patches of a batch."""
        return int(batch["truth"].shape[0])

    # ---- validation -----------------------------------------------------------------------------------

    def on_validation_epoch_start(self) -> None:
        """Forget the last epoch's scores and images."""
        # sum and number of each score, for each number of stacks; row 0 is everything
        shape = (MAX_STACKS + 1, len(VALIDATED), len(METRICS), 2)
        self._sums = torch.zeros(shape, dtype=torch.float64)
        self._panels = {}

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score every volume of a batch in its mask: the prior, and V_sharp and V_coarse beside it."""
        truth, mask = batch["truth"], batch["mask"] > 0.5
        prior = self(batch["coarse"], batch["density"], batch["sharp"]).to(truth.dtype)
        weight = loss_weight(batch["mask"], self.background_weight)
        n_stacks = stack_numbers(batch)
        volumes = {"prior": prior, "sharp": batch["sharp"], "coarse": batch["coarse"]}
        for v, name in enumerate(VALIDATED):
            for b, n in enumerate(n_stacks):
                one = slice(b, b + 1)
                scores = scores_in_mask(volumes[name][one], truth[one], mask[one])
                scores["l1"] = [float(weighted_l1(volumes[name][one], truth[one], weight[one]))]
                for m, metric in enumerate(METRICS):
                    for value in scores[metric]:
                        for row in {0, n}:
                            self._sums[row, v, m] += torch.tensor([value, 1.0], dtype=torch.float64)
        for b, n in enumerate(n_stacks):
            if n not in self._panels:
                gate = self.network.gate if self.network.use_gate else None
                self._panels[n] = panel({k: x[b : b + 1] for k, x in batch.items()}, prior[b : b + 1], gate)

    def on_validation_epoch_end(self) -> None:
        """Log mean L1, PSNR (dB), SSIM and gain, over all and by number of stacks; send the images."""
        # summed over the processes, so that all of them log, and keep, the same
        sums = self.all_gather(self._sums.to(self.device, torch.float32))
        assert isinstance(sums, Tensor)
        if sums.ndim > self._sums.ndim:
            sums = sums.sum(0)
        for name, value in validation_scores(sums).items():
            self.log(f"val/{name}", value, prog_bar=name == "psnr_gain")
        for logger in self.loggers:
            if isinstance(logger, TensorBoardLogger):
                for n, image in sorted(self._panels.items()):
                    logger.experiment.add_image(
                        f"val/{stacks_suffix(n).removeprefix('_') or 'volume'}: {PANEL_TAG}",
                        image,
                        global_step=self.global_step,
                        dataformats="HW",
                    )

    # ---- what an export needs -------------------------------------------------------------------------

    def on_fit_start(self) -> None:
        """Take the voxel size and a description from the data module.

        Raises:
            InputError: the voxel size is not known, or differs from the data's, or the weights to go on with
                were trained on another.
        """
        data = getattr(self.trainer, "datamodule", None)
        settings = dict(getattr(data, "hparams", None) or {})
        spacing_mm = settings.get("spacing_mm", getattr(data, "spacing_mm", None))
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
        self._training_data = describe_data(data, settings)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Note the voxel size of a run that is gone on with; `on_fit_start` compares it with the data's."""
        voxel_mm = checkpoint.get(EXPORT_KEY, {}).get("voxel_mm")
        if voxel_mm is not None:
            self._learnt_at_mm["ckpt_path"] = float(voxel_mm)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the description from which `g3r-export` makes a prior checkpoint, in plain values only."""
        metrics = {name: float(value) for name, value in self.trainer.callback_metrics.items()}
        checkpoint[EXPORT_KEY] = {
            "network_arguments": self.network.arguments(),
            "voxel_mm": self.voxel_mm,
            "training_data": self._training_data,
            "optimiser_steps": int(self.global_step),
            "validation": {name: value for name, value in metrics.items() if name.startswith("val/")},
        }


def take_weights(network: DensityGatedPriorNetwork, path: str) -> float:
    """Begin with the weights of a prior file, of a network that may have had fewer inputs.

    Returns:
        The voxel size (mm) that they were trained on.

    Raises:
        InputError: the file cannot be read, or its network has other channels or units.
    """
    other, meta = load_prior(Path(path))
    own = network.state_dict()
    for name, given in other.state_dict().items():
        into = own.get(name)
        fits = into is not None and into.ndim == given.ndim and into.shape[:1] == given.shape[:1]
        if into is None or not fits or into.shape[2:] != given.shape[2:] or into.numel() < given.numel():
            raise InputError(
                f"model.start_from: {path} has {dict(meta.network_arguments)}, this network differs; "
                "give it the same channels and units"
            )
        if into.shape != given.shape:
            into.zero_()
            into[:, : given.shape[1]] = given
        else:
            into.copy_(given)
    if other.sharp_base != network.sharp_base:
        torch.nn.init.zeros_(network.refiner.head.weight)
        torch.nn.init.zeros_(network.refiner.head.bias)  # type: ignore[arg-type]
    return meta.voxel_mm


def loss_weight(mask: Tensor, background_weight: float) -> Tensor:
    """Return 1 in the mask and `background_weight` elsewhere, [B, 1, I, J, K]."""
    return background_weight + (1.0 - background_weight) * (mask > 0.5).to(mask.dtype)


def weighted_l1(volume: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return sum(w |V - truth|) / sum(w), a scalar."""
    return (weight * (volume - truth).abs()).sum() / weight.sum().clamp_min(torch.finfo(weight.dtype).tiny)


def random_cube_symmetry(batch: Batch) -> dict[str, Tensor]:
    """Return the batch mirrored and turned by one random symmetry of its grid (48 of a cube).

    Axes are exchanged only among those of equal extent, so the shape stays the same. The random numbers are
    torch's global ones, which Lightning seeds.
    """
    shape = batch["truth"].shape[2:]
    order = torch.randperm(3).tolist()
    if [shape[axis] for axis in order] != list(shape):
        order = [0, 1, 2]
    mirrored = [2 + axis for axis in range(3) if torch.rand(()) < 0.5]
    dims = [0, 1, *[2 + axis for axis in order]]
    return {
        name: value.permute(dims).flip(mirrored).contiguous() if value.ndim == 5 else value
        for name, value in batch.items()
    }


def scores_in_mask(volume: Tensor, truth: Tensor, mask: Tensor) -> dict[str, list[float]]:
    """Return PSNR (dB) and SSIM per sample, over the mask, for a data range of 1 (the 99th percentile).

    Samples with an empty mask are left out; SSIM also where an extent is below its window of 11 voxels.
    """
    scores: dict[str, list[float]] = {"psnr": [], "ssim": []}
    for one, true, inside in zip(volume.float(), truth.float(), mask, strict=True):
        if not bool(inside.any()):
            continue
        psnr = peak_signal_noise_ratio(one[inside], true[inside], data_range=1.0)
        scores["psnr"].append(float(psnr))
        if min(one.shape[1:]) >= 11:
            _, local = structural_similarity_index_measure(
                one[None], true[None], data_range=1.0, return_full_image=True
            )
            scores["ssim"].append(float(local[0][inside].mean()))
    return scores


def stack_numbers(batch: Batch) -> list[int]:
    """How many stacks each sample was made of, at most `MAX_STACKS`; 0 where the batch does not say."""
    if "n_stacks" not in batch:
        return [0] * len(batch["truth"])
    return [min(int(n), MAX_STACKS) for n in batch["n_stacks"]]


def stacks_suffix(n_stacks: int) -> str:
    """Ending of a tag: `_1stack`, `_3stacks`, or nothing for 0."""
    return f"_{n_stacks}stack{'s' * (n_stacks > 1)}" if n_stacks else ""


def validation_scores(sums: Tensor) -> dict[str, float]:
    """Means by name: `psnr_prior`, `psnr_prior_1stack`, `psnr_gain` (prior less V_coarse) and so on.

    Args:
        sums: [`MAX_STACKS` + 1, volumes, metrics, 2], sums of the scores and their numbers.
    """
    result: dict[str, float] = {}
    for n, of_volume in enumerate(sums.double().cpu()):
        for name, of_metric in zip(VALIDATED, of_volume, strict=True):
            for metric, (total, count) in zip(METRICS, of_metric.tolist(), strict=True):
                if count:
                    result[f"{metric}_{name}{stacks_suffix(n)}"] = total / count
        prior, coarse = (result.get(f"psnr_{name}{stacks_suffix(n)}") for name in ("prior", "coarse"))
        if prior is not None and coarse is not None:
            result[f"psnr_gain{stacks_suffix(n)}"] = prior - coarse
    return result


def panel(batch: Batch, prior: Tensor, gate: DensityGate | None) -> Tensor:
    """Return the volumes named in `PANEL_TAG` side by side, [H, W] in [0, 1].

    The section is the one with the most brain of the batch's first sample. Confidence is c = 1 - exp(-M), the
    gate is 1 everywhere without one, the error is 4 |prior - truth|.
    """
    volumes = {name: value[0, 0].detach().float().cpu() for name, value in batch.items() if value.ndim == 5}
    section = int((volumes["mask"] > 0.5).sum((0, 1)).argmax())
    truth, density, shown = volumes["truth"], volumes["density"], prior[0, 0].detach().float().cpu()
    row = [
        volumes["coarse"],
        volumes["sharp"],
        confidence_from_density(density),
        torch.ones_like(density) if gate is None else gate(density),
        shown,
        truth,
        4.0 * (shown - truth).abs(),
    ]
    # Columns follow i (the patient's right), rows follow j upwards (anterior).
    return torch.cat([image[:, :, section].T.flip(0) for image in row], 1).clamp(0.0, 1.0)
