"""Claims measured on other pages: verdicts, presets, prior, distillation and gate."""

from __future__ import annotations

import re
from collections.abc import Iterator

from g3r.report.verdict_messages import USE
from studies.results.blocks import Block
from studies.results.findings import FEW, NOTICEABLE_DB, Claim, Finding, column, paired, shares, table_after, value
from studies.stress.outcome import FALSE

MEANS = "mean gain over the quicker one"
"""First cell of the last row of the preset table, which compares each preset with the previous one."""

SEEDS = 3
"""Least number of trainings of a variant that shows more than chance."""


EVERY = {"stress-sweep": "Every run", "stress-drawn": "Every subject"}
"""Title of the table of all runs, by block."""

AT_ONCE = {
    "stress-sweep": ", one thing wrong at a time on heads that limits were set on",
    "stress-drawn": ", all drawn at once",
}
"""Words about the study in its claims, by block."""


def warned(bad: bool, study: str) -> Claim:
    """Claim that the verdict warns about bad runs, or does not warn about good ones.

    Args:
        bad: True for bad runs, False for good ones.
        study: block of the study.
    """

    def find(block: Block) -> Finding | None:
        table = table_after(block, EVERY[study])
        runs = [row for row in table.rows if (row["bad"] == "bad") == bad] if table else []
        said = sum(not row["verdict"].startswith(f"{USE}:") for row in runs)
        if not runs:
            return None
        return shares(said, len(runs), 0.95, "runs") if bad else shares(len(runs) - said, len(runs), 0.95, "runs")

    kind = "bad" if bad else "good"
    what = "is warned about" if bad else "gets no warning"
    means = " (more than 5 % of the brain off by more than 2 mm, or under 20 dB)" if bad else ""
    return Claim(
        text=f"A {kind} run{AT_ONCE[study]}{means} {what}",
        asked="at least 95 %, asked for" if bad else "at least 95 %, asked for: at most 5 % warned",
        block=study,
        find=find,
        yes=f"The verdict is right about {kind} runs{AT_ONCE[study]}: {{figure}}.",
        no=f"The verdict is wrong about {kind} runs too often{AT_ONCE[study]}: it is right about {{figure}}.",
    )


def false_alarms(study: str) -> Claim:
    """Claim about the number of good runs with a warning although nothing is wrong with their stacks.

    Args:
        study: block of the study.
    """

    def find(block: Block) -> Finding | None:
        table = table_after(block, EVERY[study])
        runs = [row for row in table.rows if row["bad"] != "bad"] if table else []
        said = sum(row["warning"] == FALSE for row in runs)
        return shares(len(runs) - said, len(runs), 0.95, "runs") if runs else None

    drawn = AT_ONCE[study]
    return Claim(
        text=f"A good run{drawn} gets no false alarm: a warning that names nothing that is wrong with its stacks",
        asked="at least 95 %",
        block=study,
        find=find,
        yes=f"False alarms are rare{drawn}: {{figure}} of the good runs have none.",
        no=f"False alarms are too frequent{drawn}: only {{figure}} of the good runs have none.",
    )


def preset_gain(preset: str, over: str, n_stacks: int) -> Claim:
    """Claim about the gain of a slower preset over a quicker one.

    Args:
        preset: the slower.
        over: the quicker.
        n_stacks: of the subjects.
    """

    def three(block: Block) -> Finding | None:
        table = block.tables[0]
        said = re.match(r"([-+][\d.]+) \(least ([-+][\d.]+)\)", (table.row(MEANS) or {}).get(f"`{preset}`, dB", ""))
        n = len(column(table.rows, f"`{preset}`, dB")) - 1
        if said is None:
            return None
        holds = float(said[1]) >= NOTICEABLE_DB
        figure = f"{said[1]} dB, least {said[2]}"
        return Finding(figure=figure, n=n, of="subjects", holds=holds, enough=n >= FEW)

    def fewer(block: Block) -> Finding | None:
        rows = [row for row in block.tables[0].rows if row["stacks"] == str(n_stacks)]
        found = {(row["subject"], row["preset"].strip("`")): value(row, "volume") or 0.0 for row in rows}
        names = dict.fromkeys(name for name, _ in found)
        known = [name for name in names if (name, preset) in found and (name, over) in found]
        return paired([(found[name, preset], found[name, over]) for name in known], NOTICEABLE_DB, FEW)

    return Claim(
        text=f"`{preset}` is better than `{over}`, {n_stacks} stacks",
        asked=f"{NOTICEABLE_DB:g} dB or more in the mean",
        block="presets" if n_stacks == 3 else "fewer-stacks",
        find=three if n_stacks == 3 else fewer,
        yes=f"From {n_stacks} stacks `{preset}` is better than `{over}`: {{figure}}.",
        no=f"From {n_stacks} stacks `{preset}` is no better than `{over}`: {{figure}}.",
    )


