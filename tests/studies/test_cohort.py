"""Cost of a cohort: the page of many sessions, and the table of the study."""

from __future__ import annotations

from pathlib import Path

from g3r.bench.record import machine
from studies.cohort import cost


def test_the_page_of_many_is_small_and_quick(tmp_path: Path) -> None:
    row = cost.page(tmp_path, 300)
    assert 0 < row["page_bytes"] < 300 * 1000
    assert row["seconds"] < 10  # 0.1 s here; a slow disk may take longer
    page = (tmp_path / "page" / "index.html").read_text()
    assert page.count("<img ") == 290
    assert page.index("failed</span>") < page.index("use</span>")


def test_the_table_says_what_many_need() -> None:
    one = {"seconds": 50.0, "cpu_seconds": 72.0, "held_bytes": 1.2e9, "n_files": 20, "kept_bytes": 9e6}
    one |= {"work_bytes": 50e6, "thumbnail_bytes": 3e4, "sections_bytes": 5e5}
    many = {"n": 1000, "seconds": 0.25, "page_bytes": 5e5, "table_bytes": 6e4}
    found = machine(1)
    assert cost.tables({"rows": {"subject": one}, "machine": found}) == {}
    text = cost.tables({"rows": {"subject": one, "page": many}, "machine": found})["cohort-cost"]
    for line in ("| CPU time | 72 s | 20 h of one core |", "| files that stay | 20 | 20,000 |", "| 9.0 MB | 9.0 GB |"):
        assert line in text
