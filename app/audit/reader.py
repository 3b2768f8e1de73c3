"""Reading the record, on a connection that cannot write: filters, pages, single rows. Safe beside a running writer.

Every read fetches a bounded page and lets go, since a reader that stays open makes the write-ahead log grow.
"""

from __future__ import annotations

import re
import sqlite3
import zlib
from contextlib import closing
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypedDict, Unpack, cast
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.util import LRUCache

from app.audit.errors import AuditError, RecordDamaged, RecordUnreadable
from app.audit.event import MAX_PAGE_BYTES, Event
from app.audit.tables import STATE, STORE_GIVEN, checkpoints, events, invocations
from app.clock import monotonic_s, rfc3339
from app.governance.model import EventKind

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping
    from pathlib import Path

    from sqlalchemy.engine.interfaces import DBAPIConnection

Row = dict[str, Any]
MAX_LIMIT = 1000
PRIMARY = 0xFF  # of SQLite's codes: the rest says which of a kind it is
FAILURES = (SQLAlchemyError, sqlite3.Error, UnicodeDecodeError)  # the last where SQLite cites a damaged schema
LOOK_EVERY = 10_000  # of SQLite's own steps, between two looks at the clock
EVENT_COLUMNS = (events.c.seq, events.c.at, events.c.kind, events.c.invocation, events.c.actor, events.c.body)
# Whoever looks at a log opens a handful of readers; compiling what each asks would take longer than the answers do.
COMPILED: Final = LRUCache[Any, Any](500)
NEWEST = sa.select(checkpoints.c.size, checkpoints.c.note).order_by(checkpoints.c.size.desc()).limit(1)
EXTENT = sa.text(
    "SELECT (SELECT min(seq) FROM events) AS first, (SELECT max(seq) FROM events) AS last,"
    " (SELECT max(size) FROM checkpoints) AS signed"
)  # as text: the one question of whoever opens a log, which SQLAlchemy compiles anew each time
SCHEMA = sa.text("SELECT type, name, tbl_name, sql FROM sqlite_master")
REVISION = sa.text("SELECT version_num FROM alembic_version")


class EventFilters(TypedDict, total=False):
    """Which events of the log; what is left out or None filters nothing."""

    invocation: str | None  # only those under this one
    kind: str | None
    actor: str | None
    since: float | None  # wall time in seconds, included
    until: float | None  # wall time in seconds, excluded


class Page(NamedTuple):
    """Some rows, newest first, and the cursor that continues behind them, if there are more."""

    items: list[Row]
    next: str | None


class Batch(NamedTuple):
    """A checkpoint as stored: it vouches for the events `first` to `size`."""

    size: int
    first: int
    note: str
    frontier: bytes
    leaves: bytes


class Extent(NamedTuple):
    """First and last event and the last checkpoint's size, seen at one moment; 0 where there is none."""

    first: int
    last: int
    signed: int


@cache
def _common() -> sa.Engine:
    """Return an engine that has met its SQLite; all readers' are of its dialect, for which `COMPILED` holds."""
    engine = sa.create_engine("sqlite://")
    engine.connect().close()
    return engine


