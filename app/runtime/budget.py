"""What one cell may cost everybody else: so much at once, and so much with every second.

A cell that is within it waits for nothing. One that is beyond it is neither cut off nor unheard: what costs waits until
it is paid for, while its states and beats are taken as ever.
"""

from __future__ import annotations

from typing import Final

from app.clock import monotonic_s

# Honest cells were measured: 12,000 reports that waited through an outage are 9 MB with what a row costs, and stories
# of faults, people and words of operators 1.5 kB a second of the robot's time, which may pass 44 times as fast.
MOST_RECORDED: Final = 16 * 1024 * 1024
RECORDED_PER_S: Final = 64 * 1024
MOST_SHOWN: Final = 2 * 1024 * 1024  # of scenes and paths, and of states: a console is cut off that is 16 MB behind
SHOWN_PER_S: Final = 64 * 1024
ROW: Final = 512  # what a report costs the disk beside its own characters


class Budget:
    """So much of something at once, and more of it with every second; what is spent beyond that is owed."""

    def __init__(self, *, most: float, per_s: float) -> None:
        """Begin with all there is.

        Args:
            most: how much may be spent at once, by whoever has spent nothing for long.
            per_s: how much comes back in a second.
        """
        self._most, self._per_s = most, per_s
        self._left, self._as_of_s = most, monotonic_s()

    def spend(self, amount: float) -> None:
        """Spend so much, be it there or not."""
        self._left, self._as_of_s = self._now() - amount, monotonic_s()

    def owed_s(self) -> float:
        """Return for how long nothing more may be spent; 0 where something may."""
        return max(0.0, -self._now() / self._per_s)

    def _now(self) -> float:
        return min(self._most, self._left + (monotonic_s() - self._as_of_s) * self._per_s)


def records() -> Budget:
    """Return what one cell may have recorded, in characters."""
    return Budget(most=MOST_RECORDED, per_s=RECORDED_PER_S)


def drawings() -> Budget:
    """Return what one cell may have consoles shown, in characters: of how it looks and goes, or of how it is."""
    return Budget(most=MOST_SHOWN, per_s=SHOWN_PER_S)
