"""Events on their way into the log: the caller's draft, the canonical bytes that are hashed, the committed event.

The bytes are JSON with sorted keys and no spaces, `{"actor", "at", "body", "invocation", "kind", "seq"}`, so that a
record stands alone: the columns beside it in the store are only indexes. JSON has no NaN and no infinity; they are
written as null.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import orjson

from app.audit.errors import EventMalformed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.governance.model import Json

CANONICAL = orjson.OPT_SORT_KEYS | orjson.OPT_NON_STR_KEYS  # enums are keys too
MAX_BODY_BYTES = 4 * 1024 * 1024


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
    """A committed event; `body` is the exact bytes that were hashed."""

    seq: int
    at: str
    kind: str
    invocation: str | None
    actor: str
    body: bytes

    def payload(self) -> dict[str, Json]:
        """Return the draft's body, decoded."""
        return cast("dict[str, Json]", orjson.loads(self.body)["body"])


@dataclass(frozen=True, slots=True)
class Prepared:
    """A draft whose payload is in canonical bytes already: what fails, fails before it meets others in a batch."""

    at: str
    kind: str
    invocation: str | None
    actor: str
    payload: bytes

    def seal(self, seq: int) -> Event:
        """Give the event its place in the log."""
        record = {  # written in the order of its sorted keys
            "actor": self.actor,
            "at": self.at,
            "body": orjson.Fragment(self.payload),
            "invocation": self.invocation,
            "kind": self.kind,
            "seq": seq,
        }
        return Event(seq, self.at, self.kind, self.invocation, self.actor, orjson.dumps(record))


@dataclass(frozen=True, slots=True)
class Submission:
    """What one caller appends, all of it or nothing."""

    events: tuple[Prepared, ...]
    rows: tuple[RowWrite, ...] = field(default=())


def prepare(draft: EventDraft, at: str) -> Prepared:
    """Encode a draft's payload.

    Raises:
        EventMalformed: a value or key JSON cannot say, an integer beyond 64 bits, text with lone
        surrogates, over 4 MiB.
    """
    try:
        payload = orjson.dumps(draft.body, default=_plain, option=CANONICAL)
        orjson.dumps((draft.kind, draft.actor, draft.invocation))  # the same demands on the columns' texts
    except TypeError as error:
        raise EventMalformed(draft.kind, str(error)) from error
    if not payload.startswith(b"{"):
        raise EventMalformed(draft.kind, "the body is no mapping")
    if len(payload) > MAX_BODY_BYTES:
        raise EventMalformed(draft.kind, f"the body has `{len(payload)}` bytes, at most `{MAX_BODY_BYTES}` are kept")
    return Prepared(at, draft.kind, draft.invocation, draft.actor, payload)


def prepare_all(drafts: Sequence[EventDraft], at: str) -> tuple[Prepared, ...]:
    """Encode the drafts of one caller, who sees the first that fails."""
    return tuple(prepare(draft, at) for draft in drafts)


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
