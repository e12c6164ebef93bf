"""What `GaussianReconstructor` returns: the result together with its verdict."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
from markupsafe import escape

from g3r.errors import InputError
from g3r.output.result import ReconstructionResult
from g3r.report.pictures import central_sections
from g3r.report.verdict import Verdict, verdict_of
from g3r.run.output_folder import OutputFolder

logger = logging.getLogger(__name__)

BRIGHT_PERCENTILE = 99.5
"""Percentile of the volume in the brain that the pictures show as white."""


@dataclass(frozen=True)
class Report:
    """The verdict on a volume: text in a terminal, with its central sections in a notebook.

    Attributes:
        verdict: the word ("use", "check" or "do not use") and its reasons.
        sections: name and picture (PNG as base64) of the axial, the coronal and the sagittal section.
    """

    verdict: Verdict
    sections: tuple[tuple[str, str], ...]

    def __str__(self) -> str:
        lines = [f"{self.verdict.word}: {self.verdict.headline}"]
        for reason in self.verdict.reasons:
            lines.append(f"- {reason.sentence}{f' {reason.advice}' if reason.advice else ''}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        """HTML for notebooks; file names are escaped."""
        reasons = "".join(
            f"<li>{escape(one.sentence)} <i>{escape(one.advice)}</i></li>" for one in self.verdict.reasons
        )
        pictures = "".join(
            f'<img alt="{name}" title="{name}" style="height:200px;margin-right:8px" src="data:image/png;base64,{png}">'
            for name, png in self.sections
        )
        head = f"<b>{escape(self.verdict.word)}</b>: {escape(self.verdict.headline)}"
        return f"<p>{head}</p><ul>{reasons}</ul><div>{pictures}</div>"


class ReportedResult(ReconstructionResult):
    """A `ReconstructionResult` with a verdict; it has the attributes of that class."""

    @classmethod
    def of(cls, result: ReconstructionResult) -> ReportedResult:
        """The same result as a `ReportedResult`."""
        return cls(**{one.name: getattr(result, one.name) for one in fields(result)})

    def save(
        self,
        folder: str | os.PathLike[str],
        *,
        replace: bool = False,
        run: OutputFolder | None = None,
        also: Callable[[Path], None] | None = None,
    ) -> None:
        """Write every output and report.html into a folder; it appears whole or not at all.

        Args:
            folder: folder to write.
            replace: whether an earlier result in it may be replaced; other files there are kept.
            run: holds this folder already; None takes it for this call alone.
            also: writes more files of `OUTPUT_NAMES`; called with the folder in which all others are.

        Raises:
            InputError: the folder holds files already (without `replace`), or cannot be written.
        """

        def more(staged: Path) -> None:
            self._add_page(staged)
            if also is not None:
                also(staged)

        super(ReportedResult, self._judged()).save(folder, replace=replace, run=run, also=more)

    def _judged(self) -> ReportedResult:
        """The same result with the verdict in its record."""
        verdict = verdict_of(self.record)
        return changed(self, record=changed(self.record, verdict=verdict.word, reasons=verdict.deciding))

    def _add_page(self, folder: Path) -> None:
        """Write the page; a failure is only logged, because the volume is valid without it."""
        from g3r.report.page import write_report

        try:
            write_report(folder, self.slices)
        except InputError as error:
            reason = str(error).replace(str(folder), "")
            logger.warning("report.html could not be written (%s); try g3r-report DIR", reason)

    def report(self, path: str | os.PathLike[str] | None = None, *, replace: bool = False) -> Report:
        """Whether the volume may be used, and why; in a notebook with pictures.

        Args:
            path: file (.html) to write the whole page to, as `g3r-infer` puts it into its output folder.
            replace: whether an earlier file may be replaced.

        Raises:
            InputError: the file exists (without `replace`), or cannot be written.
        """
        if path is not None:
            self._write_page(Path(path), replace=replace)
        return Report(verdict_of(self.record), self._sections())

    def _write_page(self, path: Path, *, replace: bool) -> None:
        if path.exists() and not replace:
            raise InputError(f"{path}: exists already; pass replace=True to replace it, or choose another file")
        from g3r.report.page import write_report

        # the page is made from saved files, as for g3r-infer
        with tempfile.TemporaryDirectory(prefix="g3r-report-") as folder:
            saved = Path(folder) / "result"
            super(ReportedResult, self._judged()).save(saved)
            write_report(saved, self.slices, path)

    def _sections(self) -> tuple[tuple[str, str], ...]:
        """Central sections, as in the page."""
        if not self.mask.any():
            return ()
        high = float(np.percentile(self.volume[self.mask], BRIGHT_PERCENTILE)) or 1.0
        return central_sections(self.volume, np.argwhere(self.mask).mean(0), 0.0, high)
