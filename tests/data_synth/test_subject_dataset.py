"""Item numbers of epochs."""

import pytest

from data_synth.heads import phantom_subjects
from data_synth.subject_dataset import EpochSampler, SubjectDataset


def test_epoch_sampler_goes_on() -> None:
    sampler = EpochSampler(3, epoch=2)
    assert list(sampler) == [6, 7, 8]
    assert list(sampler) == [9, 10, 11]
    assert len(sampler) == 3


def test_processes_that_train_together_have_subjects_of_their_own() -> None:
    of_rank = [EpochSampler(5, epoch=1, rank=rank, n_ranks=2) for rank in range(2)]
    assert [list(sampler) for sampler in of_rank] == [[5, 7], [6, 8]]
    assert [len(sampler) for sampler in of_rank] == [2, 2]  # all end their epochs together
    assert list(EpochSampler(2, rank=3, n_ranks=4)) == [1]  # more processes than subjects, but none is idle


def test_an_iterator_that_is_not_used_costs_no_epoch() -> None:
    sampler = EpochSampler(2)
    iter(sampler)
    assert list(sampler) == [0, 1]


@pytest.mark.parametrize("n_subjects", [5, 6, 9, 10])
@pytest.mark.parametrize("n", [3, 5, 6])
def test_every_subject_meets_every_number_of_stacks(n_subjects: int, n: int) -> None:
    """Else errors by number of stacks would be those of other heads."""
    dataset = SubjectDataset[int](phantom_subjects(n_subjects, 0, "x"), length=n_subjects * n, seed=0, in_order=True)
    met = {(dataset.draw(0, index)[0], dataset.turn(index, n)) for index in range(len(dataset))}
    assert len(met) == n_subjects * n
