"""Statements compiled once write the same rows whatever order or style of parameters the driver wants."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import pytest
import sqlalchemy as sa

from app.audit.rows import DriverText

TABLE = sa.Table("things", sa.MetaData(), sa.Column("name", sa.Text), sa.Column("size", sa.Integer))


class Ordered(NamedTuple):
    name: str
    size: int


class Reversed(NamedTuple):
    size: int
    name: str


@pytest.fixture(params=["qmark", "named"])
def connection(request: pytest.FixtureRequest) -> Iterator[sa.Connection]:
    engine = sa.create_engine("sqlite://", paramstyle=request.param)
    with engine.connect() as opened:
        TABLE.create(opened)
        yield opened
    engine.dispose()


def test_rows_arrive_in_their_columns_whatever_their_own_order(connection: sa.Connection) -> None:
    text = DriverText.of(sa.insert(TABLE), connection.dialect)
    text.run_rows(connection, [Ordered("a", 1), Ordered("b", 2)])
    text.run_rows(connection, [Reversed(3, "c"), Reversed(4, "d")])
    text.run(connection, [{"size": 5, "name": "e"}])
    stored = connection.execute(sa.select(TABLE).order_by(TABLE.c.size)).all()
    assert stored == [("a", 1), ("b", 2), ("c", 3), ("d", 4), ("e", 5)]


def test_no_rows_are_no_statement(connection: sa.Connection) -> None:
    DriverText.of(sa.insert(TABLE), connection.dialect).run_rows(connection, [])
    assert connection.execute(sa.select(sa.func.count()).select_from(TABLE)).scalar() == 0
