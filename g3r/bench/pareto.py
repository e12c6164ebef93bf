"""Which of several settings no other one beats in both speed and quality."""

from __future__ import annotations

from collections.abc import Sequence


def pareto_front(seconds: Sequence[float], quality: Sequence[float]) -> list[int]:
    """Numbers of the points that no other reaches in less time and with better quality, fastest first.

    Of points that are alike in both the first stays.

    Args:
        seconds: less is better.
        quality: more is better.

    Raises:
        ValueError: lists of different lengths.
    """
    if len(seconds) != len(quality):
        raise ValueError(f"{len(seconds)} times and {len(quality)} qualities; expected as many")
    front: list[int] = []
    for n in sorted(range(len(seconds)), key=lambda k: (seconds[k], -quality[k])):
        if not front or quality[n] > quality[front[-1]]:
            front.append(n)
    return front
