"""Augmentation of a truth volume before it is sliced: torchio's transforms, and our own where torchio has none."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torchio as tio

from data_synth.atlas import TruthVolume
from data_synth.contrast import recoloured
from data_synth.pathology import REACH_MM, enlarged_ventricles, with_lesions

CONTRAST_SHARE, VENTRICLES_SHARE, LESION_SHARE = 0.3, 0.2, 0.25
"""How often a head gets other tissue intensities, enlarged ventricles, lesions."""

MIN_MASK_SHARE = 0.3
"""If less than this share of the mask is left, the transform pushed the head out of the grid and is discarded."""


def augmentation() -> tio.Compose:
    """Left-right flips, small affine and elastic deformations, and changes of contrast and brightness."""
    return tio.Compose(
        [
            tio.RandomFlip(axes=0, flip_probability=0.5),  # left-right: truth volumes are RAS
            tio.OneOf(
                {
                    tio.RandomAffine(
                        scales=0.08, degrees=15, translation=0, image_interpolation="bspline", default_pad_value=0
                    ): 0.75,
                    tio.RandomAffineElasticDeformation(
                        affine_kwargs={"scales": 0.08, "degrees": 15, "translation": 0, "default_pad_value": 0},
                        elastic_kwargs={"num_control_points": 7, "max_displacement": 2.5, "locked_borders": 2},
                    ): 0.25,
                }
            ),
            tio.RandomGamma(log_gamma=(-0.35, 0.35), p=0.8),
            tio.RandomBiasField(coefficients=0.15, order=2, p=0.4),
        ]
    )


def augmented(volume: TruthVolume, transform: tio.Transform, rng: np.random.Generator) -> TruthVolume:
    """A randomly augmented volume: sometimes other tissue intensities or a pathology, then a torchio transform.

    Args:
        volume: a head, with labels where they are known.
        transform: such as `augmentation()`.
        rng: source of randomness.

    Returns:
        A volume without labels. It is zero outside its (moved) mask, and its 99.5th percentile is 1. If too little of
        the mask is left (`MIN_MASK_SHARE`), the volume before the torchio transform.
    """
    volume = _other_anatomy(volume, rng)
    moved = transformed(volume, transform, rng)
    if moved.mask.sum() < MIN_MASK_SHARE * volume.mask.sum():
        return volume
    bright = np.float32(max(float(np.percentile(moved.data[moved.mask], 99.5)), 1e-6))
    return TruthVolume(name=moved.name, data=moved.data / bright, mask=moved.mask, affine=moved.affine)


def transformed(volume: TruthVolume, transform: tio.Transform, rng: np.random.Generator) -> TruthVolume:
    """A head and its mask after a torchio transform.

    Args:
        volume: a head.
        transform: of images and label maps.
        rng: source of randomness.

    Returns:
        A volume without labels, zero outside its mask.
    """
    subject = tio.Subject(
        image=tio.ScalarImage(tensor=torch.from_numpy(volume.data)[None], affine=volume.affine),
        mask=tio.LabelMap(tensor=torch.from_numpy(volume.mask.astype(np.uint8))[None], affine=volume.affine),
    )
    result = applied(transform, subject, rng)
    mask = result["mask"].data[0].numpy() > 0
    data = np.clip(np.nan_to_num(result["image"].data[0].numpy().astype(np.float32)), 0, None)
    return TruthVolume(
        name=volume.name, data=np.where(mask, data, np.float32(0)), mask=mask, affine=np.array(result["image"].affine)
    )


def applied(transform: tio.Transform, subject: tio.Subject, rng: np.random.Generator) -> Any:
    """Apply a torchio transform whose random numbers come from `rng`.

    torchio draws from torch's global generator, which is seeded here and restored afterwards. The transform runs on
    one thread, because torch's powers differ in the last bit where the parts of two threads meet, and numba changes
    torch's number of threads.

    Args:
        transform: to apply.
        subject: torchio's.
        rng: source of the seed.
    """
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**62)))
            return transform(subject)
    finally:
        torch.set_num_threads(n_threads)


def _other_anatomy(volume: TruthVolume, rng: np.random.Generator) -> TruthVolume:
    """Augmentations that torchio lacks: ventricles, contrast by tissue, lesions."""
    draws = rng.random(3)
    if draws[0] < VENTRICLES_SHARE:
        volume = enlarged_ventricles(volume, float(rng.uniform(0.3, 1.0) * REACH_MM))
    if draws[1] < CONTRAST_SHARE:
        volume = recoloured(volume, rng)
    if draws[2] < LESION_SHARE:
        volume = with_lesions(volume, rng)
    return volume
