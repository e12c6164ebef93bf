"""`python -m studies.prior.alone`: the prior volume alone, at the true poses of known cases."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from g3r.bench.record import markdown_table, put_between_markers, write_json, write_text
from studies.command import parser_of, run_command

if TYPE_CHECKING:
    from g3r.prior.dgpn import DensityGatedPriorNetwork

WANTED_GAIN_DB = {1: 3.0, 3: 2.0}
"""How much better than V_coarse the prior should be, by number of stacks."""

WANTED_SSIM = {1: 0.80, 3: 0.85}

SPEED_VOLUME, SPEED_SEED = "crl-sta/sta36", 52_990
"""The head on which seconds are measured: 36 weeks, three stacks."""

WANTED_SECONDS = 5.0
WANTED_TILING_DIFFERENCE = 1e-3
TILE_VOXELS = 72
"""Edge of the tiles of that check: small enough that a head is cut in all directions."""

REPEATS = 3

DEFAULT_FOLDER = Path("runs") / "bench" / "prior-alone"

VOLUMES = ("V_coarse", "V_sharp", "V_prior")


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = parser_of(
        "prior_alone",
        "The prior volume against V_coarse at the true poses of the cases in the folder that "
        "G3R_TEST_DATA names, from the first stack and from all; and the seconds it takes.",
        DEFAULT_FOLDER,
    )
    parser.add_argument("--cases", nargs="+", metavar="GLOB", default=["*"], help="which of them")
    parser.add_argument("--no-speed", action="store_true", help="skip seconds and tiles")
    parser.add_argument("--cache", type=Path, default=DEFAULT_FOLDER / "subjects", help="simulated subjects")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("prior_alone", _run, build_parser().parse_args(argv))


def _run(options: argparse.Namespace) -> int:
    from g3r.bench.record import available_cores, machine, use_threads
    from g3r.checkpoints.weights_file import SHIPPED_PRIOR
    from g3r.evaluation.case import load_case
    from g3r.prior.model import Prior
    from studies.motion.layers import THICKNESS_MM, case_folders
    from studies.prior.volumes import file_digest
    from studies.runs import preset_settings
    from studies.subjects import test_data_folder

    root = test_data_folder()
    checkpoint = Path(options.ckpt or SHIPPED_PRIOR)
    prior = Prior.load(checkpoint)
    n_views = preset_settings(options.preset).prior_views
    threads = options.threads or available_cores()
    use_threads(threads)
    rows: list[dict[str, Any]] = []
    record = {
        "weights": file_digest(checkpoint),
        "threads": threads,
        "machine": machine(),
        "n_views": n_views,
        "rows": rows,
        "speed": None,
    }
    for folder in case_folders(root / "cases", options.cases):
        case = load_case(folder, THICKNESS_MM.get(folder.name))
        for n_stacks in sorted({1, len(case.stacks)}):
            rows.append(measure(case, n_stacks, prior.network, prior.voxel_mm, n_views))
            print(_line(rows[-1]), flush=True)
    if not options.no_speed:
        record["speed"] = measure_speed(prior.network, prior.voxel_mm, n_views, root / "atlas", options.cache)
    write_json(options.output / "alone.json", record)
    text = alone_tables(record)
    write_text(options.output / "alone.md", text)
    print(text)
    if options.docs:
        put_between_markers(options.docs, "alone", text)
    return 0


def measure(
    case: Any, n_stacks: int, network: DensityGatedPriorNetwork, voxel_mm: float, n_views: int
) -> dict[str, Any]:
    """Scores of each volume of the first `n_stacks` stacks; poses are true, so nothing is aligned."""
    from g3r.acquisition.images import Volume
    from g3r.evaluation.compare import compare
    from studies.prior.volumes import figures, prior_volumes, slices_at_true_poses

    made = prior_volumes(network, slices_at_true_poses(case, n_stacks), voxel_mm, n_views)
    scores = {
        name: figures(compare(Volume(data, made.grid.affine, name), case.truth, case.truth_mask).scores)
        for name, data in made.by_name.items()
    }
    return {"case": case.name, "n_stacks": n_stacks, "scores": scores, "seconds": made.seconds["V_prior"]}


def measure_speed(
    network: DensityGatedPriorNetwork, voxel_mm: float, n_views: int, atlas: Path, cache: Path
) -> dict[str, Any]:
    """Wall seconds on a 36-week brain (the least of a few runs), and what tiles change."""
    from g3r.evaluation.case import load_case
    from studies.prior.volumes import prior_volumes, slices_at_true_poses, tiling_difference
    from studies.subjects import SubjectSpec, simulated_subject

    spec = SubjectSpec("speed-sta36", SPEED_VOLUME, "mild", SPEED_SEED, stretch=0.0)
    case = load_case(simulated_subject(spec, atlas, cache))
    slices = slices_at_true_poses(case, len(case.stacks))
    runs = [prior_volumes(network, slices, voxel_mm) for _ in range(REPEATS)]
    return {
        "shape": list(runs[0].grid.shape),
        "voxel_mm": voxel_mm,
        "seconds": {name: min(run.seconds[name] for run in runs) for name in VOLUMES},
        "all_views_seconds": prior_volumes(network, slices, voxel_mm, n_views).seconds["V_prior"],
        "tile_voxels": TILE_VOXELS,
        "tiling_difference": tiling_difference(network, runs[-1], TILE_VOXELS),
    }


def gain_db(row: Mapping[str, Any]) -> float:
    """By how much the prior is better than V_coarse."""
    return float(row["scores"]["V_prior"]["psnr_db"] - row["scores"]["V_coarse"]["psnr_db"])


def _line(row: Mapping[str, Any]) -> str:
    scores = ", ".join(f"{name} {row['scores'][name]['psnr_db']:.2f} dB" for name in VOLUMES)
    return f"{row['case']}, {row['n_stacks']} stacks: {scores}, {row['seconds']:.1f} s"


def alone_tables(record: Mapping[str, Any]) -> str:
    """The table in Markdown, with what was asked and whether it is reached, and a line about seconds."""
    body = []
    for row in record["rows"]:
        n_stacks, ssim = row["n_stacks"], row["scores"]["V_prior"]["ssim"]
        wanted_db, wanted_ssim = WANTED_GAIN_DB.get(n_stacks), WANTED_SSIM.get(n_stacks)
        cells = [f"{row['scores'][n]['psnr_db']:.2f} / {row['scores'][n]['ssim']:.3f}" for n in VOLUMES]
        body.append(
            [
                row["case"],
                n_stacks,
                *cells,
                f"{gain_db(row):+.2f}{_verdict(gain_db(row), wanted_db)}",
                f"{ssim:.3f}{_verdict(ssim, wanted_ssim)}",
                f"{row['seconds']:.1f}",
            ]
        )
    head = ["case", "stacks", *VOLUMES, "prior - coarse, dB", "SSIM of the prior", "seconds"]
    wanted = " and ".join(
        f"{gain:g} dB and SSIM {WANTED_SSIM[n]:g} from {_stacks(n)}" for n, gain in WANTED_GAIN_DB.items()
    )
    lines = [
        f"PSNR in dB / SSIM at true poses; weights {record['weights']}, mean over {record['n_views']} views "
        f"as in the product, {record['threads']} threads, wall seconds of the network. Asked: at least "
        f"{wanted}; what falls short is marked (!).",
        "",
        markdown_table(head, body),
        "",
        _mean_line(record["rows"]),
    ]
    if record["speed"]:
        lines += ["", _speed_line(record["speed"], record["threads"], record["n_views"])]
    return "\n".join(lines)


def _speed_line(speed: Mapping[str, Any], threads: int, n_views: int) -> str:
    seconds, size = speed["seconds"], " x ".join(map(str, speed["shape"]))
    difference = speed["tiling_difference"]
    all_views = speed["all_views_seconds"]
    return (
        f"A 36-week brain, {size} voxels of {speed['voxel_mm']:g} mm, three stacks, {threads} threads, the "
        f"least of {REPEATS} runs: V_coarse {seconds['V_coarse']:.1f} s, V_sharp {seconds['V_sharp']:.1f} s, "
        f"the network {seconds['V_prior']:.1f} s (asked: under {WANTED_SECONDS:g}"
        f"{_over(seconds['V_prior'], WANTED_SECONDS)}), and the mean over the {n_views} views of the product "
        f"{all_views:.1f} s{_over(all_views, WANTED_SECONDS)}. Made in tiles of {speed['tile_voxels']} "
        f"voxels instead of whole, no voxel of the prior changes by more than {difference:.1e} of the "
        f"intensity scale (asked: {WANTED_TILING_DIFFERENCE:g}"
        f"{_over(difference, WANTED_TILING_DIFFERENCE)})."
    )


def _mean_line(rows: Sequence[Mapping[str, Any]]) -> str:
    """Mean gain over the cases, by number of stacks."""
    of_number: dict[int, list[float]] = {}
    for row in rows:
        of_number.setdefault(row["n_stacks"], []).append(gain_db(row))
    listed = [
        f"{_stacks(n)} {mean(gains):+.2f} dB ({min(gains):+.2f} to {max(gains):+.2f}, {len(gains)} cases)"
        for n, gains in sorted(of_number.items())
    ]
    return f"Prior less V_coarse, mean over the cases: {'; '.join(listed)}."


def _verdict(value: float, wanted: float | None) -> str:
    return " (!)" if wanted is not None and not value >= wanted else ""


def _over(value: float, most: float) -> str:
    return "" if value <= most else " (!)"


def _stacks(n: int) -> str:
    return "one stack" if n == 1 else f"{n} stacks"


if __name__ == "__main__":
    sys.exit(main())