class Reader:
    """Read-only access to one log's database.

    Whatever raises `RecordDamaged` for what it finds raises `RecordUnreadable` where it cannot look at this moment.
    """

    def __init__(self, database: Path) -> None:
        """Open the database.

        Raises:
            RecordDamaged: there is no such file, or it is no log.
            OSError: nobody can say whether there is one.
        """
        self.database = database
        if not database.is_file():
            raise RecordDamaged(database, "no such log: is this the data directory of a server?")
        common = _common()
        self._engine = sa.Engine(
            sa.QueuePool(cast("Callable[[], DBAPIConnection]", self._connect), pool_size=2, dialect=common.dialect),
            common.dialect,
            common.url,
            execution_options={"compiled_cache": COMPILED},
        )
        try:
            self.extent()
        except AuditError:
            self._engine.dispose()
            raise

    def _connect(self) -> sqlite3.Connection:
        uri = f"file:{quote(str(self.database.resolve()))}?mode=ro"
        # A closed log in a directory that cannot be written has no place for the file readers share: read it as it is.
        log = self.database.with_name(self.database.name + "-wal")
        try:
            return open_read_only(uri)
        except sqlite3.OperationalError as error:
            if _primary(error) == sqlite3.SQLITE_BUSY or (log.exists() and log.stat().st_size):
                raise
            return open_read_only(f"{uri}&immutable=1")

    def close(self) -> None:
        """Let go of the database."""
        self._engine.dispose()

    # -- the log -----------------------------------------------------------------------------------------------------

    def events(
        self,
        *,
        after: int = 0,
        before: int | None = None,
        newest: bool = False,
        limit: int = 100,
        **filters: Unpack[EventFilters],
    ) -> list[Event]:
        """Return events in order of `seq`.

        Args:
            after: only those behind this `seq`: oldest first, the last one already seen.
            before: only those in front of this `seq`: newest first, the last one already seen.
            newest: the newest first, not the oldest.
            limit: at most so many, 1 to 1000.
            filters: which of them.

        Raises:
            ValueError: a limit out of bounds, or a time that is none.
            RecordDamaged: the database cannot be read.
        """
        query = sa.select(*EVENT_COLUMNS).where(events.c.seq > after)
        for column in (events.c.invocation, events.c.kind, events.c.actor):
            if (value := filters.get(column.name)) is not None:
                query = query.where(column == value)
        if (since := filters.get("since")) is not None:
            query = query.where(events.c.at >= rfc3339(since))
        if (until := filters.get("until")) is not None:
            query = query.where(events.c.at < rfc3339(until))
        if before is not None:
            query = query.where(events.c.seq < before)
        order = events.c.seq.desc() if newest else events.c.seq
        return [Event(*row) for row in self._all(query.order_by(order).limit(bounded(limit)))]

    def holding(
        self,
        words: Collection[str],
        *,
        kind: str | None = None,
        actor: str | None = None,
        after: int = 0,
        before: int | None = None,
        newest: bool = False,
        limit: int = 100,
    ) -> list[Event]:
        """Return events whose bytes hold one of these pieces of JSON, in order of `seq`; others are not even fetched.

        A piece may stand anywhere: whoever asks reads the events themselves.

        Args:
            words: the pieces, as they are written in canonical JSON.
            kind: only those of this kind.
            actor: only those by this actor.
            after: only those behind this `seq`.
            before: only those in front of this `seq`.
            newest: the newest first, not the oldest.
            limit: at most so many, 1 to 1000.

        Raises:
            ValueError: a limit out of bounds.
            RecordDamaged: the database cannot be read.
        """
        query = sa.select(*EVENT_COLUMNS).where(events.c.seq > after)
        query = query.where(sa.or_(*(sa.func.instr(events.c.body, word.encode()) > 0 for word in words)))
        for column, value in ((events.c.kind, kind), (events.c.actor, actor)):
            if value is not None:
                query = query.where(column == value)
        if before is not None:
            query = query.where(events.c.seq < before)
        order = events.c.seq.desc() if newest else events.c.seq
        return [Event(*row) for row in self._all(query.order_by(order).limit(bounded(limit)))]

    def extent(self) -> Extent:
        """Return how far events and checkpoints reach.

        Raises:
            RecordDamaged: the database cannot be read.
        """
        (row,) = self._all(EXTENT)
        return Extent(*(value or 0 for value in row))

    def head(self) -> tuple[int, str]:
        """Return the newest checkpoint's size and its signed note; 0 and no text before the first.

        Raises:
            RecordDamaged: the database cannot be read.
        """
        rows = self._all(NEWEST)
        return (rows[0].size, rows[0].note) if rows else (0, "")

    def batches(self, *, after: int, until: int, limit: int) -> list[Batch]:
        """Return checkpoints with `after` < size ≤ `until`, in order.

        Raises:
            RecordDamaged: the database cannot be read.
        """
        columns = (checkpoints.c[name] for name in Batch._fields)
        query = sa.select(*columns).where(checkpoints.c.size > after, checkpoints.c.size <= until)
        return [Batch(*row) for row in self._all(query.order_by(checkpoints.c.size).limit(limit))]

    def schema(self) -> list[tuple[str, str, str, str | None]]:
        """Return what the database is made of: kind, name, table and statement of each part.

        Raises:
            RecordDamaged: the database cannot be read.
        """
        return [(str(kind), str(name), str(table), sql) for kind, name, table, sql in self._all(SCHEMA)]

    def revision(self) -> str:
        """Return the revision that the database says its tables are of; no text where it says none.

        Raises:
            RecordDamaged: the database cannot be read.
        """
        rows = self._all(REVISION)
        return str(rows[0][0]) if len(rows) == 1 else ""

    def faults(self, limit: int, *, within_s: float | None = None) -> list[str] | None:
        """Return the first faults SQLite finds in its file: damaged pages, and indexes that disagree with their tables.

        It reads every page in one go, during which a writer's log ahead of the file cannot be taken back.

        Args:
            limit: how many to return at most.
            within_s: how long it may take; None has no limit.

        Returns:
            The faults; None where the time was not enough to look everywhere.

        Raises:
            RecordDamaged: the database cannot be read.
        """
        query = f"PRAGMA integrity_check({bounded(limit)})"
        try:
            with closing(self._connect()) as connection:
                if within_s is not None:
                    until_s = monotonic_s() + within_s
                    connection.set_progress_handler(lambda: monotonic_s() >= until_s, LOOK_EVERY)
                found = connection.execute(query).fetchall()
        except FAILURES as error:
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT:
                return None
            raise self._failure(error) from error
        lines = [str(line) for (line,) in found]
        return [] if lines == ["ok"] else lines

    def told(self, *, kinds: Collection[str], after: str, limit: int) -> list[tuple[Row, list[Event]]]:
        """Return rows of `invocations` by id, each with its events in order, seen at one moment.

        Args:
            kinds: only events of these kinds.
            after: cursor, the last id already seen.
            limit: at most so many rows, 1 to 1000.

        Raises:
            ValueError: a limit out of bounds.
            RecordDamaged: the database cannot be read.
        """
        page = sa.select(invocations).where(invocations.c.id > after).order_by(invocations.c.id).limit(bounded(limit))
        try:
            with self._engine.connect() as connection, connection.begin():
                connection.exec_driver_sql("BEGIN")  # both questions are about the same moment
                rows = [as_dict(invocations, row) for row in connection.execute(page)]
                found: dict[str | None, list[Event]] = {row["id"]: [] for row in rows}
                mine = sa.select(*EVENT_COLUMNS).where(events.c.invocation.in_(found), events.c.kind.in_(kinds))
                for row in connection.execute(mine.order_by(events.c.seq)):
                    found[row.invocation].append(Event(*row))
        except FAILURES as error:
            raise self._failure(error) from error
        return [(row, found[row["id"]]) for row in rows]

    def beside(
        self, table: str, *, kinds: Collection[str], since: int, after: str, limit: int
    ) -> tuple[list[Event], list[Row]]:
        """Return events of some kinds in order of `seq`, and rows of a state table by id, seen at one moment.

        Args:
            table: the state table.
            kinds: only events of these kinds.
            since: cursor of the events, the last `seq` already seen.
            after: cursor of the rows, the last id already seen.
            limit: at most so many of each, 1 to 1000.

        Raises:
            KeyError: no such table.
            ValueError: a limit out of bounds.
            RecordDamaged: the database cannot be read.
        """
        state = STATE[table]
        # By `seq` from where the last page ended: the index of kinds would have all the rest sorted for every page.
        unindexed = sa.literal_column("+events.kind", sa.Text)
        told = sa.select(*EVENT_COLUMNS).where(events.c.seq > since, unindexed.in_(kinds))
        page = sa.select(state).where(state.c.id > after).order_by(state.c.id).limit(bounded(limit))
        try:
            with self._engine.connect() as connection, connection.begin():
                connection.exec_driver_sql("BEGIN")  # both questions are about the same moment
                found = [Event(*row) for row in connection.execute(told.order_by(events.c.seq).limit(limit))]
                return found, [as_dict(state, row) for row in connection.execute(page)]
        except FAILURES as error:
            raise self._failure(error) from error

    def without_row(self, limit: int) -> list[str]:
        """Return invocations that the log knows and the table `invocations` does not, the oldest first.

        Raises:
            ValueError: a limit out of bounds.
            RecordDamaged: the database cannot be read.
        """
        rowless = ~sa.exists().where(invocations.c.id == events.c.invocation)
        query = sa.select(events.c.invocation).where(events.c.kind == EventKind.ADMISSION, rowless).distinct()
        return [str(row[0]) for row in self._all(query.order_by(events.c.invocation).limit(bounded(limit)))]

    # -- the runtime's state -----------------------------------------------------------------------------------------

    def row(self, table: str, **key: str | int) -> Row | None:
        """Return the row of a state table with this primary key.

        Raises:
            KeyError: no such table or column.
            RecordDamaged: the database cannot be read.
        """
        query = sa.select(STATE[table]).where(*(STATE[table].c[name] == value for name, value in key.items()))
        rows = self._all(query.limit(1))
        return as_dict(STATE[table], rows[0]) if rows else None

    def rows(self, table: str, filters: Mapping[str, Any] | None = None) -> list[Row]:
        """Return all rows of a state table by primary key; a filter's tuple of values means any of them.

        For what is small or filtered to be so; `page` is for the rest.

        Raises:
            KeyError: no such table or column.
            RecordDamaged: the database cannot be read.
        """
        query = filtered(STATE[table], filters).order_by(*STATE[table].primary_key.columns)
        return [as_dict(STATE[table], row) for row in self._all(query)]

    def page(
        self, table: str, filters: Mapping[str, Any] | None = None, *, limit: int = 50, cursor: str | None = None
    ) -> Page:
        """Return rows of a state table that has `created_seq`, newest first.

        Args:
            table: one that has `created_seq`.
            filters: values by column; None does not filter, a tuple means any of its values.
            limit: at most so many, 1 to 1000; fewer where they hold more than `MAX_PAGE_BYTES`.
            cursor: the `next` of the page before.

        Raises:
            KeyError: no such table or column.
            ValueError: a limit out of bounds, or a cursor that no page gave.
            RecordDamaged: the database cannot be read.
        """
        columns = STATE[table].c
        age = sa.tuple_(columns[STORE_GIVEN], columns.id)
        query = filtered(STATE[table], filters)
        if cursor is not None:
            query = query.where(age < sa.tuple_(*(sa.literal(part) for part in parse_cursor(table, cursor))))
        query = query.order_by(columns[STORE_GIVEN].desc(), columns.id.desc()).limit(bounded(limit) + 1)
        items, more = self._fitting(STATE[table], query, limit)
        return Page(items, _cursor(table, f"{items[-1][STORE_GIVEN]}.{items[-1]['id']}") if more else None)

    def _fitting(self, table: sa.Table, query: sa.Select[Any], limit: int) -> tuple[list[Row], bool]:
        """Return the first rows of a query, as many as go on a page, and whether there are more; no others are read."""
        items: list[Row] = []
        size = 0
        try:
            with self._engine.connect() as connection, closing(connection.execute(query)) as found:
                for row in found:
                    item = as_dict(table, row)
                    size += sum(len(value) for value in item.values() if isinstance(value, bytes))
                    if len(items) == limit or (items and size > MAX_PAGE_BYTES):
                        return items, True
                    items.append(item)
        except FAILURES as error:
            raise self._failure(error) from error
        return items, False

    def _all(self, query: sa.Select[*tuple[Any, ...]] | sa.TextClause) -> list[sa.Row[*tuple[Any, ...]]]:
        try:
            with self._engine.connect() as connection:
                return list(connection.execute(query).all())
        except FAILURES as error:
            raise self._failure(error) from error

    def _failure(self, error: Exception) -> AuditError:
        return failure(self.database, error)


