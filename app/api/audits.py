"""What an auditor uses: the log's signed head, its verification, telemetry, and events as they happen.

Events are sent as the very bytes that were hashed.
"""

from __future__ import annotations

import asyncio
from base64 import b64encode
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Annotated

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse

from app.api import documents
from app.api.access import allowed_roles, authorize, caller
from app.api.listing import MAX_SEQ, Digits, Identifier, within_the_log
from app.api.log import MAX_EVENTS, events
from app.api.openapi import Answers, answer, declare
from app.api.parts import parts_of
from app.api.problems import Problem, as_problem
from app.api.staying import CUT, until_refused, while_there
from app.audit.checkpoint import parse_checkpoint
from app.audit.errors import AuditError, RecordDamaged
from app.audit.reader import fitting
from app.audit.telemetry_reading import read_telemetry, telemetry_file
from app.clock import rfc3339

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from fastapi import APIRouter
    from starlette.types import Receive, Scope, Send

    from app.audit.event import Event
    from app.runtime.feed import Feed

MAX_DIGITS = 18
HEARTBEAT_S = 10.0
LEAVE_S = 2.0  # for who may not stay to take the end of their stream
HEARTBEAT = b": still here\n\n"
RETRY_MS = 1000
EVENTS = "/v1/events"
STREAM = "text/event-stream"
MCAP = "application/octet-stream"
MAX_ROWS = 5000
LAST_EVENT_ID = {
    "name": "Last-Event-ID",
    "in": "header",
    "required": False,
    "description": "The `id` of the last event that was taken, as clients of server-sent events send it.",
    "schema": {"type": "string", "pattern": rf"^[0-9]{{1,{MAX_DIGITS}}}$"},
}


class PartQuery(BaseModel):
    """Which of a session's telemetry files."""

    model_config = ConfigDict(extra="forbid")

    part: Annotated[
        int,
        Field(ge=1, le=MAX_EVENTS, description="A session that outlived a server goes on in a second file."),
        Digits,
    ] = 1


class TelemetryQuery(PartQuery):
    """Which of a session's telemetry files, and how finely."""

    rows: Annotated[
        int, Field(ge=1, le=MAX_ROWS, description="At most so many rows, evenly chosen, and the last one."), Digits
    ] = 2000


class StreamQuery(BaseModel):
    """Where a stream of events begins."""

    model_config = ConfigDict(extra="forbid")

    after: Annotated[
        int | None,
        Field(
            ge=0,
            le=MAX_SEQ,
            description="Begin after this `seq`; `Last-Event-ID` outranks it. Without either: from now.",
        ),
        Digits,
    ] = None


async def checkpoint(request: Request) -> Response:
    """Return the newest signed tree head (C2SP checkpoint, Ed25519) of the log."""
    store = parts_of(request).store
    note = store.checkpoint
    if note is None:
        raise Problem("log_empty", "nothing is recorded yet: valid once the first event is")
    head = parse_checkpoint(note.partition("\n\n")[0] + "\n")
    return answer(
        {"size": head.size, "root": b64encode(head.root).decode(), "checkpoint": note, "key": store.verifier.text()}
    )


async def verify(request: Request) -> Response:
    """Recompute the whole log from its stored bytes; `first_bad` is the first event that does not hold.

    Where the log is good, what stands beside it is compared with it, as `reins audit verify` does: the database's
    indexes, the table of invocations, the telemetry files.
    """
    parts = parts_of(request)
    async with parts.verifying:  # it reads everything there is: one at a time
        found = await parts.store.examine()
    return answer(
        {
            **asdict(found.log),
            "ok": found.ok,
            "problem": found.problem,
            "database": found.database,
            "state": found.state,
            "telemetry": found.telemetry,
        }
    )


async def telemetry(request: Request, id: Identifier, query: Annotated[TelemetryQuery, Query()]) -> Response:
    """Return what was measured during a session as columns by channel, and whether the file is as it was recorded.

    `parts` says how many files the session left; a value that was not known is null.
    """
    parts = parts_of(request)
    event, count = await _telemetry_event(request, id, query.part)
    try:
        async with parts.replaying:  # decoding is work: one at a time
            found = await asyncio.to_thread(read_telemetry, parts.store.places.telemetry, event, limit=query.rows)
    except RecordDamaged as error:
        detail = f"the telemetry of `{id}` is not what was recorded: {error.problem}"
        raise Problem("telemetry_damaged", detail) from error
    if found is None:
        raise _no_file(event, query.part, count)
    document = asdict(found)
    start_at = rfc3339(document.pop("start_s"))
    return answer({"invocation": id, "part": query.part, "parts": count, "start_at": start_at, **document})


