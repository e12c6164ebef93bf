"""The picture of docs/report.md, a page as a browser shows it: `python -m studies.report.page` (needs Chromium)."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from data_synth.cli import main as simulate
from g3r.cli.infer import main as infer
from g3r.run.atomic_file import atomic_path
from studies.harness import DOCS, FOLDER
from tests.report.browser import browser, chromium

CASE = "--phantom 30 --motion moderate --resolution 1.0 --thickness 3.0 --seed 1 --force --output"

WIDTH, HEIGHT = 900, 1005
"""Size of the browser window in pixels, which shows verdict and viewer."""

COLORS = 128


def photograph(page: Path) -> Image.Image:
    """Screenshot of the upper part of a page, with a reduced palette."""
    with tempfile.TemporaryDirectory() as profile, browser(Path(profile)) as window:
        window.open(page, WIDTH, HEIGHT)
        return window.picture().quantize(COLORS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.report.page",
        description=__doc__.splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--publish", action="store_true", help="write docs/images/report.png, too")
    parser.add_argument("--output", type=Path, default=FOLDER / "report-page", help="for subject, run and picture")
    options = parser.parse_args(argv)
    if chromium() is None:
        print("report.page: no Chromium found; install it", file=sys.stderr)
        return 3
    case, run = options.output / "case", options.output / "run"
    files = {name: [str(case / f"{name}-{n}.nii.gz") for n in range(3)] for name in ("stack", "mask")}
    line = ["--stacks", *files["stack"], "--masks", *files["mask"], "--thickness", "3.0", "--force", "--quiet"]
    if code := simulate([*CASE.split(), str(case)]) or infer([*line, "--output", str(run)]):
        return code
    shown = photograph((run / "report.html").resolve())
    for path in [options.output / "report.png", *([DOCS / "images" / "report.png"] if options.publish else [])]:
        with atomic_path(path) as temporary:
            shown.save(temporary, "PNG", optimize=True)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
