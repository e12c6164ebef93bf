"""Training data: shapes, values, that every sample can be made again, and atlas folders."""

import os
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import torch

pytest.importorskip("lightning")
pytest.importorskip("torchio")

from data_synth.atlas import cropped, find_subjects, load_subject
from data_synth.augment import augmentation, augmented
from data_synth.dataset import IMAGE_KEYS, SyntheticSubjects, synthesise
from data_synth.heads import PhantomSubject
from data_synth.phantom import fetal_brain_phantom
from data_synth.prior_data import EpochSampler, StackSynthesisDataModule
from g3r.errors import InputError

SPACING_MM = 2.0
TINY = {
    "spacing_mm": SPACING_MM,
    "patch_size": 24,
    "patches_per_subject": 4,
    "batch_size": 2,
    "subjects_per_epoch": 2,
    "val_subjects": 2,
    "val_crop": 40,
}
ATLAS = Path(os.environ.get("G3R_TEST_DATA", Path(__file__).parents[3] / "shared" / "data")) / "atlas"


def write_subject(
    folder: Path, weeks: float, affine_flip: bool = False, names: tuple[str, str] = ("t2", "mask")
) -> None:
    made = fetal_brain_phantom(weeks, 3.0)
    t2, mask, affine = made.t2, made.mask.astype(np.uint8), made.affine
    if affine_flip:  # the same brain stored the other way round
        affine = affine @ np.diag([-1.0, 1, 1, 1])
        affine[0, 3] = -affine[0, 3]
        t2, mask = t2[::-1], mask[::-1]
    folder.mkdir(parents=True, exist_ok=True)
    nib.save(nib.Nifti1Image(t2, affine), folder / f"{names[0]}.nii.gz")
    nib.save(nib.Nifti1Image(mask, affine), folder / f"{names[1]}.nii.gz")


@pytest.fixture(scope="module")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("atlas")
    write_subject(root / "a" / "week24", 24)
    write_subject(root / "a" / "week30", 30, affine_flip=True)
    write_subject(root / "b", 27, names=("sub-27", "sub-27_mask"))
    (root / "b" / "notes.txt").write_text("not an image")
    return root


def test_batches_of_training_and_validation() -> None:
    data = StackSynthesisDataModule("phantom", **TINY)
    loader = data.train_dataloader()
    assert len(loader) == 4
    batches = list(loader)
    assert len(batches) == 4
    for batch in batches:
        assert type(batch) is dict
        assert list(batch) == [*IMAGE_KEYS, "n_stacks"]
        assert batch["n_stacks"].shape == (2,)
        assert 1 <= int(batch["n_stacks"].min()) <= int(batch["n_stacks"].max()) <= 6
        for value in (batch[key] for key in IMAGE_KEYS):
            assert value.shape == (2, 1, 24, 24, 24)
            assert value.dtype == torch.float32
            assert bool(value.isfinite().all())
        assert set(batch["mask"].unique().tolist()) <= {0.0, 1.0}
        assert float(batch["truth"][batch["mask"] == 0].abs().max()) == 0
        assert float(batch["density"].min()) >= 0
        assert float(batch["coarse"].max()) < 3
        assert bool((batch["mask"].sum((1, 2, 3, 4)) > 100).all())
    second_epoch = list(loader)
    assert len(second_epoch) == 4
    assert not torch.equal(second_epoch[0]["truth"], batches[0]["truth"])

    first, again = list(data.val_dataloader()), list(data.val_dataloader())
    assert len(first) == 2
    for a, b in zip(first, again, strict=True):
        assert a["coarse"].shape == (1, 1, 40, 40, 40)
        for key in a:
            torch.testing.assert_close(a[key], b[key], rtol=0, atol=0)


def make_dataset(augment: bool = True) -> SyntheticSubjects:
    sources = [PhantomSubject("young", 23.0, 1), PhantomSubject("old", 33.0, 2)]
    return SyntheticSubjects(sources, SPACING_MM, length=4, seed=7, min_shape=30, augment=augment)


