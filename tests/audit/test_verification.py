"""Whoever changes the record is found out: every way to tamper, done to a real log, and the event it must point at.

The log holds 12 events in 4 batches of 3, unless a test says otherwise.
"""

from __future__ import annotations

import asyncio
import sqlite3
from base64 import b64encode
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from app.audit.checkpoint import NoteInvalid, Signer
from app.audit.errors import RecordDamaged, RecordUnreadable
from app.audit.event import Event
from app.audit.examination import examine_file
from app.audit.merkle import Frontier, leaf_hash
from app.audit.places import Places, load_key, load_verifier
from app.audit.reader import Batch, Extent, Reader
from app.audit.store import AuditStore
from app.audit.verification import Verification, agrees, verify_log
from tests.audit.conftest import draft, fill, without_descriptors

pytestmark = pytest.mark.anyio
Tamper = Callable[[Places], None]


def sql(*statements: str) -> Tamper:
    """Change the database as someone with the file can: without triggers in the way."""

    def tamper(places: Places) -> None:
        connection = sqlite3.connect(places.database)
        for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            connection.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return tamper


def outside(change: Callable[[str], str]) -> Tamper:
    def tamper(places: Places) -> None:
        places.checkpoints.write_text(change(places.checkpoints.read_text()))

    return tamper


def notes(text: str) -> list[str]:
    lines = text.splitlines(keepends=True)
    return ["".join(lines[start : start + 6]) for start in range(0, len(lines), 6)]


def rewrite_history(places: Places) -> None:
    """Alter event 5 and make everything in the database agree with it, checkpoints signed with a key of one's own."""
    connection = sqlite3.connect(places.database)
    sql("UPDATE events SET body = CAST(replace(body, '\"n\":4', '\"n\":9') AS BLOB) WHERE seq = 5")(places)
    signer = Signer(name=load_verifier(places).name, seed=bytes(32))
    frontier = Frontier()
    for size, first in connection.execute("SELECT size, first FROM checkpoints ORDER BY size").fetchall():
        query = "SELECT body FROM events WHERE seq BETWEEN ? AND ? ORDER BY seq"
        leaves = [leaf_hash(body) for (body,) in connection.execute(query, (first, size))]
        frontier = frontier.extend(leaves)
        connection.execute(
            "UPDATE checkpoints SET note = ?, leaves = ?, frontier = ? WHERE size = ?",
            (signer.sign(size, frontier.root()), b"".join(leaves), frontier.pack(), size),
        )
    connection.commit()
    connection.close()


def take_the_end_off_everywhere(places: Places) -> None:
    sql("DELETE FROM events WHERE seq > 9", "DELETE FROM checkpoints WHERE size > 9")(places)


def take_the_file_outside_for_a_directory(places: Places) -> None:
    places.checkpoints.unlink()
    places.checkpoints.mkdir()


def alter_a_body_and_take_the_file_outside_away(places: Places) -> None:
    sql(OTHER_BODY)(places)
    places.checkpoints.unlink()


def garble_the_schema(places: Places) -> None:
    """Leave a statement that SQLite cannot make out, and that its complaint cites as it stands."""
    content = places.database.read_bytes()
    assert content.count(b"CREATE TABLE events ") == 1
    places.database.write_bytes(content.replace(b"CREATE TABLE events ", b"CREATE TABL\xd2 events "))


SWAP_ROWS = (
    "UPDATE events SET seq = -5 WHERE seq = 5",
    "UPDATE events SET seq = 5 WHERE seq = 6",
    "UPDATE events SET seq = 6 WHERE seq = -5",
)
FORGED_LEAVES = "UPDATE checkpoints SET leaves = zeroblob(96) WHERE size = 6"
OTHER_BODY = "UPDATE events SET body = CAST(replace(body, '\"n\":4', '\"n\":9') AS BLOB) WHERE seq = 5"

