"""Names of masks."""

import pytest

from g3r.masking.names import mask_name


@pytest.mark.parametrize(
    ("stack", "mask"),
    [
        ("a/b/ax.nii.gz", "ax_mask"),
        ("ax.1.nii", "ax.1_mask"),
        ("sub-01_T2w.nii.gz", "sub-01_desc-brain_mask"),
        ("in/sub-01_ses-2_acq-haste_run-3_T2w.nii.gz", "sub-01_ses-2_acq-haste_run-3_desc-brain_mask"),
        ("sub-01_run-1_desc-denoised_T2w.nii.gz", "sub-01_run-1_desc-brain_mask"),
        ("sub-01.nii.gz", "sub-01_mask"),
        ("subject-01_T2w.nii.gz", "subject-01_T2w_mask"),
    ],
)
def test_a_mask_is_named_after_its_stack(stack: str, mask: str) -> None:
    assert mask_name(stack) == mask
