"""docs/results.md agrees with the other pages, and claims follow from figures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from studies.harness import DOCS
from studies.results.blocks import NO_MEASUREMENT, PAGE, Block, origin, published
from studies.results.findings import FAILS, HOLDS, MISSING, UNSAID, Claim, Finding, Judged, judged, paired, shares
from studies.results.page import MARKER, TOPICS, judgements, main, page
from studies.results.paper_claims import mild_motion, one_stack, parts, table_1
from studies.results.picture_claims import lesions, real_masks, volumes_of_real_masks


@pytest.fixture(scope="module")
def blocks() -> dict[str, Block]:
    return published()


CLAIMS = [claim for claims in TOPICS.values() for claim in claims()]

HEAD = "| method | subjects | s | PSNR, dB | SSIM | LPIPS |\n| --- | ---: | ---: | ---: | ---: | ---: |\n"


def methods(g3r: str, others: str, stacks: str = "3 stacks") -> Block:
    """Table 1 with the given rows, in the mask and on the grid."""
    said = "g3r: +3.00 dB over the best volume without a network (least squares, TV; least +2.00)."
    text = f"**Moderate motion, {stacks}, 16 subjects.** {said}\n\nIn the mask:\n\n{HEAD}{g3r}\n{others}\n"
    text += f"\n<details><summary>On the whole grid</summary>\n\n{HEAD}{g3r}\n{others}\n\n</details>"
    return Block("paper-methods", "paper.md", "make study-paper.compare", text)


def outcome(claims: list[Claim], words: str, block: Block) -> Judged:
    (claim,) = [one for one in claims if one.block == block.name and words in one.text]
    return judged(claim, {block.name: block}, "")


def test_the_page_is_what_the_others_say_now(blocks: Mapping[str, Block]) -> None:
    text = (DOCS / PAGE).read_text(encoding="utf-8")
    found = text.split(f"<!-- {MARKER}:begin -->")[1].split(f"<!-- {MARKER}:end -->")[0]
    assert found.strip() == page(blocks).strip(), "run `make results`"


def test_every_claim_is_of_a_published_block(blocks: Mapping[str, Block]) -> None:
    assert {claim.block for claim in CLAIMS} <= set(blocks)
    assert len({claim.text for claim in CLAIMS}) == len(CLAIMS)
    assert all(claim.asked and claim.yes != claim.no for claim in CLAIMS)


def test_what_is_measured_is_judged(blocks: Mapping[str, Block]) -> None:
    """If a published table has no figure for its claims, they look for a wrong name."""
    found = [one for several in judgements(blocks).values() for one in several]
    for name in {one.claim.block for one in found}:
        of_block = [one for one in found if one.claim.block == name]
        assert any(one.finding for one in of_block) or not blocks[name].is_measured, name


@pytest.mark.parametrize("path", sorted(DOCS.glob("*.md")), ids=lambda path: path.name)
def test_pages_with_tables_of_studies_lead_to_the_results(path: Path, blocks: Mapping[str, Block]) -> None:
    if path.name in {block.page for block in blocks.values()}:
        assert f"]({PAGE}" in path.read_text(encoding="utf-8")


def test_tables_say_where_they_are_from(blocks: Mapping[str, Block]) -> None:
    assert not NO_MEASUREMENT & set(blocks)
    assert blocks["stress-sweep"].command.startswith("make study-stress.sweep STUDY_ARGS=")
    assert blocks["paper-methods-atlas"].command == blocks["paper-stages-atlas"].command
    assert origin("paper-stages", blocks).commit == blocks["paper-methods"].commit
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", blocks["paper-real"].commit)
    assert blocks["paper-real"].machine.endswith(" threads")
    unsaid = [name for name, block in blocks.items() if block.is_measured and not origin(name, blocks).commit]
    # the tables of numerics are checked by tests; the row of another program was measured once, by hand
    assert all(name.startswith("numerics-") or name == "peers" for name in unsaid), unsaid
    assert replace(blocks["ablation"], text="weights 0123456789abcdef").is_older("f" * 16)
    assert not blocks["numerics-shape"].is_older("f" * 16)


def test_claims_follow_the_figures() -> None:
    """A complete study with enough subjects, and all results better or worse than now."""
    good = methods(
        "| g3r | 16 | 30 ± 5 | 31.00 ± 1.00 | 0.970 ± 0.010 | 0.010 ± 0.001 |",
        "| V_prior | 16 | 30 | 32.00 | 0.980 | 0.001 |\n| least squares, TV | 16 | 2 | 28.00 | 0.950 | 0.020 |\n"
        "| nesvor | 2 | 100 | 40.00 | 0.999 | 0.001 |",
    )
    claims = list(table_1())
    for words in ("PSNR in the mask", "SSIM in the mask", "Better LPIPS", "whole grid", "Seconds"):
        assert outcome(claims, words, good).outcome == HOLDS, words
    best = outcome(claims, "Better PSNR than every baseline, in the mask", good)
    # V_prior is part of g3r, and a program with fewer subjects is not compared
    assert best.finding is not None
    assert best.finding.figure == "+3.00 dB over least squares, TV; without nesvor"
    assert "+3.00 dB" in best.conclusion
    bad = methods("| g3r | 16 | 50 | 28.00 | 0.950 | 0.030 |", "| least squares, TV | 16 | 2 | 28.00 | 0.960 | 0.020 |")
    for words in ("PSNR in the mask", "SSIM in the mask", "Better PSNR", "Better LPIPS", "Seconds"):
        for claim in (one for one in claims if words in one.text and one.block == "paper-methods"):
            assert judged(claim, {"paper-methods": bad}, "").outcome == FAILS, claim.text
    few = methods("| g3r | 3 | 50 | 28.00 | 0.950 | 0.030 |", "| least squares, TV | 3 | 2 | 29.00 | 0.960 | 0.020 |")
    found = outcome(claims, "Better SSIM", few)
    assert found.verdict == f"{UNSAID} (n too small; so far it {FAILS})"
    assert "3 subjects" in found.conclusion
    assert outcome(claims, "Better LPIPS", methods("| g3r | 16 | 1 | 30 | 1 | |", "")).outcome == MISSING


def test_levels_of_motion_are_told_apart() -> None:
    rows = "| g3r | 16 | 30 | 31.00 | 0.970 | 0.010 |", "| least squares, TV | 16 | 2 | 28.00 | 0.980 | 0.020 |"
    moderate = methods(*rows)
    mild = replace(moderate, text=moderate.text.replace("Moderate", "Mild"))
    assert outcome(list(mild_motion()), "Better PSNR", mild).outcome == HOLDS
    assert outcome(list(mild_motion()), "Better SSIM", mild).outcome == FAILS
    assert outcome(list(mild_motion()), "Better PSNR", moderate).outcome == MISSING
    assert outcome(list(table_1()), "PSNR in the mask", mild).outcome == MISSING


def test_real_masks() -> None:
    head = "| stack | Dice | slices lost | predicted, masks drawn, dB | predicted, masks found, dB |\n"
    head += "| --- | ---: | ---: | ---: | ---: |\n"
    one, two, poor = (
        f"| {s} |"
        for s in ("s1_a | 0.93 | 0 | 24.0 | 23.6", "s2_a | 0.92 | 0 | 24.0 | 23.4", "s3_a | 0.91 | 0 | - | -")
    )
    block = Block("masks-written", "masks.md", "", head + f"{one}\n{two}")
    alike, as_well = (outcome([claim()], "real stacks", block) for claim in (real_masks, volumes_of_real_masks))
    assert alike.finding is not None
    assert (alike.finding.holds, alike.finding.n, alike.finding.enough) == (True, 2, False)
    assert as_well.finding is not None
    assert as_well.finding.figure == "-0.50 dB, least -0.60"
    for more in (poor, poor.replace("0.91 | 0", "0.95 | 1")):
        worse = outcome([real_masks()], "real stacks", replace(block, text=f"{block.text}\n{more}"))
        assert worse.finding is not None
        assert not worse.finding.holds


def test_lesions_are_judged_by_the_one_that_keeps_least() -> None:
    head = "Every lesion\n\n| subject | stacks | lesion | without prior | with prior | prior alone |\n"
    head += "| --- | ---: | ---: | ---: | ---: | ---: |\n"
    rows = [f"| head-{n} | 3 | bright | 1.00 | 0.9{n} | 0.80 |" for n in range(4)]
    block = Block("lesions", "prior.md", "", head + "\n".join(rows))
    three = outcome(list(lesions()), "3 stacks", block)
    assert three.outcome == HOLDS
    assert three.finding is not None
    assert three.finding.figure == "92 %, least 90 %, of 4 lesions"
    assert outcome(list(lesions()), "1 stack", block).outcome == MISSING
    one_lost = replace(block, text=f"{block.text}\n| head-0 | 3 | dark | 1.00 | 0.84 | 0.80 |")
    assert outcome(list(lesions()), "3 stacks", one_lost).outcome == FAILS
    of_few_heads = replace(block, text=head + "\n".join(rows[:3]))
    assert outcome(list(lesions()), "3 stacks", of_few_heads).outcome == UNSAID


def test_one_stack_and_the_parts() -> None:
    block = methods("| g3r | 16 | 9 | 20.00 | 0.9 | 0.1 |", "| V_prior | 16 | 9 | 19.50 | 0.9 | 0.1 |", "1 stack")
    assert outcome(list(one_stack()), "without a network", block).outcome == HOLDS
    assert outcome(list(one_stack()), "improves V_prior", block).outcome == HOLDS
    text = (
        "| variant | 3 stacks, dB (16 subjects) | 1 stack, dB (16 subjects) |\n| --- | ---: | ---: |\n"
        "| as shipped | 29.80 | 22.00 |\n| annealing constant | 29.95 | 21.00 |\n| annealing linear | 30.00 | 22.00 |\n"
        "| no annealing: without distillation | 29.80 | 21.50 |\n| without prior | 29.00 | 20.00 |\n"
        "| slices stay where the prior has them | - | 21.80 |"
    )
    variants, claims = Block("paper-variants", "paper.md", "", text), list(parts())
    assert outcome(claims, "Distillation helps, 3 stacks, phantoms", variants).outcome == HOLDS
    assert outcome(claims, "Distillation helps, 1 stack, phantoms", variants).outcome == FAILS  # less than 1.16 dB
    assert outcome(claims, "constant weight, 3 stacks, phantoms", variants).outcome == FAILS
    assert outcome(claims, "constant weight, 1 stack, phantoms", variants).outcome == HOLDS
    assert outcome(claims, "Distillation helps, 2 stacks, phantoms", variants).outcome == MISSING


@pytest.mark.parametrize(
    ("hits", "n", "expected"), [(100, 100, HOLDS), (90, 100, FAILS), (5, 5, UNSAID), (4, 5, UNSAID), (3, 5, FAILS)]
)
def test_few_runs_can_miss_a_share_and_not_reach_it(hits: int, n: int, expected: str) -> None:
    assert shares(hits, n, 0.95, "runs").outcome == expected


def test_pairs_and_words() -> None:
    found = paired([(3.0, 1.0), (2.0, 2.5)], 0.1, 2)
    assert found is not None
    assert (found.figure, found.outcome, found.counted) == ("+0.75 dB, least -0.50", HOLDS, "2 subjects")
    assert paired([], 0.1, 2) is None
    assert Finding(figure="", n=1, of="cases", holds=True, enough=True).counted == "1 case"
    older = judged(CLAIMS[0], {"paper-methods": Block("paper-methods", "paper.md", "", "Weights " + "0" * 16)}, "")
    assert older.outcome == MISSING


def test_the_command_writes_the_page(tmp_path: Path) -> None:
    for path in DOCS.glob("*.md"):
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    paper = tmp_path / "paper.md"
    paper.write_text(re.sub(r"\| g3r \| \d+ \|", "| g3r | 1600 |", paper.read_text(encoding="utf-8")))
    assert main(["--docs", str(tmp_path)]) == 0
    text = (tmp_path / PAGE).read_text(encoding="utf-8")
    assert text.startswith("# Results")
    assert "| 1600 subjects | " in text
    (tmp_path / "paper.md").write_text("<!-- gate:begin -->\n<!-- gate:end -->\n")
    with pytest.raises(ValueError, match="both have a block gate"):
        published(tmp_path)
