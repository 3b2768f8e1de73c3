"""How sure a proportion of trials is. Pure arithmetic; the evaluation counts with it as well."""

from __future__ import annotations

from math import sqrt
from typing import Final

_Z95: Final = 1.959964


def wilson(succeeded: int, runs: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a proportion of at least one run."""
    share, z2 = succeeded / runs, _Z95**2
    middle = (share + z2 / (2 * runs)) / (1 + z2 / runs)
    half = _Z95 * sqrt(share * (1 - share) / runs + z2 / (4 * runs**2)) / (1 + z2 / runs)
    return max(0.0, middle - half), min(1.0, middle + half)
