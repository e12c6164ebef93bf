"""Figure of PSNR against CPU seconds of the presets, a curve for every subject."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from studies.tables import new_figure, save_figure


def draw_presets(rows: Mapping[str, Mapping[str, Any]], presets: Sequence[str], path: Path) -> None:
    """Draw the curve of each subject with three stacks.

    Args:
        rows: of the record.
        presets: in order.
        path: of the PNG.
    """
    figure = new_figure((7.0, 4.2))
    axes = figure.add_subplot()
    three = [row for row in rows.values() if row["n_stacks"] == 3 and row["preset"] in presets]
    for name in dict.fromkeys(row["subject"] for row in three):
        own = sorted((row for row in three if row["subject"] == name), key=lambda row: presets.index(row["preset"]))
        label = f"{name.split('-', 2)[-1]}, {own[0]['pixel_mm']:g} x {own[0]['thickness_mm']:g} mm"
        db = [row["scores"]["volume"]["psnr_db"] for row in own]
        axes.plot([row["cpu_seconds"] for row in own], db, marker="o", markersize=4, label=label)
    axes.set_xscale("log")
    axes.set_xlabel("CPU seconds of the reconstruction")
    axes.set_ylabel("PSNR, dB")
    shown = [name for name in presets if any(row["preset"] == name for row in three)]
    axes.set_title(f"three stacks: {', '.join(shown)}", fontsize=9)
    axes.legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.grid(alpha=0.3)
    save_figure(figure, path)
