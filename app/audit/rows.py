"""Rows of the runtime's state on their way into the database: what fits a table, and how it is written there."""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.audit.errors import RowMalformed
from app.audit.tables import KEPT_ON_REPLACE, STATE, STORE_GIVEN

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from app.audit.event import RowWrite

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


class DriverText(NamedTuple):
    """A statement as the driver takes it, compiled once: building parameters anew cost more than the insert itself."""

    text: str
    names: tuple[str, ...]
    positional: bool

    @classmethod
    def of(cls, statement: Any, dialect: sa.Dialect) -> DriverText:  # noqa: ANN401 - an insert of either dialect
        """Compile an insertion that takes every column as a parameter."""
        compiled = statement.compile(dialect=dialect)
        return cls(str(compiled), tuple(compiled.positiontup or ()), bool(compiled.positional))

    def run(self, connection: sa.Connection, values: Sequence[Mapping[str, Any]]) -> None:
        """Execute the statement once for each mapping."""
        if self.positional:
            pick: Callable[[Mapping[str, Any]], tuple[Any, ...]] = itemgetter(*self.names)  # pyright: ignore[reportUnknownVariableType]
            self._execute(connection, [pick(row) for row in values])
        else:
            self._execute(connection, [dict(row) for row in values])

    def run_rows(self, connection: sa.Connection, rows: Sequence[tuple[Any, ...]]) -> None:
        """Execute the statement once for each named tuple, whose fields may stand in the statement's own order."""
        if not rows:
            return
        fields = getattr(rows[0], "_fields", ())
        if self.positional and fields == self.names:
            self._execute(connection, rows)
        else:
            self.run(connection, [dict(zip(fields, row, strict=True)) for row in rows])

    def _execute(self, connection: sa.Connection, parameters: Sequence[Any]) -> None:
        """Hand the rows to the driver itself, see `execute`."""
        cursor = connection.connection.cursor()
        try:
            cursor.executemany(self.text, parameters)
        finally:
            cursor.close()


def execute(connection: sa.Connection, text: str) -> None:
    """Have the driver itself execute a statement without parameters: SQLAlchemy would do as much on the way there.

    Raises:
        Exception: the driver's own error.
    """
    cursor = connection.connection.cursor()
    try:
        cursor.execute(text)
    finally:
        cursor.close()


def replacement(table: sa.Table, dialect: str) -> sa.Executable:
    """Insert a row, or put it in the place of the one with its key; what was given at its insertion stays."""
    insertion = UPSERT[dialect](table)
    keys = {column.name for column in table.primary_key.columns}
    changed = [column.name for column in table.columns if column.name not in keys | KEPT_ON_REPLACE]
    return insertion.on_conflict_do_update(
        index_elements=sorted(keys), set_={name: insertion.excluded[name] for name in changed}
    )