TAMPERING: dict[str, tuple[Tamper, int, str]] = {
    "altered body": (sql(OTHER_BODY), 5, "bytes of event `5`"),
    "altered body and its leaf": (sql(OTHER_BODY, FORGED_LEAVES), 4, "`4` to `6` are not those"),
    "altered leaf": (sql(FORGED_LEAVES), 4, "beside the checkpoint"),
    "leaf cut short": (sql("UPDATE checkpoints SET leaves = x'00' WHERE size = 6"), 4, "beside the checkpoint"),
    "altered frontier": (sql("UPDATE checkpoints SET frontier = zeroblob(64) WHERE size = 6"), 4, "beside"),
    "body of another type": (sql("UPDATE events SET body = CAST(body AS TEXT) WHERE seq = 5"), 5, "event `5`"),
    "altered actor": (sql("UPDATE events SET actor = 'nobody' WHERE seq = 7"), 7, "columns of event `7`"),
    "altered kind": (sql("UPDATE events SET kind = 'outcome' WHERE seq = 7"), 7, "columns of event `7`"),
    "altered time": (sql("UPDATE events SET at = '2000-01-01T00:00:00.000Z' WHERE seq = 12"), 12, "columns"),
    "altered invocation": (sql("UPDATE events SET invocation = NULL WHERE seq = 1"), 1, "columns of event `1`"),
    "deleted row": (sql("DELETE FROM events WHERE seq = 8"), 8, "event `8` is missing"),
    "deleted first row": (sql("DELETE FROM events WHERE seq = 1"), 1, "the first event is `2`"),
    "deleted last row": (sql("DELETE FROM events WHERE seq = 12"), 12, "event `12` is missing"),
    "deleted everything": (sql("DELETE FROM events", "DELETE FROM checkpoints"), 1, "the end was cut off"),
    "swapped rows": (sql(*SWAP_ROWS), 5, "bytes of event `5`"),
    "row before the first": (
        sql("INSERT INTO events SELECT -1, at, kind, invocation, actor, body FROM events WHERE seq = 3"),
        -1,
        "the first event is `-1`",
    ),
    "row after the last": (
        sql("INSERT INTO events SELECT 13, at, kind, invocation, actor, body FROM events WHERE seq = 3"),
        13,
        "no checkpoint vouches",
    ),
    "end cut off": (take_the_end_off_everywhere, 10, "the end was cut off"),
    "deleted checkpoint": (sql("DELETE FROM checkpoints WHERE size = 6"), 4, "covers event `4` is missing"),
    "deleted last checkpoint": (sql("DELETE FROM checkpoints WHERE size = 12"), 10, "no checkpoint vouches"),
    "forged checkpoint": (
        sql("UPDATE checkpoints SET note = replace(note, char(10) || '6' || char(10), char(10) || '5' || char(10))"),
        4,
        "does not hold",
    ),
    "checkpoint of another size": (
        sql("UPDATE checkpoints SET note = (SELECT note FROM checkpoints WHERE size = 9) WHERE size = 6"),
        4,
        "signed for `9` events",
    ),
    "history rewritten with another key": (rewrite_history, 1, "no signature by"),
    "outside: last two cut off": (outside(lambda text: "".join(notes(text)[:-2])), 7, "lacks the last checkpoints"),
    "outside: one taken out": (outside(lambda text: "".join(notes(text)[:1] + notes(text)[2:])), 4, "another"),
    "outside: order changed": (outside(lambda text: "".join(reversed(notes(text)))), 1, "another checkpoint"),
    "outside: emptied": (outside(lambda _: ""), 1, "lacks the last checkpoints"),
    "outside: garbled": (outside(lambda text: text.replace("reins/", "raids/", 1)), 1, "another checkpoint"),
    "outside: gone": (
        lambda places: places.checkpoints.unlink(),
        1,
        "outside the database, is missing: the `12` events are as",
    ),
    "outside: gone, and a body altered": (alter_a_body_and_take_the_file_outside_away, 5, "bytes of event `5`"),
    "outside: a directory": (take_the_file_outside_for_a_directory, 1, "Is a directory"),
    "database gone": (lambda places: places.database.unlink(), 1, "no such log"),
    "schema that is no text": (garble_the_schema, 1, "cannot be read as a log"),
}


@pytest.fixture
async def log(data: Path) -> Places:
    """A closed log of 12 events in 4 batches."""
    store = AuditStore.open(data)
    await fill(store)
    await store.close()
    return Places(data)


def verify(places: Places) -> Verification:
    return verify_log(places, load_verifier(places))


async def test_an_untouched_log_verifies(log: Places) -> None:
    result = verify(log)
    assert (result.ok, result.size, result.first_bad, result.problem) == (True, 12, None, None)
    assert result.checkpoint is not None
    assert b64encode(load_verifier(log).open(result.checkpoint).root).decode() == result.root


