"""Synthetic stacks of moving fetal heads with known truth, for training and for evaluation.

A head becomes stacks and then training data in this order; a module imports only from its own group and those above.

- Heads: `shapes`, `anatomy` and `phantom` make a procedural brain of any gestational age; `atlas` reads folders of
  NIfTI volumes; `heads` gives both as subjects; `template` averages them by age.
- Variation of a head: `contrast` (tissue intensities), `pathology` (ventricles, lesions), `augment` (torchio's
  transforms with a generator of ours), `head_variation` (shapes and intensities for the pose network).
- Motion: `motion` (from slice to slice), `trajectories` (in time, as recorded), `stack_planning` (where the stacks'
  slices are).
- Slices: `slice_profile` and `simulator` make the stacks, the same for evaluation and for training;
  `slice_sampling` makes slice images by the hundred; `artefacts` corrupts single slices.
- What is wrong before the prior sees it: `registration_errors` (poses), `mask_errors` (masks).
- Training data: `protocol_sampling`, `prior_samples` and `prior_data` for the prior network, `pose_samples` and
  `pose_data` for the pose network; `subject_dataset` and `data_module` hold what both share, `subject_cache` keeps
  subjects once made. Only the two data modules and their base import Lightning.
- Output: `export` writes a simulated subject as a folder; `cli` is `g3r-simulate`.
"""
