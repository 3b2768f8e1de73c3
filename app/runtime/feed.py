"""The feed: committed events, fanned out to whoever listens, none lost and none twice.

Each listener has a bounded queue. One that does not keep up is closed, and comes back with the last `seq` it has seen:
what it missed is read from the log, and joined to what is live without a seam. Nobody slow can hold the others up.
"""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from app.audit.errors import AuditError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Generator

    from app.audit.event import Event
    from app.audit.store import AuditStore

MAX_WAITING: Final = 2048
MAX_WAITING_BYTES: Final = 16_000_000  # an event may be as long as a request's body
PAGE: Final = 500


class Subscription:
    """One listener: iterate it for batches of events in order; it ends when it fell behind or the feed closed."""

    def __init__(self, store: AuditStore, after: int | None) -> None:
        """Listen from the event behind `after`; None is from now on."""
        self._store = store
        self._after = after
        self._waiting: deque[Event] = deque()
        self._bytes = 0
        self._more = asyncio.Event()
        self.closed = False

    def push(self, events: tuple[Event, ...]) -> None:
        """Take events that were just committed; a queue that is full closes."""
        if self.closed:
            return
        size = self._bytes + sum(len(event.body) for event in events)
        if len(self._waiting) + len(events) > MAX_WAITING or (self._waiting and size > MAX_WAITING_BYTES):
            self.close()
            return
        self._waiting.extend(events)
        self._bytes = size
        self._more.set()

    def close(self) -> None:
        """End it; what waits is dropped, the listener resumes from the last `seq` it has seen."""
        self.closed = True
        self._take()
        self._more.set()

    def _take(self) -> list[Event]:
        """Return what waits, which waits no longer."""
        taken, self._bytes = list(self._waiting), 0
        self._waiting.clear()
        return taken

    async def __aiter__(self) -> AsyncIterator[list[Event]]:
        """Yield events in batches: first what the log holds already, then what is committed."""
        seen = self._after
        if seen is not None:
            async for batch in self._backlog(seen):
                seen = batch[-1].seq
                yield batch
        while not self.closed:
            await self._more.wait()
            self._more.clear()
            batch = [event for event in self._take() if seen is None or event.seq > seen]
            if batch:
                seen = batch[-1].seq
                yield batch

    async def _backlog(self, after: int) -> AsyncIterator[list[Event]]:
        """Read the log up to where the live events begin; those commit to the queue meanwhile."""
        while not self.closed:
            if self._waiting and self._waiting[0].seq <= after + 1:
                return
            batch = await self._page(after)
            if not batch:
                return
            after = batch[-1].seq
            yield batch

    async def _page(self, after: int) -> list[Event]:
        """Read on in the log; where a page holds what cannot be read, event by event up to that, which raises."""
        try:
            return await self._store.events(after=after, limit=PAGE)
        except AuditError:
            return await self._store.events(after=after, limit=1)


class Feed:
    """Fans out what the store commits."""

    def __init__(self, store: AuditStore) -> None:
        """Listen to a store."""
        self._store = store
        self._subscriptions: set[Subscription] = set()
        self._closed = False
        self._end: Callable[[], None] = store.subscribe(self._publish)

    def _publish(self, events: tuple[Event, ...]) -> None:
        for subscription in tuple(self._subscriptions):
            subscription.push(events)

    @contextmanager
    def subscribe(self, *, after: int | None = None) -> Generator[Subscription]:
        """Listen inside the context: from the event behind `after` (a `seq`), or from now on.

        Once the feed is closed, what is returned has ended: whoever came for more would be waited for by the door.
        """
        subscription = Subscription(self._store, after)
        self._subscriptions.add(subscription)
        if self._closed:
            subscription.close()
        try:
            yield subscription
        finally:
            self._subscriptions.discard(subscription)
            subscription.close()

    def close(self) -> None:
        """End every subscription, and those that are asked for from now on."""
        self._closed = True
        self._end()
        for subscription in tuple(self._subscriptions):
            subscription.close()
