"""What the log says of cells: which stop is latched, and how far the reports of each journal are in.

The server keeps both in rows as well (`settings`: `estop/<cell>`, `journals/<cell>`; `cell_progress`), and nobody signs
a row. From these follows whether a robot may move, and which reports a cell may forget: so a start takes them from
here, and an auditor compares.

| event | says of a stop |
|---|---|
| human, `estop`; the server's `latched` | latched by a word, which the row repeats |
| human, `reset` | not latched by a word any more; one that was recorded late, but said before, changes nothing |
| the cell's own `estop`, `reset` | latched by the cell itself, and not any more; no row repeats it |
| the server's `not_confirmed` | the reset was not heard, unless the cell reports one: latched still |
| the server's `confirmed` | the cell says that it has no stop although it was not heard to have had that reset |

A report bears its number (`cell_seq`) and stands behind the `attached` of its link, which names the journal.
"""

from __future__ import annotations

from heapq import merge
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import orjson

from app.governance.model import EventKind

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from app.audit.event import Event
    from app.audit.reader import Reader, Row

NOT_CONFIRMED: Final = "not_confirmed"  # a word of which the cell has not said that it heard it
CONFIRMED: Final = "confirmed"  # that it came to what it was said for all the same
LATCHED: Final = "latched"  # the server's word for a latch of which the row could not be written when it was due
PAGE: Final = 50  # events, each of which may be a quarter of a megabyte
_WORDS: Final = {
    EventKind.HUMAN: ('"op":"estop"', '"op":"reset"'),
    EventKind.CELL: tuple(f'"what":"{what}"' for what in ("estop", "reset", NOT_CONFIRMED, CONFIRMED, LATCHED)),
}
UNNAMED: Final = frozenset({""})
_ATTACHED: Final = ('"link":"attached"',)
NUMBER: Final = "cell_seq"
_NUMBERED: Final = (f'"{NUMBER}":',)


class Latch(NamedTuple):
    """What the log says of a cell's stop, so far."""

    worded: bool = False  # by the newest word: what the row says
    itself: bool = False  # by the cell's own
    unheard: str | None = None  # the journal of a cell that has said nothing of a reset; "" where nobody wrote it down
    answered: bool = True  # the cell has reported a reset since the newest that was recorded
    reset_at: str = ""

    @property
    def latched(self) -> bool:
        """Say whether nothing may move before a reset."""
        return self.worded or self.itself or self.unheard is not None


class Span(NamedTuple):
    """A part of the log in which a cell's reports are numbered in one journal, `after` and `before` excluded."""

    after: int
    before: int | None
    journals: frozenset[str]


# -- stops -------------------------------------------------------------------------------------------------------------


def latches(reader: Reader) -> dict[str, Latch]:
    """Return what the log says of stops, by cell; a cell that none ever met is left out.

    Raises:
        RecordDamaged: the database cannot be read.
        EventUnreadable: an event is none, of a log that was not verified.
    """
    found: dict[str, Latch] = {}
    for event in merge(*(_all(reader, words, kind=kind) for kind, words in _WORDS.items())):
        body: dict[str, Any] = event.payload()
        named = event.actor if NUMBER in body else body.get("cell")
        if isinstance(named, str):
            found[named] = _follow(found.get(named, Latch()), event, body)
    return found


def _follow(latch: Latch, event: Event, body: Mapping[str, Any]) -> Latch:
    if NUMBER in body:
        return _by_itself(latch, event, body)
    match event.kind, body.get("op"), body.get("what"):
        case EventKind.HUMAN, "estop", _:
            answered = "said_at" in body and body["said_at"] <= latch.reset_at
            return latch if answered else latch._replace(worded=True)
        case EventKind.HUMAN, "reset", _:
            return latch._replace(worded=False, unheard=None, answered=False, reset_at=event.at)
        case EventKind.CELL, "reset", what if what == NOT_CONFIRMED:
            return latch if latch.answered else latch._replace(unheard=str(body.get("journal", "")))
        case EventKind.CELL, "reset", what if what == CONFIRMED:
            return latch._replace(unheard=None, answered=True)
        case EventKind.CELL, _, what if what == LATCHED:
            return latch._replace(worded=True)
        case _:
            return latch


def _by_itself(latch: Latch, event: Event, body: Mapping[str, Any]) -> Latch:
    """Follow a cell's own report; what it says of an invocation is about no latch."""
    if event.kind != EventKind.CELL or event.invocation is not None or "stray" in body:
        return latch
    match body.get("what"):
        case "estop":
            return latch._replace(itself=True)
        case "reset":
            return latch._replace(itself=False, unheard=None, answered=True)
        case _:
            return latch


# -- reports -----------------------------------------------------------------------------------------------------------


