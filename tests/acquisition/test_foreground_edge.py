"""Edge of the volume around the foreground mask."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from g3r.acquisition.mask_votes import foreground
from g3r.acquisition.slicing import slices_from_stacks
from tests.acquisition.ellipsoids import GRID, TURNS, WORLD, depth, ellipsoid_stack


@pytest.mark.parametrize("n_stacks", [2, 3])
def test_less_is_shown_beyond_the_head_and_nothing_of_it_is_lost(n_stacks: int) -> None:
    found = foreground(slices_from_stacks([ellipsoid_stack(turn) for turn in TURNS[:n_stacks]]), GRID)
    inside, in_full = depth(WORLD) > 0, binary_dilation(support := found.support())
    edge = found.edge(support, found.mask())
    assert edge[inside].mean(dtype=float) > 0.99
    assert edge[~inside].sum(dtype=float) < 0.75 * in_full[~inside].sum()


def test_the_edge_fades_from_the_brain_outwards() -> None:
    found = foreground(slices_from_stacks([ellipsoid_stack(turn) for turn in TURNS]), GRID)
    edge = found.edge(support := found.support(), found.mask())
    assert edge.dtype == np.float16
    assert (edge[depth(WORLD) > 0.05] == 1).all()
    assert not edge[~binary_dilation(support)].any()
    assert ((edge > 0) & (edge < 1)).any()
    rings = [
        edge[(low < -depth(WORLD)) & (-depth(WORLD) <= low + 0.03)].mean() for low in (0.0, 0.03, 0.06, 0.09, 0.12)
    ]
    assert rings == sorted(rings, reverse=True)
    assert not edge[depth(WORLD) < -0.15].any()


def test_a_single_stack_is_shown_in_full_up_to_a_rim() -> None:
    found = foreground(slices_from_stacks([ellipsoid_stack()]), GRID.respaced(0.8))
    shown = binary_dilation(support := found.support(), iterations=2)  # 1.6 mm
    np.testing.assert_array_equal(found.edge(support, found.mask()), support | (shown & ~found.out_of_reach))


@pytest.mark.parametrize("n_stacks", [1, 2])
def test_what_no_slice_saw_is_shown_in_full_where_there_is_brain(n_stacks: int) -> None:
    found = foreground(slices_from_stacks([ellipsoid_stack(low_mm=0.0, thickness_mm=4.0)] * n_stacks), GRID)
    likely = (depth(WORLD) > 0).astype(np.float32)
    edge = found.edge(support := found.support(likely), found.mask(likely))
    np.testing.assert_array_equal(edge[found.out_of_reach], support[found.out_of_reach])


@pytest.mark.parametrize(("probability", "shown"), [(0.0, 0.0), (0.02, 0.0), (0.09, 0.5), (0.2, 1.0)])
def test_what_no_slice_saw_fades_with_the_probability_of_brain(probability: float, shown: float) -> None:
    found = foreground(slices_from_stacks([ellipsoid_stack(low_mm=0.0, thickness_mm=4.0)]), GRID)
    likely = (depth(WORLD) > 0).astype(np.float32)
    support, mask = found.support(likely), found.mask(likely)
    rim = found.out_of_reach & ~support & binary_dilation(support)
    assert rim.any()
    np.testing.assert_allclose(found.edge(support, mask, np.full(GRID.shape, probability))[rim], shown, atol=1e-3)
