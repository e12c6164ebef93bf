"""Poses of stacks and slices by classical registration, in the order of the data.

`misfits.register_robustly` is the whole of it, `estimate.register` that with all stacks, `settings` chooses its
layers, `thresholds` holds its tuned decisions.

1. `bias_correction` removes the slow trend of intensity from each stack.
2. `global_search` tries several initialisations of all poses: the headers; `stack_registration` (stack to
   stack); `atlas_search` (atlas templates); proposals of the pose network. `held_out` scores each by how well
   a volume of the other stacks predicts a stack, and the best one is taken.
3. `segment_search` refines it: the slices of a stack are placed in `motion_segments`, constant between two
   jerks. Both searches rest on `pose_sampling` (candidate motions), `so3_search` (all orientations),
   `similarity` (thinned pixels against a volume) and `placement` (the best segments among candidates).
4. `slice_rounds` alternates between a volume of all slices and `slice_registration`, Gauss-Newton steps of
   every slice by the `normal_equations` of the slice model.
5. `atlas_frame` moves the result into the standard orientation or keeps the frame of the scanner; `quality`
   says which stacks are registered, and `misfits` leaves those out that do not fit the others.

Where stacks lack slices (`acquisition.area_profile` says which), the template stands for what other stacks did not
see (`unseen`), and `overlap` measures how far stacks prove each other's poses.

Where poses come from elsewhere, `given` takes the place of steps 2 to 4 and measures what they measure.

`prior_registration` is used later, for single stacks alone: their slices move towards the prior volume.
"""

from g3r.registration.estimate import Registration, register
from g3r.registration.given import GivenPoses
from g3r.registration.misfits import register_robustly
from g3r.registration.settings import RegistrationSettings

__all__ = ["GivenPoses", "Registration", "RegistrationSettings", "register", "register_robustly"]
