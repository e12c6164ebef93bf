"""Item numbers of epochs."""

from data_synth.subject_dataset import EpochSampler


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