async def telemetry_mcap(request: Request, id: Identifier, query: Annotated[PartQuery, Query()]) -> Response:
    """Return a session's telemetry file as it lies on the disk: MCAP, which Foxglove opens."""
    event, count = await _telemetry_event(request, id, query.part)
    path = telemetry_file(parts_of(request).store.places.telemetry, event)
    if path is None:
        raise _no_file(event, query.part, count)
    return WholeFile(path, media_type=MCAP, filename=path.name, headers={"Accept-Ranges": "none"})


class WholeFile(FileResponse):
    """A file, all of it.

    A server may ignore `Range` (RFC 9110, 14.2), and Starlette refuses a bad one in plain text.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]
        await super().__call__({**scope, "headers": headers}, receive, send)


async def _telemetry_event(request: Request, invocation: str, part: int) -> tuple[Event, int]:
    """Return the event that vouches for a session's telemetry file, and how many such events there are.

    Raises:
        Problem: 404 `telemetry_unknown`.
    """
    parts = parts_of(request)
    await parts.governor.sealed(invocation)
    found = await parts.store.events(invocation=invocation, kind="telemetry", limit=MAX_EVENTS)
    if len(found) < part:
        detail = f"`{invocation}` has no telemetry file `{part}`: nothing ran, or it still runs"
        raise Problem("telemetry_unknown", detail)
    return found[part - 1], len(found)


def _no_file(event: Event, part: int, count: int) -> Problem:
    """Return why there is no file where the record tells of telemetry: it was not kept, or is there no more.

    One part that is not there bars the way to no other, so each of several is told which one it is.
    """
    failed = event.payload().get("failed")
    why = "its file is not where it was kept" if failed is None else f"it was not kept: {failed}"
    which = "" if count == 1 else f" (its part `{part}` of `{count}`)"
    return Problem("telemetry_unknown", f"there is no such telemetry of `{event.invocation}`{which}: {why}")


async def stream(request: Request, query: Annotated[StreamQuery, Query()]) -> Response:
    """Send events as they become durable, as server-sent events.

    `id` is the `seq`, `event` the kind, `data` the event as it was hashed.

    A client that comes back with `Last-Event-ID` gets everything it missed. A comment is sent every few seconds, so
    that a dead connection shows; a client that does not keep up is cut off, and comes back the same way. One that has
    seen more than this log holds was told by another, and is refused: what it waits for would never come. A stream ends
    when its token expires or is withdrawn, or another request comes behind it on the connection. Where the log cannot
    be read any further, a last event `problem`, without an `id`, says why.
    """
    parts = parts_of(request)
    field, after = ("after", query.after)
    if "last-event-id" in request.headers:
        field, after = ("Last-Event-ID", _last_event_id(request))
    within_the_log(request, field, after)
    # "From now on" is fixed before the first byte is out, so that what happens meanwhile is not missed.
    let_in = partial(authorize, request, parts.principals, allowed_roles("GET", EVENTS))
    chunks = _chunks(request, parts.feed, parts.store.size if after is None else after, let_in)
    seat = ExitStack()
    seat.enter_context(parts.streams.take(caller(request).name))
    return SeatedStream(seat, chunks, let_in)


class SeatedStream(StreamingResponse):
    """A stream of events that gives its seat back however it ends, even before its first byte."""

    def __init__(self, seat: ExitStack, chunks: AsyncGenerator[bytes], let_in: Callable[[], object]) -> None:
        """Take the seat over, what is to be sent, and what says whether it still may be."""
        super().__init__(chunks, media_type=STREAM, headers={"X-Accel-Buffering": "no"})
        self._seat, self._let_in = seat, let_in

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send until either side ends it."""
        with self._seat:
            showing_out = asyncio.create_task(self._show_out(scope))
            try:
                await super().__call__(scope, receive, send)
            finally:
                showing_out.cancel()
                await asyncio.wait({showing_out})

    async def _show_out(self, scope: Scope) -> None:
        """Cut who may not stay and does not read either: their stream waits to send, and ends by itself no more."""
        refused = asyncio.ensure_future(until_refused(self._let_in))
        try:
            await asyncio.wait({refused})
        finally:
            refused.cancel()
        await asyncio.sleep(LEAVE_S)
        scope[CUT]()


