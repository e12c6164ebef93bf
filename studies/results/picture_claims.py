"""Claims about lesions, masks, the unseen part of the head, and in comparison with another program."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import mean

from studies.lesions.kept import WANTED_SHARE, WITH_PRIOR, WITHOUT_PRIOR
from studies.results.blocks import Block, TableRow, number
from studies.results.findings import FEW, Claim, Finding, column, paired, shares, table_after, value

MIN_DICE = 0.92
"""Required Dice coefficient with hand-drawn masks of real stacks."""


def counted(
    block: str, pattern: str, at_least: float, text: str, *, of: str, asked: bool = False, reverse: bool = False
) -> Claim:
    """Claim about a share that is stated in a sentence above a table.

    Args:
        block: with the sentence.
        pattern: with groups `hits` and `n`.
        at_least: required share.
        text: the claim.
        of: counted things.
        asked: whether the share was asked for.
        reverse: whether the sentence counts the wrong ones.
    """

    def find(found_in: Block) -> Finding | None:
        found = re.search(pattern, found_in.text)
        if found is None:
            return None
        hits, n = int(found["hits"]), int(found["n"])
        return shares(n - hits if reverse else hits, n, at_least, of)

    return Claim(
        text=text,
        asked=f"at least {at_least * 100:.0f} %{', asked for' * asked}",
        block=block,
        find=find,
        yes=f"{text}: in {{figure}}.",
        no=f"{text}: only in {{figure}}.",
    )


def real_masks() -> Claim:
    """Claim about the overlap with hand-drawn masks."""

    def find(block: Block) -> Finding | None:
        rows = block.tables[0].rows
        dice, lost = column(rows, "Dice"), sum(column(rows, "slices lost"))
        figure = f"Dice {mean(dice):.3f}, least {min(dice):.3f}, {len(dice)} stacks, {lost:.0f} slices lost"
        holds = min(dice) >= MIN_DICE and not lost
        return Finding(figure=figure, n=_subjects(rows), of="subjects", holds=holds, enough=_subjects(rows) >= FEW)

    return Claim(
        text="Masks found in real stacks are as people draw them",
        asked=f"Dice {MIN_DICE} or more on each, and no slice lost, asked for",
        block="masks-written",
        find=find,
        yes="Masks found in real stacks are close to those that people draw ({figure}).",
        no="Masks found in real stacks are not those that people draw ({figure}).",
    )


def volumes_of_real_masks() -> Claim:
    """Claim about the predictions by volumes from found and from drawn masks."""

    def find(block: Block) -> Finding | None:
        rows = block.tables[0].rows
        by_masks = (column(rows, f"predicted, masks {one}, dB") for one in ("found", "drawn"))
        found = paired(list(zip(*by_masks, strict=True)), -0.5, FEW)
        return found and replace(found, n=_subjects(rows), enough=_subjects(rows) >= FEW)

    text = "Volumes of masks that are found predict further real stacks"
    return Claim(
        text=f"{text} as well as those of drawn masks",
        asked="at most 0.5 dB less in the mean, asked for",
        block="masks-written",
        find=find,
        yes=f"{text} as well as those of drawn masks ({{figure}}).",
        no=f"{text} less well than those of drawn masks ({{figure}}).",
    )


def _subjects(rows: Sequence[TableRow]) -> int:
    return len({row["stack"].split("_")[0] for row in rows})


def cost_of_masks(beside: str) -> Claim:
    """What is lost by masks that were found, without the rim that differs by design.

    Args:
        beside: "true" masks, or "drawn": true ones that are as wide as found ones are.
    """
    words = "true masks" if beside == "true" else "true masks as wide as these"

    def find(block: Block) -> Finding | None:
        pairs = []
        for row in block.tables[0].rows:
            true, drawn, found = (number(part) or 0.0 for part in row["without the outer 2 mm, dB"].split("/"))
            pairs.append((found, true if beside == "true" else drawn))
        return paired(pairs, -0.5, FEW, "cases")

    return Claim(
        text=f"Masks that are found cost the inner brain little beside {words}",
        asked="at most 0.5 dB in the mean",
        block="masks-cases",
        find=find,
        yes=f"Masks that are found cost the inner brain little beside {words} ({{figure}}).",
        no=f"Masks that are found cost the inner brain more than little beside {words} ({{figure}}).",
    )


def fill(first: str, second: str, text: str) -> Claim:
    """Claim about the gain of one fill of the unseen part over another, where fills differ.

    Args:
        first: name of the better fill.
        second: name of the other fill.
        text: the claim.
    """

    def find(block: Block) -> Finding | None:
        table = table_after(block, "Every subject")
        gains = [
            (value(row, f"{first}, unseen dB") or 0.0) - (value(row, f"{second}, unseen dB") or 0.0)
            for row in (table.rows if table else ())
            if len({row[f"{name}, unseen dB"] for name in ("nothing", "harmonic", "template")}) > 1
        ]
        if not gains:
            return None
        gain, enough = mean(gains), len(gains) >= FEW
        return Finding(figure=f"{gain:+.2f} dB", n=len(gains), of="subjects", holds=gain > 0, enough=enough)

    return Claim(
        text=text,
        asked="better",
        block="unseen-sweep",
        find=find,
        yes=f"{text} ({{figure}}).",
        no=f"It is not so that {text[0].lower()}{text[1:]} ({{figure}}).",
    )


def noticed() -> Claim:
    """Claim about the warnings for subjects with missing slices and wrong poses."""

    def find(block: Block) -> Finding | None:
        found = re.search(r"Median TRE under 1 mm: (\d+) of (\d+); of the others (\d+) without a warning", block.text)
        if found is None:
            return None
        others, silent = int(found[2]) - int(found[1]), int(found[3])
        return shares(others - silent, others, 0.95, "subjects") if others else None

    return Claim(
        text="Missing slices: wrong poses are warned about",
        asked="at least 95 %",
        block="unseen-sweep",
        find=find,
        yes="Where missing slices make poses wrong, there is a warning ({figure}).",
        no="Where missing slices make poses wrong, a warning is missing too often ({figure} warned).",
    )


def nesvor() -> Iterator[Claim]:
    """Claims about one case that both programs reconstructed."""

    def compared(head: str, unit: str, sign: int) -> Claim:
        def find(block: Block) -> Finding | None:
            rows = block.tables[0].rows
            own = next((value(row, head) for row in rows if row["method"] == "g3r `balanced`"), None)
            other = next((value(row, head) for row in rows if row["method"].startswith("NeSVoR")), None)
            if own is None or other is None:
                return None
            figure = f"{own:g} against {other:g} {unit}"
            return Finding(figure=figure, n=1, of="cases", holds=sign * (own - other) > 0, enough=False)

        what = "nearer to the truth" if sign > 0 else "quicker"
        text = f"g3r is {what} than NeSVoR on a CPU"
        return Claim(text=text, asked="it is", block="peers", find=find, yes=f"{text}.", no=f"{text}: it is not.")

    yield compared("PSNR, dB", "dB", 1)
    yield compared("CPU seconds", "CPU seconds", -1)


def masks() -> Iterator[Claim]:
    """Claims about automatic masks."""
    heads = r"(?P<n>\d+) stacks with a head: found in (?P<hits>\d+)"
    none = r"(?P<n>\d+) stacks without a head: in (?P<hits>\d+) of them one was found"
    yield counted("masks-simulated", heads, 0.95, "A head is found where there is one", of="simulated stacks")
    yield counted(
        "masks-simulated", none, 0.95, "None is found where there is none", of="simulated stacks", reverse=True
    )
    yield real_masks()
    yield volumes_of_real_masks()
    yield cost_of_masks("true")
    yield cost_of_masks("drawn")


def lesions() -> Iterator[Claim]:
    """Claims about lesions that slices cover."""

    def kept(n_stacks: int) -> Claim:
        words = f"{n_stacks} stack{'s' * (n_stacks != 1)}"

        def find(block: Block) -> Finding | None:
            every = table_after(block, "Every lesion")
            rows = [row for row in (every.rows if every else ()) if row["stacks"] == str(n_stacks)]
            shares_kept = (column(rows, name) for name in (WITH_PRIOR, WITHOUT_PRIOR))
            ratios = [one / other for one, other in zip(*shares_kept, strict=True)]
            if not ratios:
                return None
            heads = len({row["subject"] for row in rows})
            figure = f"{100 * mean(ratios):.0f} %, least {100 * min(ratios):.0f} %, of {len(ratios)} lesions"
            return Finding(figure=figure, n=heads, of="heads", holds=min(ratios) >= WANTED_SHARE, enough=heads >= FEW)

        text = f"From {words} a lesion keeps its contrast with the prior"
        return Claim(
            text=text,
            asked=f"{100 * WANTED_SHARE:.0f} % or more, of each, of what the fit without prior keeps, asked for",
            block="lesions",
            find=find,
            yes=f"{text} ({{figure}} of what is kept without it).",
            no=f"{text} not as well as was asked for ({{figure}} of what is kept without it).",
        )

    yield kept(3)
    yield kept(1)


def unseen() -> Iterator[Claim]:
    """Claims about missing slices."""
    block = "unseen-sweep"
    within, under = (
        "Missing slices: brain volume within 3 % of the truth",
        "Missing slices: median pose error under 1 mm",
    )
    volume = r"Brain volume within 3% of the truth: (?P<hits>\d+) of (?P<n>\d+)"
    poses = r"Median TRE under 1 mm: (?P<hits>\d+) of (?P<n>\d+)"
    yield counted(block, volume, 0.95, within, of="subjects", asked=True)
    yield counted(block, poses, 0.9, under, of="subjects", asked=True)
    yield noticed()
    yield fill("V_prior", "template", "The network fills an unseen part better than the template alone")
    yield fill("volume", "nothing", "What is shown of an unseen part is better than nothing")
