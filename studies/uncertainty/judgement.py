"""Comparison of stated uncertainty with error: calibration in bins, coverage, ranking; as record and as table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from studies.tables import Cell, details, table

if TYPE_CHECKING:
    from g3r.uncertainty.error_model import ErrorModel
    from studies.uncertainty.data import Judged

N_BINS = 10
COVERAGE_FACTORS = (1.0, 2.0, 3.0)
EXPONENTIAL_COVERAGE = tuple(1 - np.exp(-np.array(COVERAGE_FACTORS)))
"""Coverage of exponentially distributed errors."""

MIN_VOXELS = 100
"""Least number of voxels of a part of the brain that is judged."""

REMOVED_SHARES = np.linspace(0, 0.95, 20)
"""Shares of the most uncertain voxels removed, for the sparsification curve."""


def check_record(found: Sequence[Judged], model: ErrorModel) -> dict[str, Any]:
    """Figures of every subject, and of all subjects with the same number of stacks together."""
    stated = [model.expected(one.predictors) for one in found]
    subjects = {
        one.label: {
            "n_stacks": one.subject.n_stacks,
            "psnr_db": one.psnr_db,
            "poses_mm": one.median_mm,
            "reliable": one.reliable,
            "registered": one.registered,
            "seconds": one.seconds,
            "map_seconds": one.map_seconds,
            **judge(u, np.abs(one.error)),
            "unseen": sizes(u, np.abs(one.error), one.unseen),
        }
        for one, u in zip(found, stated, strict=True)
    }
    together = {}
    for n in sorted({one.subject.n_stacks for one in found}):
        of_n = [k for k, one in enumerate(found) if one.subject.n_stacks == n and one.registered]
        size = np.concatenate([np.abs(found[k].error) for k in of_n])
        u, unseen = np.concatenate([stated[k] for k in of_n]), np.concatenate([found[k].unseen for k in of_n])
        together[str(n)] = {**judge(u, size), "unseen": sizes(u, size, unseen)}
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
        stated one; `spearman`: rank correlation; `gain_over_constant`: area between the sparsification curve (mean
        error of the voxels kept as the most uncertain are removed) and that of a constant, relative to the same
        area for the true order (0 for a constant, 1 for the errors themselves); `bins`: ten equally large groups
        by the stated value, with their mean `stated`, `mean_error` and `rms_error`; `sparsification`: the curves.
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


def sizes(stated: NDArray[np.float64], size: NDArray[np.float64], chosen: NDArray[np.bool_]) -> dict[str, float] | None:
    """Mean stated and actual size of the errors of chosen voxels; None for fewer than `MIN_VOXELS`."""
    if chosen.sum() < MIN_VOXELS:
        return None
    return {"mean_stated": float(stated[chosen].mean()), "mean_error": float(size[chosen].mean())}


def sparsification(by: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sparsification curve [20]: mean error of the remaining voxels as those with the largest `by` are removed."""
    total = np.cumsum(size[np.argsort(by, kind="stable")])
    n_kept = np.maximum(np.round((1 - REMOVED_SHARES) * len(size)).astype(int), 1)
    return np.asarray(total[n_kept - 1] / n_kept, dtype=np.float64)


def check_text(record: Mapping[str, Mapping[str, Any]]) -> str:
    """The tables in Markdown: with and without prior, by number of stacks, then every subject.

    Args:
        record: results of `check_record`, with `preset` and `weights`, by calibration.
    """
    rows: list[dict[str, Any]] = []
    each: list[dict[str, Any]] = []
    for name, one in record.items():
        for n, figures in one["by_stacks"].items():
            of_n = [s for s in one["subjects"].values() if s["n_stacks"] == int(n) and s["registered"]]
            ratios = [s["mean_error"] / s["mean_stated"] for s in of_n]
            rows.append({"calibration": name, "n_stacks": n, "ratios": ratios, **figures})
        each += [{"calibration": name, "subject": label, **s} for label, s in one["subjects"].items()]
    exponential = ["errors of exponential size", *["-"] * 4, "1.00", "-", "-"]
    exponential += [*(f"{share:.0%}" for share in EXPONENTIAL_COVERAGE), "1.00", "-", "-"]
    terms = "; ".join(
        f"{name}: ln u = {one['intercept']:.2f} "
        + " ".join(f"+ {b:.2f} {term}" for term, b in one["coefficients"].items() if b > 0)
        for name, one in record.items()
    )
    settings = ", ".join(
        f"{name}: preset `{one['preset']}`" + (f", weights {one['weights']}" if one["weights"] else "")
        for name, one in record.items()
    )
    parts = [
        f"{settings}. Errors are absolute, in % of the brightest tissue; each number of stacks is judged on "
        "all its subjects together, *spread* is the smallest and largest ratio of single subjects, *worst "
        "bin* the ratio furthest from 1 among ten equally large groups of voxels, u the stated uncertainty.",
        f"{table(rows, SUMMARY)}\n| {' | '.join(exponential)} |",
        details("Every subject, and the coefficients", table(each, EACH), f"{terms}."),
    ]
    return "\n\n".join(parts)


def _ratio(figures: Mapping[str, Any]) -> str:
    return f"{figures['mean_error'] / figures['mean_stated']:.2f}"


def _unseen_ratio(figures: Mapping[str, Any]) -> str:
    return _ratio(figures["unseen"]) if figures["unseen"] else "-"


def _coverage(n: int) -> Callable[[Mapping[str, Any]], str]:
    return lambda figures: f"{figures['coverage'][n]:.0%}"


def _worst_bin(figures: Mapping[str, Any]) -> str:
    ratios = [one["mean_error"] / one["stated"] for one in figures["bins"]]
    return f"{max(ratios, key=lambda ratio: abs(np.log(ratio))):.2f}"


SIZES: dict[str, Cell] = {
    "mean error %": lambda figures: f"{100 * figures['mean_error']:.2f}",
    "stated %": lambda figures: f"{100 * figures['mean_stated']:.2f}",
    "error / stated": _ratio,
    "unseen: error / stated": _unseen_ratio,
}
RANKS: dict[str, Cell] = {"rank correlation": "{spearman:.2f}", "gain over constant": "{gain_over_constant:.0%}"}
SUMMARY: dict[str, Cell] = {
    "calibration": "{calibration}",
    "stacks": "{n_stacks}",
    "subjects": lambda row: len(row["ratios"]),
    **SIZES,
    "spread of it": lambda row: f"{min(row['ratios']):.2f}-{max(row['ratios']):.2f}",
    **{f"within {factor:g} u": _coverage(n) for n, factor in enumerate(COVERAGE_FACTORS)},
    "worst bin": _worst_bin,
    **RANKS,
}
EACH: dict[str, Cell] = {
    "calibration": "{calibration}",
    "subject": "{subject}",
    "PSNR dB": "{psnr_db:.1f}",
    "poses mm": "{poses_mm:.2f}",
    "reliable": lambda row: {True: "yes", False: "no", None: "unknown"}[row["reliable"]],
    **SIZES,
    **RANKS,
}
