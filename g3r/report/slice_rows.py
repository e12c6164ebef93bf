"""slices.tsv read back: a record per slice, and its motion relative to the mean pose of the head."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g3r.acquisition.interleave import pass_and_place
from g3r.errors import InputError
from g3r.geometry import RigidPose
from g3r.output.files import SLICE_COLUMNS
from g3r.output.record import RunRecord


@dataclass(frozen=True, kw_only=True)
class SliceRows:
    """The K rows of slices.tsv.

    Attributes:
        stack, number: [K] number of the stack, and of the slice in it.
        motion: [K] motion of points from their place by the file's header to the estimated one.
        weight, ncc: [K] weight in the volume and correlation with it.
        reason: K reasons for weights below one; "-" for none.
    """

    stack: NDArray[np.int64]
    number: NDArray[np.int64]
    motion: RigidPose
    weight: NDArray[np.float64]
    ncc: NDArray[np.float64]
    reason: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.stack)

    @classmethod
    def read(cls, path: Path, n_stacks: int) -> SliceRows:
        """Read the table that g3r-infer wrote.

        Raises:
            InputError: it is missing, is not such a table, or names a stack that run.json does not have.
        """
        try:
            head, *lines = path.read_text(encoding="utf-8").splitlines()
            rows = [dict(zip(head.split("\t"), line.split("\t"), strict=True)) for line in lines]
            figure = {
                name: np.array([float(row[name]) for row in rows], dtype=np.float64)
                for name in SLICE_COLUMNS
                if name != "reason"
            }
            reasons = tuple(row["reason"] for row in rows)
            motion = RigidPose.from_rotvec(
                np.column_stack([figure[name] for name in ("rx", "ry", "rz")]),
                np.column_stack([figure[name] for name in ("tx", "ty", "tz")]),
            )
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read ({error.strerror}); pass the output folder of g3r-infer"
            ) from None
        except (ValueError, KeyError) as error:
            raise InputError(
                f"{path}: is not a table that g3r-infer wrote ({error}); pass its output folder as it wrote it"
            ) from None
        stack = figure["stack"].astype(np.int64)
        if stack.size and not 0 <= stack.min() <= stack.max() < n_stacks:
            raise InputError(
                f"{path}: names stack {stack.max()}, run.json has {n_stacks} stacks; pass a folder whose files belong "
                "together"
            )
        return cls(
            stack=stack,
            number=figure["slice"].astype(np.int64),
            motion=motion,
            weight=figure["weight"],
            ncc=figure["ncc"],
            reason=reasons,
        )

    def acquisition_key(self, record: RunRecord) -> NDArray[np.int64]:
        """Order [K] of the slices in time, stack after stack, by the interleave found in registration."""
        interleave = np.array([stack.interleave or 1 for stack in record.stacks])[self.stack]
        its_pass, place = pass_and_place(self.number, interleave)
        return np.lexsort((place, its_pass, self.stack))

    def head_motion(self, record: RunRecord, center_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Motion of the head in each slice relative to its mean pose, along the axes of the scanner (RAS).

        Args:
            record: has the mean motion of all slices, if there is one.
            center_mm: [3] centre of the head, in the volume's space.

        Returns:
            Shift of the head's centre [K, 3] (mm) and rotation vector [K, 3] (degrees).
        """
        mean = RigidPose.identity(1)
        if record.registration and record.registration.standard_from_scanner is not None:
            mean = RigidPose.from_matrix([record.registration.standard_from_scanner])
        # the motion of the head is the inverse of the motion of the slice
        head = self.motion.inverse() @ mean
        center = mean.inverse().apply(center_mm[None])[0]
        in_scanner = self.motion.inverse().apply(np.tile(center_mm, (len(self), 1)))
        turned = RigidPose(head.rotation, np.zeros((len(self), 3)))
        return in_scanner - center, np.rad2deg(turned.rotvec_rad())
