"""The rows of a session's telemetry on their way up: every control tick, or fewer where nothing was the matter.

A profile that does not keep every tick keeps each fifth, and all within a second of an alert, before it and after. So a
row waits until it is known that no alert follows within a second. Rows leave in the order in which they were made.
"""

from __future__ import annotations

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
        self._waiting: list[bytes] = []
        self._number = -1
        self._alert = -self._around - 1

    def add(self, row: bytes, *, alerted: bool) -> None:
        """Take the row of the next tick, and whether the watcher alerted in it."""
        number = self._number = self._number + 1
        if alerted:
            self._thin(number)
            self._alert = number
            self.ready += b"".join(self._waiting)
            self._waiting.clear()
        if self._keeps_all or number - self._alert <= self._around:
            self.ready += row
            return
        self._waiting.append(row)
        if number % EVERY == 0:  # not in every tick: what that costs, the control loop pays
            self._thin(number + 1)

    def keep_every_tick(self) -> None:
        """Keep every tick from now on, and what still waits."""
        self.ready += b"".join(self._waiting)
        self._waiting.clear()
        self._keeps_all = True

    def close(self) -> None:
        """Let the rows that still wait be sent; the last row of all is kept."""
        last = self._waiting[-1:]
        self._around = len(last)
        self._thin(self._number + 1)
        self.ready += b"".join(last)
        self._waiting.clear()

    def _thin(self, after: int) -> None:
        """Decide about the rows that have waited for a second, where all that wait came before tick `after`."""
        first = after - len(self._waiting)
        over = max(0, len(self._waiting) - self._around)
        self.ready += b"".join(self._waiting[-first % EVERY : over : EVERY])
        del self._waiting[:over]
