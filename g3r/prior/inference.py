"""Whole-volume estimation of the structural prior, in one go or in tiles."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from g3r.errors import NumericalError
from g3r.prior.dgpn import DensityGatedPriorNetwork, PriorOutput
from g3r.prior.inputs import PriorInputs
from g3r.prior.maps import DEFAULT_TILING, EstimatedPrior, PriorMaps, Tiling

VIEWS = ((), (0, 1), (1, 2), (0, 2), (0,), (1,), (2,), (0, 1, 2))
"""Mirrored axes of each view: half turns first, which show the network a head rather than its mirror image."""


def estimate_prior(
    network: DensityGatedPriorNetwork, maps: PriorMaps, *, n_views: int = 1, tiling: Tiling = DEFAULT_TILING
) -> EstimatedPrior:
    """Return V_prior for a whole volume (Eq. 7).

    The network was trained on heads in all 48 symmetric orientations, and its errors differ between them, so the
    mean over some is better than any single one ("geometric self-ensemble", Lim et al., CVPRW 2017).

    Args:
        network: the network, on any device; its mode is not changed.
        maps: intensities already divided by `g3r.acquisition.coarse_volume.normalisation_scale`.
        n_views: number of mirror images and half turns to average over, 1 to 8.
        tiling: how large volumes are cut into tiles.

    Returns:
        V_prior in the units of V_coarse, and the brain's probability.

    Raises:
        ValueError: a needed volume is missing, or the number of views is not 1 to 8.
        NumericalError: the result is not finite.

    Numerics: tiles begin at multiples of the network's stride, so a tile sees the same sub-sampled grid as
        the whole volume, and no layer has statistics of its own. The error comes from what is beyond the halo:
        none but rounding for a halo of the receptive radius, below 1e-3 of the intensity scale for 64 voxels
        (tests/prior/test_prior_inference.py).
    """
    if not 1 <= n_views <= len(VIEWS):
        raise ValueError(f"{n_views} views; expected 1 to {len(VIEWS)}")
    stride = network.config.stride
    shape_given = maps.coarse.shape
    whole = maps.coarse.size <= tiling.max_whole_voxels
    # with whole strides only, a mirrored tile is on the same sub-sampled grid as the mirrored volume
    far_end = [(0, -extent % stride) for extent in shape_given]
    volumes = {
        name: np.pad(np.asarray(volume, np.float32), far_end)
        for name, volume in vars(maps).items()
        if volume is not None
    }
    shape = volumes["coarse"].shape
    edge = max(shape) if whole else _round_up(tiling.tile_voxels, stride)
    halo = 0 if whole else _round_up(tiling.halo_voxels, stride)
    device = next(network.parameters()).device

    prior, brain = np.empty(shape, np.float32), np.empty(shape, np.float32)
    with torch.inference_mode():
        for core, seen in _tiles(shape, edge, halo):
            inputs = PriorInputs(
                **{
                    name: torch.from_numpy(np.ascontiguousarray(volume[seen], np.float32)).to(device)[None, None]
                    for name, volume in volumes.items()
                }
            )
            views = [_view(network, inputs, axes) for axes in VIEWS[:n_views]]
            inside = tuple(
                slice(wanted.start - given.start, wanted.stop - given.start)
                for wanted, given in zip(core, seen, strict=True)
            )
            prior[core] = _mean([one.volume for one in views])[inside]
            brain[core] = _mean([torch.sigmoid(one.brain_logit) for one in views])[inside]
    box = tuple(slice(extent) for extent in shape_given)
    prior, brain = np.ascontiguousarray(prior[box]), np.ascontiguousarray(brain[box])
    if not (np.isfinite(prior).all() and np.isfinite(brain).all()):
        raise NumericalError("the prior network returned NaN or infinity; check the stacks' intensities")
    return EstimatedPrior(volume=prior, brain=brain)


def _view(network: DensityGatedPriorNetwork, inputs: PriorInputs, axes: tuple[int, ...]) -> PriorOutput:
    """The network's output for inputs with some axes mirrored, mirrored back."""
    dims = [2 + axis for axis in axes]
    found = network(inputs.flip(dims))
    return PriorOutput(found.volume.flip(dims), found.brain_logit.flip(dims))


def _mean(views: Sequence[torch.Tensor]) -> NDArray[np.float32]:
    return (sum(views) / len(views))[0, 0].float().cpu().numpy()  # type: ignore[index]


def _round_up(value: int, multiple: int) -> int:
    """Return the smallest multiple that is not below the value."""
    return -(-value // multiple) * multiple


def _tiles(shape: tuple[int, ...], edge: int, halo: int) -> Iterator[tuple[tuple[slice, ...], tuple[slice, ...]]]:
    """Yield (voxels a tile writes, voxels it sees); the first parts cover the volume once."""
    # an axis that one tile sees as a whole is not cut
    edges = [extent if edge + 2 * halo >= extent else edge for extent in shape]
    for corner in np.ndindex(*[-(-extent // edge) for extent, edge in zip(shape, edges, strict=True)]):
        start = [index * edge for index, edge in zip(corner, edges, strict=True)]
        stop = [min(begin + edge, extent) for begin, edge, extent in zip(start, edges, shape, strict=True)]
        core = tuple(slice(begin, end) for begin, end in zip(start, stop, strict=True))
        # one shape for all, reaching further inwards at an end, because torch caches memory for each shape
        seen_edge = [min(edge + 2 * halo, extent) for edge, extent in zip(edges, shape, strict=True)]
        first = [
            min(max(begin - halo, 0), extent - wide)
            for begin, extent, wide in zip(start, shape, seen_edge, strict=True)
        ]
        yield core, tuple(slice(a, a + wide) for a, wide in zip(first, seen_edge, strict=True))
