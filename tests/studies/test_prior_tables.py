"""The prior's benchmarks: their tables, figures, subjects and alignment; none trains or reconstructs here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.ndimage import gaussian_filter

from g3r.acquisition.images import Volume
from g3r.evaluation.case import SimulatedCase
from g3r.evaluation.pose_error import PoseTable
from g3r.geometry import RigidPose, VolumeGrid
from g3r.planning.presets import PRESETS, changed
from studies.motion import sweep as motion_sweep
from studies.prior import ablation as prior_ablation
from studies.prior import alone as prior_alone
from studies.prior import cases as prior_cases
from studies.prior import network_scores as prior_network_scores
from studies.prior import networks as prior_networks
from studies.prior.figures import draw_ablation, draw_networks
from studies.prior.volumes import aligned_scores, slices_at_true_poses


def ablation_rows(gain=(2.0, 1.0, 0.5)):
    """Two subjects, from 1 and 3 stacks."""
    rows = {}
    for number, (name, volume) in enumerate({"a": "crl-sta/sta24", "b": "spina-bifida/sb25-operated"}.items()):
        rows[name] = {}
        for n in (1, 3):
            psnr = dict.fromkeys(prior_ablation.VARIANTS, 20.0 + n + number)
            psnr["with distillation"] += gain[n - 1] * (1 + number)
            rows[name][str(n)] = {
                "volume": volume,
                "scores": {v: {"psnr_db": db, "ssim": 0.9} for v, db in psnr.items()},
                "median_mm": dict.fromkeys(prior_ablation.FITS, 0.25),
                "seconds": {"registration": 1.0},
            }
    return rows


def test_ablation_table_gives_mean_spread_and_paired_difference():
    record = {"preset": "balanced", "weights": "abc", "subjects": ablation_rows()}
    text = prior_ablation.ablation_tables(record)
    assert "| fit without prior | 21.50 ± 0.71 | 0.900 ± 0.000 |  |" in text
    assert "| with distillation | 24.50 ± 2.12 | 0.900 ± 0.000 | +3.00 ± 1.41 |" in text
    assert "| with distillation, sb | 26.00 | 0.900 | +4.00 |" in text
    assert "2 subjects (1 sta, 1 sb)" in text
    assert "1 stack: +2.00 dB (2 of 2 better); 3 stacks: +0.50 dB" in text
    assert "2 stacks" not in text


def test_ablation_subjects_are_many_fresh_and_of_their_own():
    published, looked_at = prior_ablation.specs(), prior_ablation.specs(development=True)
    assert len(published) >= 8
    assert {one.seed for one in published}.isdisjoint(one.seed for one in looked_at)
    sweeps = [motion_sweep.specs(motion_sweep.LEVELS, 100, development=dev) for dev in (False, True)]
    assert {one.seed for one in published}.isdisjoint(one.seed for sweep in sweeps for one in sweep)
    assert all(any(one.volume.startswith(p) for p in prior_ablation.GROUPS.values()) for one in published)


def test_ablation_variants_are_settings_that_exist():
    for options in prior_ablation.FITS.values():
        changed(PRESETS["balanced"], options)


def test_ablation_keeps_only_what_was_made_alike(tmp_path):
    from g3r.bench.record import write_json

    rows = ablation_rows()
    write_json(tmp_path / "ablation.json", {"preset": "balanced", "weights": "abc", "subjects": rows})
    for weights, kept in (("abc", rows), ("def", {})):
        record = {"preset": "balanced", "weights": weights, "subjects": {}}
        assert prior_ablation._kept(tmp_path / "ablation.json", record) == kept
        assert record["subjects"] == kept


def test_alone_table_marks_what_falls_short():
    def row(n_stacks, gain, ssim):
        psnr = {"V_coarse": 20.0, "V_sharp": 21.0, "V_prior": 20.0 + gain}
        scores = {name: {"psnr_db": db, "ssim": ssim} for name, db in psnr.items()}
        return {"case": "c", "n_stacks": n_stacks, "scores": scores, "seconds": 2.5}

    rows = [row(1, 2.9, 0.81), row(3, 2.1, 0.84), row(2, 0.5, 0.5)]
    speed = {
        "shape": [9, 8, 7],
        "voxel_mm": 0.8,
        "seconds": dict.fromkeys(prior_alone.VOLUMES, 5.5),
        "tile_voxels": 72,
        "tiling_difference": 2e-4,
        "all_views_seconds": 4.9,
    }
    text = prior_alone.alone_tables({"weights": "abc", "threads": 2, "n_views": 4, "rows": rows, "speed": speed})
    assert "| +2.90 (!) | 0.810 | 2.5 |" in text
    assert "| +2.10 | 0.840 (!) | 2.5 |" in text
    assert "| +0.50 | 0.500 | 2.5 |" in text  # nothing was asked of two stacks
    assert "the network 5.5 s (asked: under 5 (!)), and the mean over the 4 views of the product 4.9 s." in text
    assert "2.0e-04 of the intensity scale (asked: 0.001)" in text


def network_record():
    scores = {n: {"l1": 0.05, "psnr_db": 25.0 + k, "ssim": 0.9} for k, n in enumerate(("1", "2", "all"))}
    one = {"scores": scores, "parameters": 1_500_000, "seconds": 2.5, "steps": 288, "train_seconds": 600}
    return {
        "threads": 2,
        "baselines": {"V_coarse": scores, "V_sharp": scores},
        "variants": {
            "size-16-32-64": {**one, "what": "small", "is_size": True},
            "full": {**one, "what": "all", "is_size": True},
        },
    }


def test_network_table():
    text = prior_networks.network_tables(network_record())
    assert "| V_coarse |  | 0.0500 | 25.00 | 26.00 | 27.00 | 0.900 |  |  |  |  |" in text
    assert "| full | all | 0.0500 | 25.00 | 26.00 | 27.00 | 0.900 | 1.50 M | 2.5 | 288 | 10 |" in text
    assert text.index("| full |") < text.index("| size-16-32-64 |")


def test_networks_differ_from_the_configuration():
    config = yaml.safe_load(prior_networks.CONFIG.read_text(encoding="utf-8"))
    found = prior_networks.names(prior_networks.distinct_variants(config))
    own_size = "size-" + "-".join(map(str, config["model"]["channels"]))
    assert "full" in found
    assert own_size not in found
    assert {"no-gate", "no-density", "no-density-no-gate", "no-sharp"} < set(found)
    per_epoch = prior_networks.epochs_of(10**6, config) / 10**6
    assert prior_networks.epochs_of(1, config) == 1
    assert prior_networks.epochs_of(300, config) == max(1, round(300 * per_epoch))
    own = ["--data.subjects_per_epoch=6", "--data.patches_per_subject=4", "--data.batch_size=2", "--data.source=9"]
    assert prior_networks.epochs_of(36, config, own) == 3


def test_network_options_are_those_of_the_module():
    training = pytest.importorskip("g3r.training.prior_module", reason="the training extra is not installed")
    for variant in prior_networks.VARIANTS:
        training.PriorModule(**{"channels": [8, 8, 8], **variant.options})


def test_scores_by_number_of_stacks():
    pytest.importorskip("torchmetrics", reason="the training extra is not installed")
    truth = torch.rand(1, 1, 12, 12, 12)
    volumes = [{"truth": truth, "mask": torch.ones_like(truth), "n_stacks": torch.tensor([n])} for n in (1, 3, 3)]
    made = [truth + error for error in (0.1, 0.01, 0.03)]
    scores = prior_network_scores.scores_by_stacks(made, volumes)
    assert scores["1"]["psnr_db"] == pytest.approx(20, abs=1e-3)
    assert scores["3"]["l1"] == pytest.approx(0.02, abs=1e-6)
    assert scores["all"]["l1"] == pytest.approx(0.14 / 3, abs=1e-6)


def test_unknown_variants_are_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        prior_networks.main(["--only", "best"])
    assert ended.value.code == 2
    assert "--only best" in capsys.readouterr().err


def test_the_newest_checkpoint_is_gone_on_with(tmp_path):
    assert prior_networks.newest_checkpoint(tmp_path) is None
    for version, age in ((0, 50), (1, 10)):
        path = tmp_path / "logs" / f"version_{version}" / "checkpoints" / "last.ckpt"
        path.parent.mkdir(parents=True)
        path.write_text("")
        import os

        os.utime(path, (1e9 - age, 1e9 - age))
    assert prior_networks.newest_checkpoint(tmp_path) == path


def test_figures(tmp_path):
    draw_ablation(ablation_rows(), prior_ablation.VARIANTS, prior_ablation.BASELINE, tmp_path / "new" / "a.png")
    draw_networks(network_record(), tmp_path / "b.png")
    assert all(path.stat().st_size > 10_000 for path in (tmp_path / "new" / "a.png", tmp_path / "b.png"))
    assert len(list(tmp_path.iterdir())) == 2  # nothing is left beside


@pytest.fixture
def head(rng):
    """A case with a random smooth head, without stacks."""
    shape = (40, 44, 36)
    truth = gaussian_filter(rng.normal(size=shape), 2.5)
    truth = (1 + truth / truth.std()).astype(np.float32)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
    mask = np.linalg.norm((index - (np.array(shape) - 1) / 2) / (15, 17, 13), axis=-1) < 1
    grid = VolumeGrid.isotropic([0, 0, 0], 1.5 * (np.array(shape) - 1), 1.5)
    case = SimulatedCase(name="head", folder=Path(), stacks=(), true=PoseTable((), RigidPose.identity(0)), points_mm={})
    case.__dict__.update(truth=Volume(truth, grid.affine, "truth"), truth_mask=mask)  # cached properties
    return case


def test_alignment_takes_back_a_small_motion(head):
    """A volume of other intensities, put away by a millimetre, is brought back to a hundredth of a voxel."""
    moved = RigidPose.from_rotvec([[0.02, -0.03, 0.01]], [[1.0, -0.6, 0.4]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = moved.rotation[0], moved.translation_mm[0]
    grid = VolumeGrid(head.truth.data.shape, matrix @ head.truth.affine)
    volume = (3.0 * head.truth.data + 7.0).astype(np.float32)
    assert aligned_scores(volume, grid, head, RigidPose.identity(1)).psnr_db > 45
    assert aligned_scores(volume, grid, head, moved.inverse()).psnr_db > 45


def test_slices_without_a_true_pose_are_left_out(tmp_path, rng):
    from g3r.acquisition.images import save_volume
    from g3r.evaluation.case import load_case

    affine = np.diag([1.0, 1.0, 3.0, 1.0])
    save_volume(tmp_path / "stack-0.nii.gz", rng.random((12, 12, 6)).astype(np.float32), affine)
    save_volume(tmp_path / "mask-0.nii.gz", np.ones((12, 12, 6), bool), affine)
    lines = ["stack slice rx ry rz tx ty tz".replace(" ", "\t")]
    lines += [f"0\t{k}\t0\t0\t0.1\t{k}\t0\t0" for k in range(5)]
    (tmp_path / "poses.tsv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    slices = slices_at_true_poses(load_case(tmp_path, 3.0), 1)
    assert slices.slice_index.tolist() == [0, 1, 2, 3, 4]
    motion = slices.world_from_header()
    np.testing.assert_allclose(motion.translation_mm[:, 0], range(5), atol=1e-9)
    np.testing.assert_allclose(motion.rotvec_rad()[:, 2], 0.1, atol=1e-9)


def test_cases_table_marks_a_prior_that_costs():
    def row(gain):
        scores = {v: {"psnr_db": 25.0, "ssim": 0.9} for v in prior_ablation.VARIANTS}
        scores[prior_ablation.VARIANTS[-1]] = {"psnr_db": 25.0 + gain, "ssim": 0.9}
        return {"n_stacks": 3, "scores": scores, "median_mm": {prior_ablation.VARIANTS[-1]: 0.07}}

    record = {"preset": "balanced", "weights": "abc", "cases": {"good": row(0.4), "bad": row(-0.3)}}
    lines = prior_cases.cases_table(record).splitlines()
    good, bad = (next(line for line in lines if line.startswith(f"| {name}")) for name in ("good", "bad"))
    assert "+0.40 |" in good
    assert "-0.30 (!)" in bad
    assert "0.07" in good
