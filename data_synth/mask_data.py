"""LightningDataModule of the mask network: scans of random scenes, made on the fly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

from data_synth.atlas import TruthVolume
from data_synth.contrast import recoloured
from data_synth.data_module import VALIDATION_SEED, SyntheticDataModule
from data_synth.head_variation import varied_head
from data_synth.heads import Subject, load_head
from data_synth.mask_head import filled_head, scene_head
from data_synth.mask_samples import MaskSample, draw_sample
from data_synth.mask_scans import Scene, draw_scan
from data_synth.mask_surroundings import draw_surroundings
from data_synth.subject_dataset import SubjectDataset

HEAD_SPACING_MM = 1.2
N_VAL_PHANTOMS = 6
RECOLOURED_SHARE = 0.3
SCALE_RANGE = (0.86, 1.08)
"""Range of the factor on a head's size; it also makes heads smaller than those of atlases, which begin at 21 weeks."""
NEGATIVE_EVERY = 5
"""One validation sample in this many shows no head."""


class MaskDataModule(SyntheticDataModule):
    """Scans of heads in random surroundings from an atlas folder or the built-in phantom; see `mask_batch`.

    Args:
        wide_mm: pixel size of the wide image, in which the head is found.
        wide_shape: pixels and slices of the wide image.
        pixel_mm: pixel size of the crop, in which the head is outlined.
        crop_shape: pixels and slices of a crop about a head.
        batch_size: scans per training batch.
        samples_per_epoch: training samples per epoch.
        scans_per_scene: samples made from one scene.
        val_samples: validation samples.
        common: see `SyntheticDataModule`.

    Raises:
        InputError: a setting out of range, no such folder, or nothing in it passes the patterns.
    """

    def __init__(
        self,
        wide_mm: float = 2.4,
        wide_shape: tuple[int, int, int] = (128, 128, 12),
        pixel_mm: float = 1.2,
        crop_shape: tuple[int, int, int] = (128, 128, 12),
        batch_size: int = 4,
        samples_per_epoch: int = 384,
        scans_per_scene: int = 16,
        val_samples: int = 40,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.check_at_least_one("batch_size", "samples_per_epoch", "scans_per_scene", "val_samples")

    def make_sets(self) -> tuple[MaskSamples, MaskSamples]:
        """Training samples, which differ from epoch to epoch, and validation samples, which do not."""
        h: Any = self.hparams
        train, val = self.subjects(N_VAL_PHANTOMS)
        shapes = {
            "wide_mm": h.wide_mm,
            "wide_shape": tuple(h.wide_shape),
            "pixel_mm": h.pixel_mm,
            "crop_shape": tuple(h.crop_shape),
        }
        scenes = max(1, h.samples_per_epoch // h.scans_per_scene)
        return MaskSamples(train, length=h.samples_per_epoch, seed=h.seed, n_scenes=scenes, **shapes), MaskSamples(
            val, length=h.val_samples, seed=h.seed + VALIDATION_SEED, n_scenes=h.val_samples, in_order=True, **shapes
        )

    def train_dataloader(self) -> DataLoader:
        """A loader of this epoch's samples."""
        h: Any = self.hparams
        n_batches = h.samples_per_epoch // h.batch_size
        return self.train_loader(
            h.samples_per_epoch, n_batches, batch_size=h.batch_size, collate_fn=mask_batch, drop_last=True
        )

    def val_dataloader(self) -> DataLoader:
        """A loader of the validation samples, the same in every epoch."""
        return self.val_loader(mask_batch)


class MaskSamples(SubjectDataset[MaskSample]):
    """Samples made on the fly; an epoch has a few scenes, which its samples use in turn.

    Args:
        subjects: atlas subjects or phantoms.
        length: samples per epoch.
        seed: of the whole dataset.
        n_scenes: per epoch.
        in_order: for validation: subjects in turn, heads without augmentation, and every fifth scan without a head.
        shapes: see `draw_sample`.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        *,
        length: int,
        seed: int,
        n_scenes: int,
        in_order: bool = False,
        **shapes: Any,
    ) -> None:
        super().__init__(subjects, length, seed, in_order)
        self.n_scenes, self.shapes = n_scenes, shapes
        self._scenes: dict[tuple[int, int], Scene] = {}

    def make(self, epoch: int, index: int) -> MaskSample:
        """Sample (epoch, index)."""
        which, rng = self.draw(epoch, index)
        if self.in_order:
            scene = self._new_scene(which, rng)
            headless = self.turn(index, NEGATIVE_EVERY) == NEGATIVE_EVERY - 1
            return draw_sample(draw_scan(scene, rng, headless), rng, **self.shapes)
        scene = self._scene(epoch, index % self.n_scenes)
        return draw_sample(draw_scan(scene, rng), rng, **self.shapes)

    def load(self, subject: Subject) -> TruthVolume:
        """The subject in the atlas frame, its mask filled to the skull."""
        return filled_head(load_head(subject, HEAD_SPACING_MM))

    def _scene(self, epoch: int, number: int) -> Scene:
        """A scene of this epoch; scenes of other epochs are dropped."""
        key = (epoch, number)
        if key not in self._scenes:
            self._scenes = {k: scene for k, scene in self._scenes.items() if k[0] == epoch}
            rng = np.random.default_rng([self.seed, epoch, number, 1])
            which = int(rng.integers(len(self.subjects)))
            self._scenes[key] = self._new_scene(which, rng)
        return self._scenes[key]

    def _new_scene(self, which: int, rng: np.random.Generator) -> Scene:
        volume = self.volume(which)
        if not self.in_order:
            volume = varied_head(recoloured(volume, rng) if rng.random() < RECOLOURED_SHARE else volume, rng)
        return new_scene(volume, rng)


def new_scene(volume: TruthVolume, rng: np.random.Generator) -> Scene:
    """A randomly scaled head in random surroundings.

    Args:
        volume: a result of `filled_head`.
        rng: source of randomness.
    """
    affine = volume.affine.copy()
    affine[:3] *= rng.uniform(*SCALE_RANGE)
    head = scene_head(replace(volume, affine=affine), rng)
    return Scene(head=head, around=draw_surroundings(head.base_mm, head.radius_mm, rng))


def mask_batch(samples: Sequence[MaskSample]) -> dict[str, torch.Tensor]:
    """Samples as one dict of tensors [B, 1, ...] by the names of `MaskSample`."""
    return {
        field.name: torch.from_numpy(np.stack([getattr(one, field.name) for one in samples])[:, None])
        for field in fields(MaskSample)
    }