def reported(reader: Reader, cell: str, journals: Collection[str]) -> dict[str, int]:
    """Return the number of the last report that the log holds, for each of a cell's journals; 0 where it holds none.

    A count without a journal's name is of before they had any, and of whatever the cell reported.

    Raises:
        RecordDamaged: the database cannot be read.
        EventUnreadable: an event is none, of a log that was not verified.
    """
    spans = _spans(reader, cell) or [Span(0, None, frozenset(journals))]
    return {name: _last(reader, cell, [one for one in spans if not name or name in one.journals]) for name in journals}


def _spans(reader: Reader, cell: str) -> list[Span]:
    """Return where which journal counts: each from its `attached` on, the first from the beginning."""
    spans: list[Span] = []
    for event in _all(reader, _ATTACHED, kind=EventKind.CELL, actor=cell):
        body: dict[str, Any] = event.payload()
        journal = str(body.get("journal", ""))
        if NUMBER in body or (spans and journal in spans[-1].journals):
            continue
        if spans:
            former = spans[-1]
            # Before journals had names, the numbers went on in the first that has one.
            names = former.journals | {journal} if former.journals == UNNAMED else former.journals
            spans[-1] = Span(former.after, event.seq, names)
        spans.append(Span(event.seq if spans else 0, None, frozenset({journal})))
    return spans


def _last(reader: Reader, cell: str, spans: Sequence[Span]) -> int:
    for span in reversed(spans):
        before = span.before
        while page := reader.holding(_NUMBERED, actor=cell, after=span.after, before=before, newest=True, limit=PAGE):
            for event in page:
                if isinstance(number := event.payload().get(NUMBER), int):
                    return number
            before = page[-1].seq
    return 0


def _all(reader: Reader, words: Collection[str], *, kind: str, actor: str | None = None) -> Iterator[Event]:
    after = 0
    while page := reader.holding(words, kind=kind, actor=actor, after=after, limit=PAGE):
        yield from page
        after = page[-1].seq


# -- rows --------------------------------------------------------------------------------------------------------------


def cell_problems(reader: Reader, *, limit: int) -> list[str]:
    """Compare the rows about stops and reports with the log; return the first that say something else, in words.

    A writer may go on meanwhile: a stop and its row are written together, and a row that changed while the log was
    read is left for the next time; reports only become more.

    Args:
        reader: the log's.
        limit: how many to name at most.

    Raises:
        RecordDamaged: the database cannot be read.
    """
    before, progress = reader.rows("settings"), reader.rows("cell_progress")
    known = latches(reader)
    first = {row["name"]: row for row in before}
    rows = {row["name"]: row for row in reader.rows("settings")}
    changed = {name for name in first | rows if first.get(name) != rows.get(name)}
    names = {name for name in rows if name.startswith("estop/")} | {f"estop/{cell}" for cell in known}
    found: list[str] = []
    for name in sorted(names - changed):
        worded = known.get(name.partition("/")[2], Latch()).worded
        if (wrong := latch_problem(rows.get(name), worded=worded)) is not None:
            found.append(f"`{name}` in the table `settings`: {wrong}")
    for where, cell, claims in _claims(progress, before):
        for journal, held in reported(reader, cell, claims).items():
            if claims[journal] > held:
                found.append(f"{where}: {progress_problem(claims[journal], held)}")
    return found[:limit]


def latch_problem(row: Row | None, *, worded: bool) -> str | None:
    """Say how the row of a cell's stop disagrees with the log; None where it does not."""
    stored = None if row is None else _json(row["value"])
    if stored is worded or (stored is None and row is None and not worded):
        return None
    says = "its row is gone" if row is None else f"its row says `{_shown(row['value'])}`"
    return f"{says}, by the log {'a' if worded else 'no'} stop is latched"


def progress_problem(claimed: int, held: int) -> str:
    """Say how the row of a cell's reports disagrees with the log."""
    return f"its row says that reports up to `{claimed}` are in the log, which holds them up to `{held}`"


def _claims(progress: Sequence[Row], settings: Sequence[Row]) -> Iterator[tuple[str, str, dict[str, int]]]:
    """Yield which numbers rows claim of which journals: where, of which cell, and the numbers."""
    for row in progress:
        yield f"`{row['cell']}` in the table `cell_progress`", row["cell"], {row["journal"]: row["up_seq"]}
    for row in settings:
        what, _, cell = row["name"].partition("/")
        former = _json(row["value"]) if what == "journals" else None
        if isinstance(former, dict):
            numbers = cast("dict[str, object]", former)
            claims = {name: seq for name, seq in numbers.items() if isinstance(seq, int)}
            yield f"`{row['name']}` in the table `settings`", cell, claims


def _json(value: object) -> Any:  # noqa: ANN401  # whatever it holds
    try:
        return orjson.loads(value) if isinstance(value, bytes | str) else None
    except orjson.JSONDecodeError:
        return None


def _shown(value: object) -> str:
    return value.decode(errors="replace")[:80] if isinstance(value, bytes) else str(value)[:80]
