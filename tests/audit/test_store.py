"""Appending, reading back, and what survives a restart."""

from __future__ import annotations

import asyncio
import importlib
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from app.audit.errors import (
    AuditError,
    EventMalformed,
    RecordDamaged,
    RecordUnavailable,
    RowExists,
    RowMalformed,
    StoreInUse,
)
from app.audit.event import Event, EventDraft, RowWrite
from app.audit.merkle import Frontier, leaf_hash
from app.audit.places import Places
from app.audit.store import AuditStore
from app.clock import parse_rfc3339, wall_s
from tests.audit.conftest import TIME, draft, fill, invocation_row, permit_row, until

pytestmark = pytest.mark.anyio


def progress_row(up_seq: int) -> RowWrite:
    return RowWrite(table="cell_progress", values={"cell": "a", "up_seq": up_seq, "journal": "", "updated_at": TIME})


def spoil(data: Path) -> None:
    data.mkdir()
    Places(data).database.write_bytes(b"no database" * 1000)


async def test_gives_places_without_gaps_to_concurrent_callers(store: AuditStore) -> None:
    answers = await asyncio.gather(*(store.append([draft(caller=n), draft(caller=n)]) for n in range(200)))
    places = [seq for answer in answers for seq in answer]
    assert sorted(places) == list(range(1, 401))
    assert all(second == first + 1 for first, second in answers)
    assert store.size == 400


async def test_returns_only_when_another_connection_sees_the_events(store: AuditStore) -> None:
    (seq,) = await store.append([draft(n=1)])
    with sqlite3.connect(store.places.database) as other:
        assert other.execute("SELECT seq FROM events").fetchall() == [(seq,)]
        assert other.execute("SELECT size FROM checkpoints").fetchall() == [(seq,)]
    other.close()
    await until(lambda: store.places.checkpoints.read_text() == f"{store.checkpoint}\n")


async def test_callers_share_a_commit_while_another_runs(store: AuditStore) -> None:
    await asyncio.gather(*(store.append([draft()]) for _ in range(100)))
    assert store.places.checkpoints.read_text().count("reins/log-") // 2 < 10


async def test_signs_a_checkpoint_over_the_stored_bytes(store: AuditStore) -> None:
    await fill(store)
    assert store.checkpoint is not None
    head = store.verifier.open(store.checkpoint)
    bodies = [event.body for event in await store.events(limit=1000)]
    assert (head.size, head.root) == (12, Frontier().extend(map(leaf_hash, bodies)).root())


async def test_stamps_events_with_the_time_they_were_handed_over(store: AuditStore) -> None:
    before = wall_s()
    await store.append([draft()])
    (event,) = await store.events()
    assert before - 0.001 <= parse_rfc3339(event.at) <= wall_s()


async def test_goes_on_where_it_ended(data: Path) -> None:
    first = AuditStore.open(data)
    await fill(first)
    checkpoint = first.checkpoint
    await first.close()
    second = AuditStore.open(data)
    assert (second.size, second.checkpoint, second.verifier) == (12, checkpoint, first.verifier)
    assert await second.append([draft()]) == [13]
    assert (await second.verify()).ok
    await second.close()


async def test_only_one_process_may_write(store: AuditStore, data: Path) -> None:
    with pytest.raises(StoreInUse):
        AuditStore.open(data)
    await fill(store, 1)


async def test_rows_ride_with_the_events_that_caused_them(store: AuditStore) -> None:
    await store.append([draft(), draft()], [invocation_row("inv_1")])
    await store.append([draft()], [invocation_row("inv_1", status="completed", document=b'{"n":2}')])
    row = await store.row("invocations", id="inv_1")
    assert row is not None
    assert (row["created_seq"], row["status"], row["document"]) == (1, "completed", b'{"n":2}')
    assert await store.invocation("inv_1") == b'{"n":2}'
    assert await store.invocation("inv_2") is None
    assert await store.escalation("esc_1") is None


async def test_created_at_stays_that_of_the_first_writing(store: AuditStore) -> None:
    await store.append([draft()], [invocation_row("inv_1")])
    later = "2027-01-01T00:00:00.000Z"
    await store.append([draft()], [invocation_row("inv_1", created_at=later, updated_at=later)])
    row = await store.row("invocations", id="inv_1")
    assert row is not None
    assert (row["created_at"], row["updated_at"]) == (TIME, later)


