"""What policy has against sessions under way: the one in force, those before it, and who has yet to say that it holds.

A question about a held session says what the policy in force has against its going on, and nothing of what only one
before it had (`Desk.outdated`). `Succession` compares sessions and tells them to hold; here is what it found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    Why = dict[str, str]  # a reason as documents have it


class Departures:
    """How sessions depart, by invocation."""

    def __init__(self) -> None:
        """Know of none."""
        self._standing: dict[str, tuple[Why, ...]] = {}
        self._over: dict[str, tuple[Why, ...]] = {}
        self._told_s: dict[str, float] = {}

    def standing(self, session: str) -> tuple[Why, ...] | None:
        """Return why a session departs from the policy in force; None where it was found not to, or let go on."""
        return self._standing.get(session)

    def over(self, session: str) -> tuple[Why, ...]:
        """Return why it departed from a policy before this one, and does not from this."""
        return self._over.get(session, ())

    def misstated(self, session: str, reasons: Sequence[Mapping[str, str]]) -> bool:
        """Say whether these reasons leave out what stands against a session, or have what is over."""
        unsaid = any(why not in reasons for why in self._standing.get(session, ()))
        return unsaid or any(why in reasons for why in self.over(session))

    # -- comparing ---------------------------------------------------------------------------------------------------

    def conform(self, session: str, reasons: Sequence[Why]) -> None:
        """Note that a session departs for no other reasons than these any more; for none, it need not hold."""
        before = (*self.over(session), *self._standing.pop(session, ()))
        self._over[session] = _but(before, reasons)
        if not reasons:
            self.holds(session)

    def depart(self, session: str, reasons: Iterable[Why], told_s: float | None = None) -> None:
        """Note why a session departs, and when it was told to hold (`clock.monotonic_s`), if it was told so now."""
        self._standing[session] = tuple(reasons)
        if told_s is not None:
            self._told_s[session] = told_s

    def recall(self, session: str, now: Iterable[Why], ever: Iterable[Why]) -> None:
        """Take back what was said before a start: what stands `now` joins what was found since, `ever` is all of it."""
        standing = _each(*self._standing.get(session, ()), *now)
        if standing:
            self._standing[session] = standing
        self._over[session] = _but(_each(*ever), standing)

    # -- answering ---------------------------------------------------------------------------------------------------

    def ask(self, session: str, reasons: Sequence[Why]) -> None:
        """Note that the policy in force has people asked for these reasons: they are not over.

        Else an answer would be refused for saying them, and for not saying them.
        """
        self._over[session] = _but(self.over(session), reasons)

    def let_go(self, session: str, answered: tuple[Why, ...] | None) -> None:
        """Note a human's word on what was `answered`; what another policy has against it since stands."""
        if self._standing.get(session) is answered:
            self._standing.pop(session, None)

    # -- holding -----------------------------------------------------------------------------------------------------

    def telling(self) -> tuple[tuple[str, float], ...]:
        """Return the sessions that have not said that they hold, and when each was told last."""
        return tuple(self._told_s.items())

    def tell(self, session: str, told_s: float) -> None:
        """Note that a session was told to hold once more."""
        self._told_s[session] = told_s

    def holds(self, session: str) -> None:
        """Note that a session holds, or is over: whoever lets it go on, or takes it over, need not wait to be seen."""
        self._told_s.pop(session, None)

    # -- forgetting --------------------------------------------------------------------------------------------------

    def sessions(self) -> frozenset[str]:
        """Return the sessions of which anything is known."""
        return frozenset((*self._standing, *self._over))

    def forget(self, session: str) -> None:
        """Forget a session that is over."""
        self._standing.pop(session, None)
        self._over.pop(session, None)


def _but(reasons: Iterable[Why], without: Sequence[Why]) -> tuple[Why, ...]:
    return tuple(why for why in reasons if why not in without)


def _each(*reasons: Why) -> tuple[Why, ...]:
    """Return reasons, each once."""
    found: list[Why] = []
    for why in reasons:
        if why not in found:
            found.append(dict(why))
    return tuple(found)
