"""Study of the paper's protocol: subjects, baselines, a fake other program, tables and pictures of a record."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_synth.export import save_simulation
from data_synth.heads import PhantomSubject, load_volume_of
from data_synth.simulator import orthogonal_settings, simulate_stacks
from g3r.acquisition.images import Volume
from g3r.evaluation.case import SimulatedCase, load_case
from g3r.evaluation.compare import compare
from g3r.fitting.initial_volumes import InitialVolumes
from g3r.gaussians import render
from g3r.geometry import RigidPose
from g3r.planning.presets import PRESETS, adapted, changed
from studies.harness import left_text
from studies.paper import peers
from studies.paper.ablation import LINEAR, NONE, SHIPPED, VARIANTS
from studies.paper.compare import STUDY, tables
from studies.paper.figures import draw
from studies.paper.least_squares import TIKHONOV, TOTAL_VARIATION, least_squares_volume
from studies.paper.methods import FILL, PRODUCT, VARIATION
from studies.paper.pictures import keep_sections
from studies.paper.scores import scored
from studies.paper.subjects import FIRST_SEED, TUNING_SEED, phantom_heads, spread_order
from studies.paper.tuning import true_volumes
from studies.paper.unconstrained import Unconstrained, fit_unconstrained
from studies.runs import header_error

FAKE = """
import shutil, sys
from pathlib import Path
output, stacks, masks = sys.argv[1], sys.argv[2:4], sys.argv[4:6]
assert all(Path(p).is_file() for p in (*stacks, *masks)) and sys.argv[6:] == ["4", "4"], sys.argv
shutil.copy(Path(stacks[0]).with_name("truth.nii.gz"), output)
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> SimulatedCase:
    """A small head with two stacks and almost no noise."""
    folder = tmp_path_factory.mktemp("paper") / "case"
    truth = load_volume_of(PhantomSubject("phantom", 21.0, 1), 2.0)
    truth = replace(truth, data=truth.data * np.float32(1000))
    settings = orthogonal_settings(2, "mild", resolution_mm=2.0, thickness_mm=4.0, snr=100.0, bias=0.0)
    stacks = simulate_stacks(truth.data, truth.mask, truth.affine, settings, np.random.default_rng(0))
    save_simulation(folder, truth, stacks, {"thickness_mm": 4.0})
    return load_case(folder)


@pytest.fixture(scope="module")
def volumes(case: SimulatedCase) -> InitialVolumes:
    return true_volumes(case)[0]


def psnr_db(data: np.ndarray, volumes: InitialVolumes, case: SimulatedCase) -> float:
    made = Volume(data.astype(np.float32), volumes.grid.affine, "made")
    return compare(made, case.truth, case.truth_mask).scores.psnr_db


def test_subjects_are_spread_and_their_own() -> None:
    heads = phantom_heads(16, "moderate")
    weeks = sorted(one.weeks for one in heads)
    assert len({one.seed for one in heads}) == 16
    assert 21 <= weeks[0] < weeks[-1] <= 38
    assert {one.seed for one in heads}.isdisjoint(one.seed for one in phantom_heads(2, "moderate", TUNING_SEED))
    assert min(one.seed for one in heads) == FIRST_SEED
    assert spread_order(6) == [0, 4, 2, 1, 3, 5]
    assert spread_order(1) == [0]
    assert spread_order(0) == []
    stacks = heads[0].acquisition(3)
    assert {one.orientation for one in stacks} == {"axial", "coronal", "sagittal"}
    assert {(one.resolution_mm, one.thickness_mm, one.profile) for one in stacks} == {(0.8, 2.2, "sinc")}


def test_least_squares_are_better_than_the_scattered_volume(case: SimulatedCase, volumes: InitialVolumes) -> None:
    ones = np.ones(len(volumes.slices))
    coarse = psnr_db(volumes.coarse, volumes, case)
    for regulariser in (TIKHONOV, TOTAL_VARIATION):
        found = least_squares_volume(volumes, ones, ones, regulariser)
        assert psnr_db(found, volumes, case) > coarse + 1, regulariser
    # without data, the strongest regulariser gives a flat volume beyond the mask, and no NaN
    flat = least_squares_volume(volumes, ones, ones, replace(TOTAL_VARIATION, strength=100.0))
    assert np.isfinite(flat).all()
    assert flat.std() < volumes.coarse.std()


@pytest.mark.parametrize("seeding", ["random", "gradient"])
def test_gaussians_alone_fit_the_slices(case: SimulatedCase, volumes: InitialVolumes, seeding: str) -> None:
    ones = np.ones(len(volumes.slices))
    planes, slices = volumes.slices.planes, volumes.slices
    errors = []
    for n_steps in (1, 40):
        settings = Unconstrained(seeding=seeding, n_steps=n_steps)
        cloud = fit_unconstrained(volumes, ones, ones, 4.0, settings, np.random.default_rng(0))
        errors.append(np.abs(render(cloud, planes).numpy() - slices.value)[slices.mask].mean())
    assert errors[1] < 0.7 * errors[0]


def test_the_printed_amplitude_is_another(volumes: InitialVolumes) -> None:
    ones = np.ones(len(volumes.slices))
    exact, printed = (
        fit_unconstrained(volumes, ones, ones, 4.0, Unconstrained(attenuation=a, n_steps=5), np.random.default_rng(0))
        for a in ("exact", "printed")
    )
    # without the factor B each Gaussian is brighter in a slice, so its amplitude must be lower
    assert float(printed.amplitude.mean()) < float(exact.amplitude.mean())


def options(**more: object) -> argparse.Namespace:
    parsed = STUDY.parser().parse_args([])
    for name, value in ({"with_lpips": False} | more).items():
        setattr(parsed, name, value)
    return parsed


