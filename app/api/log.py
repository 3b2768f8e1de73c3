"""The log by page: filters, both orders, and the search for words.

Events are sent as the very bytes that were hashed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

import orjson
from fastapi import Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import Response

from app.api.listing import MAX_SEQ, Digits, Filter, within_the_log
from app.api.openapi import answer
from app.api.parts import parts_of
from app.audit.reader import fitting
from app.audit.searching import Words
from app.clock import parse_rfc3339, rfc3339
from app.governance.model import EventKind

if TYPE_CHECKING:
    from app.audit.reader import EventFilters
    from app.audit.store import AuditStore

MAX_EVENTS = 1000
MAX_TEXT = 200


def _moment(text: str) -> str:
    moment = text.replace(" ", "+")  # an unescaped `+` of an offset arrives as a space
    rfc3339(parse_rfc3339(moment))
    return moment


Moment = Annotated[str, Field(max_length=40, examples=["2026-03-01T09:30:00.250Z"]), AfterValidator(_moment)]


def _some_words(text: str) -> str:
    if not text.split():
        raise ValueError("holds no word: valid is what an event holds, for instance `mug_1 separation`")
    return text


Text = Annotated[str, Field(max_length=MAX_TEXT, examples=["mug_1 separation"]), AfterValidator(_some_words)]


class EventQuery(BaseModel):
    """Filters of the log."""

    model_config = ConfigDict(extra="forbid")

    invocation: Filter = None
    kind: EventKind | None = None
    actor: Filter = None
    since: Moment | None = Field(default=None, description="RFC 3339, included.")
    until: Moment | None = Field(default=None, description="RFC 3339, excluded.")
    text: Text | None = Field(
        default=None,
        description="Words that are all contained, in whatever case, in what an event holds: its actor, kind and "
        "invocation, and the keys, texts and numbers of its body.",
    )
    order: Annotated[Literal["oldest", "newest"], Field(description="By `seq`: which end comes first.")] = "oldest"
    after: Annotated[
        int,
        Field(ge=0, le=MAX_SEQ, description="Only behind this `seq`; oldest first, the last one already seen."),
        Digits,
    ] = 0
    before: Annotated[
        int | None,
        Field(ge=1, le=MAX_SEQ, description="Only in front of this `seq`; newest first, the last one already seen."),
        Digits,
    ] = None
    limit: Annotated[int, Field(ge=1, le=MAX_EVENTS), Digits] = 100

    def filters(self) -> EventFilters:
        """Return which events are asked for."""
        since, until = (None if at is None else parse_rfc3339(at) for at in (self.since, self.until))
        return {
            "invocation": self.invocation, "kind": self.kind, "actor": self.actor, "since": since, "until": until,
        }  # fmt: skip

    def span(self, behind: int | None = None) -> Span:
        """Return where the events stand, and which comes first; those of the next page, if one is `behind` this."""
        newest = self.order == "newest"
        after, before = (self.after, self.before)
        if behind is not None:
            after, before = (after, behind) if newest else (behind, before)
        return {"after": after, "before": before, "newest": newest}


class Span(TypedDict):
    """A stretch of the log, as `AuditStore.events` takes it."""

    after: int
    before: int | None
    newest: bool


async def events(request: Request, query: Annotated[EventQuery, Query()]) -> Response:
    """Return events of the log in order of `seq`, the oldest first.

    `next` is the `after` that continues, null at the end. With `order=newest` the newest come first, and `next` is the
    `before` that continues: what is recorded meanwhile moves no page. Of events that are long a page holds fewer than
    `limit`.

    With `text` the events themselves are read. One request looks at 50,000 of them at most, and for about a second: it
    may find fewer than `limit`, or none, and yet there is a `next` from which the search goes on. `searched` says how
    many it looked at, and the last of them.
    """
    for bound in ("after", "before"):
        within_the_log(request, bound, getattr(query, bound))
    store = parts_of(request).store
    return answer(await (_page(store, query) if query.text is None else _search(store, query, Words(query.text))))


async def _page(store: AuditStore, query: EventQuery) -> dict[str, Any]:
    filters = query.filters()
    all_found = await store.events(**filters, **query.span(), limit=query.limit)
    found = all_found[: fitting(len(event.body) for event in all_found)]
    following = found[-1].seq if len(found) == query.limit or len(found) < len(all_found) else None
    if following is not None and not await store.events(**filters, **query.span(following), limit=1):
        following = None  # a page may end just where the log does
    return {"items": [orjson.Fragment(event.body) for event in found], "next": following}


async def _search(store: AuditStore, query: EventQuery, words: Words) -> dict[str, Any]:
    found = await store.search(words, **query.filters(), **query.span(), limit=query.limit)
    seq, at = (None, None) if found.last is None else (found.last.seq, found.last.at)
    return {
        "items": [orjson.Fragment(event.body) for event in found.events],
        "next": seq if found.more else None,
        "searched": {"events": found.looked, "seq": seq, "at": at},
    }
