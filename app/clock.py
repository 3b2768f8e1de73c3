"""The only module that reads clocks; everything else is told the time or asks here.

Wall time is for people and records (it may step), monotonic time is for durations and deadlines inside one process.
"""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime
from functools import lru_cache
from math import floor
from typing import Final


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


_RFC3339: Final = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)?", re.ASCII | re.IGNORECASE)


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

    Digits beyond the millisecond are cut off, as `rfc3339` cuts them.

    Raises:
        ValueError: the text is no time, names no offset (a local time means nothing on another machine), or is outside
            the years 1 to 9999 once it is put in UTC.
    """
    strange = f"`{text}` is no RFC 3339 time: valid is for instance `2026-03-01T09:30:00.250Z`"
    if _RFC3339.fullmatch(text) is None:  # ISO 8601 has weeks, days of the year and times without separators, too
        raise ValueError(strange)
    try:
        moment = datetime.fromisoformat(text.upper())
    except ValueError as error:
        raise ValueError(strange) from error
    if moment.tzinfo is None:
        raise ValueError(f"`{text}` names no offset: valid is for instance `2026-03-01T09:30:00.250Z`")
    try:
        moment = moment.astimezone(UTC)
    except OverflowError as error:
        raise ValueError(f"`{text}` lies outside the years 1 to 9999 in UTC: valid are times within them") from error
    return moment.replace(microsecond=moment.microsecond // 1000 * 1000).timestamp()
