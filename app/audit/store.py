"""The durable store on the event loop: group commit, subscribers, health, and reads that do not block it.

Callers await `append`. The first one starts a batch, whoever comes until the loop gets to it joins. The batch is made
ready on the event loop, inserted and committed in one thread of its own; meanwhile the next batch collects. So it grows
with the load and nobody waits for a window to pass. Callers are answered when their events are on the disk, subscribers
right before them; the checkpoint goes into the file outside meanwhile. Only when it stands there is the next batch
closed, for it could not be committed before: who was answered and asks again is in it, and a slow disk is waited for
half as often.
"""

from __future__ import annotations

import asyncio
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from app.audit.errors import AuditError, EventUnreadable, RecordDamaged, RecordUnavailable, RowExists
from app.audit.event import Event, EventDraft, RowWrite, Submission, prepare_all
from app.audit.examination import WITHIN_S as EXAMINE_WITHIN_S
from app.audit.examination import Examination, examine
from app.audit.ledger import Ledger, Staged, describe, probe
from app.audit.places import Places
from app.audit.reader import EventFilters, Page, Reader, Row
from app.audit.rows import check_row
from app.audit.searching import Found, Words, search
from app.audit.verification import Progress, Verification, verify_log
from app.clock import monotonic_s, rfc3339, wall_s
from app.disk import full

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence
    from pathlib import Path

    from app.audit.checkpoint import Verifier

T = TypeVar("T")

MAX_BATCH_EVENTS = 512  # bounds how long one batch keeps the event loop
MAX_WAITING = 10_000
PROBE_AFTER_S = 1.0
PAUSE_S = 0.0005  # in which whoever reads all of the log steps aside, again and again


