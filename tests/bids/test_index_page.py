"""The page of a cohort: worst sessions first, no executable content, no external requests."""

from __future__ import annotations

import re
from pathlib import Path

from g3r.bids.dataset import Session
from g3r.bids.derivative import REPORT, SECTIONS, THUMBNAIL, figure_path
from g3r.bids.index_page import write_index
from g3r.bids.outcome import FAILED, NOT_RUN, Outcome, log_path
from g3r.report.verdict_messages import CHECK, DO_NOT_USE, USE


def test_the_worst_come_first_and_text_is_escaped(tmp_path: Path) -> None:
    verdicts = [USE, CHECK, FAILED, NOT_RUN, DO_NOT_USE]
    outcomes = [
        Outcome(
            session=Session(participant=f"0{n}", session="1", stacks=()),
            verdict=verdict,
            n_slices=9,
            n_used=7,
            unseen_share=0.012,
            reasons=("<script>alert(1)</script> & more",) if verdict == FAILED else ("one", "two"),
        )
        for n, verdict in enumerate(verdicts)
    ]
    pictures = [
        figure_path(outcomes[n].session, tmp_path, end) for n, end in ((0, SECTIONS), (0, THUMBNAIL), (1, SECTIONS))
    ]
    log, report = log_path(outcomes[2].session, tmp_path), figure_path(outcomes[1].session, tmp_path, REPORT)
    for path in (*pictures, log, report):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"picture or log")
    write_index(outcomes, tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert re.findall(r"<td class=session>(sub-\d\d)_ses-1", page) == ["sub-02", "sub-04", "sub-01", "sub-03", "sub-00"]
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in page
    assert "http" not in page.replace("http-equiv", "")
    assert {tmp_path / link for link in re.findall(r'src="([^"]+)"', page)} == set(pictures[1:])
    assert {tmp_path / link for link in re.findall(r'href="([^"]+)"', page)} == {pictures[0], pictures[2], log, report}
    assert "<td class=why>one; two</td>" in page
    assert "1 failed, 1 do not use, 1 check, 1 not run, 1 use" in page