def over_prior(n_stacks: int, at_least: float) -> Claim:
    """Claim about the gain of the `balanced` volume over V_prior from one stack or two, on every subject.

    Args:
        n_stacks: of the subjects.
        at_least: required gain in dB of each subject.
    """
    words = f"{n_stacks} stack{'s' * (n_stacks != 1)}"

    def find(block: Block) -> Finding | None:
        rows = [row for row in block.tables[0].rows if (row["stacks"], row["preset"]) == (str(n_stacks), "`balanced`")]
        gains = [gain for row in rows if (gain := value(row, "over V_prior")) is not None]
        if not gains:
            return None
        figure = f"{sum(gain >= at_least for gain in gains)} of {len(gains)}, least {min(gains):+.2f} dB"
        return Finding(
            figure=figure, n=len(gains), of="subjects", holds=min(gains) >= at_least, enough=len(gains) >= FEW
        )

    return Claim(
        text=f"The volume is above V_prior on every subject, {words}",
        asked=f"{at_least:g} dB or more on each, asked for",
        block="single-stack" if n_stacks == 1 else "fewer-stacks",
        find=find,
        yes=f"From {words} `balanced` is above V_prior on every subject: {{figure}}.",
        no=f"From {words} `balanced` is not as far above V_prior on every subject as was asked for: {{figure}}.",
    )


def preset_limit(preset: str) -> Claim:
    """Claim that seconds of the whole command and dB below `accurate` stay within their limits in the table."""

    def find(block: Block) -> Finding | None:
        table = next((table for table in block.tables if table.rows and "at most" in table.rows[0]), None)
        rows = [row for row in table.rows if row["preset"] == f"`{preset}`"] if table else []
        if not rows:
            return None
        seconds, limit = column(rows, "seconds"), column(rows, "at most")[0]
        heads = list(rows[0])
        loss = column(rows, "dB less than `accurate`")
        allowed = column(rows, heads[-1])
        figure = f"{max(seconds):.1f} s of {limit:g} s"
        if loss:
            figure += f", {max(loss):.2f} dB of {allowed[0]:g} dB less than `accurate`"
        holds = max(seconds) <= limit and all(one <= most for one, most in zip(loss, allowed, strict=True))
        # every case must stay within the limits: a single case can show a failure, but few cannot show success
        return Finding(figure=figure, n=len(rows), of="cases", holds=holds, enough=not holds or len(rows) >= FEW)

    return Claim(
        text=f"`{preset}` stays within its limits of time and loss",
        asked="in every case; the limits stand in the table",
        block="trade",
        find=find,
        yes=f"`{preset}` stays within its limits ({{figure}}).",
        no=f"`{preset}` breaks a limit ({{figure}}).",
    )