class AuditStore:
    """The record of one server: append, read, verify, subscribe."""

    def __init__(self, ledger: Ledger) -> None:
        """Take an opened ledger; `AuditStore.open` is the usual way."""
        self._ledger = ledger
        self.places = ledger.places
        self._reader = Reader(ledger.places.database)
        self._committer = ThreadPoolExecutor(1, thread_name_prefix="audit-commit")
        self._readers = ThreadPoolExecutor(1, thread_name_prefix="audit-read")
        self._searchers = ThreadPoolExecutor(1, thread_name_prefix="audit-search")  # who reads waits for no search
        self._waiting: deque[tuple[Submission, asyncio.Future[list[int]]]] = deque()
        self._writing = False
        self._closed = False
        self._idle: asyncio.Future[None] | None = None
        self._probe: asyncio.TimerHandle | None = None
        self._reason: str | None = None
        self._wrote_s = 0.0
        self.damage: str | None = None
        """What the last examination found wrong with the log itself; nothing may move on such a record."""
        self._subscribers: list[Callable[[tuple[Event, ...]], None]] = []

    @classmethod
    def open(cls, data_dir: Path, *, progress: Progress | None = None) -> AuditStore:
        """Open or create the log in a data directory, and verify all of it; blocks, so call it at start.

        Args:
            data_dir: the directory.
            progress: told how many events are verified, and of how many.

        Raises:
            RecordUnavailable: the directory or the database cannot be written.
            RecordDamaged: what is stored contradicts its signatures, or parts of it are missing.
            StoreInUse: another process writes here.
        """
        return cls(Ledger(Places(data_dir), progress=progress))

    async def close(self) -> None:
        """Finish what was handed over, then let go of everything."""
        self._closed = True
        if self._probe is not None:
            self._probe.cancel()
        if self._writing:
            self._idle = asyncio.get_running_loop().create_future()
            await self._idle
        self._committer.shutdown()
        self._readers.shutdown()
        self._searchers.shutdown()
        self._reader.close()
        self._ledger.close()

    # -- facts -------------------------------------------------------------------------------------------------------

    @property
    def healthy(self) -> bool:
        """Whether the last write reached the disk, in the database and outside it."""
        return self._reason is None

    @property
    def reason(self) -> str | None:
        """Why the store is not healthy."""
        return self._reason

    async def look(self) -> None:
        """Find out whether the disk takes more; waits at most `PROBE_AFTER_S` for that.

        A disk that filled up or became read-only since the last write, and a file of the record that was deleted or
        replaced, show in `healthy` and `reason` after this.
        """
        if self._reason is not None or self._closed:
            return
        if (why := self._in_the_way()) is not None:
            self._note_health(why)
        elif not self._writing and monotonic_s() - self._wrote_s >= PROBE_AFTER_S:
            await asyncio.wait({self._write_probe()}, timeout=PROBE_AFTER_S)

    @property
    def size(self) -> int:
        """How many events are durable."""
        return self._ledger.frontier.size

    @property
    def checkpoint(self) -> str | None:
        """The newest signed tree head that is durable; none before the first event."""
        return self._ledger.note or None

    @property
    def verifier(self) -> Verifier:
        """The public key of this log."""
        return self._ledger.signer.verifier

    # -- writing -----------------------------------------------------------------------------------------------------

    async def append(self, events: Sequence[EventDraft], rows: Sequence[RowWrite] = ()) -> list[int]:
        """Record events, and rows of state with them, and return the events' places once they are durable.

        All or nothing. Once handed over they are written even if the caller is cancelled.

        Raises:
            RecordUnavailable: not known to be recorded, nothing may move on them.
            RowExists: a row to be written once is there already; nothing was recorded.
            EventMalformed, RowMalformed: the caller's bug; nothing was recorded.
        """
        for row in rows:
            check_row(row)
        return await self._enqueue(Submission(prepare_all(events, rfc3339(wall_s())), tuple(rows)))

    def subscribe(self, callback: Callable[[tuple[Event, ...]], None]) -> Callable[[], None]:
        """Call back on the event loop with every batch of events once durable; returns how to end it.

        An exception in a callback goes to the loop's exception handler and harms neither writers nor other subscribers.
        """
        self._subscribers.append(callback)
        return lambda: self._subscribers.remove(callback) if callback in self._subscribers else None

    def _enqueue(self, submission: Submission) -> asyncio.Future[list[int]]:
        if self._closed:
            raise RecordUnavailable("the store is closed")
        if len(self._waiting) >= MAX_WAITING:
            raise RecordUnavailable(f"`{MAX_WAITING}` callers wait already")
        loop = asyncio.get_running_loop()
        future: asyncio.Future[list[int]] = loop.create_future()
        self._waiting.append((submission, future))
        if not self._writing:
            self._writing = True
            loop.call_soon(self._write_batch)
        return future

    def _write_batch(self) -> None:
        batch = self._next_batch()
        loop = asyncio.get_running_loop()
        if not batch:
            self._writing = False
            if self._idle is not None:
                self._idle.set_result(None)
            return
        try:
            staged = self._ledger.stage([submission for submission, _ in batch])
        except Exception as error:  # whatever it was, nothing of the batch is recorded, and everyone is told
            self._fail(batch, error)
            loop.call_soon(self._write_batch)
            return
        self._committer.submit(self._commit, batch, staged, loop)

    def _commit(
        self,
        batch: list[tuple[Submission, asyncio.Future[list[int]]]],
        staged: Staged,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        """Commit a batch and write its checkpoint outside, in the commit thread; the loop is told as soon as it may."""
        ailing = self._reason is not None
        trouble: str | None = None
        try:
            self._ledger.commit(staged)
            if ailing:  # health comes back with an answer only when all of it has reached the disk
                trouble = self._ledger.follow(staged)
        except Exception as error:
            loop.call_soon_threadsafe(self._settle, batch, staged, error, None)
        else:
            loop.call_soon_threadsafe(self._settle, batch, staged, None, trouble)
            if not ailing and (trouble := self._ledger.follow(staged)) is not None:
                loop.call_soon_threadsafe(self._note_health, trouble)
        finally:
            loop.call_soon_threadsafe(self._write_batch)

    def _next_batch(self) -> list[tuple[Submission, asyncio.Future[list[int]]]]:
        batch: list[tuple[Submission, asyncio.Future[list[int]]]] = []
        size = 0
        while self._waiting and size < MAX_BATCH_EVENTS:
            batch.append(self._waiting.popleft())
            size += len(batch[-1][0].events) + len(batch[-1][0].rows)
        return batch

    def _settle(
        self,
        batch: list[tuple[Submission, asyncio.Future[list[int]]]],
        staged: Staged,
        error: Exception | None,
        trouble: str | None,
    ) -> None:
        if error is not None:
            self._fail(batch, error)
        else:
            self._ledger.adopt(staged)
            self._note_health(trouble)
            self._publish(staged.events)
            for (_, future), answer in zip(batch, staged.answers, strict=True):
                if future.done():
                    continue
                if isinstance(answer, RowExists):
                    future.set_exception(answer)
                else:
                    future.set_result([event.seq for event in answer])

    def _fail(self, batch: list[tuple[Submission, asyncio.Future[list[int]]]], error: BaseException) -> None:
        reason = describe(error)
        try:
            self._ledger.take_back()
        except Exception as undo:  # the next stage fails as well and says why; this one must still answer its callers
            reason = f"{reason}; taking it back: {describe(undo)}"
        self._note_health(reason)
        for _, future in batch:
            if not future.done():
                refusal = RecordUnavailable(reason)
                refusal.__cause__ = error
                future.set_exception(refusal)

    def _publish(self, events: tuple[Event, ...]) -> None:
        if not events:
            return
        for callback in tuple(self._subscribers):
            try:
                callback(events)
            except Exception as error:
                context = {"message": "a subscriber of the record failed", "exception": error}
                asyncio.get_running_loop().call_exception_handler(context)

    # -- health ------------------------------------------------------------------------------------------------------

    def _note_health(self, reason: str | None) -> None:
        if reason is None:
            self._wrote_s = monotonic_s()
        self._reason = reason
        if reason is not None and self._probe is None and not self._closed:
            self._probe = asyncio.get_running_loop().call_later(PROBE_AFTER_S, self._try_again)

    def _try_again(self) -> None:
        """Write something that needs room on the disk, so that health comes back without anyone risking a proposal."""
        self._probe = None
        if self._reason is None or self._closed or len(self._waiting) >= MAX_WAITING:
            return
        # Writing the same row again may need no room that the database has not got already.
        if (why := self._in_the_way()) is not None:
            self._note_health(why)
            return
        self._write_probe()

    def _in_the_way(self) -> str | None:
        """Return why nothing could be kept, as far as that shows without writing."""
        return self._ledger.displaced() or full(self.places.folder, "record")

    def _write_probe(self) -> asyncio.Future[list[int]]:
        written = self._enqueue(Submission((), (RowWrite(table="probes", values=probe()),)))
        written.add_done_callback(lambda answer: answer.exception())  # what it says stands in the health already
        return written

    # -- reading -----------------------------------------------------------------------------------------------------

    async def events(
        self,
        *,
        after: int = 0,
        before: int | None = None,
        newest: bool = False,
        limit: int = 100,
        **filters: Unpack[EventFilters],
    ) -> list[Event]:
        """Return events in order of `seq`, each readable; arguments and errors as `Reader.events`.

        One that is not says as much as a verification would: it stands in `damage`, and nothing launches.
        """
        read = partial(self._reader.events, after=after, before=before, newest=newest, limit=limit, **filters)
        with self._meeting_damage():
            return await self._read(partial(_readable, read))

    async def search(
        self,
        words: Words,
        *,
        after: int = 0,
        before: int | None = None,
        newest: bool = False,
        limit: int = 100,
        **filters: Unpack[EventFilters],
    ) -> Found:
        """Look for words in the log, as far as one look goes; arguments and errors as `events`, `searching.search`.

        One search runs at a time, in a thread that no other reader waits for.
        """
        if self._closed:
            raise AuditError("the store is closed")
        span = {"after": after, "before": before, "newest": newest}
        look = partial(search, partial(self._reader.events, **filters), words, **span, limit=limit, pause_s=PAUSE_S)
        with self._meeting_damage():
            return await asyncio.get_running_loop().run_in_executor(self._searchers, look)

    @contextmanager
    def _meeting_damage(self) -> Generator[None]:
        """Note an event that cannot be read."""
        try:
            yield
        except EventUnreadable as error:
            self.damage = str(error)
            raise RecordDamaged(self.places.database, str(error)) from error

    async def invocation(self, key: str) -> bytes | None:
        """Return the document of an invocation, if there is one."""
        row = await self.row("invocations", id=key)
        return None if row is None else row["document"]

    async def escalation(self, key: str) -> bytes | None:
        """Return the document of an escalation, if there is one."""
        row = await self.row("escalations", id=key)
        return None if row is None else row["document"]

    async def row(self, table: str, **key: str | int) -> Row | None:
        """Return the row of a state table with this primary key; errors as `Reader.row`."""
        return await self._read(partial(self._reader.row, table, **key))

    async def rows(self, table: str, filters: Mapping[str, Any] | None = None) -> list[Row]:
        """Return rows of a state table by primary key; errors as `Reader.rows`."""
        return await self._read(partial(self._reader.rows, table, filters))

    async def page(
        self, table: str, filters: Mapping[str, Any] | None = None, *, limit: int = 50, cursor: str | None = None
    ) -> Page:
        """Return rows of a state table that has `created_seq`, newest first; errors as `Reader.page`."""
        return await self._read(partial(self._reader.page, table, filters, limit=limit, cursor=cursor))

    async def ask(self, question: Callable[[Reader], T]) -> T:
        """Return the answer to a question that takes several reads, off the event loop; errors as the reads have."""
        return await self._read(partial(question, self._reader))

    async def verify(self) -> Verification:
        """Recompute the log from its stored bytes, in a thread with a connection of its own.

        Raises:
            RecordUnreadable: it cannot be read now.
        """
        return await asyncio.to_thread(verify_log, self.places, self.verifier, pause_s=PAUSE_S)

    async def examine(self) -> Examination:
        """Compare everything that lies in the data directory with the log, in a thread with connections of its own.

        Raises:
            RecordUnreadable: it cannot be read now; what the last examination found holds on.
        """
        found = await asyncio.to_thread(examine, self.places, self.verifier, pause_s=PAUSE_S, within_s=EXAMINE_WITHIN_S)
        self.damage = found.log.problem
        return found

    async def _read(self, query: Callable[[], T]) -> T:
        if self._closed:
            raise AuditError("the store is closed")
        return await asyncio.get_running_loop().run_in_executor(self._readers, query)


def _readable(query: Callable[[], list[Event]]) -> list[Event]:
    """Return what a query finds, where each event of it can be read. Raises `EventUnreadable`."""
    found = query()
    for event in found:
        event.payload()
    return found
