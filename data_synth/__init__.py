"""Synthetic stacks of moving fetal heads with known truth, for training and for evaluation.

The groups are in processing order: a head becomes stacks, then training data. A module imports only from its own group
and the groups above it.

- Heads: `shapes`, `noise`, `anatomy` and `phantom` make a procedural brain of any gestational age; `atlas` reads
  folders of NIfTI volumes; `heads` gives both as subjects; `template` averages subjects by age; `objects` makes an
  object that is not a brain.
- Variation of a head: `contrast` (tissue intensities), `pathology` (ventricles, lesions), `augment` (torchio
  transforms with a seeded generator), `head_variation` (shapes and intensities for the pose and mask networks).
- Motion: `motion` (from slice to slice), `trajectories` (in time, as recorded), `stack_planning` (positions and
  orientations of the slices).
- Slices: `slice_profile` and `simulator` make the stacks, the same for evaluation and for training;
  `slice_sampling` makes hundreds of slice images quickly; `artefacts` corrupts single slices.
- Defects of the prior network's input: `registration_errors` (poses), `mask_errors` (masks), `uneven_coverage`
  (missing slices, fields of view that cut the head).
- Scenes for the mask network: `mask_labels` (tissues), `mask_head` (head with skull, face and neck),
  `mask_surroundings` (mother and fetal body), `mask_slicing` and `mask_scans` (slices of a scene).
- Training data: `protocol_sampling`, `prior_samples` and `prior_data` for the prior network, `pose_samples` and
  `pose_data` for the pose network, `mask_samples` and `mask_data` for the mask network. `subject_dataset` and
  `data_module` hold the common parts, `subject_cache` stores synthetic subjects in files. Only the three data modules
  (`prior_data`, `pose_data`, `mask_data`) and their base class in `data_module` import Lightning.
- Output: `export` writes a simulated subject as a folder; `cli` is `g3r-simulate`.
"""
