"""Looking for words in the log, slice by slice.

An event holds a word where one of its texts contains it, whatever the case: who said it, its kind, its invocation, and
of its body every key, every text, and every number, `true` and `false` as JSON writes them. Several words have to be
there all, each of them anywhere. What only stands between texts, like a brace, is none of them.

No index of words is kept, which would have to be written with every event: a search reads the events themselves. So
one look is bounded, in events and in time, says how far it came, and the next one goes on from there.
"""

from __future__ import annotations

import json
from time import sleep
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import orjson

from app.audit.errors import EventUnreadable
from app.audit.event import MAX_PAGE_BYTES
from app.clock import monotonic_s

if TYPE_CHECKING:
    from collections.abc import Iterator

    from app.audit.event import Event
    from app.governance.model import Json

SLICE: Final = 500  # events read at a time; the connection is given back between two slices
MOST: Final = 50_000  # events looked at in one go
WITHIN_S: Final = 1.0


class Read(Protocol):
    """Reads a stretch of the log, as `Reader.events` does, of which the filters are given."""

    def __call__(self, *, after: int, before: int | None, newest: bool, limit: int) -> list[Event]:
        """Return events in order."""
        ...


class Words:
    """What is looked for: the words of a text, each once, without their case."""

    def __init__(self, text: str) -> None:
        """Take the words between the blanks of a text."""
        self.words: Final = tuple(dict.fromkeys(text.casefold().split()))
        # As they stand in an event's bytes. What a command line took for no UTF-8 stands in none.
        escaped = (json.dumps(word, ensure_ascii=False)[1:-1] for word in self.words)
        self._pieces = tuple(piece.encode("utf-8", "surrogatepass") for piece in escaped)

    def held_by(self, event: Event) -> bool:
        """Say whether an event holds all of them.

        Raises:
            EventUnreadable: the stored bytes were damaged or changed.
        """
        body = event.payload()  # what cannot be read is not passed over
        whole = _folded(event)
        if not all(piece in whole for piece in self._pieces):  # most events end here
            return False
        texts = [text.casefold() for text in texts_of([event.actor, event.kind, event.invocation, body])]
        return all(any(word in text for text in texts) for word in self.words)


def _folded(event: Event) -> bytes:
    """Return an event's bytes without their case. Raises `EventUnreadable`."""
    if type(event.body) is not bytes:  # SQLite keeps any type anywhere
        raise EventUnreadable(event.seq)
    return event.body.lower() if event.body.isascii() else event.body.decode().casefold().encode()


def texts_of(document: Json) -> Iterator[str]:
    """Yield all that can be read in a document: keys, texts, numbers, `true` and `false`; in no order."""
    waiting = [document]
    while waiting:
        match waiting.pop():
            case dict() as fields:
                yield from fields
                waiting += fields.values()
            case list() as items:
                waiting += items
            case str() as text:
                yield text
            case None:
                pass
            case value:
                yield orjson.dumps(value).decode()


class Found(NamedTuple):
    """What one look found, how many events it looked at, the last of them, and whether there are more behind it."""

    events: list[Event]
    looked: int
    last: Event | None
    more: bool


def search(
    read: Read,
    words: Words,
    *,
    after: int = 0,
    before: int | None = None,
    newest: bool = False,
    limit: int = 100,
    pause_s: float = 0.0,
) -> Found:
    """Look for words in a stretch of the log, until `limit` events are found or `MOST` looked at, or for `WITHIN_S`.

    What was found is no longer than a page (`MAX_PAGE_BYTES`) but for its last event.

    Args:
        read: reads the events that come into question.
        words: what is looked for.
        after: only behind this `seq`.
        before: only in front of this `seq`.
        newest: the newest first, not the oldest.
        limit: at most so many are found.
        pause_s: how long to step aside after every slice.

    Raises:
        EventUnreadable: the stored bytes of an event were damaged or changed.
        RecordDamaged: as `read` raises it.
    """
    until_s = monotonic_s() + WITHIN_S
    found: list[Event] = []
    looked, last, room = 0, None, MAX_PAGE_BYTES
    while looked < MOST and len(found) < limit and room > 0 and (not looked or monotonic_s() < until_s):
        page = read(after=after, before=before, newest=newest, limit=min(SLICE, MOST - looked))
        for event in page:
            last = event
            looked += 1
            if words.held_by(event):
                found.append(event)
                room -= len(event.body)
                if len(found) == limit or room <= 0:
                    break
        if last is None or not page:
            return Found(found, looked, last, more=False)
        after, before = (after, last.seq) if newest else (last.seq, before)
        sleep(pause_s)
    return Found(found, looked, last, more=bool(read(after=after, before=before, newest=newest, limit=1)))
