"""What waits for a verdict, in the order in which people are shown it: the higher risk first, then the oldest.

However much waits, no more than so many of the first are held in memory, and the number of all. The rest is in the
record, and is read from there before those that are held are too few to be shown.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING, Final

from app.governance.model import Risk

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from app.runtime.review import Review

Rank = tuple[int, str, str]
GRAVEST_FIRST: Final = {risk.value: -place for place, risk in enumerate(Risk)}


def rank(review: Review) -> Rank:
    """Return where a review stands; a console's page puts them in the same order."""
    # Nobody signs a row: what a damaged one holds has a place as well.
    return GRAVEST_FIRST.get(str(review.risk), 1), str(review.created_at), str(review.id)


class Queue:
    """The first of the reviews that wait, and how many there are."""

    def __init__(self, most: int) -> None:
        """Hold nothing, and never more than `most`."""
        self._most = most
        self._order: list[Rank] = []
        self._held: dict[str, Review] = {}
        self._beyond = 0  # wait in the record alone; each of them comes behind all that are held

    def __len__(self) -> int:
        """Return how many wait, those included that are not held."""
        return len(self._order) + self._beyond

    def first(self, count: int) -> list[Review]:
        """Return the first that wait, as far as they are held."""
        return [self._held[name] for _, _, name in self._order[:count]]

    def short_of(self, count: int) -> bool:
        """Say whether more would be shown if they were read from the record."""
        return self._beyond > 0 and len(self._order) < count

    def add(self, review: Review) -> None:
        """Take one that has come to wait."""
        place = rank(review)
        if self._beyond and not (self._order and place < self._order[-1]):
            self._beyond += 1
            return
        insort(self._order, place)
        self._held[review.id] = review
        self._trim()

    def remove(self, review: Review) -> None:
        """Let go of one that has its verdict."""
        if self._held.pop(review.id, None) is None:
            self._beyond = max(0, self._beyond - 1)
        else:
            del self._order[bisect_left(self._order, rank(review))]

    def replace(self, best: Iterable[Review], waiting: Collection[str]) -> None:
        """Take what the record says: the first that wait, as many as may be held or more, and the names of all."""
        self._held = {review.id: review for review in best}
        self._order = sorted(rank(review) for review in self._held.values())
        self._beyond = len(waiting) - len(self._order)
        self._trim()

    def _trim(self) -> None:
        while len(self._order) > self._most:
            del self._held[self._order.pop()[2]]
            self._beyond += 1
