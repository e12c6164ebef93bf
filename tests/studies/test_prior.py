"""Prior studies, without any training: statistics and marks of their tables, subjects and networks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.metrics import score
from g3r.geometry import VolumeGrid
from g3r.geometry.grid import on_grid
from g3r.planning.presets import PRESETS, changed
from g3r.prior.config import PriorNetworkConfig
from g3r.prior.model import Prior
from g3r.training.prior_batches import DENSITY_KINDS
from studies.harness import Row
from studies.motion import sweep
from studies.prior import ablation, alone, cases, gate, network_scores, networks, sets, trainings
from studies.prior.figures import draw_ablation, draw_networks
from studies.prior.volumes import prior_volumes, slices_at_true_poses, template_at_truth, tiling_difference
from studies.subjects import read_case

SETTINGS = {"preset": "balanced", "weights": "abc", "threads": 2, "n_views": 4}


def ablation_rows(gain: tuple[float, float, float] = (2.0, 1.0, 0.5)) -> dict[str, dict[str, Any]]:
    """Rows of two subjects, from 1 and 3 stacks."""
    rows = {}
    for number, (name, volume) in enumerate({"a": "crl-sta/sta24", "b": "spina-bifida/sb25-operated"}.items()):
        for n in (3, 1):
            psnr = dict.fromkeys(ablation.VARIANTS, 20.0 + n + number)
            psnr["with distillation"] += gain[n - 1] * (1 + number)
            rows[f"{name} {n}"] = {
                "subject": name,
                "n_stacks": n,
                "volume": volume,
                "scores": {v: {"psnr_db": db, "ssim": 0.9} for v, db in psnr.items()},
                "median_mm": dict.fromkeys(ablation.FITS_COMPARED, 0.25),
            }
    return rows


def test_ablation_table_gives_mean_spread_and_paired_difference() -> None:
    text = ablation.tables(SETTINGS | {"rows": ablation_rows()})["ablation"]
    assert "| fit without prior | 21.50 ± 0.71 | 0.900 ± 0.000 |  |" in text
    assert "| with distillation | 24.50 ± 2.12 | 0.900 ± 0.000 | +3.00 ± 1.41 |" in text
    assert "| with distillation, sb | 26.00 | 0.900 | +4.00 |" in text
    assert "2 subjects (1 sta, 1 sb)" in text
    assert "1 stack: +2.00 dB (2 of 2 better); 3 stacks: +0.50 dB" in text
    assert "| b | 1 | 22.00 | 22.00 | 22.00 | 22.00 | 22.00 | 26.00 | 0.25 |" in text
    assert "2 stacks" not in text


def test_ablation_subjects_are_many_fresh_and_of_their_own() -> None:
    published, looked_at = ablation.specs(), ablation.specs(development=True)
    assert len(published) >= 8
    assert {one.seed for one in published}.isdisjoint(one.seed for one in looked_at)
    sweeps = [sweep.specs(sweep.LEVELS, 100, development=dev) for dev in (False, True)]
    assert {one.seed for one in published}.isdisjoint(one.seed for subjects in sweeps for one in subjects)
    assert all(any(one.volume.startswith(p) for p in ablation.GROUPS.values()) for one in published)
    for options in ablation.FITS_COMPARED.values():
        changed(PRESETS["balanced"], options)


def test_alone_table_marks_what_falls_short() -> None:
    def row(n_stacks: int, gain: float, ssim: float) -> dict[str, Any]:
        psnr = {"V_coarse": 20.0, "V_sharp": 21.0, "V_prior": 20.0 + gain}
        scores = {name: {"psnr_db": db, "ssim": ssim} for name, db in psnr.items()}
        return {"case": "c", "n_stacks": n_stacks, "scores": scores, "seconds": 2.5}

    speed = {"shape": [9, 8, 7], "voxel_mm": 0.8, "seconds": dict.fromkeys(alone.VOLUMES, 5.5), "tile_voxels": 72}
    speed |= {"tiling_difference": 2e-4, "all_views_seconds": 4.9}
    rows = {"a": row(1, 2.9, 0.81), "b": row(3, 2.1, 0.84), "c": row(2, 0.5, 0.5), alone.SPEED: speed}
    text = alone.tables(SETTINGS | {"rows": rows})["alone"]
    assert "| 22.90 / 0.810 | +2.90 (!) | 0.810 | 2.5 |" in text
    assert "| +2.10 | 0.840 (!) | 2.5 |" in text
    assert "| +0.50 | 0.500 | 2.5 |" in text  # there is no requirement for two stacks
    assert "the network 5.5 s (asked: under 5 (!)), and the mean over the 4 views of the product 4.9 s." in text
    assert "2.0e-04 of the intensity scale (asked: 0.001)" in text


def test_cases_table_marks_a_prior_that_costs() -> None:
    def row(gain: float) -> dict[str, Any]:
        scores = {v: {"psnr_db": 25.0, "ssim": 0.9} for v in ablation.VARIANTS}
        scores[cases.PRODUCT] = {"psnr_db": 25.0 + gain, "ssim": 0.9}
        return {"n_stacks": 3, "scores": scores, "median_mm": {cases.PRODUCT: 0.07}}

    text = cases.tables(SETTINGS | {"rows": {"good": row(0.4), "bad": row(-0.3)}})["cases"]
    assert "| 25.40 | +0.40 | 0.900 | 0.07 |" in text
    assert "| 24.70 | -0.30 (!) | 0.900 | 0.07 |" in text


def network_record() -> dict[str, Any]:
    scores = {n: {"l1": 0.05, "psnr_db": 25.0 + k, "ssim": 0.9} for k, n in enumerate(("1", "2", "all"))}
    one = {"scores": scores, "parameters": 1_500_000, "seconds": 2.5, "steps": 288, "train_seconds": 600}
    rows = {"size-16-32-64": {**one, "what": "small", "is_size": True}, "full": {**one, "what": "all", "is_size": True}}
    return SETTINGS | {"rows": {"V_coarse": {"scores": scores}, "V_sharp": {"scores": scores}, **rows}}


def test_network_table() -> None:
    text = networks.tables(network_record())["networks"]
    assert "| V_coarse |  | 0.0500 | 25.00 | 26.00 | 27.00 | 0.900 |  |  |  |  |" in text
    assert "| full | all | 0.0500 | 25.00 | 26.00 | 27.00 | 0.900 | 1.50 M | 2.5 | 288 | 10 |" in text
    assert text.index("| full |") < text.index("| size-16-32-64 |")


def test_networks_differ_from_the_configuration() -> None:
    config = trainings.configuration()
    found = {variant.name for variant in networks.distinct_variants(config)}
    assert {"no-template", "as-printed"} <= found
    assert "sharp-base" in found or config["model"]["init_args"]["network"].get("sharp_base")
    assert "size-" + "-".join(map(str, config["model"]["init_args"]["network"]["channels"])) not in found
    assert {"full", "alpha-0.05", "no-sharp"} <= found
    per_epoch = trainings.epochs_of(10**6, config) / 10**6
    assert trainings.epochs_of(1, config) == 1
    assert trainings.epochs_of(300, config) == max(1, round(300 * per_epoch))
    own = ["--data.subjects_per_epoch=6", "--data.patches_per_subject=4", "--data.batch_size=2", "--data.source=9"]
    assert trainings.epochs_of(36, config, own) == 3


def test_network_options_are_those_of_the_network() -> None:
    for variant in networks.VARIANTS:
        PriorNetworkConfig(**variant.options)


def test_the_gate_s_factorial_is_complete_and_no_network_is_trained_twice() -> None:
    found = gate.variants()
    read = {(kind, *variant.options.values()) for kind, variant in found if any(variant.options.values())}
    assert len(found) == len({variant.name for _, variant in found}) == 10
    assert read == {(kind, f, g) for kind in DENSITY_KINDS for f in (True, False) for g in (True, False) if f or g}
    for _, variant in found:
        PriorNetworkConfig(**variant.options)


def test_gate_table() -> None:
    def row(db: float, **more: object) -> dict[str, Any]:
        return {"scores": {"all": db, "unseen": db - 2, "seen": db + 1}, **more}

    rows = {"V_coarse": row(20, variant="V_coarse")}
    for seed, db in ((1, 22.0), (2, 23.0)):
        rows[f"neither, seed {seed}"] = row(db, variant="neither", seed=seed, steps=384, train_seconds=90)
    text = gate.tables({"val_subjects": 6, "arguments": [], "rows": rows})["gate"]
    assert "|  | seeds | all | c of 0 to 0.05 | c of 0.6 to 1 | steps | trained, min |" in text
    assert "| V_coarse |  | 20.00 | 18.00 | 21.00 |  |  |" in text
    assert "| neither | 2 | 22.50 ± 0.71 | 20.50 ± 0.71 | 23.50 ± 0.71 | 384 | 2 |" in text


def test_sets_of_weights_side_by_side() -> None:
    def row(case: str, name: str, db: float, **unseen: float) -> Row:
        scores = {"V_prior": {"whole": db - 1}, "volume": {"whole": db, **unseen}}
        return {"case": case, "set": name, "median_mm": 0.3, "volume_error": -0.01, "scores": scores}

    rows = [
        row("a", "usual", 30),
        row("a", "cc0", 29),
        row("b", "usual", 25, unseen=20),
        row("b", "cc0", 23, unseen=18),
    ]
    record = {"preset": "balanced", "rows": dict(enumerate([*rows, row("c", "usual", 40)]))}
    text = sets.tables(record)["sets"]
    assert "| a | 0.30 / 0.30 | -1.0% / -1.0% | 29.00 / 28.00 | 30.00 / 29.00 | - / - |" in text
    assert "| b | 0.30 / 0.30 | -1.0% / -1.0% | 24.00 / 22.00 | 25.00 / 23.00 | 20.0 / 18.0 |" in text
    assert "cc0 costs 1.50 dB of V_prior and 1.50 dB of the volume in the mean." in text
    assert "| c |" not in text  # not measured with every set


def test_gate_scores_are_those_of_bins_of_coverage() -> None:
    truth = torch.rand(1, 1, 16, 16, 16, generator=torch.Generator().manual_seed(0))
    density = torch.zeros_like(truth)
    density[..., 8:] = 3.0
    one = {"truth": truth, "mask": torch.ones_like(truth), "density": density}
    made = truth + torch.where(density > 0, 0.01, 0.1)
    found = gate.scores([made], [one])
    assert found["unseen"] == pytest.approx(20, abs=1e-4)
    assert found["seen"] == pytest.approx(40, abs=1e-3)
    assert found.keys() == {"all", "unseen", "seen"}


def test_scores_by_number_of_stacks() -> None:
    truth = torch.rand(1, 1, 12, 12, 12, generator=torch.Generator().manual_seed(0))
    pattern = torch.where(torch.arange(12) % 2 == 0, 1.0, -1.0)
    volumes = [{"truth": truth, "mask": torch.ones_like(truth), "n_stacks": torch.tensor([n])} for n in (1, 3, 3)]
    made = [truth + error * pattern for error in (0.1, 0.01, 0.03)]
    scores = network_scores.scores_by_stacks(made, volumes)
    expected = score(made[0][0, 0].numpy(), truth[0, 0].numpy(), np.ones((12, 12, 12), bool))
    assert (scores["1"]["psnr_db"], scores["1"]["ssim"]) == (expected.psnr_db, expected.ssim)
    assert scores["3"]["l1"] == pytest.approx(0.02, abs=1e-6)
    assert scores["all"]["l1"] == pytest.approx(0.14 / 3, abs=1e-6)


def test_a_table_without_training_needs_a_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert networks.STUDY.main(["--no-train", "--output", str(tmp_path)]) == 3
    assert "no trained variant" in capsys.readouterr().err


def test_the_newest_checkpoint_is_gone_on_with(tmp_path: Path) -> None:
    assert trainings.newest_checkpoint(tmp_path) is None
    for version, age in ((0, 50), (1, 10)):
        path = tmp_path / "logs" / f"version_{version}" / "checkpoints" / "last.ckpt"
        path.parent.mkdir(parents=True)
        path.write_text("")
        os.utime(path, (1e9 - age, 1e9 - age))
    assert trainings.newest_checkpoint(tmp_path) == path


def test_figures_are_drawn_from_records(tmp_path: Path) -> None:
    draw_ablation(list(ablation_rows().values()), ablation.VARIANTS, ablation.BASELINE, tmp_path / "new" / "a.png")
    draw_networks(network_record(), tmp_path / "b.png")
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["a.png", "b.png"]  # no temporary file


def test_slices_without_a_true_pose_are_left_out(tmp_path: Path, rng: np.random.Generator) -> None:
    from g3r.acquisition.images import save_volume

    affine = np.diag([1.0, 1.0, 3.0, 1.0])
    save_volume(tmp_path / "stack-0.nii.gz", rng.random((12, 12, 6)).astype(np.float32), affine)
    save_volume(tmp_path / "mask-0.nii.gz", np.ones((12, 12, 6), bool), affine)
    lines = ["stack slice rx ry rz tx ty tz".replace(" ", "\t")]
    lines += [f"0\t{k}\t0\t0\t0.1\t{k}\t0\t0" for k in range(5)]
    (tmp_path / "poses.tsv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    slices = slices_at_true_poses(read_case(tmp_path), 1)
    assert slices.slice_index.tolist() == [0, 1, 2, 3, 4]
    motion = slices.world_from_header()
    np.testing.assert_allclose(motion.translation_mm[:, 0], range(5), atol=1e-9)
    np.testing.assert_allclose(motion.rotvec_rad()[:, 2], 0.1, atol=1e-9)


def small_prior() -> Prior:
    """An untrained network with the template of two phantoms."""
    from data_synth.heads import PhantomSubject
    from data_synth.template import atlas_templates
    from g3r.prior.dgpn import DensityGatedPriorNetwork

    template = atlas_templates([PhantomSubject("a", 22.0, 1), PhantomSubject("b", 28.0, 2)], 3.0)
    config = PriorNetworkConfig(channels=(4, 4), units=(1, 1), tail_channels=2, template_spacing_mm=3.0)
    network = DensityGatedPriorNetwork(config).eval()
    network.set_template(torch.from_numpy(template.volume))
    return Prior(network=network, voxel_mm=2.5, weeks=tuple(template.weeks.tolist()), training_data="nothing")


def test_volumes_of_a_case_start_from_a_template_at_the_truth(subject: Path) -> None:
    case, prior = read_case(subject), small_prior()
    placed = template_at_truth(prior.template, case.truth, case.truth_mask)
    true = case.truth.grid.world(np.argwhere(case.truth_mask))
    here = placed.grid.world(np.argwhere(placed.volume > 0))
    np.testing.assert_allclose(here.mean(0), true.mean(0), atol=0.01)
    n_mm3 = len(here) * placed.grid.voxel_volume_mm3
    assert n_mm3 == pytest.approx(len(true) * case.truth.grid.voxel_volume_mm3, rel=1e-3)
    for head in (placed, None):
        made = prior_volumes(prior, slices_at_true_poses(case, 3), head)
        assert set(made.by_name) == set(alone.VOLUMES)
        assert set(made.seconds) >= set(alone.VOLUMES)
        assert {one.shape for one in made.by_name.values()} == {made.grid.shape}
        dense = made.maps.density > 2
        assert dense.any()
        # an untrained network gives the base of Eq. 7
        np.testing.assert_allclose(made.by_name["V_prior"][dense], made.by_name["V_coarse"][dense], atol=2e-3)
        assert made.maps.outline is not None
        inside = score_dice(made.maps.outline > 0.5, resample_mask(case, made.grid))
        assert inside > 0.9
        assert tiling_difference(prior, made, 16) < 1e-6


def score_dice(one: np.ndarray, other: np.ndarray) -> float:
    return float(2 * (one & other).sum() / (one.sum() + other.sum()))


def resample_mask(case: SimulatedCase, grid: VolumeGrid) -> np.ndarray:
    return on_grid(case.truth_mask.astype(np.float32), case.truth.grid, grid, outside=0.0) > 0.5