async def test_an_empty_log_verifies(store: AuditStore) -> None:
    result = await store.verify()
    assert (result.ok, result.size, result.checkpoint) == (True, 0, None)


@pytest.mark.parametrize("name", TAMPERING)
async def test_finds_tampering_and_names_the_event(log: Places, name: str) -> None:
    tamper, first_bad, problem = TAMPERING[name]
    tamper(log)
    result = verify(log)
    assert not result.ok
    assert problem in (result.problem or "")
    assert result.first_bad == first_bad
    assert result.size < max(first_bad, 1)


def rewrite_with_the_stolen_key(places: Places) -> str:
    """Sign another history with the log's own key; returns the checkpoints that the file outside would need."""
    rewrite_history(places)
    signer = load_key(places)
    signed = ""
    with closing(sqlite3.connect(places.database)) as connection:
        rows = connection.execute("SELECT size, frontier FROM checkpoints ORDER BY size").fetchall()
        for size, packed in rows:
            note = signer.sign(size, Frontier.unpack(size, packed).root())
            connection.execute("UPDATE checkpoints SET note = ? WHERE size = ?", (note, size))
            signed += note + "\n"
        connection.commit()
    return signed


async def test_finds_a_history_rewritten_with_the_stolen_key(log: Places) -> None:
    """Even the log's own key cannot make the file outside agree with another history."""
    rewrite_with_the_stolen_key(log)
    result = verify(log)
    assert (result.ok, result.first_bad) == (False, 4)
    assert "holds another checkpoint" in (result.problem or "")


def against(places: Places, kept: Path) -> Verification:
    return examine_file(places.folder, kept=kept).log


@pytest.mark.parametrize(("those", "good"), [(slice(0, 1), 12), (slice(0, 2), 3), (slice(2, 3), 0), (slice(3, 4), 0)])
async def test_finds_what_was_rewritten_everywhere_by_what_was_kept_elsewhere(
    log: Places, tmp_path: Path, those: slice, good: int
) -> None:
    """Event 5 is another one: what vouches for 3 events cannot tell, what vouches for it as well can."""
    kept = tmp_path / "kept"
    kept.write_text("".join(notes(log.checkpoints.read_text())[those]))
    assert against(log, kept).ok
    log.checkpoints.write_text(rewrite_with_the_stolen_key(log))
    assert verify(log).ok, "nothing in the directory tells"
    result = against(log, kept)
    assert (result.ok, result.size, result.first_bad) == (good == 12, good, None if good == 12 else good + 1)
    assert good == 12 or "kept elsewhere" in (result.problem or "")


async def test_finds_an_end_that_was_cut_off_everywhere_by_what_was_kept_elsewhere(log: Places, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text(notes(log.checkpoints.read_text())[-1].rstrip("\n"))
    take_the_end_off_everywhere(log)
    outside(lambda text: "".join(notes(text)[:3]))(log)
    assert verify(log).ok, "nothing in the directory tells"
    result = against(log, kept)
    assert (result.ok, result.size, result.first_bad) == (False, 9, 10)
    assert result.problem == "a checkpoint kept elsewhere vouches for `12` events, here are `9`: the end was cut off"


async def test_finds_a_size_at_which_the_log_never_signed(log: Places, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text(load_key(log).sign(5, bytes(32)))
    result = against(log, kept)
    assert (result.ok, result.size, result.first_bad) == (False, 0, 1)


async def test_takes_a_kept_checkpoint_of_nothing_and_one_that_a_witness_signed(log: Places, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    signer = load_key(log)
    witnessed = notes(log.checkpoints.read_text())[1].rstrip("\n") + "\n— witness.example AAAAAAAAAAAA\n"
    kept.write_text(f"{signer.sign(0, Frontier().root())}\n{witnessed}\n")
    assert against(log, kept).ok


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: "", "no signature line"),
        (lambda text: text[:-40], "signature"),
        (lambda text: text + "and more\n", "no signature line"),
        (lambda text: text.replace("\n3\n", "\n4\n"), "does not hold"),
        (lambda text: "\ufeff" + text, "does not hold"),
    ],
    ids=["nothing", "torn", "more", "another size", "a mark"],
)
async def test_refuses_as_kept_what_is_no_checkpoint_of_the_log(
    log: Places, tmp_path: Path, change: Callable[[str], str], said: str
) -> None:
    kept = tmp_path / "kept"
    kept.write_text(change(log.checkpoints.read_text()), encoding="utf-8")
    with pytest.raises(NoteInvalid, match=said):
        against(log, kept)