async def test_a_row_written_once_is_refused_the_second_time_with_its_events(store: AuditStore) -> None:
    await store.append([draft()], [permit_row("a")])
    answers = await asyncio.gather(
        store.append([draft(n=1)], [permit_row("a")]),
        store.append([draft(n=2)], [permit_row("b")]),
        store.append([draft(n=3)], [permit_row("b")]),
        store.append([draft(n=4)]),
        return_exceptions=True,
    )
    assert [type(answer) for answer in answers] == [RowExists, list, RowExists, list]
    assert [event.payload().get("n") for event in await store.events()] == [None, 2, 4]
    assert [row["permit"] for row in await store.rows("permits_used")] == ["a", "b"]
    assert store.healthy


async def test_a_row_twice_in_one_call_is_refused_too(store: AuditStore) -> None:
    with pytest.raises(RowExists, match="permits_used"):
        await store.append([draft()], [permit_row("a"), permit_row("a")])
    assert store.size == 0


async def test_rows_alone_leave_the_tree_as_it_is(store: AuditStore) -> None:
    await fill(store, 1)
    checkpoint = store.checkpoint
    assert (
        await store.append([], [RowWrite(table="settings", values={"name": "a", "value": b"1", "updated_at": TIME})])
        == []
    )
    assert store.checkpoint == checkpoint
    assert (await store.verify()).ok


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        (RowWrite(table="events", values={}), "no table of state"),
        (RowWrite(table="permits_used", values={"permit": "a"}), "has the columns"),
        (invocation_row("inv_1", created_seq=1), "has the columns"),
        (invocation_row("inv_1", status=None), "status"),
        (invocation_row("inv_1", document="text"), "bytes"),
        (invocation_row("inv_1", agent="\ud800"), "UTF-8"),
        (
            progress_row(2**63),
            "64 bits",
        ),
        (
            progress_row(True),
            "64 bits",
        ),
    ],
)
async def test_a_malformed_row_harms_its_caller_alone(store: AuditStore, row: RowWrite, problem: str) -> None:
    bad, good = await asyncio.gather(store.append([draft()], [row]), store.append([draft()]), return_exceptions=True)
    assert isinstance(bad, RowMalformed)
    assert problem in str(bad)
    assert good == [1]


async def test_a_malformed_event_harms_its_caller_alone(store: AuditStore) -> None:
    bad, good = await asyncio.gather(
        store.append([draft(), draft(value=object())]), store.append([draft()]), return_exceptions=True
    )
    assert isinstance(bad, EventMalformed)
    assert good == [1]


async def test_a_cancelled_caller_s_events_are_recorded_all_the_same(store: AuditStore) -> None:
    task = asyncio.create_task(store.append([draft(n=1)]))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert await store.append([draft(n=2)]) == [2]
    assert [event.payload()["n"] for event in await store.events()] == [1, 2]


async def test_close_finishes_what_was_handed_over(data: Path) -> None:
    store = AuditStore.open(data)
    waiting = [asyncio.create_task(store.append([draft()])) for _ in range(50)]
    await asyncio.sleep(0)
    await store.close()
    assert sorted(seq for (seq,) in await asyncio.gather(*waiting)) == list(range(1, 51))
    with pytest.raises(RecordUnavailable, match="closed"):
        await store.append([draft()])
    with pytest.raises(AuditError, match="closed"):
        await store.events()


async def test_subscribers_hear_of_durable_events_before_the_caller_does(store: AuditStore) -> None:
    heard: list[Event] = []
    end = store.subscribe(heard.extend)
    await store.append([draft(n=1), draft(n=2)])
    assert [event.seq for event in heard] == [1, 2]
    assert heard == await store.events()
    end()
    end()
    await store.append([draft(n=3)])
    assert len(heard) == 2


async def test_a_failing_subscriber_harms_nobody_and_is_reported(store: AuditStore) -> None:
    reported: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context["exception"]))
    heard: list[Event] = []

    def fail(_: tuple[Event, ...]) -> None:
        raise RuntimeError("broken")

    store.subscribe(fail)
    store.subscribe(heard.extend)
    assert await store.append([draft()]) == [1]
    assert [str(error) for error in reported] == ["broken"]
    assert len(heard) == 1


