"""Training checkpoints that are written whole or not at all."""

import os
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from g3r.errors import InputError, cannot_be_written
from g3r.run.atomic_file import atomic_path, remove_leftovers


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint to a temporary file and renames it, so that a kill leaves the earlier one.

    Lightning's own temporary file may be on another disk, from which it is copied.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint, whole or not at all.

        Args:
            checkpoint: Lightning's state of the training.
            path: path of the file; folders are created.
            storage_options: not used.

        Raises:
            InputError: the file cannot be written.
        """
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                torch.save(checkpoint, temporary)
        except OSError as error:
            raise cannot_be_written(path, error) from None
        except RuntimeError as error:  # raised by torch on a full disk
            if "write" not in str(error):
                raise
            raise InputError(f"{path}: cannot be written ({error}); free some space") from None

    def load_checkpoint(self, path: str | Path, *arguments: Any, **options: Any) -> dict[str, Any]:
        """Read a checkpoint to resume from; remove temporary files of killed runs."""
        remove_leftovers(Path(path).parent, Path(path).suffix)
        return super().load_checkpoint(path, *arguments, **options)
