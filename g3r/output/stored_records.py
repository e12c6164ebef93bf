"""Classes of stage results, which the files of a stage store may hold."""

from __future__ import annotations

from g3r.acquisition.area_profile import AreaProfile
from g3r.acquisition.foreground import Foreground
from g3r.acquisition.planes import FieldsOfView, Planes, Slices
from g3r.fitting.held_out_slices import HeldOutChoice
from g3r.fitting.initial_volumes import InitialVolumes, PriorVolume
from g3r.fitting.pose_rounds import PoseRounds, RefinedPoses
from g3r.fitting.prior_stage import PriorCloud
from g3r.fitting.slice_stage import SliceFit
from g3r.gaussians import GaussianCloud
from g3r.geometry import RigidPose, VolumeGrid
from g3r.registration import Registration
from g3r.registration.atlas_frame import Orientation
from g3r.registration.overlap import Overlap
from g3r.registration.stack_quality import StackQuality

STORED_RECORDS = (
    Registration,
    AreaProfile,
    Overlap,
    StackQuality,
    InitialVolumes,
    PriorVolume,
    RefinedPoses,
    PoseRounds,
    PriorCloud,
    HeldOutChoice,
    SliceFit,
    Slices,
    FieldsOfView,
    Foreground,
    Planes,
    RigidPose,
    Orientation,
    VolumeGrid,
    GaussianCloud,
)