async def test_events_are_filtered_and_paged(store: AuditStore) -> None:
    for number in range(6):
        kind, actor = ("alert", "cell") if number % 2 else ("proposal", "planner")
        await store.append([EventDraft(kind=kind, actor=actor, invocation=f"inv_{number % 3}", body={"n": number})])

    async def seqs(**filters: object) -> list[int]:
        return [event.seq for event in await store.events(**filters)]

    assert await seqs(kind="alert") == [2, 4, 6]
    assert await seqs(actor="planner") == [1, 3, 5]
    assert await seqs(invocation="inv_0") == [1, 4]
    assert await seqs(invocation="inv_0", kind="alert") == [4]
    assert await seqs(after=2, limit=3) == [3, 4, 5]
    assert await seqs(newest=True, limit=3) == [6, 5, 4]
    assert await seqs(newest=True, before=4, kind="alert") == [2]
    assert await seqs(after=2, before=5) == [3, 4]
    assert await seqs(kind="nothing") == []
    times = [parse_rfc3339(event.at) for event in await store.events()]
    assert await seqs(since=times[0]) == [1, 2, 3, 4, 5, 6]
    assert await seqs(since=times[-1] + 1) == []
    assert await seqs(until=times[-1] + 1) == [1, 2, 3, 4, 5, 6]
    assert await seqs(until=times[0]) == []


@pytest.mark.parametrize("limit", [0, -1, 1001])
async def test_refuses_a_limit_out_of_bounds(store: AuditStore, limit: int) -> None:
    with pytest.raises(ValueError, match="1 to 1000"):
        await store.events(limit=limit)


async def test_invocations_are_listed_newest_first_by_cursor(store: AuditStore) -> None:
    for number in range(5):
        status = "completed" if number == 2 else "running"
        await store.append([draft()], [invocation_row(f"inv_{number}", status=status)])
    await store.append([draft()], [invocation_row("inv_0", status="failed")])  # an update keeps its age
    first = await store.page("invocations", limit=2)
    assert [row["id"] for row in first.items] == ["inv_4", "inv_3"]
    await store.append([draft()], [invocation_row("inv_9")])  # and a new one moves no page
    second = await store.page("invocations", limit=2, cursor=first.next)
    last = await store.page("invocations", limit=2, cursor=second.next)
    assert [row["id"] for row in second.items + last.items] == ["inv_2", "inv_1", "inv_0"]
    assert last.next is None
    running = await store.page("invocations", {"status": "running", "agent": "planner", "cell": None})
    assert [row["id"] for row in running.items] == ["inv_9", "inv_4", "inv_3", "inv_1"]
    ended = await store.page("invocations", {"status": ("completed", "failed")})
    assert [row["id"] for row in ended.items] == ["inv_2", "inv_0"]
    assert first.next is not None
    for table, strange in (("escalations", first.next), ("invocations", f"{first.next}x"), ("invocations", "4.inv_3")):
        with pytest.raises(ValueError, match="valid is the `next` of the page before, of the same list"):
            await store.page(table, cursor=strange)


@pytest.mark.parametrize("cursor", ["", "1", "1.", "01.inv_1", "٣.inv_1", "x.inv_1", "-1.inv_1", "9" * 40 + ".inv_1"])
async def test_refuses_a_cursor_no_page_gave(store: AuditStore, cursor: str) -> None:
    with pytest.raises(ValueError, match="no cursor"):
        await store.page("invocations", cursor=cursor)


@pytest.mark.parametrize("table", ["events", "checkpoints"])
@pytest.mark.parametrize(
    "change",
    [
        "DELETE FROM {0}",
        "UPDATE {0} SET {1} = 'x'",
        "UPDATE OR REPLACE {0} SET {1} = 'x'",
        "REPLACE INTO {0} SELECT * FROM {0}",
        "INSERT OR REPLACE INTO {0} SELECT * FROM {0} WHERE true",
        "INSERT INTO {0} SELECT * FROM {0} WHERE true ON CONFLICT DO UPDATE SET {1} = 'x'",
    ],
)
async def test_the_database_refuses_to_change_what_is_recorded(store: AuditStore, table: str, change: str) -> None:
    """Whoever opens the file with another program has set nothing for its connection."""
    await fill(store, 1)
    column = {"events": "actor", "checkpoints": "note"}[table]
    connection = sqlite3.connect(store.places.database)
    with pytest.raises(sqlite3.IntegrityError, match="only grow"):
        connection.execute(change.format(table, column))
    connection.close()


async def test_a_replacing_row_that_spells_its_number_otherwise_is_refused_too(store: AuditStore) -> None:
    await fill(store, 1)
    with closing(sqlite3.connect(store.places.database)) as connection:
        for forged in (
            "INSERT OR REPLACE INTO events (seq, at, kind, actor, body) VALUES ('1', '', '', '', x'')",
            "INSERT OR REPLACE INTO events (rowid, at, kind, actor, body) VALUES (1.0, '', '', '', x'')",
        ):
            with pytest.raises(sqlite3.IntegrityError, match="only grow"):
                connection.execute(forged)


