"""An atlas folder of phantoms."""

from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray

from data_synth.atlas import VENTRICLES
from data_synth.phantom import Phantom, fetal_brain_phantom
from g3r.geometry import VolumeGrid

SPOT_MM = (13.0, 11.0, 9.0)
"""Position of the spot: right, anterior and superior of a phantom's centre, inside its head."""

SPOT_RADIUS_MM = 6.0


def write_subject(
    folder: Path, weeks: float, affine_flip: bool = False, names: tuple[str, str] = ("t2", "mask")
) -> None:
    made = fetal_brain_phantom(weeks, 3.0)
    t2, mask, affine = made.t2, made.mask.astype(np.uint8), made.affine
    if affine_flip:  # the same brain stored with flipped axes
        affine = affine @ np.diag([-1.0, 1, 1, 1])
        affine[0, 3] = -affine[0, 3]
        t2, mask = t2[::-1], mask[::-1]
    folder.mkdir(parents=True, exist_ok=True)
    nib.save(nib.Nifti1Image(t2, affine), folder / f"{names[0]}.nii.gz")
    nib.save(nib.Nifti1Image(mask, affine), folder / f"{names[1]}.nii.gz")


def write_marked_subject(folder: Path, weeks: float, axes: str) -> tuple[Phantom, NDArray[np.uint8]]:
    """A phantom with a bright spot at `SPOT_MM`, which its labels call ventricles, as t2, mask and labels.

    Args:
        folder: to write.
        weeks: of the phantom.
        axes: of the files, such as "LPS" if the first index grows to the left.

    Returns:
        The phantom with the spot, and its labels: `VENTRICLES` in the spot, 1 in the rest of the head, 0 around it.
    """
    made = fetal_brain_phantom(weeks, 3.0)
    place = VolumeGrid(made.t2.shape, made.affine).world(np.moveaxis(np.indices(made.t2.shape), 0, -1))
    spot = np.linalg.norm(place - SPOT_MM, axis=-1) < SPOT_RADIUS_MM
    assert made.mask[spot].all()
    made = replace(made, t2=np.where(spot, 3 * made.t2.max(), made.t2).astype(np.float32))
    labels = np.where(spot, VENTRICLES, made.mask).astype(np.uint8)
    orientations = nib.orientations
    turn = orientations.ornt_transform(orientations.io_orientation(made.affine), orientations.axcodes2ornt(axes))
    folder.mkdir(parents=True)
    for name, data in {"t2": made.t2, "mask": made.mask.astype(np.uint8), "labels": labels}.items():
        nib.save(nib.Nifti1Image(data, made.affine).as_reoriented(turn), folder / f"{name}.nii.gz")
    return made, labels