def failure(database: Path, error: Exception) -> RecordDamaged | RecordUnreadable:
    """Return what an error of SQLite, or of SQLAlchemy about one, means for the log.

    An `OperationalError` with a code is the world's fault, like a file that cannot be opened, a lock, or a disk that
    does not answer. It is the file's where the code says no more than that the statement is wrong, since then a table
    is missing, and where the driver has none, since then a text is no UTF-8.
    """
    cause = getattr(error, "orig", None) or error
    if isinstance(cause, sqlite3.OperationalError) and _primary(cause) != sqlite3.SQLITE_ERROR:
        return RecordUnreadable(database, str(cause))
    return RecordDamaged(database, f"cannot be read as a log: {cause}")


def _primary(error: sqlite3.Error) -> int:
    return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & PRIMARY


def open_read_only(uri: str) -> sqlite3.Connection:
    """Open a SQLite URI and read its head, so that what is wrong with it shows here.

    Raises:
        sqlite3.Error, UnicodeDecodeError: it cannot be opened or is no database.
    """
    connection = sqlite3.connect(uri, uri=True, check_same_thread=False, isolation_level=None, timeout=5)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except (sqlite3.Error, UnicodeDecodeError):
        connection.close()
        raise
    return connection


def as_dict(table: sa.Table, row: sa.Row[*tuple[Any, ...]]) -> Row:
    """Return a row of a whole table as values by column."""
    return dict(zip(table.columns.keys(), row, strict=True))


