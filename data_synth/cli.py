"""`g3r-simulate`: motion-corrupted stacks with known truth, from a volume or from a built-in phantom."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from g3r._version import __version__
from g3r.cli.failures import INTERRUPTED, run_command

PROG = "g3r-simulate"

BRIGHT = 1000.0
"""The 99.5th percentile of the truth in the mask; stacks are int16."""
PHANTOM_SPACING_MM = 0.8
MARGIN_VOXELS = 4
"""Background around the truth that is written."""
LESS_MEMORY = "choose a coarser --resolution, or crop the volume"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code (0 done, 2 usage, 3 bad input, 4 out of memory, 130 interrupted)."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.volume is not None and arguments.mask is None:
        parser.error("--volume needs --mask")
    if arguments.volume is None and arguments.mask is not None:
        parser.error("--mask needs --volume")
    if arguments.stacks < 1:
        parser.error(f"--stacks {arguments.stacks}; expected at least 1")
    if arguments.seed < 0:
        parser.error(f"--seed {arguments.seed}; expected 0 or above")
    return run_command(
        PROG,
        lambda: _simulate(arguments),
        interrupted=lambda: ("interrupted; no simulation was written", INTERRUPTED),
        less_memory=LESS_MEMORY,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROG, description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--volume", type=Path, help="NIfTI volume to slice")
    source.add_argument("--phantom", type=float, metavar="WEEKS", help="built-in brain of 18 to 41 weeks")
    source.add_argument("--object", action="store_true", help="built-in object that is no brain, for --anatomy generic")
    parser.add_argument("--mask", type=Path, help="mask on the grid of --volume")
    parser.add_argument("--output", type=Path, required=True, help="folder to write")
    parser.add_argument("--stacks", type=int, default=3, help="axial, coronal, sagittal, axial, ...")
    parser.add_argument("--resolution", type=float, default=0.8, help="in-plane pixel spacing, mm")
    parser.add_argument("--thickness", type=float, default=2.2, help="slice thickness, mm")
    parser.add_argument("--gap", type=float, default=0.0, help="between slices, mm")
    parser.add_argument("--motion", default="moderate", choices=["none", "mild", "moderate", "severe"])
    parser.add_argument("--profile", default="box", choices=["box", "gaussian", "sinc"], help="through the slice")
    parser.add_argument("--snr", type=float, default=25.0, help="mid-grey over noise; inf for no noise")
    parser.add_argument("--bias", type=float, default=0.05, help="in-plane inhomogeneity; 0 for none")
    parser.add_argument("--gain", type=float, default=0.05, help="deviation of the slices' log intensity")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--force", action="store_true", help="replace an earlier simulation in --output")
    return parser


def _simulate(arguments: argparse.Namespace) -> int:
    """Simulate and write the stacks, and print a line about them; returns the exit code."""
    import numpy as np

    from data_synth.atlas import AtlasSubject, cropped
    from data_synth.export import check_output, save_simulation
    from data_synth.heads import PhantomSubject, load_volume_of
    from data_synth.objects import textured_ellipsoids
    from data_synth.simulator import orthogonal_settings, simulate_stacks

    check_output(arguments.output, replace=arguments.force)  # before any work
    settings = orthogonal_settings(
        arguments.stacks,
        arguments.motion,
        resolution_mm=arguments.resolution,
        thickness_mm=arguments.thickness,
        gap_mm=arguments.gap,
        profile=arguments.profile,
        snr=arguments.snr,
        bias=arguments.bias,
        gain_deviation=arguments.gain,
    )
    if arguments.object:
        truth = textured_ellipsoids(PHANTOM_SPACING_MM, arguments.seed)
    elif arguments.volume is None:
        truth = load_volume_of(PhantomSubject("phantom", arguments.phantom, arguments.seed), PHANTOM_SPACING_MM)
    else:
        truth = load_volume_of(AtlasSubject(arguments.volume.name, arguments.volume, arguments.mask), spacing_mm=None)
    truth = cropped(truth, MARGIN_VOXELS)
    truth = replace(truth, data=truth.data * np.float32(BRIGHT))
    rng = np.random.default_rng(arguments.seed)
    stacks = simulate_stacks(truth.data, truth.mask, truth.affine, settings, rng, fine=True)
    record = {
        key: str(value.name) if isinstance(value, Path) else value
        for key, value in vars(arguments).items()
        if key not in ("output", "force")
    }
    record["version"] = __version__
    if not np.isfinite(arguments.snr):
        record["snr"] = "inf"  # JSON has no infinity
    save_simulation(arguments.output, truth, stacks, record, replace=arguments.force)
    n_slices = sum(len(one.true_pose) for one in stacks)
    made_of = f"{len(stacks)} stacks, {n_slices} slices, motion {arguments.motion}"
    print(f"{arguments.output}: {made_of}, from {truth.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
