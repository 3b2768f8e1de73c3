"""The broadcast: what every console is shown, encoded once for all of them.

Committed events, and the newest documents of whatever changed, collect for a moment and leave as one text for
everybody. A console joins at such a moment as well: what is due goes to those who are there, then the newcomers get
one snapshot, and from the next update on all get the same. Nothing is awaited in between, so no event is missed and
none comes twice.

The last events are kept in memory, so that a console that comes back with the last `seq` it saw misses none of them.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import OrderedDict, deque
from math import inf
from typing import TYPE_CHECKING, Any, Final

import orjson

from app.clock import monotonic_s, wall_s
from app.runtime.outlet import Key, Outlet
from app.runtime.shortened import shown_event, shown_invocation

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from app.audit.event import Event
    from app.audit.store import AuditStore
    from app.runtime.cells import Cell
    from app.runtime.desk import Desk
    from app.runtime.escalation import Escalation
    from app.runtime.fleet import Fleet
    from app.runtime.grant import Standing
    from app.runtime.invocation import Invocation
    from app.runtime.register import Register
    from app.runtime.review import Review

TICK_S: Final = 0.033
FLOOD_TICK_S: Final = 0.2  # while much ends that nobody saw begin: a line in a log is read no sooner
GATHER_S: Final = 0.004  # documents become visible right behind their events: let them leave together
BEAT_S: Final = 0.2
LONG_UPDATE: Final = 2048  # bytes; a third of what may be under way when a frame of poses leaves
REFRESH_S: Final = 1.0  # facts and gauges of a cell that otherwise has not changed
KEPT_BEATS: Final = 1024  # for as long as anything may be on its way that names one; a long update is a beat, too
KEPT_EVENTS: Final = 2000
SHOWN_EVENTS: Final = 200
SNAPSHOT_BYTES: Final = 8 * 1024 * 1024  # of events: a console has to take it before it falls behind
SHOWN_INVOCATIONS: Final = 20
PAGE: Final = 1000
GOING_AWAY: Final = 1001
FAILED: Final = 1011


class Broadcast:
    """Tells all consoles of one server what has become durable, and what things are like now."""

    def __init__(self, store: AuditStore, register: Register, desk: Desk, fleet: Fleet) -> None:
        """Listen to the record, the register, the desk and the fleet."""
        self._store, self._register, self._desk, self._fleet = store, register, desk, fleet
        self._events: deque[Event] = deque(maxlen=KEPT_EVENTS)
        self._fresh: list[Event] = []
        self._invocations: dict[str, Invocation] = {}
        self._living: set[str] = set()  # invocations that consoles were shown and believe to be under way
        self._newest: OrderedDict[str, Invocation] = OrderedDict()
        self._escalations: dict[str, Escalation] = {}
        self._grants: dict[str, Standing] = {}
        self._reviews: dict[str, Review] = {}
        self._queued = False  # how many reviews wait may have changed
        self._cells: dict[str, Mapping[str, Any]] = {}  # as consoles were told of them; empty: to be told anew
        self._consoles: set[Outlet] = set()
        self._joining: dict[Outlet, int | None] = {}
        self._due: asyncio.TimerHandle | None = None
        self._due_s = self._flushed_s = self._refreshed_s = 0.0
        self._tick_s = TICK_S
        self._beats = 0
        self._beaten_s: deque[float] = deque(maxlen=KEPT_BEATS)  # when the newest were said; the last is `_beats`
        self.seq = 0
        self.boot = f"boot_{secrets.token_hex(8)}"
        self._leave = store.subscribe(self._committed)
        register.on_shown = self._shown
        desk.on_held = self._held
        desk.grants.on_changed = self._granted
        desk.reviews.on_changed = self._reviewed
        fleet.on_stated = self._stated

    async def open(self) -> None:
        """Read what the log and the invocations were before this run; call it once, right after the start."""
        after = max(0, self._store.size - KEPT_EVENTS)
        older: list[Event] = []
        first = self._events[0].seq if self._events else None
        while page := await self._store.events(after=after, limit=PAGE):
            older.extend(shown_event(event) for event in page if first is None or event.seq < first)
            after = page[-1].seq
            if first is not None and after >= first:
                break
        live, self._events = self._events, deque(older, KEPT_EVENTS)
        self._events.extend(event for event in live if not older or event.seq > older[-1].seq)
        self.seq = self._events[-1].seq if self._events else 0
        newest = {known.id: known for known in reversed(await self._register.newest_ones(SHOWN_INVOCATIONS))}
        self._newest = OrderedDict({**newest, **self._newest})

    async def run(self) -> None:
        """Beat, and look after cells that have fallen silent, for ever."""
        while True:
            await asyncio.sleep(BEAT_S)
            self.beat()

    def close(self) -> None:
        """End every console."""
        self._leave()
        if self._due is not None:
            self._due.cancel()
        self._end(GOING_AWAY, "the server stops")

    # -- consoles ----------------------------------------------------------------------------------------------------

    def join(self, outlet: Outlet, after: int | None) -> None:
        """Send a console a snapshot, and every update from then on.

        Args:
            outlet: where to.
            after: the last `seq` it saw; the snapshot then holds every event behind it that is kept.
        """
        self._joining[outlet] = after
        self._schedule()

    def leave(self, outlet: Outlet) -> None:
        """Forget a console."""
        self._consoles.discard(outlet)
        self._joining.pop(outlet, None)

    def beat(self) -> None:
        """Say to every console that the server lives, and what became of cells that say nothing."""
        self._look_at_cells()
        if not self._consoles:
            return
        number = self._next_beat()
        beat = orjson.dumps({"type": "beat", "n": number, "at": wall_s(), "seq": self._told()}).decode()
        for outlet in tuple(self._consoles):
            outlet.say(beat, ("beat", number))
        self._drop_ended()

    def since_beat_s(self, number: int) -> float:
        """Return how long ago a beat was said, in seconds; infinity of one that was not, or too long ago."""
        back = self._beats - number
        return monotonic_s() - self._beaten_s[-1 - back] if 0 <= back < len(self._beaten_s) else inf

    def _next_beat(self) -> int:
        self._beats += 1
        self._beaten_s.append(monotonic_s())
        return self._beats

    def _told(self) -> int:
        return self._fresh[0].seq - 1 if self._fresh else self.seq

    # -- what changes ------------------------------------------------------------------------------------------------

    def _committed(self, events: tuple[Event, ...]) -> None:
        shown = [shown_event(event) for event in events]
        self._events.extend(shown)
        self.seq = events[-1].seq
        if self._consoles:
            self._fresh.extend(shown)
            self._schedule(self._tick_s)

    def _shown(self, version: Invocation) -> None:
        newest = self._newest
        if version.id not in newest and len(newest) >= SHOWN_INVOCATIONS:
            newest.popitem(last=False)
        newest[version.id] = version
        if self._consoles:
            self._invocations[version.id] = version
            self._schedule(TICK_S if self._followed(version) else self._tick_s)

    def _held(self, version: Escalation) -> None:
        if self._consoles:
            self._escalations[version.id] = version
            self._schedule()

    def _granted(self, version: Standing) -> None:
        if self._consoles:
            self._grants[version.id] = version
            self._schedule()

    def _reviewed(self, versions: Sequence[Review]) -> None:
        if self._consoles:
            self._reviews.update((version.id, version) for version in versions)
            self._queued = True
            self._schedule()

    def _stated(self, cell: Cell) -> None:
        if self._consoles and self._changed(cell.id, self._fleet.document(cell)):
            self._schedule()

    def _look_at_cells(self) -> None:
        """Notice what changes without a word: a cell that came, left, fell silent, or is known no more."""
        if not self._consoles:
            return
        now_s = monotonic_s()
        refresh = now_s - self._refreshed_s >= REFRESH_S
        if refresh:
            self._refreshed_s = now_s
        for cell in self._fleet.cells():
            if refresh or self._changed(cell.id, self._fleet.document(cell)):
                self._cells[cell.id] = {}
                self._schedule()
        if self._forgotten_cells():
            self._schedule()

    def _changed(self, cell: str, document: Mapping[str, Any]) -> bool:
        return _steady(document) != self._cells.get(cell)

    # -- telling -----------------------------------------------------------------------------------------------------

    def _schedule(self, tick_s: float = TICK_S) -> None:
        """Let what is due leave so long after what left last, at the earliest."""
        due_s = max(monotonic_s() + GATHER_S, self._flushed_s + tick_s)
        if self._due is not None:
            if self._due_s <= due_s:
                return
            self._due.cancel()
        self._due_s = due_s
        self._due = asyncio.get_running_loop().call_later(due_s - monotonic_s(), self._flush)

    def _flush(self) -> None:
        self._due = None
        self._flushed_s = monotonic_s()
        try:
            update = self._update()
            if update is not None:
                self._tell(update)
            self._welcome()
        except Exception as error:  # beats would go on vouching for what is shown, and it is not what is
            self._end(FAILED, f"what changed could not be told ({type(error).__name__}): come back for a snapshot")
            self._joining = {}
            self._forget()
            raise
        finally:
            self._drop_ended()

    def _update(self) -> bytes | None:
        parts: list[bytes] = []
        if not self._consoles:
            self._living.clear()
            self._forget()
            return None
        if self._fresh:
            parts.append(b'"events":' + _events(self._fresh))
        if invocations := self._changed_invocations():
            parts.append(b'"invocations":' + _array(map(shown_invocation, invocations)))
        for name, changed in (
            (b"escalations", self._escalations),
            (b"grants", self._grants),
            (b"reviews", self._reviews),
        ):
            if changed:
                parts.append(b'"%s":' % name + orjson.dumps([one.public() for one in changed.values()]))
        if self._queued:
            parts.append(b'"reviews_waiting":%d' % self._desk.reviews.count)
        parts += self._of_cells()
        self._forget()
        return b",".join(parts) or None

    def _of_cells(self) -> list[bytes]:
        told = {b"cells": _array(self._changed_cells()), b"cells_gone": orjson.dumps(self._forgotten_cells())}
        return [b'"%s":' % name + those for name, those in told.items() if those != b"[]"]

    def _tell(self, update: bytes) -> None:
        """Tell what changed; what is long is a beat as well, so that poses wait for no other to be acknowledged."""
        mark: Key | None = None
        head = b'{"type":"update","seq":%d,' % self.seq
        if len(update) > LONG_UPDATE:
            number = self._next_beat()
            mark, head = ("beat", number), head + b'"beat":%d,' % number
        text = (head + update + b"}").decode()
        for outlet in tuple(self._consoles):
            outlet.say(text, mark)

    def _forget(self) -> None:
        for cell in self._forgotten_cells():
            del self._cells[cell]
        self._fresh, self._invocations, self._escalations = [], {}, {}
        self._grants, self._reviews, self._queued = {}, {}, False

    def _followed(self, version: Invocation) -> bool:
        """Say whether consoles know of it or will see it go on: of what ended before they could, events tell."""
        return not version.final or version.id in self._living

    def _changed_invocations(self) -> list[Invocation]:
        """Return what consoles follow, and the newest of the others; a flood of those is told less often."""
        followed = [one for one in self._invocations.values() if self._followed(one)]
        others = [one for one in self._invocations.values() if not self._followed(one)]
        self._tick_s = FLOOD_TICK_S if len(others) >= SHOWN_INVOCATIONS else TICK_S
        self._living.difference_update(one.id for one in followed if one.final)
        self._living.update(one.id for one in followed if not one.final)
        return followed + others[-SHOWN_INVOCATIONS:]

    def _changed_cells(self) -> list[bytes]:
        """Return the cells that changed; one that says more than it may is told of later, as it is by then."""
        changed: list[bytes] = []
        for cell in self._fleet.cells():
            document = self._fleet.document(cell)
            if self._changed(cell.id, document) and cell.shown.owed_s() <= 0:
                self._cells[cell.id] = _steady(document)
                changed.append(orjson.dumps(document))
                cell.shown.spend(len(changed[-1]))
        return changed

    def _forgotten_cells(self) -> list[str]:
        """Return the cells that consoles were told of, and that are known no more."""
        return [cell for cell in self._cells if cell not in self._fleet.roster]

    def _welcome(self) -> None:
        if not self._joining:
            return
        documents = self._documents()
        for outlet, after in self._joining.items():
            if outlet.ended is None:
                events = _events(self._behind(after))
                outlet.say((b'{"type":"snapshot","seq":%d,"events":' % self.seq + events + documents).decode())
                self._consoles.add(outlet)
        self._joining = {}

    def _behind(self, after: int | None) -> list[Event]:
        """Return what a console has not seen: as much as is kept, or fits."""
        kept = list(self._events)
        if after is None or after > self.seq:  # a `seq` this log has not reached is another log's
            kept, after = kept[-SHOWN_EVENTS:], 0
        room = SNAPSHOT_BYTES
        for place in range(len(kept) - 1, -1, -1):
            room -= len(kept[place].body)
            if room < 0 or kept[place].seq <= after:
                return kept[place + 1 :]
        return kept

    def _documents(self) -> bytes:
        cells = [self._fleet.document(cell) for cell in self._fleet.cells()]
        self._cells = {document["id"]: _steady(document) for document in cells}
        living = {one.id: one for one in self._register.live()}
        self._living.update(living)
        invocations = {**self._newest, **living}
        documents = {
            "cells": cells,
            "invocations": orjson.Fragment(_array(map(shown_invocation, invocations.values()))),
            "escalations": [one.public() for one in self._desk.pending()],
            "grants": [one.public() for one in self._desk.grants.active()],
            "reviews": [one.public() for one in self._desk.reviews.waiting()],
            "reviews_waiting": self._desk.reviews.count,
        }
        return b"," + orjson.dumps(documents)[1:]

    def _end(self, code: int, reason: str) -> None:
        for outlet in (*self._consoles, *self._joining):
            outlet.end(code, reason)

    def _drop_ended(self) -> None:
        self._consoles = {outlet for outlet in self._consoles if outlet.ended is None}


def _events(events: Iterable[Event]) -> bytes:
    """Return events as a JSON array; each is in the bytes that were hashed, or shortened."""
    return _array(event.body for event in events)


def _array(items: Iterable[bytes]) -> bytes:
    return b"[" + b",".join(items) + b"]"


def _steady(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what of a cell's document is worth an update at once: all but what its sensors read."""
    return {name: value for name, value in document.items() if name not in {"facts", "gauges"}}
