"""Datasets whose items are made on the fly from heads, and the order in which a training asks for them.

An item is a function of the seed, the epoch and the index alone, whatever process or order makes it.
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
    """Items from heads; number n is (epoch, index) = divmod(n, length).

    Args:
        subjects: atlas subjects or phantoms; loaded on first use and kept in memory.
        length: items per epoch.
        seed: of the whole dataset.
        in_order: for validation: subjects in turn instead of drawn, and items are kept once made.
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
    """Numbers epoch * length + index, one epoch further each time it is iterated.

    Args:
        length: items per epoch, over all processes.
        epoch: to begin with.
        now: gives the epoch when it is iterated; None counts.
        rank: of this process.
        n_ranks: processes that train together. Each has numbers of its own, and as many as the others.
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
        # a generator: loaders ask for an iterator more than once before they begin
        if self.now is not None:
            self.epoch = self.now()
        first = self.epoch * self.length
        self.epoch += 1
        for k in range(len(self)):
            yield first + (self.rank + k * self.n_ranks) % self.length


def epoch_of(trainer: Any, n_batches: int) -> Callable[[], int] | None:
    """A function that gives the epoch of a trainer; None without a trainer.

    Loaders are made before a checkpoint is read that holds the epoch, so the epoch is looked up later.

    Args:
        trainer: of Lightning, or None.
        n_batches: per epoch.
    """
    if trainer is None:
        return None
    # an epoch that ended with the checkpoint is counted by its steps first
    return lambda: max(trainer.current_epoch, trainer.global_step // n_batches)
