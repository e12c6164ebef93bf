"""Final messages of `g3r-infer` after a signal: what was written, in one line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from g3r.output.result import ReconstructionResult


def nothing_written(folder: Path) -> str:
    """Message of a run that ended before its result was in place.

    Args:
        folder: folder of the result.
    """
    return f"interrupted; nothing was written{_way_on(folder)}"


def ended_in_order(result: ReconstructionResult, folder: Path) -> str:
    """Message of a run that obeyed a first signal and wrote its result so far.

    Args:
        result: the written result.
        folder: folder of the result.
    """
    if result.record.partial:
        return f"{result.record.stopped_at}: {folder} holds the volume so far, marked as partial{_way_on(folder)}"
    return f"interrupted at the end: the result in {folder} is complete"


def ended_behind(folder: Path, dicom_out: str | None) -> str:
    """Message of a run that was ended at once after its result was in place.

    Args:
        folder: folder of the result.
        dicom_out: folder of the DICOM series; None if none was asked for.
    """
    from g3r.output.result import is_partial

    if is_partial(folder):
        return f"interrupted; {folder} holds the volume so far, marked as partial{_way_on(folder)}"
    lacking = dicom_out is not None and not any(Path(dicom_out).glob("*.dcm"))
    return f"interrupted; the result in {folder} is complete{'; --dicom-out was not written' if lacking else ''}"


def _way_on(folder: Path) -> str:
    from g3r.run.output_folder import OutputFolder

    kept = OutputFolder(folder).stages.is_dir()
    return "; --resume goes on from the last finished stage" if kept else ""