async def test_settings_make_a_commit_durable(store: AuditStore) -> None:
    connection = store._ledger._connection
    answers = {name: connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in ("journal_mode", "synchronous")}
    assert answers == {"journal_mode": "wal", "synchronous": 2}
    assert connection.exec_driver_sql("PRAGMA wal_autocheckpoint").scalar() == 1000


async def test_keys_are_made_at_the_first_start(store: AuditStore, data: Path) -> None:
    places = Places(data)
    assert places.secret_key.stat().st_mode & 0o777 == 0o600
    assert places.public_key.read_text().strip() == store.verifier.text()


async def test_refuses_a_key_that_others_can_read(data: Path) -> None:
    await AuditStore.open(data).close()
    Places(data).secret_key.chmod(0o644)
    with pytest.raises(RecordDamaged, match="600"):
        AuditStore.open(data)


async def test_refuses_to_sign_an_old_log_with_a_new_key(data: Path) -> None:
    store = AuditStore.open(data)
    await fill(store, 1)
    await store.close()
    Places(data).secret_key.unlink()
    with pytest.raises(RecordDamaged, match="missing"):
        AuditStore.open(data)


@pytest.mark.parametrize("emptied", [False, True], ids=["deleted", "emptied"])
async def test_refuses_to_begin_another_log_with_the_key_of_one_that_is_gone(data: Path, emptied: bool) -> None:
    store = AuditStore.open(data)
    await fill(store, 1)
    await store.close()
    places = Places(data)
    for path in (places.database, places.checkpoints):
        path.unlink()
    if emptied:
        places.database.touch()
    for _ in range(2):
        with pytest.raises(RecordDamaged, match=r"log\.key.*gone: restore `reins\.db` and `checkpoints\.log`"):
            AuditStore.open(data)
    assert places.database.exists() is emptied


@pytest.mark.parametrize("last", ["connect", "migrate", "write_durably", "sync_folder", "CheckpointFile"])
async def test_a_first_start_that_was_cut_off_anywhere_is_followed_by_another(
    data: Path, monkeypatch: pytest.MonkeyPatch, last: str
) -> None:
    where = "places" if last in ("write_durably", "sync_folder") else "ledger"
    real = getattr(importlib.import_module(f"app.audit.{where}"), last)

    def cut_off(*given: Any, **named: Any) -> None:
        real(*given, **named)
        raise OSError("cut off")

    with monkeypatch.context() as patched:
        patched.setattr(f"app.audit.{where}.{last}", cut_off)
        with pytest.raises(RecordUnavailable, match="cut off"):
            AuditStore.open(data)
    store = AuditStore.open(data)
    await fill(store, 1)
    assert (await store.verify()).size == 3
    await store.close()


async def test_refuses_keys_that_do_not_belong_together(data: Path, tmp_path: Path) -> None:
    await AuditStore.open(data).close()
    await AuditStore.open(tmp_path / "other").close()
    Places(data).public_key.write_text(Places(tmp_path / "other").public_key.read_text())
    with pytest.raises(RecordDamaged, match="public half"):
        AuditStore.open(data)


async def test_writes_the_public_key_again_when_it_is_lost(data: Path) -> None:
    await AuditStore.open(data).close()
    text = Places(data).public_key.read_text()
    Places(data).public_key.unlink()
    await AuditStore.open(data).close()
    assert Places(data).public_key.read_text() == text


async def test_refuses_a_file_that_is_no_database(data: Path) -> None:
    spoil(data)
    with pytest.raises(RecordDamaged, match="not a database"):
        AuditStore.open(data)


async def test_a_refused_start_leaves_the_directory_free(data: Path) -> None:
    spoil(data)
    for _ in range(2):
        with pytest.raises(RecordDamaged):
            AuditStore.open(data)


async def test_too_many_waiting_callers_are_refused_at_once(store: AuditStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.audit.store.MAX_WAITING", 3)
    answers = await asyncio.gather(*(store.append([draft()]) for _ in range(5)), return_exceptions=True)
    assert [isinstance(answer, RecordUnavailable) for answer in answers] == [False, False, False, True, True]


async def test_refuses_a_key_file_that_holds_none(data: Path) -> None:
    await AuditStore.open(data).close()
    Places(data).secret_key.write_text("nothing")
    with pytest.raises(RecordDamaged, match="PRIVATE"):
        AuditStore.open(data)


async def test_refuses_a_key_file_that_is_no_text(data: Path) -> None:
    await AuditStore.open(data).close()
    Places(data).secret_key.write_bytes(b"\xff\xfe")
    with pytest.raises(RecordDamaged, match=r"log\.key.*is no text"):
        AuditStore.open(data)
