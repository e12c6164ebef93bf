"""Detection of masks that end inside the brain, in images without surroundings.

Such images, for example brain-extracted ones, show themselves how far the brain reaches. Where skull and mother are
shown, too, grey values do not tell brain from what lies beside it, and nothing is detected.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from g3r.acquisition.stacks import Stack

LEFT_OUT_RANGE = (0.09, 0.4)
"""Range of the share of an image's content outside its mask that means that the mask lacks brain. A mask that fits
leaves out 2 to 4 %, a mask that is one pixel of 0.8 mm too small 6 to 8 %, four pixels 18 to 26 % (heads of 24 and 30
weeks of docs/stress.md). Above the range the image shows something else, too."""

RIM_MM = 6.0
"""Brain that a mask leaves out lies this close around it; content that reaches further is something else."""

MAX_BEYOND = 0.1
"""Largest share of the left-out content that may lie further away: noise, edges of the image."""

BRIGHT_SHARE = 0.3
"""Share of the median in the mask above which a pixel is content; darker pixels are noise or background."""

MOST_OF_PIXELS = 5
"""Side of an in-plane square (pixels) most of whose pixels must be bright: at an SNR of 7 one pixel of noise in ten is.
That is a median filter, which leaves edges where they are: on five heads drawn for docs/stress.md, with an SNR of 11 to
27, it changes shares by 0.005 at most."""


def left_out_share(stack: Stack) -> float:
    """Share of a stack's content outside its mask; 0 if that is little, or if the image shows more than the brain.

    Only slices with a mask count: others may have been left out on purpose.
    """
    used = stack.mask.any((0, 1))
    image, mask = stack.image[:, :, used], stack.mask[:, :, used]
    bright = image > BRIGHT_SHARE * float(np.median(image[mask]))
    shown = uniform_filter(bright.astype(np.float32), (MOST_OF_PIXELS, MOST_OF_PIXELS, 1)) > 0.5
    outside = shown & ~mask
    share = float(outside.sum()) / max(float(shown.sum()), 1.0)
    low, high = LEFT_OUT_RANGE
    if not low <= share <= high:
        return 0.0
    in_plane_mm = [distance_transform_edt(~one, stack.spacing_mm[:2]) for one in np.moveaxis(mask, 2, 0)]
    beyond = np.stack(in_plane_mm, 2)[outside] > RIM_MM
    return share if beyond.mean() < MAX_BEYOND else 0.0
