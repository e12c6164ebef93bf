"""The moving picture of docs/how.md: Gaussians that are fitted to slices: `python -m studies.how.fit`.

It shows the built-in phantom, from three stacks with moderate motion. To make the progress visible, the fit starts from
the seeds, without the prior and without amplitudes by least squares. The shipped fit starts close to where this ends.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates

from data_synth.cli import main as simulate
from g3r.acquisition.planes import volume_from_pixels, volume_planes
from g3r.acquisition.stacks import Stack, load_stack
from g3r.errors import G3RError
from g3r.fitting.observer import FitMoment
from g3r.gaussians import GaussianCloud
from g3r.gaussians.render import render
from g3r.geometry import VolumeGrid
from g3r.output.result import ReconstructionResult
from g3r.planning.presets import PRESETS, changed
from g3r.reconstruct import GaussianReconstructor
from g3r.run.atomic_file import atomic_path
from studies.harness import DOCS, FOLDER
from studies.tradeoff.convergence import WAYS

SHOWN_STEPS = (1, 2, 3, 4, 6, 8, 11, 16, 22, 32, 45, 64, 80)

PIXEL_MM, HEIGHT, CAPTION, GAP = 0.3, 340, 28, 12
FRAME_MS, LAST_MS = 300, 2000
QUALITY = 80
BRIGHT_PERCENTILE = 99.7


class Watcher:
    """Observer of the fit that keeps the cloud at the steps that are shown."""

    every = 1

    def __init__(self) -> None:
        self.clouds: dict[int, GaussianCloud] = {}

    def __call__(self, moment: FitMoment) -> None:
        """Keep the cloud if this step of the fit to the slices is shown."""
        if moment.slices is not None and moment.step in SHOWN_STEPS:
            self.clouds[moment.step] = moment.cloud()


def section(cloud: GaussianCloud, result: ReconstructionResult) -> NDArray[np.float32]:
    """The middle coronal section [across, up] of a cloud, in pixels of `PIXEL_MM`, in the support of the result."""
    grid, center_mm = result.grid, result.grid.world(np.argwhere(result.mask).mean(0))
    first, last = grid.world(np.zeros(3)), grid.world(np.array(grid.shape) - 1.0)
    affine = np.diag([PIXEL_MM, PIXEL_MM, PIXEL_MM, 1.0])
    affine[:3, 3] = first[0], center_mm[1], first[2]
    n_across, _, n_up = ((last - first) / PIXEL_MM).astype(int) + 1
    fine = VolumeGrid((int(n_across), 1, int(n_up)), affine)
    pixels = render(cloud, volume_planes(fine)).detach().numpy()
    at = grid.index(fine.world(np.argwhere(np.ones(fine.shape)))).T.reshape(3, *fine.shape)
    shown = map_coordinates(result.support.astype(np.float32), at, order=1)
    return (volume_from_pixels(pixels, fine) * (shown > 0.5))[:, 0, :]


def across_slices(stack: Stack) -> NDArray[np.float32]:
    """A section across the slices of a stack [across, up], which shows the motion between slices."""
    rows = np.flatnonzero(stack.mask.any((0, 2)))
    return stack.image[:, rows[len(rows) // 2], :]


def picture(data: NDArray[np.floating], mm: tuple[float, float]) -> Image.Image:
    """Grey picture of a section [across, up], the patient's right on the left, `HEIGHT` pixels high.

    Args:
        data: first row at the bottom.
        mm: of a pixel, across and up.
    """
    bright = np.percentile(data[data > 0], BRIGHT_PERCENTILE)
    grey = np.rint(255 * np.clip(data.T[::-1, ::-1] / bright, 0, 1)).astype(np.uint8)
    extent_mm = data.shape[0] * mm[0], data.shape[1] * mm[1]
    # no smoothing: the measured slices stay visible as bars
    size = (round(HEIGHT * extent_mm[0] / extent_mm[1]), HEIGHT)
    return Image.fromarray(grey).resize(size, Image.Resampling.BOX if mm[1] > 1 else Image.Resampling.BICUBIC)


def frame(left: Image.Image, right: Image.Image, words: tuple[str, str]) -> Image.Image:
    """Two pictures beside each other, with a line below each."""
    whole = Image.new("L", (left.width + GAP + right.width, HEIGHT + CAPTION))
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(14)
    for image, at, text in ((left, 0, words[0]), (right, left.width + GAP, words[1])):
        whole.paste(image, (at, 0))
        draw.text((at + image.width / 2, HEIGHT + CAPTION / 2), text, fill=220, font=font, anchor="mm")
    return whole


def frames(folder: Path) -> list[Image.Image]:
    """The frames of the fit of a simulated subject in a folder."""
    stacks = [load_stack(folder / f"stack-{n}.nii.gz", folder / f"mask-{n}.nii.gz", thickness_mm=3.0) for n in range(3)]
    watcher = Watcher()
    settings = changed(PRESETS["fast"], {**WAYS["Adam from the seeds"], "slice_stage.n_steps": max(SHOWN_STEPS)})
    result = GaussianReconstructor(None, settings, observer=watcher).reconstruct(stacks)
    spacing = stacks[0].spacing_mm
    left = picture(across_slices(stacks[0]), (float(spacing[0]), float(spacing[2])))
    found = []
    for step, cloud in watcher.clouds.items():
        right = picture(section(cloud, result), (PIXEL_MM, PIXEL_MM))
        found.append(frame(left, right, ("one stack, cut across its slices", f"{len(cloud):,} Gaussians, step {step}")))
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.how.fit",
        description=__doc__.splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--publish", action="store_true", help="write docs/images/fit.webp, too")
    parser.add_argument("--output", type=Path, default=FOLDER / "how-fit", help="for subject and picture")
    options = parser.parse_args(argv)
    case = options.output / "case"
    line = "--phantom 30 --motion moderate --resolution 1.0 --thickness 3.0 --seed 1 --force --output"
    if code := simulate([*line.split(), str(case)]):
        return code
    try:
        shown = frames(case)
    except G3RError as error:
        print(f"how.fit: {error}", file=sys.stderr)
        return error.exit_code
    for path in [options.output / "fit.webp", *([DOCS / "images" / "fit.webp"] if options.publish else [])]:
        duration = [FRAME_MS] * (len(shown) - 1) + [LAST_MS]
        with atomic_path(path) as temporary:
            shown[0].save(
                temporary,
                "WEBP",
                save_all=True,
                append_images=shown[1:],
                duration=duration,
                loop=0,
                quality=QUALITY,
                method=6,
            )
        print(f"{path}: {len(shown)} frames, {path.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
