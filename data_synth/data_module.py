"""Base class of the three data modules (prior, pose and mask network): subjects, settings checks, worker processes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numba
import SimpleITK as sitk
import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from data_synth.heads import Subject, training_and_validation
from data_synth.subject_dataset import EpochSampler, SubjectDataset, epoch_of
from g3r.errors import InputError

logger = logging.getLogger(__name__)

VALIDATION_SEED = 1_000_003
"""Offset that is added to the seed for validation."""


class SyntheticDataModule(LightningDataModule):
    """Training data made on the fly from an atlas folder or from the built-in phantom.

    Training items differ from epoch to epoch; validation items do not.

    Args:
        source: `phantom`, or a folder of NIfTI volumes with masks (see `data_synth.atlas`).
        include: glob patterns of subject names for training; None takes all.
        exclude: glob patterns of subject names to use neither for training nor for validation.
        val_include: glob patterns of subject names for validation; they are excluded from training. None validates
            on other simulations of the training subjects, which flatters the network, and logs a warning.
        num_workers: worker processes that make training data.
        seed: determines every item, together with its epoch and index.

    Raises:
        InputError: no such folder, or nothing in it passes the patterns.
    """

    def __init__(
        self,
        source: str = "phantom",
        include: list[str] | None = None,
        exclude: list[str] | None = None,
        val_include: list[str] | None = None,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self._subjects: tuple[list[Subject], list[Subject]] | None = None
        self.train_set: SubjectDataset | None = None
        self.val_set: SubjectDataset | None = None

    def check_at_least_one(self, *names: str) -> None:
        """Refuse settings below 1.

        Raises:
            InputError: the value of one of the named settings is below 1.
        """
        for name in names:
            if self.hparams[name] < 1:
                raise InputError(f"data.{name}: {self.hparams[name]}; expected at least 1")

    def setup(self, stage: str | None = None) -> None:
        """Find the subjects; their volumes are loaded on first use."""
        if self.train_set is None:
            self.train_set, self.val_set = self.make_sets()
            n_train, n_val = len(self.train_set.subjects), len(self.val_set.subjects)
            logger.info("synthesis from %d training and %d validation subjects", n_train, n_val)

    def make_sets(self) -> tuple[SubjectDataset, SubjectDataset]:
        """Make the datasets to train on and to validate on."""
        raise NotImplementedError

    def subjects(self, n_val_phantoms: int) -> tuple[list[Subject], list[Subject]]:
        """Training and validation subjects; `n_val_phantoms` validation subjects if the source is the phantom."""
        if self._subjects is None:
            h: Any = self.hparams
            self._subjects = training_and_validation(
                h.source, h.include, h.exclude, h.val_include, n_val_phantoms=n_val_phantoms, seed=h.seed
            )
        return self._subjects

    def train_loader(self, n_items: int, n_batches: int, *, split_ranks: bool = False, **options: Any) -> DataLoader:
        """A loader of the training set with an `EpochSampler` and persistent worker processes.

        Args:
            n_items: per epoch.
            n_batches: per epoch, over all processes.
            split_ranks: whether to divide the items among the processes of a distributed training. Lightning does this
                itself for loaders that it is given directly.
            options: further options of the loader.
        """
        self.setup()
        assert self.train_set is not None
        trainer, n_workers = self.trainer, int(self.hparams["num_workers"])
        rank, n_ranks = (trainer.global_rank, trainer.world_size) if trainer is not None and split_ranks else (0, 1)
        # Workers are spawned, because the thread pools of numba and torch do not survive a fork. They persist,
        # because they hold the loaded volumes.
        return DataLoader(
            self.train_set,
            sampler=EpochSampler(
                n_items, now=epoch_of(trainer, max(1, n_batches // n_ranks)), rank=rank, n_ranks=n_ranks
            ),
            num_workers=n_workers,
            multiprocessing_context="spawn" if n_workers else None,
            persistent_workers=n_workers > 0,
            worker_init_fn=one_thread,
            **options,
        )

    def val_loader(self, collate: Callable[[Any], Any] | None = None) -> DataLoader:
        """A loader of the validation set, one item per batch; without `collate` an item is already a batch."""
        self.setup()
        assert self.val_set is not None
        return DataLoader(self.val_set, batch_size=1 if collate else None, collate_fn=collate)


def one_thread(worker: int) -> None:
    """Limit a worker process to one core, so that the others are free for the training."""
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