def fake_peer(tmp_path: Path) -> peers.Peer:
    script = tmp_path / "fake program.py"
    script.write_text(FAKE)
    return peers.peer(
        f"fake={shlex.quote(sys.executable)} {shlex.quote(str(script))} {{output}} {{stacks}} {{masks}} {{thicknesses}}"
    )


def test_another_program_is_run_and_scored(
    case: SimulatedCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "paper_case", lambda spec, atlas, cache, n: case)
    spec = phantom_heads(16, "moderate")[0]
    row = peers.measure_peer(spec, 2, fake_peer(tmp_path), options())
    assert row["scores"]["fake"]["mask"]["psnr_db"] > 60  # the truth aligned with itself
    assert row["scores"]["fake"]["grid"]["ssim"] > 0.99
    for wrong in ("false {stacks} {output}", "no-such-program {stacks} {output}", "true {stacks} {output}"):
        refused = peers.measure_peer(spec, 2, peers.peer(f"wrong={wrong}"), options())
        assert refused["skipped"], wrong
        assert "scores" not in refused, wrong


@pytest.mark.parametrize(
    "text", ["nesvor", "=run {stacks} {output}", "a=run {stacks}", "a=run {stacks} {out} {output}"]
)
def test_a_command_without_its_places_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        peers.peer(text)


def test_places_inside_words(tmp_path: Path) -> None:
    words = peers.arguments(peers.peer("x=run --in={stacks} {output}"), tmp_path, 2, 2.2, tmp_path / "v.nii.gz")
    assert words == ["run", f"--in={tmp_path}/stack-0.nii.gz {tmp_path}/stack-1.nii.gz", f"{tmp_path}/v.nii.gz"]


def test_beside_the_brain_black_stays_black(case: SimulatedCase) -> None:
    """The fit in the mask has an offset, which must not brighten the background on the whole grid."""
    dimmed = np.where(case.truth_mask, 0.5 * case.truth.data + 100, 0).astype(np.float32)
    row, _ = scored(case, dimmed, case.truth.grid, RigidPose.identity(1), None)
    assert row["mask"]["psnr_db"] > 50
    assert row["grid"]["ssim"] > 0.8


def test_tables_and_pictures_of_a_record(case: SimulatedCase, volumes: InitialVolumes, tmp_path: Path) -> None:
    row, comparison = scored(case, volumes.sharp, volumes.grid, header_error(case).common, None)
    subject, base = "moderate-30.0w-1", {"weeks": 30.0, "motion": "moderate", "subject": "moderate-30.0w-1"}
    scores = {name: row | {"seconds": 1.0} for name in (PRODUCT, VARIATION)}
    filled = {FILL: row | {"seconds": 2.0}}
    stages = {"tre_mm": 0.1, "own_tre_mm": 0.2, "seconds": 30.0, "cpu_seconds": 40.0, "stages": {"registration": 9.0}}
    variants = {"as shipped": {"psnr_db": 30.0}, "without prior": {"psnr_db": 28.0}}
    record = {
        "preset": "balanced",
        "weights": "0",
        "threads": 1,
        "subjects": "phantoms",
        "why_no_lpips": "no weights",
        "machine": {"processor": "a", "cores": 1, "threads": 1, "python": "3", "torch": "2", "numba": "0"}
        | {"g3r": "0", "commit": None},
        "rows": {
            "one": base | {"kind": "methods", "n_stacks": 3, "scores": scores} | stages,
            "other": base | {"kind": "methods", "n_stacks": 3, "scores": scores | filled} | stages,
            "refused": base | {"kind": "methods", "n_stacks": 3, "skipped": "no"},
            "peer": base | {"kind": "methods", "n_stacks": 3, "scores": {"fake": row | {"seconds": 5.0}}},
            "parts": base | {"kind": "variants", "n_stacks": 3, "scores": variants},
        },
    }
    texts = tables(record)
    assert set(texts) == {"paper-methods", "paper-variants", "paper-stages"}
    assert "LPIPS is left out: no weights" in texts["paper-methods"]
    assert "| LPIPS" not in texts["paper-methods"]
    assert "| fake | 1 | 5 |" in texts["paper-methods"]
    assert "+0.00 dB over the best volume" in texts["paper-methods"]
    assert "+0.00 dB over template fill (on 1 subject)" in texts["paper-methods"]
    assert "g3r refused 1 more, which count for no method" in texts["paper-methods"]
    assert "| as shipped | 30.00 |" in texts["paper-variants"]
    assert "registration | 9.0" in texts["paper-stages"]
    assert set(tables(record | {"subjects": "volumes of atlas"})) == {f"{name}-atlas" for name in texts}
    keep_sections(tmp_path / "sections" / f"{subject}-3.npz", case, {PRODUCT: comparison.volume})
    draw(record, options(output=tmp_path, figure=tmp_path / "paper-methods.png"))
    assert (tmp_path / "paper-methods.png").stat().st_size > 5000
    assert (tmp_path / "paper-stacks.png").is_file()
    assert not (tmp_path / "paper-one-stack.png").exists()


def test_several_stacks_are_not_distilled_where_the_variant_is_not_run_again() -> None:
    shipped, without, held = (changed(PRESETS["balanced"], VARIANTS[name]) for name in (SHIPPED, NONE, LINEAR))
    assert adapted(shipped, 2) == adapted(without, 2) != adapted(held, 2)
    assert adapted(shipped, 1) != adapted(without, 1)


def test_the_time_that_is_left() -> None:
    assert left_text(2, 6, 240.0) == " (2 of 6, about 8 min left)"
    assert left_text(6, 6, 240.0) == ""
