"""Review afterwards: finished sessions that policy marks wait for a human's verdict.

A session comes up for review in the same append as its end. A verdict moves nothing: it is recorded, once. What a
reviewer writes (`note`) stays in the record and never reaches an agent; the verdict is in the session's trace.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from app.audit.documents import documents
from app.audit.errors import AuditError
from app.audit.event import RowWrite
from app.governance.authority import refusal, reviewed
from app.governance.control import TAKEOVER
from app.governance.model import AuthorityMode, EventKind, Reason, Status
from app.runtime.drafts import SERVER, review_event
from app.runtime.errors import Conflict, Forbidden, NotFound
from app.runtime.invocation import read_invocation, reasons_document
from app.runtime.queue import Queue, rank
from app.runtime.recollection import events_of, invocation_of
from app.runtime.review import Review, read_review
from app.runtime.uncut import uncut

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from app.audit.event import EventDraft
    from app.governance.model import Outcome
    from app.runtime.invocation import Invocation, Principal
    from app.runtime.kernel import Kernel
    from app.runtime.register import Register

WAITING: Final = "waiting"
JUDGED: Final = "judged"  # as a filter of the list: whatever the verdict is
VERDICTS: Final = ("accepted", "objected", "inconclusive")
SHOWN: Final = 100  # as many as anybody wants to see at once; the rest follows as these are judged
HELD: Final = 1000  # so that the record is read through once for many verdicts
PAGE: Final = 200  # while a page is parsed, nothing else goes on
ENDED: Final = frozenset({Status.COMPLETED, Status.FAILED})


class Reviews:
    """The review queue of one server."""

    def __init__(self, register: Register, kernel: Kernel) -> None:
        """Take where sessions end, and what knows policy."""
        self._register = register
        self._kernel = kernel
        self._queue = Queue(HELD)
        self._shown: set[str] = set()
        self._arrived: list[Review] | None = None  # while the record is read: what it may not have had yet
        self._lock = asyncio.Lock()
        self.on_changed: Callable[[Sequence[Review]], None] = lambda _: None
        register.on_ending = self.due

    # -- coming up ---------------------------------------------------------------------------------------------------

    def due(self, ended: Invocation) -> tuple[EventDraft, RowWrite, Callable[[], None]] | None:
        """Return what to record with a session's end, and what to do once it is; None where no review is due."""
        if ended.status not in ENDED or ended.outcome is None or ended.terms.launched_at_s is None:
            return None
        why = reviewed(self._kernel.policy, ended.capability, ended.profile, ended.outcome)
        if not why:
            return None
        review = self._build(ended, ended.outcome, why)
        return review_event("waiting", SERVER, review), review.row(), lambda: self._hold(review)

    def _build(self, ended: Invocation, outcome: Outcome, why: tuple[Reason, ...]) -> Review:
        now = self._register.now()
        return Review(
            id=self._kernel.identities.make("rev"),
            invocation=ended.id,
            status=WAITING,
            capability=ended.capability,
            agent=ended.agent,
            cell=ended.cell,
            profile=ended.profile,
            risk=self._kernel.risk(ended.capability),
            outcome=outcome.value,
            reasons=reasons_document(why),
            verdict=None,
            created_at=now,
            updated_at=now,
        )

    def _hold(self, review: Review) -> None:
        if review.status == WAITING:
            self._queue.add(review)
            if self._arrived is not None:
                self._arrived.append(review)
            self._tell()
        else:
            self._queue.remove(review)
            self._tell(review)

    def _tell(self, *closed: Review) -> None:
        """Tell what has its verdict, and what is now among those that are shown; how many wait may be all there is."""
        shown = self.waiting()
        fresh = [review for review in shown if review.id not in self._shown]
        self._shown = {review.id for review in shown}
        self.on_changed([*closed, *fresh])

    @uncut
    async def request(self, invocation_id: str, principal: Principal) -> dict[str, Any]:
        """Put a finished session up for review, because a person wants it looked at.

        Raises:
            NotFound: no such invocation.
            Conflict: `wrong_status`, it is not a session that has ended; `review_not_enabled`, its profile's authority
                has no review; `already_reviewed`, it waits for a verdict, or has one.
            RecordUnavailable: nothing was recorded.
        """
        async with self._lock:
            ended = await self._ended(invocation_id)
            if ended.status not in ENDED or ended.outcome is None:
                raise Conflict("wrong_status", f"`{ended.status}` is no end of a session: there is nothing to review")
            refused = refusal(self._kernel.policy, ended.profile, AuthorityMode.REVIEW_ONLY)
            if refused is not None:
                raise Conflict.of(refused)
            if await self._register.store.rows("reviews", {"invocation": ended.id}):
                raise Conflict("already_reviewed", f"`{ended.id}` waits for a verdict already, or has one")
            rule = f"{ended.profile}/authority"
            why = Reason(rule, "review_requested", "a person wants this looked at", "look at the trace")
            review = self._build(ended, ended.outcome, (why,))
            await self._register.append([review_event("waiting", principal.name, review)], [review.row()])
            self._hold(review)
        return review.public()

    async def _ended(self, name: str) -> Invocation:
        """Return an invocation, and what has ended as the log has it: a review is signed with that."""
        known = self._register.newest(name)
        if known is not None:
            return known
        row = await self._register.store.row("invocations", id=name)
        if row is not None:
            stored = self._register.stored.read("invocations", row, read_invocation)
            found, _ = invocation_of(row, stored, await events_of(self._register.store, invocation=name))
            if found is not None:
                return found
        raise NotFound("invocation", name)

    # -- reading -----------------------------------------------------------------------------------------------------

    def waiting(self) -> list[Review]:
        """Return what is judged first of all that waits, at most `SHOWN`: by risk, then by how long it has waited."""
        return self._queue.first(SHOWN)

    @property
    def count(self) -> int:
        """How many wait, whether they are shown or not."""
        return len(self._queue)

    async def list(
        self,
        *,
        status: str | None = None,
        invocation: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> tuple[list[dict[str, Any]], str | None]:
        """Return reviews, newest first, and the cursor behind them. Raises `ValueError` on a bad limit or cursor."""
        wanted = {"status": VERDICTS if status == JUDGED else status, "invocation": invocation}
        page = await self._register.store.page("reviews", wanted, limit=limit, cursor=cursor)
        return self._register.stored.those_of("reviews", page.items, _shown), page.next

    # -- judging -----------------------------------------------------------------------------------------------------

    @uncut
    async def resolve(
        self, review_id: str, principal: Principal, verdict: str, note: str | None = None
    ) -> dict[str, Any]:
        """Take a person's verdict on a finished session.

        Raises:
            NotFound: no such review.
            Conflict: `already_reviewed`, it has a verdict.
            Forbidden: `own_proposal`, nobody reviews what they proposed, or drove where nothing else ran.
            RecordUnavailable: nothing was recorded.
        """
        async with self._lock:
            present = await self._told(review_id)
            if present.verdict is not None:
                by = present.verdict["by"]
                raise Conflict("already_reviewed", f"`{by}` reviewed `{review_id}` already: `{present.status}`")
            if principal.name == present.agent or principal.name in await self._drivers(present):
                raise Forbidden("own_proposal", "nobody reviews what they proposed themselves, or drove by hand alone")
            now = self._register.now()
            said = {"by": principal.name, "at": now, "verdict": verdict, "note": note}
            closed = replace(present, status=verdict, verdict=said, updated_at=now)
            await self._register.append([review_event("verdict", principal.name, closed)], [closed.row()])
            self._hold(closed)
            if self._queue.short_of(SHOWN):
                with suppress(AuditError):  # the verdict is recorded, whatever reading says; the next one reads again
                    await self.recall()
        return closed.public()

    async def _told(self, review_id: str) -> Review:
        """Return a review as the log has it: a verdict is signed with what it is on. Raises `NotFound`."""
        row = await self._register.store.row("reviews", id=review_id)
        if row is not None:
            kept = self._register.stored.read("reviews", row, read_review)
            said = await events_of(self._register.store, invocation=kept.invocation, kind=EventKind.REVIEW)
            for document in documents(said, "review"):
                if document["id"] == review_id:
                    return Review(**document)
        raise NotFound("review", review_id)

    async def _drivers(self, present: Review) -> set[str]:
        """Return who had the controls of a session that was nothing but driving: it bears the first one's name."""
        found: set[str] = set()
        after = 0 if present.capability == TAKEOVER else None
        while after is not None:
            said = await self._register.store.events(
                invocation=present.invocation, kind=EventKind.HUMAN, after=after, limit=PAGE
            )
            found |= {event.actor for event in said if event.payload().get("op") == "takeover"}
            after = said[-1].seq if len(said) == PAGE else None
        return found

    async def recall(self) -> None:
        """Read what waits from the record, the number of all and the first of them; no verdict is taken meanwhile."""
        self._arrived = []
        try:
            best, names = await self._read()
            best += [review for review in self._arrived if review.id not in names]
            self._queue.replace(best, names | {review.id for review in self._arrived})
        finally:
            self._arrived = None
        self._tell()

    async def _read(self) -> tuple[list[Review], set[str]]:
        """Return the first that wait in the record, at most `HELD`, and the names of all of them."""
        best: list[Review] = []
        names: set[str] = set()
        cursor: str | None = None
        while True:
            page = await self._register.store.page("reviews", {"status": WAITING}, limit=PAGE, cursor=cursor)
            found = self._register.stored.those_of("reviews", page.items, read_review)
            names.update(review.id for review in found)
            best = sorted([*best, *found], key=rank)[:HELD]
            cursor = page.next
            if cursor is None:
                return best, names


def _shown(document: bytes) -> dict[str, Any]:
    return read_review(document).public()
