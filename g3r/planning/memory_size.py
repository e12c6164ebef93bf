"""Sizes of memory as people write and read them: 2G, 1500M, "1.1 GB"."""

from __future__ import annotations

import math
import re

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def parsed_size(text: str) -> int:
    """Bytes of "1500M", "2G", "2.5GB" or "1000000" (powers of ten).

    Raises:
        ValueError: anything else, or nothing.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)B?", text.strip(), flags=re.IGNORECASE)
    size = round(float(found[1]) * _UNITS[found[2].upper()]) if found else 0
    if size < 1:
        raise ValueError(f"size {text!r}; expected a number of bytes, or one with K, M, G or T, as 2G")
    return size


def gigabytes(n_bytes: float) -> str:
    """A size in messages, rounded up: 1.15 GB."""
    return f"{math.ceil(n_bytes / 1e7) / 100:.2f} GB"