def filtered(table: sa.Table, filters: Mapping[str, Any] | None) -> sa.Select[Any]:
    """Select from a table by equality.

    Raises:
        KeyError: no such column.
    """
    query = sa.select(table)
    for name, value in (filters or {}).items():
        if isinstance(value, tuple):
            query = query.where(table.c[name].in_(cast("tuple[Any, ...]", value)))
        elif value is not None:
            query = query.where(table.c[name] == value)
    return query


def fitting(sizes: Iterable[int]) -> int:
    """Return how many of these many bytes go on a page: as many as fit, and one in any case."""
    count, room = 0, MAX_PAGE_BYTES
    for size in sizes:
        room -= size
        if count and room < 0:
            break
        count += 1
    return count


def bounded(limit: int) -> int:
    """Return a limit within bounds.

    Raises:
        ValueError: it is not.
    """
    if not 1 <= limit <= MAX_LIMIT:
        raise ValueError(f"`{limit}` is no limit: valid is 1 to {MAX_LIMIT}")
    return limit


_CURSOR: Final = re.compile(r"(0|[1-9][0-9]{0,17})\.(.+)", re.ASCII | re.DOTALL)  # a damaged id is one, too


def _cursor(table: str, place: str) -> str:
    """Return a place as one in this list: no other list takes it, nor this one another that was made of it."""
    return f"{place}.{zlib.crc32(f'{table} {place}'.encode()):08x}"


def parse_cursor(table: str, cursor: str) -> tuple[int, str]:
    """Read what `page` returned as `next` of a table.

    Raises:
        ValueError: no page of that table gave this.
    """
    place, _, _ = cursor.rpartition(".")
    found = _CURSOR.fullmatch(place)
    if found is None or cursor != _cursor(table, place):
        raise ValueError(f"`{cursor[:80]}` is no cursor: valid is the `next` of the page before, of the same list")
    return int(found[1]), found[2]
