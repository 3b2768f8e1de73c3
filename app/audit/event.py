"""Events on their way into the log: the caller's draft, the canonical bytes that are hashed, the committed event.

The bytes are JSON without spaces, `{"actor", "at", "body", "invocation", "kind", "seq"}` in this order, so that a
record stands alone: the columns beside it in the store are only indexes. In a body the keys are sorted but for those of
dataclasses, which keep their own order. JSON has no NaN and no infinity; they are written as null.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import orjson

from app.audit.errors import EventMalformed, EventUnreadable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.governance.model import Json

CANONICAL = orjson.OPT_SORT_KEYS
ANY_KEYS = CANONICAL | orjson.OPT_NON_STR_KEYS  # enums are keys too; the bytes are the same, at twice the price
MAX_BODY_BYTES = 4 * 1024 * 1024
MAX_PAGE_BYTES = 4 * 1024 * 1024  # of events that are read and written in one go: meanwhile nothing else goes on


@dataclass(frozen=True, slots=True, kw_only=True)
class EventDraft:
    """What a caller wants recorded: `seq` and `at` are the store's to give.

    `body` may hold anything JSON can say, and dataclasses, enums, named tuples, mappings and sets, which are written
    as JSON says them.
    """

    kind: str
    actor: str
    body: Mapping[str, Any]
    invocation: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RowWrite:
    """One row of the runtime's mutable state, written in the transaction of the events that caused it.

    `once` makes it an insertion that fails with `RowExists` when the key is taken (a permit is used once); otherwise
    the row of that key is replaced.
    """

    table: str
    values: Mapping[str, str | int | bytes | None]
    once: bool = False


class Event(NamedTuple):
    """A committed event, its fields in the order of the table's columns; `body` is the exact bytes that were hashed."""

    seq: int
    at: str
    kind: str
    invocation: str | None
    actor: str
    body: bytes

    def payload(self) -> dict[str, Json]:
        """Return the draft's body, decoded.

        Raises:
            EventUnreadable: the stored bytes were damaged or changed.
        """
        try:
            record: object = orjson.loads(self.body)
        except orjson.JSONDecodeError as error:
            raise EventUnreadable(self.seq) from error
        match record:
            case {"body": dict()}:
                return cast("dict[str, dict[str, Json]]", record)["body"]
            case _:
                raise EventUnreadable(self.seq)


class Prepared(NamedTuple):
    """A draft in canonical bytes already, all but its place: what fails, fails before it meets others in a batch.

    `seq` is the last of the sorted keys, so the bytes of the others need no second encoding.
    """

    at: str
    kind: str
    invocation: str | None
    actor: str
    unplaced: bytes

    def seal(self, seq: int) -> Event:
        """Give the event its place in the log."""
        at, kind, invocation, actor, unplaced = self
        return Event(seq, at, kind, invocation, actor, b'%b,"seq":%d}' % (unplaced, seq))


class Submission(NamedTuple):
    """What one caller appends, all of it or nothing."""

    events: tuple[Prepared, ...]
    rows: tuple[RowWrite, ...] = ()


def prepare(draft: EventDraft, at: str) -> Prepared:
    """Encode a draft's payload.

    Raises:
        EventMalformed: a value or key JSON cannot say, an integer beyond 64 bits, text with lone
        surrogates, over 4 MiB.
    """
    kind, actor, invocation, body = draft.kind, draft.actor, draft.invocation, draft.body
    record = {"actor": actor, "at": at, "body": body, "invocation": invocation, "kind": kind}
    try:
        unplaced = _encode(record)[:-1]
        if type(body) is not dict and not _encode(body).startswith(b"{"):
            raise EventMalformed(kind, "the body is no mapping")
    except TypeError as error:
        raise EventMalformed(kind, str(error)) from error
    if len(unplaced) > MAX_BODY_BYTES and (size := len(_encode(record["body"]))) > MAX_BODY_BYTES:
        raise EventMalformed(kind, f"the body has `{size}` bytes, at most `{MAX_BODY_BYTES}` are kept")
    return Prepared(at, kind, invocation, actor, unplaced)


def prepare_all(drafts: Sequence[EventDraft], at: str) -> tuple[Prepared, ...]:
    """Encode the drafts of one caller, who sees the first that fails."""
    return tuple([prepare(draft, at) for draft in drafts])


def read_columns(body: bytes) -> Event:
    """Read the columns back out of an event's bytes.

    Raises:
        ValueError: the bytes are no record of an event.
    """
    record: object = orjson.loads(body)
    match record:
        case {
            "seq": int(seq),
            "at": str(at),
            "kind": str(kind),
            "invocation": str() | None as invocation,
            "actor": str(actor),
            "body": dict(),
        }:
            return Event(seq, at, kind, invocation, actor, body)
        case _:
            raise ValueError("the bytes are no record of an event")


def _encode(value: object) -> bytes:
    try:
        return orjson.dumps(value, default=_plain, option=CANONICAL)
    except TypeError:  # a key that is no plain text, or something JSON cannot say in any way
        return orjson.dumps(value, default=_plain, option=ANY_KEYS)


def _plain(value: object) -> object:
    match value:
        case Mapping():
            return {str(key): item for key, item in cast("Mapping[Any, Any]", value).items()}
        case tuple():  # orjson writes plain tuples itself, so this one has names
            return cast("Any", value)._asdict()
        case set() | frozenset():
            return sorted(cast("frozenset[Any]", value))
        case _:
            raise TypeError(f"a `{type(value).__name__}` cannot be written as JSON")
