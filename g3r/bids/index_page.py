"""index.html: every session with its verdict and its picture, the worst first; it loads nothing from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from g3r.bids.derivative import figure_path
from g3r.bids.outcome import CHECK, DO_NOT_USE, FAILED, NOT_RUN, TRUSTED, Outcome
from g3r.run.atomic_file import write_text

PAGE = "index.html"

WORST_FIRST = (FAILED, DO_NOT_USE, CHECK, NOT_RUN, TRUSTED)

HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src 'self' file:; style-src 'unsafe-inline'">
<title>Fetal brain volumes by g3r</title>
<style>
body { font-family: sans-serif; margin: 2em; }
td, th { padding: 0.3em 0.8em; text-align: left; vertical-align: top; border-bottom: 1px solid #ccc; }
img { height: 6em; }
.failed, .do-not-use { color: #b00020; }
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
    titles = "".join(f"<th>{title}</th>" for title in ("session", "verdict", "slices", "unseen", "why", "picture"))
    body = f"<p>{escape(', '.join(counts))}</p>\n<table>\n<tr>{titles}</tr>\n{rows}\n</table>\n</body>\n</html>\n"
    write_text(out_dir / PAGE, HEAD + body)


def _row(one: Outcome, out_dir: Path) -> str:
    picture = figure_path(one.session, out_dir)
    image = ""
    if picture.is_file():
        link = escape(picture.relative_to(out_dir).as_posix(), quote=True)
        image = f'<a href="{link}"><img loading="lazy" alt="sections" src="{link}"></a>'
    cells = [
        escape(one.session.stem),
        f'<span class="{one.verdict.replace(" ", "-")}">{escape(one.verdict)}</span>',
        "" if one.n_slices is None else f"{one.n_used} of {one.n_slices}",
        "" if one.unseen_share is None else f"{100 * one.unseen_share:.1f} %",
        escape("; ".join(one.warnings) or one.reason or ""),
        image,
    ]
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
