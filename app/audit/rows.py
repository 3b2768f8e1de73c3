"""Rows of the runtime's state on their way into the database: what fits a table, and how it is written there."""

from __future__ import annotations

from functools import cache
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import orjson
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.audit.errors import RowMalformed
from app.audit.tables import BEGIN_WRITE, KEPT_ON_REPLACE, STATE, STORE_GIVEN

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from app.audit.event import RowWrite

MAX_TOGETHER_BYTES = 64 * 1024 * 1024  # SQLite takes a billion in one parameter
NOT_THERE = "what was written to the table `{}` is not there"
NUL = "\\u0000"  # ends a text where SQLite reads JSON
UPSERT = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}
WORDS: Mapping[type, str] = {str: "text in UTF-8", int: "an integer of 64 bits", bytes: "bytes"}


class Field(NamedTuple):
    """What one column takes."""

    type: type
    nullable: bool

    def takes(self, value: object) -> bool:
        """Say whether a value can stand in the column."""
        if value is None:
            return self.nullable
        if not isinstance(value, self.type) or isinstance(value, bool):
            return False
        match value:
            case int():
                return -(2**63) <= value < 2**63
            case str():
                return value.isascii() or not any("\ud800" <= character <= "\udfff" for character in value)
            case _:
                return True


def fields_of(table: sa.Table) -> dict[str, Field]:
    """Return what each column takes that a caller fills in."""
    return {
        column.name: Field(column.type.python_type, bool(column.nullable))
        for column in table.columns
        if column.name != STORE_GIVEN
    }


FIELDS: Mapping[str, Mapping[str, Field]] = {name: fields_of(table) for name, table in STATE.items()}


def check_row(row: RowWrite) -> None:
    """Refuse a row before it can spoil a batch of others.

    Raises:
        RowMalformed: an unknown table, a column missing or too many, a value of another type.
    """
    fields = FIELDS.get(row.table)
    if fields is None:
        raise RowMalformed(f"`{row.table}` is no table of state: valid are {', '.join(f'`{name}`' for name in FIELDS)}")
    if row.values.keys() != fields.keys():
        raise RowMalformed(f"a row of `{row.table}` has the columns {sorted(fields)}, not {sorted(row.values)}")
    for name, value in row.values.items():
        field = fields[name]
        if type(value) is str and field.type is str and value.isascii():
            continue  # the usual case, at a glance
        if not field.takes(value):
            raise RowMalformed(f"`{row.table}.{name}` cannot hold `{value!r}`: valid is {WORDS[field.type]}")


def primary_key(row: RowWrite) -> tuple[object, ...]:
    """Return the values of a row's primary key."""
    return tuple(row.values[column.name] for column in STATE[row.table].primary_key.columns)


def same_key(row: RowWrite) -> sa.Select[Any]:
    """Ask for the stored row that has the same primary key."""
    columns = STATE[row.table].primary_key.columns
    return sa.select(sa.literal(1)).where(*(column == row.values[column.name] for column in columns))


class Writing(NamedTuple):
    """Rows of one table, on their way."""

    table: str
    text: str  # the statement, and what it takes for each of the rows
    rows: Sequence[Any]
    packed: tuple[str, bytes] | None  # all rows as JSON, beside what they hold of bytes; see `Insertion.pack`


class Insertion:
    """How rows get into one table: compiled once, because SQLAlchemy's way there costs more than the insert itself."""

    def __init__(self, statement: Any, table: sa.Table, dialect: sa.Dialect) -> None:  # noqa: ANN401 - either dialect's
        """Compile an insertion that takes columns of a table as its parameters."""
        compiled = statement.compile(dialect=dialect)
        self.table = table.name
        self._text = str(compiled)
        self.names: tuple[str, ...] = tuple(compiled.positiontup)
        self._keys = tuple((column.name, self.names.index(column.name)) for column in table.primary_key.columns)
        self._bytes = tuple(table.c[name].type.python_type is bytes for name in self.names)

    def of(self, rows: Sequence[Mapping[str, Any]]) -> Writing:
        """Make ready rows that are given by their columns' names."""
        pick: Callable[[Mapping[str, Any]], tuple[Any, ...]] = itemgetter(*self.names)  # pyright: ignore[reportUnknownVariableType]
        return self.in_order([pick(row) for row in rows])

    def in_order(self, rows: Sequence[tuple[Any, ...]]) -> Writing:
        """Make ready rows whose values stand in the order of `names`."""
        return Writing(self.table, self._text, rows, self.pack(rows))

    def pack(self, rows: Sequence[tuple[Any, ...]]) -> tuple[str, bytes] | None:
        """Return rows as `unpacking` takes them; None where they would not come out as they went in."""
        pieces = [b"\0"]  # SQLite takes no bytes at all for NULL
        start = 2  # it counts from 1
        lists: list[list[Any]] = []
        for row in rows:
            fields: list[Any] = []
            for value, is_bytes in zip(row, self._bytes, strict=True):
                if not is_bytes:
                    fields.append(value)
                elif value is None:
                    fields += (None, None)
                else:
                    fields += (start, len(value))
                    pieces.append(value)
                    start += len(value)
            lists.append(fields)
        text = orjson.dumps(lists).decode()
        if start > MAX_TOGETHER_BYTES or NUL in text:
            return None
        return text, b"".join(pieces)

    def unpacking(self, text: str, content: str) -> str:
        """Return the statement that writes what `pack` returned, both parts of it given as SQLite's expressions."""
        found: list[str] = []
        place = 0
        for is_bytes in self._bytes:
            field = f"value ->> {place}"
            found.append(f"substr({content}, {field}, value ->> {place + 1})" if is_bytes else field)
            place += 1 + is_bytes
        head, _, rest = self._text.partition(f" VALUES ({', '.join('?' * len(self.names))})")
        # `WHERE true`, so that the ON of a conflict is not taken for a join's.
        return f"{head} SELECT {', '.join(found)} FROM json_each({text}) WHERE true{rest}"  # noqa: S608

    def missing(self, text: str) -> str:
        """Return where rows come from that `pack` returned as JSON and whose keys the table does not hold."""
        fields = [place + sum(self._bytes[:place]) for _, place in self._keys]
        same = [f"kept.{name} = given.value ->> {field}" for (name, _), field in zip(self._keys, fields, strict=True)]
        there = f"EXISTS (SELECT 1 FROM {self.table} AS kept WHERE {' AND '.join(same) or 'true'})"  # noqa: S608
        return f"FROM json_each({text}) AS given WHERE NOT {there}"

    def holding(self, row: Sequence[Any]) -> tuple[str, list[Any]]:
        """Return the query for the key of a row, and what it takes."""
        same = " AND ".join(f"{name} = ?" for name, _ in self._keys) or "true"
        return f"SELECT 1 FROM {self.table} WHERE {same}", [row[place] for _, place in self._keys]  # noqa: S608


