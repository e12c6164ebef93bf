"""Datasets whose items are made on the fly from heads, and the sampler that sets the order of items in a training.

An item depends only on the seed, the epoch and the index, not on the process or the order in which items are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from torch.utils.data import Dataset, Sampler

from data_synth.atlas import TruthVolume
from data_synth.heads import Subject

Item = TypeVar("Item")


class SubjectDataset(Dataset[Item], Generic[Item]):
    """Dataset of items made from heads; item number n is (epoch, index) = divmod(n, length).

    Args:
        subjects: atlas subjects or phantoms; loaded on first use and kept in memory.
        length: items per epoch.
        seed: of the whole dataset.
        in_order: for validation: subjects are taken in turn instead of at random, and items are kept in memory.
    """

    def __init__(self, subjects: Sequence[Subject], length: int, seed: int, in_order: bool = False) -> None:
        if not subjects:
            raise ValueError("a dataset needs at least one subject")
        self.subjects = list(subjects)
        self.length = length
        self.seed = seed
        self.in_order = in_order
        self._volumes: dict[int, TruthVolume] = {}
        self._kept: dict[int, Item] = {}

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, number: int) -> Item:
        """Item `number`."""
        if number in self._kept:
            return self._kept[number]
        item = self.make(*divmod(int(number), self.length))
        if self.in_order:
            self._kept[number] = item
        return item

    def make(self, epoch: int, index: int) -> Item:
        """Make item (epoch, index)."""
        raise NotImplementedError

    def load(self, subject: Subject) -> TruthVolume:
        """Read or make the head of a subject."""
        raise NotImplementedError

    def volume(self, which: int) -> TruthVolume:
        """The head of subject number `which`, loaded once."""
        if which not in self._volumes:
            self._volumes[which] = self.load(self.subjects[which])
        return self._volumes[which]

    def draw(self, epoch: int, index: int) -> tuple[int, np.random.Generator]:
        """The number of the subject of item (epoch, index), and the generator for all its other draws."""
        rng = np.random.default_rng([self.seed, epoch, index])
        return index % len(self.subjects) if self.in_order else int(rng.integers(len(self.subjects))), rng

    def turn(self, index: int, n: int) -> int:
        """0 to n - 1 in turn, shifted with each pass through the subjects, so that each of these meets all of them."""
        n_passes, which = divmod(index, len(self.subjects))
        return (which + n_passes) % n


class EpochSampler(Sampler[int]):
    """Sampler of the item numbers epoch * length + index; each iteration yields the next epoch.

    Args:
        length: items per epoch, over all processes.
        epoch: first epoch.
        now: returns the epoch at the start of an iteration; None counts iterations instead.
        rank: of this process.
        n_ranks: processes that train together. Each gets different numbers, and all get the same amount.
    """

    def __init__(
        self, length: int, epoch: int = 0, now: Callable[[], int] | None = None, rank: int = 0, n_ranks: int = 1
    ) -> None:
        self.length = length
        self.epoch = epoch
        self.now = now
        self.rank = rank
        self.n_ranks = n_ranks

    def __len__(self) -> int:
        return max(1, self.length // self.n_ranks)

    def __iter__(self) -> Iterator[int]:
        # a generator, so that the epoch advances only when items are taken: loaders may make several iterators first
        if self.now is not None:
            self.epoch = self.now()
        first = self.epoch * self.length
        self.epoch += 1
        for k in range(len(self)):
            yield first + (self.rank + k * self.n_ranks) % self.length


def epoch_of(trainer: Any, n_batches: int) -> Callable[[], int] | None:
    """A function that returns the current epoch of a trainer; None without a trainer.

    Loaders are made before a checkpoint with the epoch is read, so the epoch must be looked up later.

    Args:
        trainer: of Lightning, or None.
        n_batches: per epoch.
    """
    if trainer is None:
        return None
    # after a checkpoint at the end of an epoch, current_epoch still lags behind the steps
    return lambda: max(trainer.current_epoch, trainer.global_step // n_batches)
