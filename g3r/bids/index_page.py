"""index.html: every session with its verdict and its picture, the worst first; it loads nothing from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from g3r.bids.derivative import REPORT, THUMBNAIL, figure_path
from g3r.bids.outcome import FAILED, NO_STACK, NOT_RUN, Outcome, log_path
from g3r.report.verdict_messages import CHECK, DO_NOT_USE, USE
from g3r.run.atomic_file import write_text

PAGE = "index.html"

WORST_FIRST = (FAILED, DO_NOT_USE, CHECK, NOT_RUN, NO_STACK, USE)

TITLES = ("session", "verdict", "slices", "unseen", "why", "picture")

HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src 'self' file:; style-src 'unsafe-inline'">
<title>Fetal brain volumes by g3r</title>
<style>
body { font-family: sans-serif; margin: 2em; }
table { border-collapse: collapse; }
td, th { padding: 0.4em 0.8em; text-align: left; vertical-align: top; border-bottom: 1px solid #ccc; }
td.session, td.verdict, td.slices, td.unseen { white-space: nowrap; }
td.why { max-width: 40em; overflow-wrap: anywhere; }
img { width: 15em; height: 5.5em; object-fit: contain; background: #000; display: block; }
.failed, .do-not-use { color: #b00020; font-weight: bold; }
.check { color: #8a5a00; font-weight: bold; }
@media (max-width: 700px) {
  body { margin: 1em; }
  table, tbody, tr, td { display: block; }
  tr { border-bottom: 1px solid #ccc; padding: 0.7em 0; }
  td { border: none; padding: 0.15em 0; }
  td.session, td.verdict { display: inline-block; margin-right: 0.8em; }
  td.slices::after { content: " slices"; }
  td.unseen::after { content: " unseen"; }
  td.slices, td.unseen { display: inline-block; margin-right: 0.8em; color: #555; }
  tr:first-child, td:empty { display: none !important; }
  img { width: 100%; height: auto; }
}
</style>
</head>
<body>
<h1>Fetal brain volumes by g3r</h1>
<p>For research only, not for diagnosis. The worst first; click a picture to see all of it.</p>
"""


def write_index(outcomes: Sequence[Outcome], out_dir: Path) -> None:
    """Write the page.

    Raises:
        OSError: it cannot be written.
    """
    ordered = sorted(outcomes, key=lambda one: (WORST_FIRST.index(one.verdict), -(one.unseen_share or 0.0)))
    counts = [f"{n} {verdict}" for verdict in WORST_FIRST if (n := sum(one.verdict == verdict for one in outcomes))]
    rows = "\n".join(_row(one, out_dir) for one in ordered)
    titles = "".join(f"<th>{title}</th>" for title in TITLES)
    body = f"<p>{escape(', '.join(counts))}</p>\n<table>\n<tr>{titles}</tr>\n{rows}\n</table>\n</body>\n</html>\n"
    write_text(out_dir / PAGE, HEAD + body)


def _row(one: Outcome, out_dir: Path) -> str:
    cells = [
        escape(one.session.stem),
        _verdict(one, out_dir),
        "" if one.n_slices is None else f"{one.n_used} of {one.n_slices}",
        "" if one.unseen_share is None else f"{100 * one.unseen_share:.1f} %",
        _why(one, out_dir),
        _picture(one, out_dir),
    ]
    return f"<tr>{''.join(f'<td class={title}>{cell}</td>' for title, cell in zip(TITLES, cells, strict=True))}</tr>"


def _verdict(one: Outcome, out_dir: Path) -> str:
    """The verdict, as a link to the report of the session if there is one."""
    word = f'<span class="{one.verdict.replace(" ", "-")}">{escape(one.verdict)}</span>'
    report = figure_path(one.session, out_dir, REPORT)
    return f'<a href="{_link(report, out_dir)}">{word}</a>' if report.is_file() else word


def _why(one: Outcome, out_dir: Path) -> str:
    """The reasons; for a failure also a link to the log of the run."""
    words = escape("; ".join(one.reasons))
    log = log_path(one.session, out_dir)
    if one.verdict != FAILED or not log.is_file():
        return words
    return f'{words} (<a href="{_link(log, out_dir)}">log</a>)'


def _picture(one: Outcome, out_dir: Path) -> str:
    """The thumbnail, as a link to the large picture; empty without a picture."""
    large, small = figure_path(one.session, out_dir), figure_path(one.session, out_dir, THUMBNAIL)
    if not large.is_file():
        return ""
    shown = small if small.is_file() else large
    image = f'<img loading="lazy" alt="sections" src="{_link(shown, out_dir)}">'
    return f'<a href="{_link(large, out_dir)}">{image}</a>'


def _link(path: Path, out_dir: Path) -> str:
    return escape(quote(path.relative_to(out_dir).as_posix()), quote=True)
