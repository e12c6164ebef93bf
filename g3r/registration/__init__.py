"""Poses of stacks and slices by classical registration, in the order of the data.

`misfits.register_robustly` is the entry point; `estimate.register` registers all stacks and leaves none out. `settings`
chooses the layers, `thresholds` holds the tuned limits.

1. `bias_correction` removes the slow trend of intensity from each stack.
2. `global_search` tries several initialisations of all poses: the headers; `stack_registration` (stack to
   stack); `atlas_search` (atlas templates); proposals of the pose network. `held_out` scores each by how well
   a volume of the other stacks predicts a stack, and the best one is taken.
3. `segment_search` refines it: the slices of a stack are placed in `motion_segments`, constant between two
   jerks. Both searches rest on `pose_sampling` (candidate motions), `so3_search` (all orientations),
   `similarity` (thinned pixels against a volume) and `placement` (the best segments among candidates).
4. `slice_rounds` alternates between a volume of all slices and `slice_registration`, Gauss-Newton steps of
   every slice by the `normal_equations` of the slice model. `stray_slices` searches again for slices in wrong places.
5. `atlas_frame` moves the result into the standard orientation or keeps the frame of the scanner. `motion_shear`
   removes the part of the open shear (`open_strain`) that is not motion.
6. `quality` decides by `stack_quality`, `handedness` and `intruder` which stacks are registered, and `misfits` leaves
   out those that do not fit the others.

Where stacks lack slices (`acquisition.area_profile` finds them), the template stands for what other stacks did not
see (`unseen`), and `overlap` measures how far stacks check each other's poses.

Where poses come from elsewhere, `given` takes the place of steps 2 to 4 and makes the same measurements.

`prior_registration` is used later, for single stacks alone: it moves their slices towards the prior volume.
`stack_in_volume` places a stack in a finished volume.
"""

from g3r.registration.estimate import Registration, register
from g3r.registration.given import GivenPoses
from g3r.registration.misfits import register_robustly
from g3r.registration.settings import RegistrationSettings

__all__ = ["GivenPoses", "Registration", "RegistrationSettings", "register", "register_robustly"]