def with_prior(first: str, second: str, n_stacks: int, what: str) -> Claim:
    """Claim about the gain of one row of the prior ablation over another.

    Args:
        first: the better row.
        second: the other row.
        n_stacks: of the subjects.
        what: the part that is claimed to help.
    """
    words = f"{n_stacks} stack{'s' * (n_stacks != 1)}"

    def find(block: Block) -> Finding | None:
        table, counted = block.tables[0], re.search(r"(\d+) subjects", block.text)
        one, other = (value(table.row(name), f"{words}: dB") for name in (first, second))
        if one is None or other is None or counted is None:
            return None
        n, gain = int(counted[1]), round(one - other, 2)
        return Finding(figure=f"{gain:+.2f} dB", n=n, of="subjects", holds=gain >= NOTICEABLE_DB, enough=n >= FEW)

    return Claim(
        text=f"{what} helps, {words}, mild motion, atlas volumes",
        asked=f"{NOTICEABLE_DB:g} dB or more; it helps in the paper",
        block="ablation",
        find=find,
        yes=f"{what} helps from {words} in mild motion ({{figure}}).",
        no=f"{what} brings next to nothing from {words} in mild motion ({{figure}}).",
    )


def over_coarse(words: str, at_least: float) -> Claim:
    """Claim about the gain of V_prior over V_coarse at true poses.

    Args:
        words: number of stacks as written in the table.
        at_least: required gain in dB.
    """

    def find(block: Block) -> Finding | None:
        found = re.search(rf"{words} ([-+][\d.]+) dB \([^,)]*, (\d+) cases\)", block.text)
        if found is None:
            return None
        gain, n = float(found[1]), int(found[2])
        return Finding(figure=f"{gain:+.2f} dB", n=n, of="cases", holds=gain >= at_least, enough=n >= FEW)

    return Claim(
        text=f"V_prior is above V_coarse at true poses, {words}",
        asked=f"{at_least:g} dB or more, asked for",
        block="alone",
        find=find,
        yes=f"At true poses V_prior is as far above V_coarse from {words} as was asked for ({{figure}}).",
        no=f"At true poses V_prior is less above V_coarse from {words} than was asked for ({{figure}}).",
    )


def gate(head: str, where: str) -> Claim:
    """Claim about the gain by density as an input of F and in the gate.

    Args:
        head: of the column.
        where: the part of the brain, in words.
    """

    def find(block: Block) -> Finding | None:
        table = block.tables[0]
        with_it, without = table.row("coverage, in F, gate"), table.row("neither")
        one, other = value(with_it, head), value(without, head)
        seeds = [value(row, "seeds") for row in (with_it, without)]
        if one is None or other is None:
            return None
        n, gain = int(min(seed or 0 for seed in seeds)), round(one - other, 2)
        holds = gain >= NOTICEABLE_DB
        return Finding(figure=f"{gain:+.2f} dB", n=n, of="seeds", holds=holds, enough=n >= SEEDS)

    return Claim(
        text=f"Density in the network and as its gate helps {where}",
        asked=f"{NOTICEABLE_DB:g} dB or more; in the paper's Table 2 it brings 0.46 of SSIM and 0.02 dB from one stack",
        block="gate",
        find=find,
        yes=f"Density helps the prior network {where} ({{figure}}).",
        no=f"Density does not help the prior network {where} ({{figure}}).",
    )


def verdicts() -> Iterator[Claim]:
    """Claims about the verdict on unusable volumes."""
    for study in EVERY:
        yield warned(True, study)
        yield warned(False, study)
        yield false_alarms(study)


def presets() -> Iterator[Claim]:
    """Claims about speed and accuracy of the presets."""
    yield preset_gain("balanced", "fast", 3)
    yield preset_gain("accurate", "balanced", 3)
    yield preset_gain("accurate", "balanced", 2)
    yield over_prior(2, 0.0)
    yield over_prior(1, 0.3)
    for name in ("preview", "fast", "balanced", "accurate"):
        yield preset_limit(name)


def prior() -> Iterator[Claim]:
    """Claims about the prior, its distillation and its gate."""
    for n in (1, 2, 3):
        yield with_prior("with distillation", "fit without prior", n, "The prior with distillation")
    for n in (1, 2, 3):
        yield with_prior("with distillation", "prior as initialisation", n, "Distillation, beside initialisation,")
    yield over_coarse("1 stack", 3.0)
    yield over_coarse("3 stacks", 2.0)
    yield gate("all", "over the whole brain")
    yield gate("c of 0 to 0.05", "where no slice looked")
