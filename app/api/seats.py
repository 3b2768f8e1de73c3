"""Seats: a bound on how many requests of a kind may be held open at once, over all callers and for each.

A stream or a long poll costs little and lasts long, so that nothing but a bound keeps one caller from holding all there
is. Whoever finds no seat is told so at once, and when to come back; no request for a seat waits.
"""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from app.api.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Generator

COME_BACK_S: Final = 5


class Seats:
    """So many requests of one kind at once, and so many of them for one principal."""

    def __init__(self, *, code: str, limit: int, each: int) -> None:
        """Set out the seats.

        Args:
            code: the problem's code for whoever finds none.
            limit: how many there are.
            each: how many one principal may have.
        """
        self._code, self._limit, self._each = code, limit, each
        self._taken: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """Return how many are taken."""
        return self._taken.total()

    @contextmanager
    def take(self, name: str) -> Generator[None]:
        """Hold a seat for a principal inside the context. Raises `Problem`: 503 with the code, no seat is free."""
        if self._taken[name] >= self._each:
            raise self._refused(f"`{name}` holds `{self._each}` of these open: valid are at most so many each")
        if self.taken >= self._limit:
            raise self._refused(f"`{self._limit}` of these are open: valid are at most so many together")
        self._taken[name] += 1
        try:
            yield
        finally:
            self._taken[name] -= 1
            if not self._taken[name]:
                del self._taken[name]

    def _refused(self, detail: str) -> Problem:
        return Problem(self._code, detail, headers={"Retry-After": str(COME_BACK_S)})