def test_a_sample_is_a_function_of_seed_epoch_and_index() -> None:
    straight, other_way = make_dataset(), make_dataset()
    a = straight.sample(2, 1)
    torch.rand(5)  # the global generator plays no part
    other_way.sample(0, 3)
    b = other_way.sample(2, 1)
    for key in IMAGE_KEYS:
        np.testing.assert_array_equal(getattr(a, key), getattr(b, key))
    item = straight[2 * 4 + 1]
    np.testing.assert_array_equal(item["coarse"].data[0].numpy(), a.coarse)
    assert straight.sample(3, 1).truth.shape != a.truth.shape or (
        np.abs(straight.sample(3, 1).coarse - a.coarse).max() > 0
    )


def test_synthesis_leaves_the_global_generator_alone() -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    make_dataset().sample(0, 0)
    torch.testing.assert_close(torch.rand(3), expected, rtol=0, atol=0)


def test_coarse_and_truth_share_grid_and_scale() -> None:
    dataset = make_dataset(augment=False)
    for index in range(3):
        one = dataset.sample(0, index)
        seen = one.mask & (one.density > 0.5)
        assert seen.sum() > 0.3 * one.mask.sum()
        assert 0.85 < one.coarse[seen].mean() / one.truth[seen].mean() < 1.1
        assert np.corrcoef(one.coarse[seen], one.truth[seen])[0, 1] > 0.3
        assert abs(np.percentile(one.coarse[one.density > 0.1], 99) - 1) < 1e-3


def test_epoch_sampler_goes_on() -> None:
    sampler = EpochSampler(3, epoch=2)
    assert list(sampler) == [6, 7, 8]
    assert list(sampler) == [9, 10, 11]
    assert len(sampler) == 3


def test_processes_that_train_together_have_subjects_of_their_own() -> None:
    of_rank = [EpochSampler(5, epoch=1, rank=rank, n_ranks=2) for rank in range(2)]
    assert [list(sampler) for sampler in of_rank] == [[5, 7, 9], [6, 8]]
    assert list(EpochSampler(2, rank=3, n_ranks=4)) == [1]  # more processes than subjects: none is idle


def test_augmentation_keeps_a_head() -> None:
    volume = make_dataset()._volume(0)
    transform = augmentation()
    for seed in range(4):
        varied = augmented(volume, transform, np.random.default_rng(seed))
        assert varied.data.dtype == np.float32
        assert np.isfinite(varied.data).all()
        assert (varied.data[~varied.mask] == 0).all()
        assert abs(np.percentile(varied.data[varied.mask], 99.5) - 1) < 1e-3
        assert 0.6 < varied.mask.sum() / volume.mask.sum() < 1.5


def test_atlas_conventions_and_patterns(atlas: Path) -> None:
    assert [s.name for s in find_subjects(atlas)] == ["a/week24", "a/week30", "b/sub-27"]
    assert [s.name for s in find_subjects(atlas, include=["a/*"])] == ["a/week24", "a/week30"]
    assert [s.name for s in find_subjects(atlas, exclude=["week*"])] == ["b/sub-27"]
    with pytest.raises(InputError, match=r"none of 3 subjects.*change the patterns"):
        find_subjects(atlas, include=["c/*"])
    with pytest.raises(InputError, match="no such folder"):
        find_subjects(atlas / "nowhere")
    with pytest.raises(InputError, match=r"expected SUBJECT/t2\.nii\.gz"):
        find_subjects(Path(__file__).parent)


def test_atlas_volumes_come_canonical_and_normalised(atlas: Path) -> None:
    for subject in find_subjects(atlas, include=["a/*"]):
        volume = load_subject(subject, SPACING_MM)
        np.testing.assert_allclose(volume.affine[:3, :3], np.eye(3) * SPACING_MM, atol=1e-6)
        assert abs(np.percentile(volume.data[volume.mask], 99.5) - 1) < 0.02
        reference = fetal_brain_phantom(float(subject.name[-2:]), 3.0)
        # the resampled brain lies where the original does
        place = volume.affine[:3, :3] @ np.argwhere(volume.mask).mean(0) + volume.affine[:3, 3]
        expected = reference.affine[:3, :3] @ np.argwhere(reference.mask).mean(0) + reference.affine[:3, 3]
        np.testing.assert_allclose(place, expected, atol=0.3)
        tight = cropped(volume, 2)
        assert tight.mask.sum() == volume.mask.sum()
        place = tight.affine[:3, :3] @ np.argwhere(tight.mask).mean(0) + tight.affine[:3, 3]
        np.testing.assert_allclose(place, expected, atol=0.3)


