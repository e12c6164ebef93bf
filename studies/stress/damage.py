"""Faults added to simulated stacks after the simulation: wrong headers, wrong masks, wrong stacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, generate_binary_structure

from g3r.acquisition.k_space_extent import filled_share
from g3r.acquisition.psf import partial_fwhm_pixels
from g3r.acquisition.stacks import Stack

Stacks = tuple[Stack, ...]

DISC = generate_binary_structure(2, 1)[:, :, None]


@dataclass(frozen=True)
class Damage:
    """A change of a subject's stacks.

    Attributes:
        apply: function of the subject's stacks, the stacks of another subject, and a random generator.
        last_without_truth: whether the last stack has no true poses any more.
    """

    apply: Callable[[Stacks, Stacks, np.random.Generator], Stacks]
    last_without_truth: bool = False


def first_stacks(n: int) -> Damage:
    """Keep only the first `n` stacks."""
    return Damage(lambda stacks, other, rng: stacks[:n])


def stated_thickness(factor: float) -> Damage:
    """State a thickness that is wrong by a factor, in all stacks."""
    return Damage(
        lambda stacks, other, rng: tuple(replace(one, thickness_mm=factor * one.thickness_mm) for one in stacks)
    )


def masks_grown(pixels: int) -> Damage:
    """Dilate masks in plane by a number of pixels; a negative number erodes them."""
    change = binary_dilation if pixels > 0 else binary_erosion

    def grown(stack: Stack) -> Stack:
        return replace(stack, mask=change(stack.mask, DISC, iterations=abs(pixels)))

    return Damage(lambda stacks, other, rng: tuple(map(grown, stacks)))


def images_cut() -> Damage:
    """Set images to zero beyond their masks, as brain extraction does, in all stacks."""

    def cut(stack: Stack) -> Stack:
        return replace(stack, image=np.where(stack.mask, stack.image, np.float32(0)))

    return Damage(lambda stacks, other, rng: tuple(map(cut, stacks)))


def images_interpolated(factor: int) -> Damage:
    """Interpolate all stacks to smaller pixels by zeros around k-space, as scanners do; the spectrum is then looked at.

    Args:
        factor: pixels per acquired pixel, along either axis.
    """

    def interpolated(stack: Stack) -> Stack:
        k_space = np.fft.fftshift(np.fft.fft2(stack.image, axes=(0, 1)), axes=(0, 1))
        # the zero frequency is number n // 2 before and after
        before = [factor * n // 2 - n // 2 for n in stack.image.shape[:2]]
        after = [factor * n - n - first for n, first in zip(stack.image.shape, before, strict=False)]
        filled = np.pad(k_space, [*zip(before, after, strict=True), (0, 0)])
        image = np.abs(np.fft.ifft2(np.fft.ifftshift(filled, axes=(0, 1)), axes=(0, 1))) * factor**2
        affine = stack.affine.copy()
        affine[:3, :2] /= factor
        # pixel n of the acquired image is number factor n, and the middle of its part of the mask
        shift = (-(factor // 2), -(factor // 2))
        mask = np.roll(stack.mask.repeat(factor, axis=0).repeat(factor, axis=1), shift, axis=(0, 1))
        image = image.astype(np.float32)
        first, second = (partial_fwhm_pixels(filled_share(image, axis) or 1.0) for axis in (0, 1))
        return replace(
            stack, image=image, mask=mask, affine=affine, file_affine=None, in_plane_fwhm_pixels=(first, second)
        )

    return Damage(lambda stacks, other, rng: tuple(map(interpolated, stacks)))


def slices_lost(share: float) -> Damage:
    """Remove the masks of random slices in all stacks."""

    def lost(stack: Stack, rng: np.random.Generator) -> Stack:
        return replace(stack, mask=stack.mask & (rng.random(stack.mask.shape[2]) >= share))

    return Damage(lambda stacks, other, rng: tuple(lost(one, rng) for one in stacks))


def span_lost(share: float) -> Damage:
    """Remove the masks of the middle slices of every stack."""

    def lost(stack: Stack) -> Stack:
        rows = np.flatnonzero(stack.mask.any((0, 1)))
        n, first = round(share * len(rows)), round((1 - share) / 2 * len(rows))
        kept = np.isin(np.arange(stack.mask.shape[2]), rows[first : first + n], invert=True)
        return replace(stack, mask=stack.mask & kept)

    return Damage(lambda stacks, other, rng: tuple(map(lost, stacks)))


def other_contrast() -> Damage:
    """Invert the contrast of the last stack: dark fluid and bright tissue."""

    def inverted(stack: Stack) -> Stack:
        bright = float(np.percentile(stack.image[stack.mask], 99))
        return replace(stack, image=np.where(stack.image > 0, np.maximum(1.2 * bright - stack.image, 0), 0))

    return Damage(lambda stacks, other, rng: (*stacks[:-1], inverted(stacks[-1])))


def slices_reversed() -> Damage:
    """Reverse the slices of the last stack, which mirrors the head; no rigid motion can correct this."""

    def reversed_(stack: Stack) -> Stack:
        return replace(stack, image=stack.image[:, :, ::-1], mask=stack.mask[:, :, ::-1])

    return Damage(lambda stacks, other, rng: (*stacks[:-1], reversed_(stacks[-1])), last_without_truth=True)


def halves_swapped() -> Damage:
    """Put the even slices of the last stack before the odd ones, like files sorted by time instead of position."""

    def swapped(stack: Stack) -> Stack:
        order = [*range(0, stack.image.shape[2], 2), *range(1, stack.image.shape[2], 2)]
        return replace(stack, image=stack.image[:, :, order], mask=stack.mask[:, :, order])

    return Damage(lambda stacks, other, rng: (*stacks[:-1], swapped(stacks[-1])), last_without_truth=True)


def stack_of_another() -> Damage:
    """Replace the last stack by a stack of another head."""
    return Damage(lambda stacks, other, rng: (*stacks[:-1], other[len(stacks) - 1]), last_without_truth=True)


def nothing() -> Damage:
    """No damage."""
    return Damage(lambda stacks, other, rng: stacks)


def applied(damage: Damage, stacks: Sequence[Stack], other: Sequence[Stack], rng: np.random.Generator) -> Stacks:
    """The stacks after the damage; see `Damage`.

    Args:
        damage: to apply.
        stacks: of a subject.
        other: stacks of another subject.
        rng: source of randomness.
    """
    return damage.apply(tuple(stacks), tuple(other), rng)
