"""Tables of docs/paper.md, from the record of `studies.paper.compare`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import mean
from typing import Any

from studies.harness import Record, Row
from studies.paper.ablation import VARIANTS
from studies.paper.methods import METHODS, NO_NETWORK, PRODUCT, UNCONSTRAINED
from studies.tables import Cell, details, spread, stacks, table

SCORES = {"psnr_db": "PSNR, dB", "ssim": "SSIM", "ncc": "NCC", "rmse": "RMSE", "lpips": "LPIPS"}
FORMS = {"psnr_db": "{:.2f}", "seconds": "{:.0f}"}
ROUND = "{:.3f}"

NOT_YET = "Not measured yet."

CONDITIONS = (("moderate", 3), ("moderate", 1), ("mild", 3))


def rows_of(record: Record, kind: str, **wanted: Any) -> list[Row]:
    """Measured rows of a kind that have the given values.

    Args:
        record: of the study.
        kind: methods or variants.
        wanted: values by name.
    """
    rows = record["rows"].values()
    return [
        row
        for row in rows
        if row["kind"] == kind and "skipped" not in row and all(row.get(k) == v for k, v in wanted.items())
    ]


def values(rows: Iterable[Row], method: str, place: str, score: str) -> list[float]:
    """One score of a method, subject by subject.

    Args:
        rows: of methods.
        method: its name.
        place: "mask" or "grid".
        score: key of the score, or "seconds".
    """
    found = [row["scores"][method] for row in rows if method in row["scores"]]
    chosen = [one if score == "seconds" else one[place] for one in found]
    return [float(one[score]) for one in chosen if score in one]


def methods_table(rows: Sequence[Row], place: str, why_no_lpips: str) -> str:
    """Table 1 for one level of motion, one number of stacks and one place.

    Args:
        rows: of methods.
        place: "mask" or "grid".
        why_no_lpips: reason why there is no LPIPS; empty if there is.
    """
    named = {name for row in rows for name in row["scores"]}
    names = [name for name in METHODS if name in named] + sorted(named - set(METHODS))
    shown = [key for key in SCORES if key != "lpips" or not why_no_lpips]

    def cell(score: str) -> Cell:
        return lambda line: spread(values(rows, line["name"], place, score), FORMS.get(score, ROUND))

    def how_many(line: Mapping[str, Any]) -> int:
        return sum(line["name"] in row["scores"] for row in rows)

    columns: dict[str, Cell] = {"method": "{name}", "subjects": how_many, "s": cell("seconds")}
    columns |= {SCORES[key]: cell(key) for key in shown}
    return table([{"name": name} for name in names], columns)


def subjects(n: int) -> str:
    """A number of subjects in words."""
    return f"{n} subject{'s' * (n != 1)}"


def gains(rows: Sequence[Row]) -> str:
    """Gain of the product over each kind of baseline, in words."""
    product = values(rows, PRODUCT, "mask", "psnr_db")
    if not product:
        return ""
    lines = []
    for what, names in (
        ("the best volume without a network", NO_NETWORK),
        ("the best unconstrained fit", UNCONSTRAINED),
    ):
        # only baselines that every subject has, because a template fits only some heads
        found = {name: values(rows, name, "mask", "psnr_db") for name in names}
        means = {name: mean(each) for name, each in found.items() if len(each) == len(product)}
        if means:
            best = max(means, key=lambda name: means[name])
            least = min(one - other for one, other in zip(product, found[best], strict=True))
            lines.append(f"{mean(product) - means[best]:+.2f} dB over {what} ({best}; least {least:+.2f})")
    partly = [name for name in METHODS if 0 < len(values(rows, name, "mask", "psnr_db")) < len(product)]
    for name in partly:
        own = [row for row in rows if name in row["scores"] and PRODUCT in row["scores"]]
        if own:
            ahead = mean(values(own, PRODUCT, "mask", "psnr_db")) - mean(values(own, name, "mask", "psnr_db"))
            lines.append(f"{ahead:+.2f} dB over {name} (on {subjects(len(own))})")
    return f"g3r: {'; '.join(lines)}."


def main_tables(record: Record) -> str:
    """Table 1 for every condition: in the mask, then on the whole grid."""
    parts = []
    for motion, n in CONDITIONS:
        rows = rows_of(record, "methods", motion=motion, n_stacks=n)
        if not rows:
            continue
        own = [row for row in rows if "tre_mm" in row]
        if not own:
            continue
        refused = sum(
            "skipped" in row
            and "peer" not in row
            and (row["kind"], row["motion"], row["n_stacks"]) == ("methods", motion, n)
            for row in record["rows"].values()
        )
        poses = mean(row["tre_mm"] for row in own), mean(row["own_tre_mm"] for row in own)
        title = f"**{motion.capitalize()} motion, {stacks(n)}, {subjects(len(own))}.**"
        title += f" g3r refused {refused} more, which count for no method." if refused else ""
        parts.append(
            f"{title} Median pose error {poses[0]:.2f} mm, {poses[1]:.2f} mm of poses of their own; "
            f"{mean(row['cpu_seconds'] for row in own):.0f} CPU seconds of g3r. {gains(own)}"
        )
        parts += ["In the mask:", methods_table(rows, "mask", record["why_no_lpips"])]
        parts.append(details("On the whole grid", methods_table(rows, "grid", record["why_no_lpips"])))
    return "\n\n".join(parts)


def variants_table(record: Record) -> str:
    """Fig. 4A as a table."""
    rows = rows_of(record, "variants")
    if not rows:
        return NOT_YET
    numbers = sorted({row["n_stacks"] for row in rows}, reverse=True)
    columns: dict[str, Cell] = {"variant": "{name}"}
    for n in numbers:
        columns[f"{stacks(n)}, dB ({subjects(len(of_number(rows, n)))})"] = _variant_cell(rows, n)
    return table([{"name": name} for name in VARIANTS], columns)


def of_number(rows: Iterable[Row], n_stacks: int) -> list[Row]:
    """The rows with a given number of stacks."""
    return [row for row in rows if row["n_stacks"] == n_stacks]


def variant_values(rows: Iterable[Row], name: str, n_stacks: int) -> list[float]:
    """PSNR of a variant, subject by subject.

    Args:
        rows: of variants.
        name: of the variant.
        n_stacks: only rows with this number of stacks.
    """
    return [float(row["scores"][name]["psnr_db"]) for row in of_number(rows, n_stacks) if name in row["scores"]]


def _variant_cell(rows: Sequence[Row], n_stacks: int) -> Cell:
    return lambda line: spread(variant_values(rows, line["name"], n_stacks))


def stages_table(record: Record) -> str:
    """Seconds of each stage, three stacks, moderate motion."""
    rows = [row for row in rows_of(record, "methods", motion="moderate", n_stacks=3) if "stages" in row]
    if not rows:
        return NOT_YET
    names = list(dict.fromkeys(name for row in rows for name in row["stages"]))
    lines: list[Mapping[str, Any]] = [
        {"name": name, "of": [row["stages"].get(name, 0) for row in rows]} for name in names
    ]
    lines.append({"name": "all, wall time", "of": [row["seconds"] for row in rows]})
    lines.append({"name": "all, CPU time", "of": [row["cpu_seconds"] for row in rows]})
    return table(lines, {"stage": "{name}", "s": lambda line: spread(line["of"], "{:.1f}")})
