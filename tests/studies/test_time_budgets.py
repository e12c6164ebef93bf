"""The table of time budgets: what it marks."""

from studies.tradeoff.time_budgets import budget_table


def entry(budget_s: float, seconds: float, psnr_db: float) -> dict[str, object]:
    return {
        "budget_s": budget_s,
        "seconds": seconds,
        "psnr_db": psnr_db,
        "motion": "draft",
        "fit": "fast",
        "n_steps": 5,
        "n_gaussians": 1234,
    }


def test_late_and_worse_are_marked_and_nothing_else():
    text = budget_table({"one": [entry(10, 13.0, 30.0), entry(20, 24.1, 29.95), entry(30, 30.0, 29.8)]})
    rows = [line for line in text.splitlines() if line.startswith("| one")]
    assert [row.count("(!)") for row in rows] == [0, 1, 1]
    assert "24.1 (!)" in rows[1]
    assert "29.80 (!)" in rows[2]
    assert "1,234" in rows[0]
