"""The presets: one record of settings for the whole reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from g3r.errors import InputError
from g3r.fitting.held_out_slices import HeldOutSettings
from g3r.fitting.pose_rounds import PoseRoundSettings, RoundFit
from g3r.fitting.prior_stage import PriorStageSettings
from g3r.fitting.slice_stage import SliceStageSettings
from g3r.fitting.slice_targets import SliceModel
from g3r.fitting.voxel_correction import VoxelCorrectionSettings
from g3r.gaussians.seeding import LatticeSpacing
from g3r.planning.anatomy import FETAL_BRAIN, Anatomy
from g3r.prior.maps import DEFAULT_TILING, Tiling
from g3r.registration import RegistrationSettings

RESOLUTION_RANGE_MM = (0.3, 3.0)


@dataclass(frozen=True, kw_only=True)
class ReconstructionSettings:
    """Everything that decides a result, apart from the data and the prior's weights.

    Args:
        resolution_mm: voxel size of the volume.
        gaussian_spacing_pixels: edge of the lattice cell per Gaussian, in units of the cube root of what one pixel
            covers (its area times the slice thickness): thicker slices and larger pixels determine fewer Gaussians.
        max_gaussian_spacing_mm: upper bound of that edge in mm.
        registration: poses from the slices.
        pose_rounds: poses from the slices and V_prior, in turn with the volume.
        prior_stage: stage 1.
        slice_model: forward model of a slice in stage 2.
        slice_stage: stage 2.
        n_lattices: number of fits of stage 2, each on a lattice of its own, whose mean is the volume; 0 shows V_prior
            alone, or the least-squares volume of the slices.
        held_out: how held-out slices decide the widths of the profiles; None takes the width of `slice_model`.
        prior_weight: least weight of V_prior in the volume with one pixel per mm3; see `fitting.prior_weight`.
        voxel_correction: how the volume is corrected by detail in the slices that Gaussians cannot show; None leaves
            that out.
        prior_views: mirror images over which the prior is averaged; see `estimate_prior`. 0 leaves its network out.
        prior_whole_voxels, prior_tile_voxels, prior_halo_voxels: when and how the prior network works in
            tiles; see `estimate_prior`.
        share_probes: number of random changes that measure the prior share; see `estimate_prior_share`.
        least_squares_voxel_mm: without a network and a fit, the least-squares volume is written, with voxels of at
            least this size, since its noise grows as they shrink; 0 takes V_sharp.
        use_prior: False seeds from V_sharp and leaves distillation out.
        distillation: whether the fit of a single stack is held to the prior; False uses the prior only as its start.
        several_stacks_distilled: whether the fit of several stacks is held to the prior, too; by default it only starts
            there.
        common_bias_field: divide out the bias field that stacks share (N4).
        fill_unseen: show an estimate where no slice looked; False leaves zeros there.
        anatomy: what the stacks show; see `for_anatomy`.
        seed: of every random choice, that of `registration` included.
    """

    resolution_mm: float = 0.8
    gaussian_spacing_pixels: float = 2.14
    max_gaussian_spacing_mm: float = 3.0
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    pose_rounds: PoseRoundSettings = field(default_factory=PoseRoundSettings)
    prior_stage: PriorStageSettings = field(default_factory=PriorStageSettings)
    slice_model: SliceModel = field(default_factory=SliceModel)
    slice_stage: SliceStageSettings = field(default_factory=SliceStageSettings)
    n_lattices: int = 1
    held_out: HeldOutSettings | None = field(default_factory=HeldOutSettings)
    prior_weight: float = 0.3
    voxel_correction: VoxelCorrectionSettings | None = field(default_factory=VoxelCorrectionSettings)
    prior_views: int = 2
    prior_whole_voxels: int = DEFAULT_TILING.max_whole_voxels
    prior_tile_voxels: int = DEFAULT_TILING.tile_voxels
    prior_halo_voxels: int = DEFAULT_TILING.halo_voxels
    share_probes: int = 1
    least_squares_voxel_mm: float = 0.0
    use_prior: bool = True
    distillation: bool = True
    several_stacks_distilled: bool = False
    common_bias_field: bool = True
    fill_unseen: bool = True
    anatomy: Anatomy = FETAL_BRAIN
    seed: int = 0

    def __post_init__(self) -> None:
        if self.registration.seed != self.seed:
            object.__setattr__(self, "registration", replace(self.registration, seed=self.seed))

    @property
    def lattice(self) -> LatticeSpacing:
        """Spacing of the lattice of Gaussians."""
        return LatticeSpacing(pixels=self.gaussian_spacing_pixels, at_most_mm=self.max_gaussian_spacing_mm)

    @property
    def tiling(self) -> Tiling:
        """When and how the prior network works in tiles."""
        return Tiling(self.prior_whole_voxels, self.prior_tile_voxels, self.prior_halo_voxels)

    @property
    def round_fit(self) -> RoundFit:
        """The fit in a round of poses and volume."""
        return RoundFit(
            settings=self.pose_rounds,
            lattice=self.lattice,
            prior_stage=self.prior_stage,
            slice_stage=self.slice_stage,
            slice_model=self.slice_model,
            distillation=self.use_prior and self.distillation,
        )


_BALANCED = ReconstructionSettings()

_QUICK_SEARCH = replace(
    _BALANCED.registration, n_candidates=800, network_as_reserve=True, attempts=2, steps_per_round=4
)

PRESETS: dict[str, ReconstructionSettings] = {
    "preview": replace(  # least squares alone: neither torch nor a network is loaded
        _BALANCED,
        pose_rounds=PoseRoundSettings(single_stack=0, two_stacks=0),
        held_out=None,
        n_lattices=0,
        voxel_correction=None,
        least_squares_voxel_mm=1.0,
        use_prior=False,
        prior_views=0,
        registration=replace(
            _QUICK_SEARCH,
            network=False,
            attempts=1,
            n_rounds=6,
            stray_searches=1,
            finest_voxel_mm=1.1,
            finest_voxel_pixels=0.9,
            max_pixels=400_000,
            check_handedness=False,
            leave_out_misfits=False,
        ),
    ),
    "fast": replace(
        _BALANCED,
        pose_rounds=PoseRoundSettings(moves_to_prior=4, two_stacks=1),
        held_out=None,
        voxel_correction=None,
        prior_views=1,
        registration=replace(_QUICK_SEARCH, n_rounds=5, finest_voxel_mm=1.4, max_pixels=200_000),
        prior_stage=replace(_BALANCED.prior_stage, n_steps=15),
        slice_stage=replace(_BALANCED.slice_stage, n_steps=110),
    ),
    "balanced": replace(_BALANCED, registration=replace(_BALANCED.registration, n_rounds=9, finest_voxel_mm=1.4)),
    "accurate": replace(
        _BALANCED,
        n_lattices=6,
        # a second round of three stacks changed nothing; a third of two did as much harm as good
        pose_rounds=PoseRoundSettings(more_stacks=1),
        held_out=HeldOutSettings(slab=0.4, n_steps=25),
        prior_views=8,
        share_probes=2,
    ),
}
"""Settings by name, from quick to careful."""


def preset(name: str) -> ReconstructionSettings:
    """The settings of a preset.

    Raises:
        InputError: there is none of this name.
    """
    if name not in PRESETS:
        raise InputError(f"preset {name!r}; expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


def keeping_poses(settings: ReconstructionSettings) -> ReconstructionSettings:
    """The settings without any step that moves slices relative to each other."""
    return replace(
        settings,
        registration=replace(settings.registration, segments=False),
        pose_rounds=settings.pose_rounds.at_most(0),
        slice_stage=replace(settings.slice_stage, optimise_poses=False),
    )


def settings_of(given: ReconstructionSettings | str) -> ReconstructionSettings:
    """Settings, or those of a preset by its name.

    Raises:
        InputError: an unknown preset, or a resolution outside 0.3-3 mm.
    """
    settings = preset(given) if isinstance(given, str) else given
    low, high = RESOLUTION_RANGE_MM
    if not low <= settings.resolution_mm <= high:
        raise InputError(f"resolution {settings.resolution_mm:g} mm; expected {low:g} to {high:g} mm")
    return settings


def for_anatomy(settings: ReconstructionSettings, anatomy: Anatomy) -> ReconstructionSettings:
    """The settings without what is specific to fetal brains, if the stacks show something else.

    Without template, pose network and standard orientation the search starts from the stacks' headers, and V_sharp
    stands for the prior volume.

    Args:
        settings: of a preset.
        anatomy: what the stacks show.
    """
    if anatomy == FETAL_BRAIN:
        return replace(settings, anatomy=anatomy)
    search = replace(settings.registration, template=False, network=False, standard_orientation=False)
    return replace(settings, anatomy=anatomy, use_prior=False, registration=search)


def adapted(settings: ReconstructionSettings, n_stacks: int) -> ReconstructionSettings:
    """The settings as they hold for a single stack, or for several.

    Args:
        settings: as requested.
        n_stacks: with slices.
    """
    stage = settings.slice_stage
    if n_stacks == 1:
        # slices of a single stack drift if they are registered to a volume made of themselves; the prior holds them
        held = settings.use_prior and settings.distillation and settings.registration.segments
        return replace(
            settings,
            held_out=None,  # a narrow profile and a smooth volume look alike
            n_lattices=min(settings.n_lattices, 1),  # most of the volume is the prior
            pose_rounds=settings.pose_rounds if held else settings.pose_rounds.at_most(0),
            slice_stage=replace(stage, optimise_poses=stage.optimise_poses and held),
        )
    # several stacks check each other: they are nearer to the truth if the prior does not pull (docs/paper.md, "Parts of
    # the fit"), and where it shall, the schedule alone decides how hard
    distillation = settings.distillation and settings.several_stacks_distilled
    return replace(settings, distillation=distillation, slice_stage=replace(stage, prior_error=0.0))


def changed(settings: Any, options: Mapping[str, Any]) -> Any:
    """Settings with some fields replaced; `registration.n_rounds` names a field of a record inside.

    Raises:
        ValueError: no such field.
    """
    for path, value in options.items():
        name, _, rest = path.partition(".")
        if not is_dataclass(settings) or name not in {field.name for field in fields(settings)}:
            raise ValueError(f"{type(settings).__name__} has no field {name!r}")
        inner = changed(getattr(settings, name), {rest: value}) if rest else value
        settings = replace(settings, **{name: inner})  # type: ignore[type-var]
    return settings
