"""Rows come out of the database as they went in, whatever way their statement takes them there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from sqlite3 import IntegrityError

import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st

from app.audit import rows
from app.audit.rows import Batches, Insertion

META = sa.MetaData()
THINGS = sa.Table(
    "things",
    META,
    sa.Column("name", sa.Text),
    sa.Column("size", sa.Integer),
    sa.Column("content", sa.LargeBinary),
    sa.Column("cover", sa.LargeBinary),
)
NOTES = sa.Table("notes", META, sa.Column("id", sa.Text, primary_key=True), sa.Column("text", sa.Text, nullable=False))
Thing = tuple[str | None, int | None, bytes | None, bytes | None]
PLAIN: Thing = ("a", 1, b"x", None)

integers = st.integers(-(2**63), 2**63 - 1)
things = st.tuples(
    st.none() | st.text(st.characters(exclude_categories=["Cs"])), st.none() | integers, *[st.none() | st.binary()] * 2
)


class Opened:
    """A database in memory with two tables, and how rows get into them."""

    def __init__(self, connection: sa.Connection) -> None:
        META.create_all(connection)
        self.connection = connection
        self.things = Insertion(sa.insert(THINGS), THINGS, connection.dialect)
        self.notes = Insertion(rows.replacement(NOTES, "sqlite"), NOTES, connection.dialect)
        self.batches = Batches(connection, [self.things, self.notes])
        self.steps: list[str] = []
        connection.connection.set_trace_callback(self.steps.append)  # pyright: ignore[reportAttributeAccessIssue]

    def taken(self, table: sa.Table) -> list[tuple[object, ...]]:
        """Return what a table holds, and empty it."""
        found = self.connection.execute(sa.select(table).order_by(sa.text("rowid"))).all()
        self.connection.execute(sa.delete(table))
        return [tuple(row) for row in found]


@pytest.fixture(scope="module")
def opened() -> Iterator[Opened]:
    engine = sa.create_engine("sqlite://", isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        yield Opened(connection)
    engine.dispose()


@given(st.lists(things, min_size=1, max_size=6))
def test_every_value_comes_back_as_it_was(opened: Opened, given_rows: list[Thing]) -> None:
    opened.batches.write([opened.things.in_order(given_rows)])
    assert opened.taken(THINGS) == given_rows
    opened.batches.write([opened.things.of([dict(zip(THINGS.c.keys(), row, strict=True)) for row in given_rows])])
    assert opened.taken(THINGS) == given_rows


@pytest.mark.parametrize(
    ("given_rows", "at_once"),
    [
        ([PLAIN, PLAIN], True),
        ([PLAIN, ("cut\0here", 2, b"", None)], False),  # SQLite's JSON ends a text at NUL
        ([(r"\u0000 in words", 2, b"", None)], False),  # looks like it, which costs nothing but the speed
        ([PLAIN, ("b", 2, bytes(40), bytes(25))], False),
    ],
)
def test_what_would_not_come_back_from_one_step_takes_several(
    opened: Opened, monkeypatch: pytest.MonkeyPatch, given_rows: Sequence[Thing], at_once: bool
) -> None:
    monkeypatch.setattr(rows, "MAX_TOGETHER_BYTES", 64)
    opened.steps.clear()
    opened.batches.write([opened.notes.in_order([("1", "one")]), opened.things.in_order(given_rows)])
    assert ("COMMIT" in opened.steps) is not at_once
    assert (opened.taken(NOTES), opened.taken(THINGS)) == ([("1", "one")], given_rows)


@pytest.mark.parametrize("name", ["plain", "not\0plain"])
def test_the_last_row_of_a_key_stays_and_all_of_a_batch_or_none_is_written(opened: Opened, name: str) -> None:
    twice = opened.notes.in_order([("1", "one"), ("1", "uno")])
    opened.batches.write([twice, opened.things.in_order([(name, 1, None, None)])])
    assert (opened.taken(NOTES), opened.taken(THINGS)) == ([("1", "uno")], [(name, 1, None, None)])
    with pytest.raises(IntegrityError):
        opened.batches.write([opened.things.in_order([(name, 1, None, None)]), opened.notes.in_order([("2", None)])])
    opened.connection.connection.rollback()
    assert (opened.taken(NOTES), opened.taken(THINGS)) == ([], [])


@pytest.mark.parametrize("content", ["plain", "not\0plain"])
def test_a_row_that_a_trigger_of_somebody_else_leaves_out_fails_the_batch(opened: Opened, content: str) -> None:
    fine = opened.things.in_order([(content, 1, b"x", None)])
    left_out = opened.notes.in_order([("1", "one"), ("2", "two")])
    opened.connection.exec_driver_sql(
        "CREATE TRIGGER foreign_one BEFORE INSERT ON notes WHEN new.id = '2' BEGIN SELECT RAISE(IGNORE); END"
    )
    try:
        with pytest.raises((IntegrityError, OSError), match="what was written to the table `notes` is not there"):
            opened.batches.write([fine, left_out])
        opened.connection.connection.rollback()
    finally:
        opened.connection.exec_driver_sql("DROP TRIGGER foreign_one")
    assert (opened.taken(NOTES), opened.taken(THINGS)) == ([], [])
    opened.batches.write([fine, left_out])
    assert (len(opened.taken(NOTES)), len(opened.taken(THINGS))) == (2, 1)


def test_no_rows_are_no_step(opened: Opened) -> None:
    opened.steps.clear()
    opened.batches.write([])
    assert opened.steps == []
