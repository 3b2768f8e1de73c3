"""The tables `escalations`, `grants` and `reviews`, compared with the log: what is pending and what is granted.

They are state like `invocations` (`projection`), but simpler: an event that changes one holds the whole document as it
then is, so the newest event about a document must say what the table says. Where a session goes on or ends by itself,
the event only says which question is `withdrawn` by that. Not stated, so not compared: how often a grant was used (the
launches say it), and when a document last changed.
"""

from __future__ import annotations

from hashlib import blake2b
from time import sleep
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import orjson

from app.governance.model import EventKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from app.audit.event import Event
    from app.audit.reader import Reader, Row

PAGE: Final = 200
KINDS: Final = (
    EventKind.ESCALATION, EventKind.APPROVAL, EventKind.HUMAN, EventKind.GRANT, EventKind.REVIEW,
    EventKind.LAUNCH, EventKind.STATUS, EventKind.OUTCOME,
)  # fmt: skip
TABLES: Final = {"escalation": "escalations", "grant": "grants", "review": "reviews"}
"""What an event's body calls the document, and where its newest version is kept."""
_NOT_STATED: Final = frozenset({"status", "uses", "used_at", "updated_at"})
_REPEATED: Final = ("invocation", "cell", "expires_at")  # columns that a query goes by
_WITHDRAWN: Final = "withdrawn"


class Said(NamedTuple):
    """What the newest events about a document say; the document itself is read again if need be."""

    seq: int  # of the newest that holds the document
    digest: bytes  # of the document but for `_NOT_STATED`
    status: str


def document_problems(reader: Reader, *, limit: int, pause_s: float = 0.0) -> list[str]:
    """Compare every row of the three tables with the log; return the first that differ, or are missing, in words.

    A page of rows and the events up to it are read at one moment, so a writer may go on meanwhile.

    Args:
        reader: the log's.
        limit: how many to name at most.
        pause_s: how long to step aside after every page, so that a server whose process this runs in goes on.

    Raises:
        RecordDamaged: the database cannot be read.
    """
    found: list[str] = []
    said, since = nothing_said(), 0
    for table, newest in said.items():
        after, seen, more = "", set[str](), True
        while more:
            events, rows = reader.beside(table, kinds=KINDS, since=since, after=after, limit=PAGE)
            since = follow(events, said) or since
            if len(events) < PAGE:  # else there are events that these rows already know of
                found += [wrong for row in rows if (wrong := _wrong(reader, table, row, newest)) is not None]
                seen.update(row["id"] for row in rows)
                after, more = (rows[-1]["id"] if rows else after), len(rows) == PAGE
            if len(found) >= limit:
                return found[:limit]
            sleep(pause_s)
        lost = sorted(name for name in newest.keys() - seen if reader.row(table, id=name) is None)
        found += [f"`{name}`: the log knows it, the table `{table}` does not" for name in lost]
    return found[:limit]


def nothing_said() -> dict[str, dict[str, Said]]:
    """Return what is known of each table's documents before the first event."""
    return {table: {} for table in TABLES.values()}


def follow(events: Iterable[Event], said: dict[str, dict[str, Said]]) -> int:
    """Take events in order of `seq`; returns the last one's, 0 where there is none."""
    seq = 0
    for event in events:
        seq = event.seq
        body: dict[str, Any] = event.payload()
        for word, table in TABLES.items():
            if (document := _whole(body.get(word))) is not None:
                said[table][document["id"]] = Said(event.seq, _digest(document), document["status"])
        questions, gone = said["escalations"], body.get(_WITHDRAWN)
        if isinstance(gone, str) and gone in questions:
            questions[gone] = questions[gone]._replace(status=_WITHDRAWN)
    return seq


def documents(events: Iterable[Event], word: str) -> list[dict[str, Any]]:
    """Return the newest version of each document that events call `word`, as a key of `TABLES`."""
    found: dict[str, dict[str, Any]] = {}
    for event in events:
        body: dict[str, Any] = event.payload()
        if (document := _whole(body.get(word))) is not None:
            found[document["id"]] = document
        if word == "escalation" and (gone := body.get(_WITHDRAWN)) in found:
            found[gone] = {**found[gone], "status": _WITHDRAWN}
    return list(found.values())


def is_founded(row: Row, newest: Mapping[str, Said]) -> bool:
    """Say whether a row of one of the tables says what the newest event about its document says."""
    said, document = newest.get(row["id"]), _document(row)
    if said is None or document is None:
        return False
    if _strange_column(row, document) is not None:
        return False
    return row["status"] == document["status"] == said.status and _digest(document) == said.digest


def _strange_column(row: Row, document: Mapping[str, Any]) -> str | None:
    """Return a column that repeats a field of the document, and does not."""
    return next((name for name in _REPEATED if name in row and name in document and row[name] != document[name]), None)


def _document(row: Row) -> dict[str, Any] | None:
    try:
        document = _whole(orjson.loads(row["document"]))
    except (orjson.JSONDecodeError, TypeError):
        return None
    return document if document is not None and document["id"] == row["id"] else None


def _whole(value: object) -> dict[str, Any] | None:
    """Return a document; an approval may only name the grant that it gave, and a cell's own words hold none."""
    match value:
        case {"id": str(), "status": str()}:
            return cast("dict[str, Any]", value)
        case _:
            return None


def _wrong(reader: Reader, table: str, row: Row, newest: Mapping[str, Said]) -> str | None:
    if is_founded(row, newest):
        return None
    said, document, name = newest.get(row["id"]), _document(row), row["id"]
    if said is None:
        return f"`{name}`: the table `{table}` knows it, the log does not"
    if document is None:
        return f"`{name}`: what the table `{table}` holds is no document of it"
    for where, status in (("column", row["status"]), ("document", document["status"])):
        if status != said.status:
            return f"`{name}`: the {where} of the table `{table}` says `{status}`, the log makes it `{said.status}`"
    if (column := _strange_column(row, document)) is not None:
        return f"`{name}`: the column `{column}` of the table `{table}` is not what its document says"
    (event,) = reader.events(after=said.seq - 1, limit=1)
    stated = next(known for word in TABLES if (known := _whole(event.payload().get(word))) and known["id"] == name)
    others = sorted(key for key in stated.keys() | document.keys() if stated.get(key) != document.get(key))
    named = ", ".join(f"`{key}`" for key in others if key not in _NOT_STATED)
    return f"`{name}`: {named} in the table `{table}` is not what event `{said.seq}` says"


def _digest(document: dict[str, Any]) -> bytes:
    stated = {name: value for name, value in document.items() if name not in _NOT_STATED}
    return blake2b(orjson.dumps(stated, option=orjson.OPT_SORT_KEYS), digest_size=16).digest()
