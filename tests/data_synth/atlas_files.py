"""An atlas folder of phantoms."""

from pathlib import Path

import nibabel as nib
import numpy as np

from data_synth.phantom import fetal_brain_phantom


def write_subject(
    folder: Path, weeks: float, affine_flip: bool = False, names: tuple[str, str] = ("t2", "mask")
) -> None:
    made = fetal_brain_phantom(weeks, 3.0)
    t2, mask, affine = made.t2, made.mask.astype(np.uint8), made.affine
    if affine_flip:  # the same brain stored the other way round
        affine = affine @ np.diag([-1.0, 1, 1, 1])
        affine[0, 3] = -affine[0, 3]
        t2, mask = t2[::-1], mask[::-1]
    folder.mkdir(parents=True, exist_ok=True)
    nib.save(nib.Nifti1Image(t2, affine), folder / f"{names[0]}.nii.gz")
    nib.save(nib.Nifti1Image(mask, affine), folder / f"{names[1]}.nii.gz")
