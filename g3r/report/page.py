"""report.html: one self-contained file that loads nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from g3r.acquisition.images import load_volume
from g3r.acquisition.planes import Slices
from g3r.errors import InputError, cannot_be_written
from g3r.output.files import FULL_WEIGHT, REPORT_NAME
from g3r.output.map_colours import INFERNO
from g3r.output.record import RunRecord
from g3r.planning.anatomy import NAME_OF
from g3r.registration.thresholds import DOWNWEIGHTED_BELOW, MIN_HELD_OUT, RETRY_BELOW_CORRELATION
from g3r.report.motion_chart import motion_chart
from g3r.report.pictures import central_sections
from g3r.report.slice_pictures import MAX_SHOWN, SlicePicture, slice_pictures, worst_first
from g3r.report.slice_rows import SliceRows
from g3r.report.stack_rows import scale_ends, stack_rows
from g3r.report.verdict import verdict_of
from g3r.report.viewer_images import ViewerImages
from g3r.run.atomic_file import write_text
from g3r.run.json_record import to_plain

SCRIPTS = ("niivue.umd.js", "nifti.js", "plain_viewer.js", "webgl_viewer.js", "viewer.js")
"""The page's scripts, in the order in which it runs them."""

SHIFT_AXES = ("right", "anterior", "superior")
TURN_AXES = ("pitch (about right)", "roll (about anterior)", "yaw (about superior)")


def write_report(folder: Path, slices: Slices | None = None, output: Path | None = None) -> Path:
    """Write the page of an output folder, whole or not at all.

    Args:
        folder: folder of a finished run.
        slices: slices of the run in their final poses, with their pixels; None leaves their pictures out.
        output: file to write; report.html in the folder by default.

    Raises:
        InputError: files of the folder are missing or damaged, slices are not its own, or the page cannot be written.
    """
    path = folder / REPORT_NAME if output is None else output
    text = report_html(folder, slices)
    try:
        write_text(path, text)
    except OSError as error:
        raise cannot_be_written(path, error) from None
    return path


def report_html(folder: Path, slices: Slices | None = None) -> str:
    """The text of the page; see `write_report`."""
    record = RunRecord.read(folder / "run.json")
    if record.registration is None:
        raise InputError(f"{folder / 'run.json'}: is a configuration, of no run; pass the output folder of a run")
    rows = SliceRows.read(folder / "slices.tsv", len(record.stacks))
    images = ViewerImages.load(folder)
    pictures = _pictures(folder, record, rows, slices)
    scripts = [_asset(name) for name in SCRIPTS]
    data = _json({"layers": images.records(), "colors": _colors()})
    return _template().render(
        csp=_security_policy(scripts),
        style=Markup(_asset("report.css")),
        scripts=[Markup(text) for text in scripts],
        data=Markup(data),
        verdict=verdict_of(record),
        record=record,
        stacks=stack_rows(record),
        n_stacks_used=sum(not (stack.quality and stack.quality.left_out) for stack in record.stacks),
        scale=scale_ends(),
        good=RETRY_BELOW_CORRELATION,
        bad=MIN_HELD_OUT,
        sections=central_sections(
            images.data["volume"], images.grid.index(images.mask_center_mm), *images.window["volume"]
        ),
        unseen=_unseen_line(record),
        rests_on_others=_rests_on_others(record),
        charts=_charts(record, rows, images),
        pictures=pictures,
        rows=[_row_of(record, rows, k) for k in worst_first(rows).tolist() if rows.weight[k] < FULL_WEIGHT],
        n_used=int((rows.weight >= DOWNWEIGHTED_BELOW).sum()),
        n_slices=len(rows),
        max_shown=MAX_SHOWN,
        seconds=[(name, f"{value:.1f}") for name, value in record.seconds.items()],
        all_seconds=f"{sum(record.seconds.values()):.0f}",
        settings=json.dumps(_plain_settings(record), indent=2),
    )


def _asset(name: str) -> str:
    return (files("g3r.report") / "page" / name).read_text(encoding="utf-8")


def _template() -> jinja2.Template:
    loader = jinja2.FunctionLoader(_asset)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html.j2")


def _security_policy(scripts: list[str]) -> str:
    """Content security policy: only the page's own scripts, by their hashes, and no external address."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'" for text in scripts
    )
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:; "
        "connect-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def _json(value: Any) -> str:
    """JSON that is safe inside a script element."""
    return json.dumps(value).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _colors() -> str:
    """The colour map, 256 colours of three bytes each, as base64."""
    return base64.b64encode(INFERNO.tobytes()).decode("ascii")


def _pictures(folder: Path, record: RunRecord, rows: SliceRows, slices: Slices | None) -> list[SlicePicture]:
    if slices is None:
        return []
    if len(slices) != len(rows):
        raise InputError(
            f"{folder / 'slices.tsv'}: has {len(rows)} slices, {len(slices)} are given; pass the stacks of this run"
        )
    volume = load_volume(folder / "volume.nii.gz")
    return slice_pictures(slices, rows, [stack.name for stack in record.stacks], volume)


def _row_of(record: RunRecord, rows: SliceRows, k: int) -> dict[str, Any]:
    return {
        "stack": record.stacks[int(rows.stack[k])].name,
        "number": int(rows.number[k]),
        "weight": float(rows.weight[k]),
        "ncc": float(rows.ncc[k]),
        "reason": rows.reason[k],
    }


def _charts(record: RunRecord, rows: SliceRows, images: ViewerImages) -> list[Any]:
    order = rows.acquisition_key(record)
    shift_mm, turn_deg = rows.head_motion(record, images.mask_center_mm)
    counts_less = rows.weight[order] < DOWNWEIGHTED_BELOW
    names = [stack.name for stack in record.stacks]
    return [
        motion_chart(title, axes, values[order], stack=rows.stack[order], counts_less=counts_less, names=names)
        for title, axes, values in (("shift, mm", SHIFT_AXES, shift_mm), ("turn, degrees", TURN_AXES, turn_deg))
    ]


def _unseen_line(record: RunRecord) -> str:
    line = record.unseen.line() if record.unseen else None
    if line:
        return line[0].upper() + line[1:] + "."
    if record.unseen is None:
        return "Not measured."
    what = NAME_OF[record.settings.anatomy]
    return f"Slices saw the whole {what} ({100 * record.unseen.share:.1f} % lies between them)."


def _rests_on_others(record: RunRecord) -> float | None:
    """Mean prior share of the brain; 0 without a prior, None where it was not estimated."""
    if not record.settings.use_prior:
        return 0.0
    share = (record.uncertainty or {}).get("prior_share")
    return float(share["mean_in_mask"]) if share else None


def _plain_settings(record: RunRecord) -> dict[str, Any]:
    return to_plain(record.settings)
