"""Stated uncertainty against error: calibration in bins, coverage, ranking; as record and as table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g3r.bench.record import markdown_table

if TYPE_CHECKING:
    from g3r.uncertainty.error_model import ErrorModel
    from studies.uncertainty.data import Judged

N_BINS = 10
COVERAGE_FACTORS = (1.0, 2.0, 3.0)
EXPONENTIAL_COVERAGE = tuple(1 - np.exp(-np.array(COVERAGE_FACTORS)))
"""What errors of exponential size would show."""

LEFT_OUT_SHARES = np.linspace(0, 0.95, 20)
"""Shares of the most uncertain voxels left out, for the sparsification curve."""


def check_record(found: Sequence[Judged], model: ErrorModel) -> dict[str, Any]:
    """Figures of every subject, and of all with the same number of stacks together."""
    stated = [model.expected(one.predictors) for one in found]
    subjects = {
        one.label: {
            "n_stacks": one.n_stacks,
            "psnr_db": one.psnr_db,
            "poses_mm": one.median_mm,
            "trusted": one.reliable,
            "registered": one.registered,
            "seconds": one.seconds,
            "map_seconds": one.map_seconds,
            **judge(u, np.abs(one.error)),
        }
        for one, u in zip(found, stated, strict=True)
    }
    together = {}
    for n in sorted({one.n_stacks for one in found}):
        of_n = [k for k, one in enumerate(found) if one.n_stacks == n and one.registered]
        size = np.concatenate([np.abs(found[k].error) for k in of_n])
        together[str(n)] = judge(np.concatenate([stated[k] for k in of_n]), size)
    return {
        "intercept": model.intercept,
        "coefficients": model.coefficients,
        "subjects": subjects,
        "by_stacks": together,
    }


def judge(stated: NDArray[np.float64], size: NDArray[np.float64]) -> dict[str, Any]:
    """How well a stated uncertainty describes the size of errors, both [n] and positive.

    Returns:
        `mean_stated`, `mean_error`; `coverage`: share of voxels whose error is under 1, 2 and 3 times the
        stated; `spearman`: rank correlation; `gain_over_constant`: share of the way from a constant to the
        true order by which the mean error of the voxels kept falls as the most uncertain are left out (area
        under the sparsification curve; 0 for a constant, 1 for the errors themselves); `bins`: ten equally
        large groups by the stated value, each its mean `stated`, `mean_error` and `rms_error`;
        `sparsification`: the curves.
    """
    from scipy.stats import spearmanr

    curve, ideal = sparsification(stated, size), sparsification(size, size)
    flat = np.full_like(curve, size.mean())
    area, most = float((flat - curve).mean()), float((flat - ideal).mean())
    order = np.argsort(stated, kind="stable")
    bins = [
        {
            "stated": float(stated[group].mean()),
            "mean_error": float(size[group].mean()),
            "rms_error": float(np.sqrt((size[group] ** 2).mean())),
        }
        for group in np.array_split(order, N_BINS)
    ]
    constant = bool(np.ptp(stated) == 0)
    return {
        "mean_stated": float(stated.mean()),
        "mean_error": float(size.mean()),
        "coverage": [float((size < factor * stated).mean()) for factor in COVERAGE_FACTORS],
        "spearman": 0.0 if constant else float(spearmanr(stated, size).statistic),
        "gain_over_constant": area / most if most > 0 else 0.0,
        "bins": bins,
        "sparsification": {"stated": curve.tolist(), "ideal": ideal.tolist()},
    }


def sparsification(by: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean error of the voxels that are kept as those with the largest `by` are left out [20]."""
    total = np.cumsum(size[np.argsort(by, kind="stable")])
    n_kept = np.maximum(np.round((1 - LEFT_OUT_SHARES) * len(size)).astype(int), 1)
    return np.asarray(total[n_kept - 1] / n_kept, dtype=np.float64)


def check_text(record: Mapping[str, Mapping[str, Any]]) -> str:
    """The tables in Markdown: with and without prior, by number of stacks, then every subject."""
    head = ["calibration", "stacks", "subjects", "mean error %", "stated %", "error / stated", "spread of it"]
    head += [f"within {factor:g} u" for factor in COVERAGE_FACTORS]
    head += ["worst bin", "rank correlation", "gain over constant"]
    rows, each = [], []
    for name, one in record.items():
        for n, figures in one["by_stacks"].items():
            of_n = [s for s in one["subjects"].values() if s["n_stacks"] == int(n) and s["registered"]]
            ratios = [s["mean_error"] / s["mean_stated"] for s in of_n]
            rows.append(
                [
                    name,
                    n,
                    len(of_n),
                    *_sizes(figures),
                    f"{min(ratios):.2f}-{max(ratios):.2f}",
                    *(f"{share:.0%}" for share in figures["coverage"]),
                    f"{_worst_bin(figures):.2f}",
                    *_ranks(figures),
                ]
            )
        for label, s in one["subjects"].items():
            reliable = {True: "yes", False: "no", None: "unknown"}[s["trusted"]]
            poses = f"{s['poses_mm']:.2f}"
            each.append([name, label, f"{s['psnr_db']:.1f}", poses, reliable, *_sizes(s), *_ranks(s)])
    rows.append(
        ["errors of exponential size", *["-"] * 4, "1.00", "-"]
        + [f"{share:.0%}" for share in EXPONENTIAL_COVERAGE]
        + ["1.00", "-", "-"]
    )
    each_head = ["calibration", "subject", "PSNR dB", "poses mm", "trusted", "mean error %", "stated %"]
    each_head += ["error / stated", "rank correlation", "gain over constant"]
    terms = "; ".join(
        f"{name}: ln u = {one['intercept']:.2f} "
        + " ".join(f"+ {b:.2f} {term}" for term, b in one["coefficients"].items() if b > 0)
        for name, one in record.items()
    )
    settings = ", ".join(
        f"{name}: preset `{one['preset']}`" + (f", weights {one['weights']}" if one["weights"] else "")
        for name, one in record.items()
    )
    lines = [
        f"{settings}. Errors are absolute, in % of the brightest tissue; each number of stacks is judged on "
        "all its subjects together, *spread* is the smallest and largest ratio of single subjects, *worst "
        "bin* the ratio furthest from 1 among ten equally large groups of voxels, u the stated uncertainty.",
        "",
        markdown_table(head, rows),
        "",
        "<details><summary>Every subject, and the coefficients</summary>",
        "",
        markdown_table(each_head, each),
        "",
        f"{terms}.",
        "",
        "</details>",
    ]
    return "\n".join(lines)


def _sizes(figures: Mapping[str, Any]) -> list[str]:
    error, stated = figures["mean_error"], figures["mean_stated"]
    return [f"{100 * error:.2f}", f"{100 * stated:.2f}", f"{error / stated:.2f}"]


def _ranks(figures: Mapping[str, Any]) -> list[str]:
    return [f"{figures['spearman']:.2f}", f"{figures['gain_over_constant']:.0%}"]


def _worst_bin(figures: Mapping[str, Any]) -> float:
    ratios = [one["mean_error"] / one["stated"] for one in figures["bins"]]
    return float(max(ratios, key=lambda ratio: abs(np.log(ratio))))
