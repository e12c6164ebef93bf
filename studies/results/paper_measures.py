"""Measures for the claims about the paper's protocol, from the tables of docs/paper.md."""

from __future__ import annotations

import re
from collections.abc import Callable

from studies.paper.methods import PRIOR, PRODUCT
from studies.results.blocks import Block, Table
from studies.results.findings import FEW, NOTICEABLE_DB, Finding, table_after, value
from studies.tables import stacks

Find = Callable[[Block], Finding | None]

PSNR, SSIM, LPIPS = "PSNR, dB", "SSIM", "LPIPS"


def of_condition(block: Block, n_stacks: int, place: str = "mask", motion: str = "moderate") -> Table | None:
    """Table 1 of one condition; None if the block lacks it.

    Args:
        block: of all methods.
        n_stacks: number of stacks that the volumes are made from.
        place: "mask" or "grid".
        motion: its level.
    """
    tables = list(block.tables)
    for n, table in enumerate(tables):
        if f"**{motion.capitalize()} motion, {stacks(n_stacks)}," in table.before:
            return table if place == "mask" else next((t for t in tables[n + 1 :] if "grid" in t.before), None)
    return None


def level(n_stacks: int, head: str, at: float, needed: int, *, most: bool = False) -> Find:
    """Measure of a score of g3r itself.

    Args:
        n_stacks: number of stacks that the volumes are made from.
        head: of the column.
        at: required value.
        needed: least number of subjects.
        most: whether the score must be at most `at` instead of at least.
    """

    def find(block: Block) -> Finding | None:
        table = of_condition(block, n_stacks)
        row = table.row(PRODUCT) if table else None
        found, n = value(row, head), value(row, "subjects")
        if row is None or found is None or n is None:
            return None
        unit = {PSNR: " dB", "s": " s"}.get(head, "")
        holds = found <= at if most else found >= at
        return Finding(figure=f"{row[head]}{unit}", n=int(n), of="subjects", holds=holds, enough=n >= needed)

    return find


def ahead(
    n_stacks: int,
    head: str,
    needed: int,
    *,
    of: tuple[str, ...] = (),
    first: str = PRODUCT,
    at_least: float = 0.0,
    place: str = "mask",
    motion: str = "moderate",
) -> Find:
    """Measure of the lead of a method over the best of the others that have the same number of subjects.

    Args:
        n_stacks: number of stacks that the volumes are made from.
        head: of the column; LPIPS is better when lower.
        needed: least number of subjects.
        of: the others; without any, all methods but V_prior.
        first: the method.
        at_least: what the difference is to reach; with 0 it is to be above, by two units of the third digit.
        place: "mask" or "grid".
        motion: its level.
    """

    def find(block: Block) -> Finding | None:
        table = of_condition(block, n_stacks, place, motion)
        row = table.row(first) if table else None
        own, n = value(row, head), value(row, "subjects")
        if table is None or own is None or n is None:
            return None
        sign = -1 if head == LPIPS else 1
        names = of or [row["method"] for row in table.rows if row["method"] not in (first, PRIOR)]
        known = {name: other for name in names if (other := value(table.row(name), head)) is not None}
        # means over different numbers of subjects are not compared
        same = [name for name in known if value(table.row(name), "subjects") == n]
        gains = {name: sign * (own - known[name]) for name in same}
        if not gains:
            return None
        least = min(gains, key=lambda name: gains[name])
        gain = gains[least]
        word = "over" if gain > 0 else "against"
        text = {PSNR: f"{gain:+.2f} dB {word}", LPIPS: f"{abs(gain):.3f} {'lower' if gain > 0 else 'higher'} than"}.get(
            head, f"{gain:+.3f} {word}"
        )
        # means have three digits at most: a difference of one in the last is none
        holds = gain >= at_least if at_least else round(gain, 3) >= (0.01 if head == PSNR else 0.002)
        figure = "; without ".join([f"{text} {least}", *(name for name in known if name not in same)])
        return Finding(figure=figure, n=int(n), of="subjects", holds=holds, enough=n >= needed)

    return find


def gain_said(n_stacks: int, over: str, at_least: float, needed: int) -> Find:
    """Measure of g3r's gain over the best of a kind, from the line above the table, which has more digits.

    Args:
        n_stacks: number of stacks that the volumes are made from.
        over: the kind, in the words of the line.
        at_least: required gain.
        needed: least number of subjects.
    """

    def find(block: Block) -> Finding | None:
        table = of_condition(block, n_stacks)
        said = re.search(rf"([-+][\d.]+) dB over {over} \(([^;]*); least ([-+][\d.]+)\)", table.before if table else "")
        n = value(table.row(PRODUCT), "subjects") if table else None
        if said is None or n is None:
            return None
        return Finding(
            figure=f"{said[1]} dB over {said[2]}, least {said[3]}",
            n=int(n),
            of="subjects",
            holds=float(said[1]) >= at_least,
            enough=n >= needed,
        )

    return find


def variant(n_stacks: int, first: str, second: str, needed: int, at_least: float = NOTICEABLE_DB) -> Find:
    """Measure of the gain of one variant of the fit over another.

    Args:
        n_stacks: number of stacks that the volumes are made from.
        first: name of the better variant.
        second: name of the other variant.
        needed: least number of subjects.
        at_least: required difference.
    """

    def find(block: Block) -> Finding | None:
        (table, *_) = block.tables
        head = next((one for one in table.rows[0] if one.startswith(f"{stacks(n_stacks)}, dB")), "")
        counted = re.search(r"\((\d+) subject", head)
        one, other = value(table.row(first), head), value(table.row(second), head)
        if counted is None or one is None or other is None:
            return None
        n, gain = int(counted[1]), one - other
        return Finding(
            figure=f"{gain:+.2f} dB", n=n, of="subjects", holds=round(gain, 2) >= at_least, enough=n >= needed
        )

    return find


def predicts_better(than: str, head: str) -> Find:
    """Measure of how much better g3r predicts held-out real stacks than another volume.

    Args:
        than: name of the other volume.
        head: of the column.
    """

    def find(block: Block) -> Finding | None:
        counted = re.search(r"subjects: (\d+), held-out stacks: (\d+)", block.text)
        table = block.tables[0]
        own, other = value(table.row(PRODUCT), head), value(table.row(than), head)
        if counted is None or own is None or other is None:
            return None
        gain = own - other
        text = f"{gain:+.2f} dB" if head == PSNR else f"{gain:+.4f}"
        n = int(counted[1])
        figure = f"{text}, {counted[2]} held-out stacks"
        each = table_after(block, "Every stack") if head == PSNR else None
        if each:
            better = [(value(one, f"{PRODUCT}, dB") or 0) > (value(one, f"{than}, dB") or 0) for one in each.rows]
            figure = f"{text}, better in {sum(better)} of {len(better)} held-out stacks"
        return Finding(figure=figure, n=n, of="subjects", holds=gain > 0, enough=n >= FEW)

    return find