def test_training_on_a_folder(atlas: Path) -> None:
    data = StackSynthesisDataModule(str(atlas), include=["a/*"], val_include=["b/*"], **TINY)
    data.setup()
    assert [s.name for s in data.train_subjects.sources] == ["a/week24", "a/week30"]
    assert [s.name for s in data.val_volumes.subjects.sources] == ["b/sub-27"]
    assert len(next(iter(data.val_dataloader()))) == len(IMAGE_KEYS) + 1
    mixed = StackSynthesisDataModule(str(atlas), val_include=["week24"], phantom_share=0.5, **TINY)
    mixed.setup()
    assert len(mixed.train_subjects.sources) == 4


@pytest.mark.parametrize(
    "wrong", [{"patch_size": 0}, {"phantom_share": 1.0}, {"batch_size": 99}, {"source": "/no/such/folder"}]
)
def test_bad_settings_say_so(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"expected|raise"):
        StackSynthesisDataModule(**{**TINY, **wrong}).setup()


def test_kept_subjects_are_the_same(tmp_path: Path) -> None:
    sources = [PhantomSubject("young", 23.0, 1)]

    def dataset(cache: Path | None, seed: int = 7) -> SyntheticSubjects:
        return SyntheticSubjects(
            sources, 2.5, length=2, seed=seed, min_shape=24, augment=False, distinct=1, cache=cache
        )

    fresh = dataset(None).sample(0, 1)
    first = dataset(tmp_path)
    made = first.sample(0, 1)
    np.testing.assert_array_equal(made.coarse, fresh.coarse)
    files = list(tmp_path.iterdir())
    assert len(files) == 1
    again = dataset(tmp_path)
    again._made = None  # type: ignore[method-assign,assignment]  # would fail if anything had to be made
    for epoch in (0, 3):  # every epoch is the first one again
        kept = again.sample(epoch, 1)
        for key in ("coarse", "density", "sharp", "truth"):
            np.testing.assert_allclose(getattr(kept, key), getattr(fresh, key), rtol=1e-3, atol=1e-6)
        np.testing.assert_array_equal(kept.mask, fresh.mask)
        assert (kept.name, kept.n_stacks, kept.residual) == (fresh.name, fresh.n_stacks, fresh.residual)
    # another recipe does not take this one's files, and a damaged file is made again
    assert dataset(tmp_path, seed=8).kept.load(0, 1) is None
    files[0].write_bytes(files[0].read_bytes()[:1000])
    np.testing.assert_array_equal(dataset(tmp_path).sample(0, 1).coarse, fresh.coarse)
    # patches of one subject differ from epoch to epoch
    seeds = {dataset(tmp_path)[2 * epoch + 1]["sample_seed"] for epoch in (0, 1)}
    assert seeds == {(7, 0, 1), (7, 1, 1)}


def test_validation_takes_one_two_and_three_stacks_in_turn() -> None:
    data = StackSynthesisDataModule("phantom", **{**TINY, "val_subjects": 3})
    assert [int(batch["n_stacks"]) for batch in data.val_dataloader()] == [1, 2, 3]


@pytest.mark.slow
def test_a_worker_process_makes_the_same_samples() -> None:
    batches = {}
    for n_workers in (0, 1):
        torch.manual_seed(0)  # the order of patches in the queue is torch's
        loader = StackSynthesisDataModule("phantom", num_workers=n_workers, **TINY).train_dataloader()
        batches[n_workers] = torch.cat([b["truth"] for _ in range(2) for b in loader])
    totals = [sorted(b.sum((1, 2, 3, 4)).tolist()) for b in batches.values()]
    np.testing.assert_allclose(totals[0], totals[1], rtol=1e-5)


@pytest.mark.skipif(not ATLAS.is_dir(), reason="no atlas: set G3R_TEST_DATA to a folder that holds atlas/")
def test_a_real_atlas() -> None:
    subject = find_subjects(ATLAS, include=["crl-sta/sta2?"])[0]
    volume = cropped(load_subject(subject, SPACING_MM), 4)
    one = synthesise(volume, np.random.default_rng(0))
    assert one.truth.shape == volume.data.shape
    assert np.isfinite(one.coarse).all()
    assert 20 < volume.mask.sum() * SPACING_MM**3 / 1000 < 600
