"""Hold-to-run: what a human at the controls wants, for how long it counts, and why nothing moves.

A command is good for `EXPIRES_MS` of the cell's own ticks. Whatever stopped the motion, a key that is still held does
not start it again: it takes a command of nothing first (`release_first`), which is what letting go of the key sends. So
does the first motion of all, and of every lease: a key that somebody held before they had the controls starts nothing.
Nor does one that was pressed and refused: whoever kept it down sees nothing move, and need not expect it to begin.
A command that only expired is no such stop, and the next one goes on, unless nothing came for `SILENT_MS`: everything
stands by then. What comes after that was held back on its way, and whoever sent it may have let go since.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from app.governance.model import Wish

if TYPE_CHECKING:
    from app.governance.model import WatchPlan
    from app.governance.permit import Grant

EXPIRES_MS: Final = 100
SILENT_MS: Final = 300  # as long as a link may be silent
TELL_EVERY_MS: Final = 200
NOTHING: Final = Wish()


def asks(wish: Wish) -> bool:
    """Say whether a wish asks for any motion."""
    return wish != NOTHING


@dataclass(slots=True, kw_only=True)
class Steering:
    """One human's hand on one session; ticks are the cell's.

    Attributes:
        grant: What they drive under.
        plan: What they are watched by.
        alone: Whether the session is nothing but this driving.
        lease: By which the newest command came.
        number: Of the newest command.
        refused: Why the newest command was not done; empty where it was.
        armed: Whether a motion may begin: nothing was wanted since whatever stopped or refused the last one.
        stopped_by: The rule that stopped the motion and still stands in its way.
        leavable: Whether a new motion may lead out of that, or it has to end by itself.
        blocked: By rule, its signal, and how far it was violated when it stopped the motion first.
        asked: The newest command as it came, done or not; nothing once it has expired.
    """

    grant: Grant
    plan: WatchPlan
    alone: bool
    period_s: float
    lease: str = ""
    actor: str = ""
    number: int = -1
    refused: str = ""
    armed: bool = False
    stopped_by: str = ""
    leavable: bool = False
    blocked: dict[str, tuple[str, float]] = field(default_factory=dict[str, tuple[str, float]])
    asked: Wish = NOTHING
    _wish: Wish = NOTHING
    _expires: int = 0
    _asked_until: int = 0
    _silent: float = math.inf  # the tick at which the newest motion counts as let go of
    _told: tuple[object, ...] = ()
    _tell_again: int = 0

    def wish(self, tick: int) -> Wish:
        """Return what counts in a tick: the newest command that was taken, until it expires."""
        if tick >= self._expires:
            self._wish = NOTHING
        if tick >= self._asked_until:
            self.asked = NOTHING
        if tick >= self._silent:
            self.rest()
        return self._wish

    def come_by(self, lease: str) -> None:
        """Note by which lease a command comes: under a new one nothing is wanted yet."""
        if lease != self.lease:
            self.lease = lease
            self.rest()

    def hear(self, wish: Wish, number: int, actor: str, tick: int) -> None:
        """Note a command and who sent it, whatever becomes of it."""
        self.asked, self.number, self.actor = wish, number, actor
        self._asked_until = self._after(EXPIRES_MS, tick)

    def take(self, wish: Wish, tick: int) -> None:
        """Let a command count from now on."""
        self.refused, self._wish = "", wish
        self._expires = self._after(EXPIRES_MS, tick)
        if asks(wish):
            self._silent = self._after(SILENT_MS, tick)
        else:
            self.armed, self._silent = True, math.inf

    def refuse(self, why: str, *, later: bool = False) -> None:
        """Do not do what is wanted: nor later, once nothing is in its way, unless it only has to wait (`later`)."""
        if not later:
            self.rest()
        self.refused, self._wish = why, NOTHING

    def rest(self) -> None:
        """Want nothing, and nothing again until the key was let go of."""
        self._wish, self.armed, self._silent = NOTHING, False, math.inf

    def stop(self, rule: str, *, leavable: bool) -> bool:
        """Stand still for a rule; return whether that is news."""
        news = self.stopped_by != rule
        self.stopped_by, self.leavable = rule, leavable
        if news:
            self.rest()
        return news

    def news(self, tick: int, undone: str) -> bool:
        """Say whether what is wanted, or why it is not done, is another kind of thing than was told last, and due."""
        kind = (*(_sign(value) for value in (*self._wish.base, *self._wish.tool)), self._wish.grip, undone)
        if kind == (self._told or _AT_FIRST) or tick < self._tell_again:
            return False
        self._told, self._tell_again = kind, self._after(TELL_EVERY_MS, tick)
        return True

    def _after(self, ms: int, tick: int) -> int:
        return tick + round(ms / (1000.0 * self.period_s))


def _sign(value: float) -> int:
    return (value > 0.0) - (value < 0.0)


_AT_FIRST: Final = (0, 0, 0, 0, 0, 0, None, "")
