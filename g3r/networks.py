"""The networks of a reconstruction, loaded when they are needed: their libraries take seconds to import."""

from __future__ import annotations

import os
from functools import cached_property
from typing import TYPE_CHECKING, Any

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.acquisition.planes import Slices
from g3r.checkpoints.device import device_of
from g3r.checkpoints.plain_values import number
from g3r.checkpoints.shipped import set_of
from g3r.checkpoints.stored_model import StoredModel
from g3r.checkpoints.weights_file import WeightsFile
from g3r.fitting.subject_prior import SubjectPrior
from g3r.geometry import RigidPose
from g3r.planning.presets import ReconstructionSettings
from g3r.pose_network.stored_template import stored_template
from g3r.run.lean_import import lean

if TYPE_CHECKING:
    from g3r.pose_network.model import PoseModel
    from g3r.prior.model import Prior

Source = str | os.PathLike[str] | WeightsFile | None


class Networks:
    """Prior and pose network of a reconstruction, and the atlas template of its registration.

    Args:
        prior: checkpoint of the prior, or the name of a set of weights that ships with the package; the default set
            when None.
        pose: the same for the pose network; when None, that of the set that `prior` names.
        settings: of the reconstruction, which decide what of these is used.
        device: see `device_of`.

    Raises:
        InputError: an unreadable or mismatched checkpoint, no GPU.
    """

    def __init__(self, prior: Source, pose: Source, settings: ReconstructionSettings, device: str) -> None:
        use_prior, search = settings.use_prior, settings.registration
        self.device = device_of(device) if use_prior or search.network or device != "auto" else "cpu"
        self.stored_prior = StoredModel(prior, "prior", self._load_prior) if use_prior else None
        use_pose = search.template or search.network
        self.stored_pose = StoredModel(pose or set_of(prior), "pose", self._load_pose) if use_pose else None

    def start(self) -> None:
        """Begin to load the prior in the background. The pose network is not loaded ahead, since it is rarely used."""
        if self.stored_prior:
            self.stored_prior.start()

    @property
    def prior(self) -> Prior | None:
        """The prior network; None where it is not used."""
        return self.stored_prior.model if self.stored_prior else None

    @property
    def pose(self) -> PoseModel | None:
        """The pose network; None where it is not used."""
        return self.stored_pose.model if self.stored_pose else None

    @cached_property
    def template(self) -> AtlasTemplate | None:
        """Atlas template of the registration; None where it is not used."""
        return stored_template(self.stored_pose) if self.stored_pose else None

    def subject_prior(self, settings: ReconstructionSettings) -> SubjectPrior:
        """The maker of a subject's volumes; waits for the prior network if the settings use it."""
        prior = self.prior if settings.use_prior else None
        own_voxel_mm = max(settings.resolution_mm, settings.least_squares_voxel_mm)
        return SubjectPrior(
            network=prior,
            voxel_mm=prior.voxel_mm if prior else own_voxel_mm,
            common_bias_field=settings.common_bias_field,
            least_squares=settings.least_squares_voxel_mm > 0,
        )

    @property
    def prior_voxel_mm(self) -> float | None:
        """Voxel size of V_prior; None without its network."""
        return number(self.stored_prior.file.description, "voxel_mm") if self.stored_prior else None

    def proposed_motion(self, slices: Slices) -> RigidPose | None:
        """Motions [K] (world from header) of slices as the pose network predicts them; None where it is not used.

        Args:
            slices: at their header poses.
        """
        return None if self.pose is None else self.pose.predict(slices) @ slices.header_pose.inverse()

    def records(self) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
        """Facts about prior and pose network, for run.json."""
        prior, pose = (stored.record() if stored else None for stored in (self.stored_prior, self.stored_pose))
        return prior, pose

    def _load_prior(self, file: WeightsFile) -> Prior:
        with lean():
            from g3r.prior.model import Prior

        model = Prior.load(file)
        model.network.to(self.device)
        return model

    def _load_pose(self, file: WeightsFile) -> PoseModel:
        with lean():
            from g3r.pose_network.model import PoseModel

        model = PoseModel.load(file)
        model.network.to(self.device)
        return model