def _last_event_id(request: Request) -> int:
    given = request.headers.getlist("last-event-id")
    if len(given) > 1:
        raise Problem("given_twice", f"`Last-Event-ID` is given {len(given)} times: valid is once")
    text = given[0].strip(" \t")  # blanks around a value are none of it (RFC 9110, 5.5)
    if not (text.isascii() and text.isdigit()) or len(text) > MAX_DIGITS:
        message = f"`{text[:40]}` is no `Last-Event-ID`: valid is the `id` of an event"
        raise Problem("request_invalid", message, errors=[{"field": "Last-Event-ID", "message": message}])
    return int(text)


async def _over(request: Request, let_in: Callable[[], object]) -> None:
    """Return once a stream's reader may not stay any more, or does not."""
    await while_there(request, until_refused(let_in))


async def _chunks(request: Request, feed: Feed, after: int, let_in: Callable[[], object]) -> AsyncGenerator[bytes]:
    yield b"retry: %d\n\n" % RETRY_MS
    with feed.subscribe(after=after) as subscription:
        batches = aiter(subscription)
        waiting: asyncio.Future[list[Event] | None] | None = None
        over = asyncio.ensure_future(_over(request, let_in))
        try:
            while True:
                # A wait that ran out must not cancel the iteration, so it goes on as a task of its own.
                waiting = waiting or asyncio.ensure_future(anext(batches, None))
                await asyncio.wait({waiting, over}, timeout=HEARTBEAT_S, return_when=asyncio.FIRST_COMPLETED)
                if over.done():  # whoever asks for the rest is told why
                    return
                if not waiting.done():
                    yield HEARTBEAT
                    continue
                try:
                    batch, waiting = waiting.result(), None
                except AuditError as error:
                    yield b"event: problem\ndata: %s\n\n" % as_problem(error).response(EVENTS).body
                    return
                if batch is None:
                    return
                while batch:  # in pieces: a batch of long ones would hold everybody up
                    count = fitting(len(event.body) for event in batch)
                    yield b"".join(map(as_sse, batch[:count]))
                    batch = batch[count:]
        finally:
            over.cancel()
            if waiting is not None:
                waiting.cancel()
                await asyncio.wait({waiting})


def as_sse(event: Event) -> bytes:
    """Return an event as one server-sent event; JSON has no line breaks of its own."""
    kind = event.kind if event.kind.isidentifier() else "event"
    return b"id: %d\nevent: %s\ndata: %s\n\n" % (event.seq, kind.encode(), event.body)


def register(router: APIRouter) -> None:
    """Add the auditors' routes."""
    declare(router, "GET /v1/audit/events", events, Answers(model=documents.EventList, codes=("request_invalid",)))
    declare(
        router,
        "GET /v1/audit/checkpoint",
        checkpoint,
        Answers(model=documents.CheckpointDocument, codes=("log_empty",)),
    )
    declare(router, "GET /v1/audit/verify", verify, Answers(model=documents.VerificationDocument))
    declare(
        router,
        "GET /v1/audit/telemetry/{id}",
        telemetry,
        Answers(model=documents.TelemetryDocument, codes=("request_invalid", "telemetry_unknown", "telemetry_damaged")),
    )
    declare(
        router,
        "GET /v1/audit/telemetry/{id}/mcap",
        telemetry_mcap,
        Answers(model=documents.McapFile, media_type=MCAP, codes=("request_invalid", "telemetry_unknown")),
    )
    declare(
        router,
        f"GET {EVENTS}",
        stream,
        Answers(
            model=documents.EventDocument,
            media_type=STREAM,
            codes=("request_invalid", "too_many_streams"),
        ),
        parameters=[LAST_EVENT_ID],
    )