async def test_refuses_two_kept_checkpoints_that_contradict_each_other(log: Places, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text(log.checkpoints.read_text() + load_key(log).sign(6, bytes(32)))
    with pytest.raises(NoteInvalid, match="two histories"):
        against(log, kept)


DAMAGE_AT_THE_END = [
    "altered time",
    "deleted last row",
    "deleted everything",
    "row after the last",
    "end cut off",
    "deleted last checkpoint",
    "altered body",
    "outside: last two cut off",
    "outside: emptied",
    "outside: gone",
]


@pytest.mark.parametrize("name", sorted(set(DAMAGE_AT_THE_END) - {"altered time"}))
async def test_does_not_start_on_a_log_whose_end_was_changed(log: Places, name: str) -> None:
    TAMPERING[name][0](log)
    with pytest.raises(RecordDamaged):
        AuditStore.open(log.folder)


async def test_a_checkpoint_a_crash_kept_from_the_file_outside_is_no_damage(log: Places) -> None:
    whole = log.checkpoints.read_text()
    outside(lambda text: "".join(notes(text)[:-1]))(log)
    assert verify(log).ok
    store = AuditStore.open(log.folder)
    assert log.checkpoints.read_text() == whole
    await store.close()


async def test_a_checkpoint_torn_by_a_crash_is_written_again(log: Places) -> None:
    whole = log.checkpoints.read_text()
    log.checkpoints.write_text(whole[:-40])
    assert verify(log).ok
    store = AuditStore.open(log.folder)
    assert log.checkpoints.read_text() == whole
    await store.append([draft()])
    assert (await store.verify()).ok
    await store.close()


async def test_refuses_a_file_outside_that_ends_in_garbage(log: Places) -> None:
    with log.checkpoints.open("a") as file:
        file.write("garbage" * 1000)
    with pytest.raises(RecordDamaged, match="no checkpoint"):
        AuditStore.open(log.folder)


async def test_verifies_while_others_append(store: AuditStore) -> None:
    await fill(store, batches=20)
    appending = asyncio.gather(*(fill(store, batches=20, each=1) for _ in range(4)))
    results = [await store.verify() for _ in range(5)]
    await appending
    assert [result.problem for result in results] == [None] * 5
    assert all(result.size >= 60 for result in results)
    assert (await store.verify()).size == 140


async def test_what_was_known_of_the_log_holds_on_while_it_cannot_be_read(store: AuditStore) -> None:
    await fill(store)
    assert (await store.examine()).ok
    with without_descriptors(), pytest.raises(RecordUnreadable):
        await store.examine()
    assert store.damage is None
    sql(OTHER_BODY)(store.places)
    assert not (await store.examine()).ok
    with without_descriptors(), pytest.raises(RecordUnreadable):
        await store.examine()
    assert store.damage == "the bytes of event `5` were altered"


async def test_verifies_a_batch_larger_than_a_page(store: AuditStore) -> None:
    await store.append([draft(n=n) for n in range(2500)])
    assert (await store.verify()).size == 2500


async def test_reports_a_database_that_cannot_be_read(log: Places) -> None:
    log.database.write_bytes(log.database.read_bytes()[:8192] + bytes(60000))
    result = verify(log)
    assert not result.ok
    assert result.first_bad == 1
    assert str(log.database) in (result.problem or "")


async def test_a_database_that_cannot_be_opened_now_is_no_damaged_one(log: Places) -> None:
    key = load_verifier(log)
    with without_descriptors(), pytest.raises(RecordUnreadable, match=r"`reins\.db`: unable to open database file"):
        verify_log(log, key)
    assert verify_log(log, key).ok


async def test_checkpoints_that_cannot_be_opened_now_are_no_damaged_ones(
    log: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = load_verifier(log)
    with ExitStack() as later:
        at_its_second_look(monkeypatch, lambda: later.enter_context(without_descriptors()))
        with pytest.raises(RecordUnreadable, match=r"`checkpoints\.log`: Too many open files"):
            verify_log(log, key)
    monkeypatch.undo()
    assert verify_log(log, key).ok


async def test_a_database_that_another_holds_for_itself_is_no_damaged_one(
    log: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *args, **kwargs: connect(*args, **(kwargs | {"timeout": 0})))
    with closing(connect(log.database)) as holder:
        holder.execute("PRAGMA locking_mode = EXCLUSIVE")
        holder.execute("BEGIN EXCLUSIVE")
        with pytest.raises(RecordUnreadable, match="database is locked"):
            verify(log)
    assert verify(log).ok


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("UPDATE events SET body = x'00' WHERE seq = 2", "at event `2`: the bytes of event `2` were altered"),
        ("UPDATE events SET body = 'text' WHERE seq = 2", "at event `2`: the bytes of event `2` were altered"),
        ("UPDATE events SET kind = 'cell' WHERE seq = 3", "the columns of event `3` are not what its bytes say"),
    ],
)
async def test_a_start_believes_no_event_that_it_has_not_verified(log: Places, change: str, problem: str) -> None:
    sql(change)(log)
    with pytest.raises(RecordDamaged, match=problem):
        AuditStore.open(log.folder)


