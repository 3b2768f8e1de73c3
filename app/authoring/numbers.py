"""Numbers beside a number: what a bound is changed to, and where it is probed."""

from __future__ import annotations

from typing import Final

STEP: Final = 0.01
"""A bound is moved by one percent: what does not notice that does not hold it."""


def beside(value: float, *, whole: bool = False) -> tuple[float, ...]:
    """Return the numbers a bound is changed to: a little more and a little less; what is counted stays whole."""
    if whole:
        step = max(1, round(abs(value) * STEP))
        return int(value) + step, int(value) - step
    step = abs(value) * STEP or STEP
    return float(f"{value + step:.12g}"), float(f"{value - step:.12g}")


def probes(value: float) -> tuple[float, ...]:
    """Return where a bound shows: on it, between it and what it is changed to, and well beside."""
    step = abs(value) * STEP or STEP
    return tuple(float(f"{value + share * step:.12g}") for share in (0.0, 0.5, -0.5, 2.0, -2.0, 20.0, -20.0))
