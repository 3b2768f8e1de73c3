"""What a database is made of, compared with what the migrations make.

The log's tree says what the events are, and nothing of the triggers that keep them from being changed, of a trigger
that somebody added, or of a table with another shape. So the schema of a stored database has to be that of a database
made anew, to the letter.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, TypeAlias

import sqlalchemy as sa

from app.audit.migrate import migrate, revisions
from app.audit.reader import SCHEMA

if TYPE_CHECKING:
    from collections.abc import Iterable

    from app.audit.reader import Reader

Schema: TypeAlias = dict[tuple[str, str], tuple[str, str]]
"""By kind and name: the table it belongs to, and the statement that made it; SQLite's own indexes have none."""


def schema_problems(reader: Reader) -> list[str]:
    """Return in what a database is made otherwise than by its revision, in words; an empty list means in nothing.

    Raises:
        RecordDamaged: the database cannot be read.
    """
    revision = reader.revision()
    if revision not in revisions():
        return [f"its tables are of another version: `{revision}` is no revision"]
    made = made_by(revision)
    found = as_schema(reader.schema())
    missing = [f"the {kind} `{name}` is missing" for kind, name in sorted(made.keys() - found.keys())]
    foreign = [f"no server makes the {kind} `{name}`" for kind, name in sorted(found.keys() - made.keys())]
    changed = sorted(key for key in made.keys() & found.keys() if made[key] != found[key])
    return missing + foreign + [f"the {kind} `{name}` is not as a server makes it" for kind, name in changed]


@cache  # a revision stays as it was written
def made_by(revision: str) -> Schema:
    """Return what the migrations up to a revision make."""
    engine = sa.create_engine("sqlite://", isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            migrate(connection, revision)
            return as_schema(tuple(row) for row in connection.execute(SCHEMA))
    finally:
        engine.dispose()


def as_schema(rows: Iterable[tuple[str, str, str, str | None]]) -> Schema:
    """Return rows of SQLite's own table by kind and name; how a statement is broken into lines says nothing."""
    return {(kind, name): (table, " ".join((sql or "").split())) for kind, name, table, sql in rows}