async def test_a_start_tells_how_far_it_has_verified(log: Places) -> None:
    told: list[tuple[int, int]] = []
    store = AuditStore.open(log.folder, progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (store.size, store.size)
    await store.close()


@pytest.mark.parametrize(
    ("tamper", "problem"),
    [
        (sql("UPDATE checkpoints SET frontier = x'00' WHERE size = 12"), "the checkpoint at `12`"),
        (sql("UPDATE checkpoints SET frontier = zeroblob(64) WHERE size = 12"), "not what was signed"),
        (sql("UPDATE checkpoints SET note = replace(note, 'reins', 'raids') WHERE size = 12"), "its checkpoints"),
        (outside(lambda text: text.replace("reins", "raids")), "not one of this log"),
        (outside(lambda text: text.split("\n\nreins")[0] + "\n\n"), "not among the database's last"),
    ],
)
async def test_says_at_the_start_what_was_changed(log: Places, tamper: Tamper, problem: str) -> None:
    tamper(log)
    with pytest.raises(RecordDamaged, match=problem):
        AuditStore.open(log.folder)


def at_its_second_look(monkeypatch: pytest.MonkeyPatch, happens: Callable[[], None]) -> None:
    """Let something happen just before the walk looks for the second time how far the log goes."""
    looks: list[Extent] = []
    look = Reader.extent

    def extent(reader: Reader) -> Extent:
        if len(looks) == 2:  # the first is the reader's own, at its opening
            happens()
        looks.append(look(reader))
        return looks[-1]

    monkeypatch.setattr(Reader, "extent", extent)


async def test_checkpoints_that_vanish_under_the_walk_are_a_finding(
    log: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Reader.batches

    def batches(reader: Reader, *, after: int, until: int, limit: int) -> list[Batch]:
        sql("DELETE FROM checkpoints WHERE size > 6")(log)
        return look(reader, after=after, until=until, limit=1)

    monkeypatch.setattr(Reader, "batches", batches)
    found = verify_log(log, load_verifier(log))
    assert (found.ok, found.size, found.first_bad) == (False, 6, 7)
    assert found.problem is not None
    assert "vanished" in found.problem


async def test_batches_committed_after_the_walk_began_need_no_checkpoint_outside_yet(
    log: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = log.database.read_bytes()
    sql("DELETE FROM events WHERE seq > 6", "DELETE FROM checkpoints WHERE size > 6")(log)
    outside(lambda text: "".join(notes(text)[:2]))(log)
    at_its_second_look(monkeypatch, lambda: sql(*_put_back(log, whole))(log))
    found = verify_log(log, load_verifier(log))
    assert (found.ok, found.size, found.problem) == (True, 12, None)
    monkeypatch.undo()
    assert verify_log(log, load_verifier(log)).first_bad == 7, "what was there from the start needs them"


def _put_back(log: Places, whole: bytes) -> tuple[str, ...]:
    copy = log.folder / "whole.db"
    copy.write_bytes(whole)
    return (
        f"ATTACH '{copy}' AS whole",
        "INSERT INTO events SELECT * FROM whole.events WHERE seq > 6",
        "INSERT INTO checkpoints SELECT * FROM whole.checkpoints WHERE size > 6",
    )


@pytest.mark.parametrize("body", [b"", b"\xff", b"[]", b'{"seq": 1}', b'{"seq": "1"}'])
async def test_bytes_that_are_no_event_agree_with_no_columns(body: bytes) -> None:
    assert not agrees(Event(1, "2026-03-01T09:30:00.000Z", "proposal", None, "planner", body))
