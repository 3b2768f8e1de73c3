"""The register: every invocation that is not final, in memory, and the one way its changes become durable and visible.

A change is made under the invocation's lock: the next version is computed, its row and the events that caused it are
appended in one transaction, and only then the version in memory moves on and whoever waits is woken. If the append
fails, nothing has changed.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from app.audit.errors import RecordUnavailable, RowUnreadable
from app.audit.event import EventDraft
from app.clock import rfc3339
from app.governance.model import SESSION, TERMINAL, EventKind, Status
from app.runtime.drafts import SERVER
from app.runtime.errors import NotFound
from app.runtime.invocation import read_invocation
from app.runtime.recollection import events_of, invocation_of
from app.runtime.stored import Stored
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from app.audit.event import RowWrite
    from app.audit.store import AuditStore
    from app.runtime.invocation import Invocation

MAX_UNSAID: Final = 1000
LEFT_OUT: Final = {"what": "left_out"}  # words of which there were more than could wait, and how many
UNFINISHED: Final = tuple(status.value for status in Status if status not in TERMINAL)


@dataclass(slots=True, kw_only=True)
class Entry:
    """A live invocation: its newest durable version, the lock its changes take, and who waits for the next."""

    newest: Invocation
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def tell(self) -> None:
        """Wake whoever waits for the next version."""
        self.changed.set()
        self.changed = asyncio.Event()


class Register:
    """Live invocations of one server, and appending on their behalf."""

    def __init__(self, store: AuditStore, wall_s: Callable[[], float]) -> None:
        """Take the store and the wall clock."""
        self.store = store
        self.stored = Stored()
        self._wall_s = wall_s
        self._live: dict[str, Entry] = {}
        self._unsaid: list[EventDraft] = []  # what the record could not take yet
        self._lost = 0  # words that it will never take: there were too many
        self._saying = asyncio.Lock()
        self.unfounded: dict[str, str] = {}  # rows that said, at the start, something else than the log: what
        self.on_final: Callable[[Invocation], None] = lambda _: None
        self.on_ending: Callable[[Invocation], tuple[EventDraft, RowWrite, Callable[[], None]] | None] = lambda _: None
        self.on_shown: Callable[[Invocation], None] = lambda _: None

    def now(self) -> str:
        """Return the wall time as text."""
        return rfc3339(self._wall_s())

    def now_s(self) -> float:
        """Return the wall time in seconds."""
        return self._wall_s()

    def live(self) -> list[Invocation]:
        """Return the newest version of everything not final."""
        return [entry.newest for entry in self._live.values()]

    def newest(self, invocation: str) -> Invocation | None:
        """Return a live invocation's newest version."""
        entry = self._live.get(invocation)
        return None if entry is None else entry.newest

    def under_way(self, invocation: str) -> bool:
        """Say whether an invocation was launched and is not over."""
        known = self.newest(invocation)
        return known is not None and known.status in SESSION

    def entry(self, invocation: str) -> Entry | None:
        """Return a live invocation's entry, to lock it."""
        return self._live.get(invocation)

    async def recall(self) -> None:
        """Read back what an earlier run of the server left unfinished, as the log has it."""
        cursor: str | None = None
        while True:
            page = await self.store.page("invocations", {"status": UNFINISHED}, limit=500, cursor=cursor)
            for row in page.items:
                try:
                    stored = self.stored.read("invocations", row, read_invocation)
                except RowUnreadable as error:
                    self.unfounded[row["id"]] = error.problem
                    continue
                invocation, wrong = invocation_of(row, stored, await events_of(self.store, invocation=row["id"]))
                if wrong:
                    self.unfounded[row["id"]] = wrong
                if invocation is not None and not invocation.final:
                    self._live[invocation.id] = Entry(newest=invocation)
            cursor = page.next
            if cursor is None:
                return

    def check_undamaged(self) -> None:
        """Refuse what would have anything move on a record that holds no more. Raises `RecordUnavailable`."""
        if (damage := self.store.damage) is not None:
            raise RecordUnavailable(f"the log is damaged, so nothing moves: {damage}")

    def trouble(self) -> str | None:
        """Say which rows, when the server started, were not what the log says."""
        if not self.unfounded:
            return None
        named = "; ".join(f"`{name}`: {what}" for name, what in sorted(self.unfounded.items()))
        return f"{named}; since this server started the log holds in its place; valid: look with `reins audit verify`"

    async def newest_ones(self, limit: int) -> list[Invocation]:
        """Return the invocations proposed last, newest first, final or not."""
        page = await self.store.page("invocations", limit=limit)
        return self.stored.those_of("invocations", page.items, read_invocation)

    async def append(
        self, drafts: Sequence[EventDraft], rows: Sequence[RowWrite] = (), versions: Sequence[Invocation] = ()
    ) -> Sequence[int]:
        """Make events, rows and new versions durable together, then let the versions be seen. Returns the places.

        Raises:
            RecordUnavailable: nothing is known to be recorded, and nothing has changed; a start may find it in the log.
            RowExists: a row that is written once is there already; nothing has changed.
        """
        # What follows from an end is recorded with it: the event and the row, and then what they change in memory.
        follows = [found for version in versions if version.final and (found := self.on_ending(version)) is not None]
        rows = [*rows, *[version.row() for version in versions]]
        seqs = await self.store.append(
            [*drafts, *[draft for draft, _, _ in follows]] if follows else drafts,
            [*rows, *[row for _, row, _ in follows]] if follows else rows,
        )
        for version in versions:
            self._show(version)
        for _, _, done in follows:
            done()
        return seqs[: len(drafts)]

    async def say(self, *drafts: EventDraft) -> bool:
        """Record what has happened already: now, or as soon as the record takes it. Returns whether it is in.

        For what restrains and for notices, which a record that fails must not stand in the way of.
        """
        self._unsaid.extend(drafts)
        return await self.say_unsaid()

    @uncut
    async def say_unsaid(self) -> bool:
        """Record what is left unsaid; returns whether nothing is. What waits is stamped with when it was said.

        Only so much waits; how many words were given up for newer ones is recorded in their place.
        """
        async with self._saying:  # what somebody else is having recorded may be left unsaid yet
            unsaid, self._unsaid = self._unsaid, []
            if not unsaid:
                return True
            now, lost = self.now(), self._lost
            told = [] if not lost else [EventDraft(kind=EventKind.CELL, actor=SERVER, body={**LEFT_OUT, "count": lost})]
            try:
                await self.append([*told, *unsaid])
            except RecordUnavailable:
                stamped = [replace(draft, body={"said_at": now, **draft.body}) for draft in unsaid]
                waiting = [*stamped, *self._unsaid]
                self._unsaid = waiting[-MAX_UNSAID:]
                self._lost += len(waiting) - len(self._unsaid)
                return False
            self._lost -= lost
            return True

    def unsaid(self) -> list[str]:
        """Return what happened and is not in the record, one line each."""
        return [f"{draft.kind} {draft.invocation or ''}".rstrip() for draft in self._unsaid]

    async def load(self, invocation: str) -> Invocation:
        """Return the newest durable version, from memory or from the store.

        Raises:
            NotFound: there is none.
            RowUnreadable: it is damaged.
        """
        entry = self._live.get(invocation)
        if entry is not None:
            return entry.newest
        row = await self.store.row("invocations", id=invocation)
        if row is None:
            raise NotFound("invocation", invocation)
        return self.stored.read("invocations", row, read_invocation)

    async def wait(self, invocation: str, seconds: float, known_updated_at: str | None) -> Invocation:
        """Return the invocation at its next change, at once if `known_updated_at` is past, or after the time.

        Raises:
            NotFound: there is none.
        """
        entry = self._live.get(invocation)
        if entry is None:
            return await self.load(invocation)
        if known_updated_at is None or entry.newest.updated_at == known_updated_at:
            changed = entry.changed
            try:
                async with asyncio.timeout(seconds):
                    await changed.wait()
            except TimeoutError:
                return entry.newest
        return entry.newest

    def wake(self) -> None:
        """Have everybody who waits for a change look, though there was none."""
        for entry in self._live.values():
            entry.tell()

    def _show(self, version: Invocation) -> None:
        self.on_shown(version)
        entry = self._live.get(version.id)
        if entry is None:
            if not version.final:
                self._live[version.id] = Entry(newest=version)
            return
        entry.newest = version
        entry.tell()
        if version.final:
            del self._live[version.id]
            self.on_final(version)