class Batches:
    """Writes rows of several tables in one transaction, in one step of the database where that can be.

    Between any two steps the driver takes the interpreter, and the event loop that had it has to wait until it gets it
    back: row by row, a batch costs the loop more in waiting than it costs to write. So SQLite gets all of a batch at
    once, inserted into a view of this connection whose triggers know where it belongs.

    A trigger that somebody else put into the file can leave a row out without a word (`RAISE(IGNORE)`). So every key
    has to be there before the transaction ends, or the batch fails as on a disk that takes no more.
    """

    def __init__(self, connection: sa.Connection, insertions: Sequence[Insertion]) -> None:
        """Tell the database what belongs where. Raises `sqlalchemy.exc.SQLAlchemyError`."""
        self._connection = connection
        self._insertions = {insertion.table: insertion for insertion in insertions}
        self._begin = BEGIN_WRITE[connection.dialect.name]
        columns: list[str] = []
        for insertion in insertions:
            columns += [f"NULL AS {insertion.table}", f"NULL AS {insertion.table}_bytes"]
        connection.exec_driver_sql(f"CREATE TEMP VIEW batch AS SELECT {', '.join(columns)}")
        for insertion in insertions:
            given = f"new.{insertion.table}"
            connection.exec_driver_sql(
                f"CREATE TEMP TRIGGER batch_{insertion.table} INSTEAD OF INSERT ON batch WHEN {given} IS NOT NULL"
                f" BEGIN {insertion.unpacking(given, f'{given}_bytes')};"
                f" SELECT RAISE(ABORT, '{NOT_THERE.format(insertion.table)}') {insertion.missing(given)}; END"
            )

    def write(self, writings: Sequence[Writing]) -> None:
        """Write and commit; each table at most once.

        Raises:
            Exception: the driver's own error, or OSError; a transaction may be left open.
        """
        parameters: list[str | bytes] = []
        for writing in writings:
            if writing.packed is None:
                self._one_by_one(writings)
                return
            parameters += writing.packed
        if writings:
            names = ", ".join(f"{writing.table}, {writing.table}_bytes" for writing in writings)
            given = ", ".join("?" * len(parameters))
            execute(self._connection, f"INSERT INTO batch ({names}) VALUES ({given})", parameters)  # noqa: S608

    def _one_by_one(self, writings: Sequence[Writing]) -> None:
        execute(self._connection, self._begin)
        cursor = self._connection.connection.cursor()
        try:
            for writing in writings:
                cursor.executemany(writing.text, writing.rows)
                insertion = self._insertions[writing.table]
                if any(cursor.execute(*insertion.holding(row)).fetchone() is None for row in writing.rows):
                    raise OSError(NOT_THERE.format(writing.table))
        finally:
            cursor.close()
        execute(self._connection, "COMMIT")


def execute(connection: sa.Connection, text: str, parameters: Sequence[str | bytes] = ()) -> None:
    """Have the driver itself execute a statement: SQLAlchemy would do as much on the way there.

    Raises:
        Exception: the driver's own error.
    """
    cursor = connection.connection.cursor()
    try:
        cursor.execute(text, parameters)
    finally:
        cursor.close()


@cache
def prepared(table: sa.Table, dialect: str, *, replaces: bool = False) -> Insertion:
    """Return how rows get into a table; compiled once, however many logs a process opens.

    Args:
        table: the table.
        dialect: the database's, one of `UPSERT`.
        replaces: whether a row takes the place of the one with its key, as `replacement` says.
    """
    statement = replacement(table, dialect) if replaces else sa.insert(table)
    return Insertion(statement, table, sa.URL.create(dialect).get_dialect()())


def replacement(table: sa.Table, dialect: str) -> sa.Executable:
    """Insert a row, or put it in the place of the one with its key; what was given at its insertion stays."""
    insertion = UPSERT[dialect](table)
    keys = {column.name for column in table.primary_key.columns}
    changed = [column.name for column in table.columns if column.name not in keys | KEPT_ON_REPLACE]
    return insertion.on_conflict_do_update(
        index_elements=sorted(keys), set_={name: insertion.excluded[name] for name in changed}
    )
