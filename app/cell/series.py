"""The rows of a session's telemetry on their way up: every control tick, or fewer where nothing was the matter.

A profile that does not keep every tick keeps each fifth, and all within a second of an alert, before it and after. So a
row waits until it is known that no alert follows within a second. Rows leave in the order in which they were made.
"""

from __future__ import annotations

from collections import deque
from typing import Final

EVERY: Final = 5
AROUND_S: Final = 1.0


class Series:
    """Rows of one session; `ready` holds those that may be sent, and whoever sends them clears it."""

    __slots__ = ("_alert", "_around", "_keeps_all", "_number", "_waiting", "ready")

    def __init__(self, period_s: float, *, keep_every_tick: bool) -> None:
        """Begin with nothing; `period_s` is a control period."""
        self.ready = bytearray()
        self._keeps_all = keep_every_tick
        self._around = round(AROUND_S / period_s)
        self._waiting: deque[bytes] = deque()
        self._number = -1
        self._alert = -self._around - 1

    def add(self, row: bytes, *, alerted: bool) -> None:
        """Take the row of the next tick, and whether the watcher alerted in it."""
        self._number += 1
        if alerted:
            self._alert = self._number
            self.ready += b"".join(self._waiting)
            self._waiting.clear()
        if self._keeps_all or self._number - self._alert <= self._around:
            self.ready += row
            return
        self._waiting.append(row)
        if len(self._waiting) > self._around:
            self._thin()

    def close(self) -> None:
        """Let the rows that still wait be sent; the last row of all is kept."""
        while len(self._waiting) > 1:
            self._thin()
        self.ready += b"".join(self._waiting)
        self._waiting.clear()

    def _thin(self) -> None:
        """Decide about the row that has waited longest."""
        number = self._number - len(self._waiting) + 1
        row = self._waiting.popleft()
        if number % EVERY == 0:
            self.ready += row
