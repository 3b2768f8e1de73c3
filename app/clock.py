"""The only module that reads clocks; everything else is told the time or asks here.

Wall time is for people and records (it may step), monotonic time is for durations and deadlines inside one process.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from functools import lru_cache
from math import floor


def wall_s() -> float:
    """Return the wall time in seconds since 1970-01-01T00:00:00Z."""
    return time.time()  # noqa: TID251  # the one place that may


def monotonic_s() -> float:
    """Return seconds on a clock that never steps back; its zero means nothing."""
    return time.monotonic()  # noqa: TID251  # the one place that may


def precise_ns() -> int:
    """Return nanoseconds on the finest clock of this process, for timing single calls; its zero means nothing."""
    return time.perf_counter_ns()


def cpu_s() -> float:
    """Return the seconds of processor time that this process has had; it stands still while others have the machine."""
    return time.process_time()


def rfc3339(wall_s: float) -> str:
    """Write a wall time as RFC 3339 in UTC with milliseconds, for instance `2026-03-01T09:30:00.250Z`.

    The width is fixed, so that texts sort like the times they name.

    Args:
        wall_s: seconds since 1970-01-01T00:00:00Z; digits beyond the millisecond are cut off.

    Raises:
        ValueError: the time lies outside the years 1 to 9999, or is not finite.
    """
    try:
        second = floor(wall_s)
        microseconds = round((wall_s - second) * 1_000_000)
        if microseconds == 1_000_000:
            second, microseconds = second + 1, 0
        return f"{_to_second(second)}.{microseconds // 1000:03d}Z"
    except (OverflowError, OSError, ValueError) as error:
        raise ValueError(f"`{wall_s}` is no wall time: valid are finite seconds within the years 1 to 9999") from error


@lru_cache(maxsize=8)  # the present second is asked for thousands of times
def _to_second(second: int) -> str:
    return datetime.fromtimestamp(second, tz=UTC).replace(tzinfo=None).isoformat()


def parse_rfc3339(text: str) -> float:
    """Read an RFC 3339 time with an offset and return seconds since 1970-01-01T00:00:00Z; `t` and `z` may be small.

    Raises:
        ValueError: the text is no time, or names no offset (a local time means nothing on another machine).
    """
    try:
        moment = datetime.fromisoformat(text.upper())
    except ValueError as error:
        raise ValueError(f"`{text}` is no RFC 3339 time: valid is for instance `2026-03-01T09:30:00.250Z`") from error
    if moment.tzinfo is None:
        raise ValueError(f"`{text}` names no offset: valid is for instance `2026-03-01T09:30:00.250Z`")
    return moment.timestamp()
