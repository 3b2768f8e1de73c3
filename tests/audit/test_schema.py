"""A database that is made otherwise than the migrations make one is found, before and while a server writes to it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from app.audit.archive import database_problems, verify_file
from app.audit.errors import RecordDamaged, RecordUnavailable
from app.audit.places import Places
from app.audit.store import AuditStore
from tests.audit.conftest import draft, fill, permit_row
from tests.audit.test_migrate import REVISIONS, put_back

pytestmark = pytest.mark.anyio

FOREIGN = "CREATE TRIGGER foreign_one BEFORE INSERT ON {} BEGIN SELECT RAISE(IGNORE); END"
CHANGES = {
    "the trigger `events_refuse_delete` is missing": ["DROP TRIGGER events_refuse_delete"],
    "the index `events_by_at` is missing": ["DROP INDEX events_by_at"],
    "no server makes the trigger `foreign_one`": [FOREIGN.format("events")],
    "no server makes the table `other`": ["CREATE TABLE other (a)"],
    "the table `permits_used` is not as a server makes it": ["ALTER TABLE permits_used ADD COLUMN more TEXT"],
    "the trigger `events_refuse_update` is not as a server makes it": [
        "DROP TRIGGER events_refuse_update",
        "CREATE TRIGGER events_refuse_update BEFORE UPDATE ON events BEGIN SELECT 1; END",
    ],
    "its tables are of another version: `head` is no revision": ["UPDATE alembic_version SET version_num = 'head'"],
    "its tables are of another version: `` is no revision": ["DELETE FROM alembic_version"],
}


def change(places: Places, *statements: str) -> None:
    with closing(sqlite3.connect(places.database, isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)


@pytest.mark.parametrize("problem", CHANGES)
async def test_a_changed_schema_is_found(data: Path, problem: str) -> None:
    store = AuditStore.open(data)
    await fill(store)
    await store.close()
    assert database_problems(data) == []
    change(store.places, *CHANGES[problem])
    assert verify_file(data).ok, "the events are as they were signed"
    assert problem in (database_problems(data) or [""])[0]
    with pytest.raises((RecordDamaged, RecordUnavailable), match=r"trigger|index|table"):
        AuditStore.open(data)


async def test_a_schema_that_was_changed_before_the_first_event_is_found(data: Path) -> None:
    await AuditStore.open(data).close()
    change(Places(data), FOREIGN.format("events"))
    with pytest.raises(RecordDamaged, match="no server makes the trigger `foreign_one`"):
        AuditStore.open(data)


@pytest.mark.parametrize("revision", REVISIONS)
async def test_a_record_of_an_older_version_is_compared_with_that(data: Path, revision: str) -> None:
    store = AuditStore.open(data)
    await fill(store)
    await store.close()
    put_back(store.places.database, revision)
    assert database_problems(data) == []
    change(store.places, "DROP TRIGGER events_refuse_update")
    assert database_problems(data) == [f"`{store.places.database}`: the trigger `events_refuse_update` is missing"]


@pytest.mark.parametrize("table", ["events", "checkpoints", "permits_used"])
async def test_nothing_is_acknowledged_that_a_foreign_trigger_leaves_out(store: AuditStore, table: str) -> None:
    await fill(store)
    change(store.places, FOREIGN.format(table))
    with pytest.raises(RecordUnavailable, match=f"what was written to the table `{table}` is not there"):
        await store.append([draft()], rows=[permit_row("p1")])
    assert (store.healthy, store.size) == (False, 12)
    change(store.places, "DROP TRIGGER foreign_one")
    assert await store.append([draft()], rows=[permit_row("p1")]) == [13]
    assert (store.healthy, (await store.verify()).ok) == (True, True)
