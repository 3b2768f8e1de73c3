"""Bounds on what callers may take of the server, so that none keeps the others out.

A stream or a long poll costs little and lasts long, so that nothing but a bound keeps one caller from holding all there
is: `Seats`. Whoever finds no seat is told so at once, and when to come back; no request for a seat waits. Before they
have said who they are, all are the same: a `Doorstep` lets the newest come and the longest-standing go. And who sits
may say much, but not more than their `Ration`.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from app.api.problems import Problem
from app.clock import monotonic_s

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Generator

COME_BACK_S: Final = 5
LONG_BYTES: Final = 16 * 1024  # of a body; hardly any is as long that nobody blew up


class Turns:
    """What keeps the event loop busy comes one by one, and rests after each for as long as it took.

    Whatever is ready at once the loop does in one go. Of sixteen long bodies each costs little more than a millisecond,
    and yet a stop that comes meanwhile would wait for all of them at every one of its steps.
    """

    def __init__(self) -> None:
        """Begin with nobody's turn."""
        self._lock = asyncio.Lock()

    @asynccontextmanager
    async def take(self) -> AsyncGenerator[None]:
        """Wait for one's turn, and hold it inside the context."""
        async with self._lock:
            began_s = monotonic_s()
            try:
                yield
            finally:
                await asyncio.sleep(monotonic_s() - began_s)


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


@dataclass(frozen=True, slots=True, eq=False)
class Stranger:
    """Somebody on the doorstep: from which address, and how long they may stand there."""

    address: str
    patience: asyncio.Timeout


class Doorstep:
    """Room for those who have come and not yet said who they are.

    Whoever comes finds room: if there is none, the one that has stood there longest of those from the address that most
    are from has to go. So nobody without a token keeps out who has one and says so at once.
    """

    def __init__(self, *, code: str, limit: int) -> None:
        """Make room.

        Args:
            code: the problem's code for whoever has to go.
            limit: how many may stand there, at least one.
        """
        self._code, self._limit = code, limit
        self._standing: list[Stranger] = []  # the longest first

    @property
    def standing(self) -> int:
        """Return how many stand there."""
        return len(self._standing)

    @asynccontextmanager
    async def stand(self, address: str, within_s: float) -> AsyncGenerator[None]:
        """Stand there inside the context, and say within so many seconds who it is.

        Raises:
            Problem: 503 with the code, somebody else needed the room.
            TimeoutError: the time is over.
        """
        sent_away = False
        try:
            async with asyncio.timeout(within_s) as patience:
                if len(self._standing) >= self._limit:
                    self._send_away()
                stranger = Stranger(address, patience)
                self._standing.append(stranger)
                try:
                    yield
                finally:
                    sent_away = stranger not in self._standing
                    if not sent_away:
                        self._standing.remove(stranger)
        except TimeoutError:
            if not sent_away:
                raise
            detail = f"`{self._limit}` who came later have not said who they are either: valid is to say it at once"
            raise Problem(self._code, detail, headers={"Retry-After": str(COME_BACK_S)}) from None

    def _send_away(self) -> None:
        many = Counter(stranger.address for stranger in self._standing)
        longest = max(self._standing, key=lambda stranger: many[stranger.address])  # of equals the first
        self._standing.remove(longest)
        if not longest.patience.expired():  # or else on the way out already
            longest.patience.reschedule(asyncio.get_running_loop().time())


class Ration:
    """So much of something for one principal within a time, over all connections it spreads it over."""

    def __init__(self, *, most: int, within_s: float) -> None:
        """Set how much, and within how many seconds."""
        self.most, self.within_s = most, within_s
        self._taken: dict[str, tuple[int, float]] = {}  # how much, since when; one entry for each principal

    def take(self, name: str, amount: int = 1) -> bool:
        """Say whether a principal may have so much more now; if so, it is taken."""
        now_s = monotonic_s()
        taken, since_s = self._taken.get(name, (0, now_s))
        if now_s - since_s >= self.within_s:
            taken, since_s = 0, now_s
        if taken + amount > self.most:
            return False
        self._taken[name] = taken + amount, since_s
        return True
