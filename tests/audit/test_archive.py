"""The auditor's tools, with and without a server running on the directory."""

from __future__ import annotations

import hashlib
import os
import socket
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from app.audit.archive import database_problems, export, show, tail, telemetry_problems, verify_file
from app.audit.checkpoint import Signer
from app.audit.errors import RecordDamaged
from app.audit.event import EventDraft
from app.audit.merkle import Frontier, leaf_hash
from app.audit.places import Places
from app.audit.reader import COMPILED, Reader
from app.audit.searching import Words
from app.audit.store import AuditStore
from app.audit.telemetry import TelemetryWriter, channels
from tests.audit.conftest import draft, fill, hide_from_index

pytestmark = pytest.mark.anyio


async def test_verifies_beside_a_running_server(store: AuditStore, data: Path) -> None:
    await fill(store)
    assert verify_file(data).size == 12
    await fill(store, 1)
    assert (verify_file(data).ok, verify_file(data).size) == (True, 15)


async def test_verifies_against_a_key_kept_elsewhere(store: AuditStore, data: Path) -> None:
    await fill(store)
    stranger = Signer(name=store.verifier.name, seed=bytes(32)).verifier
    assert verify_file(data, store.verifier).ok
    assert verify_file(data, stranger).first_bad == 1


async def test_reads_a_closed_log_and_changes_nothing(data: Path) -> None:
    store = AuditStore.open(data)
    await fill(store)
    await store.close()
    before = contents(data)
    assert verify_file(data).ok
    assert len(tail(data).events) == 12
    after = contents(data)
    assert {name: after[name] for name in before} == before


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


async def test_shows_an_invocation_beyond_one_page(store: AuditStore, data: Path) -> None:
    await store.append([draft(invocation="inv_2", n=n) for n in range(1500)] + [draft(invocation="inv_3")])
    events = show(data, "inv_2")
    assert [event.seq for event in events] == list(range(1, 1501))
    assert show(data, "inv_9") == []


async def test_tail_gives_the_end_and_what_follows(store: AuditStore, data: Path) -> None:
    await fill(store)
    assert [event.seq for event in tail(data, limit=3).events] == [10, 11, 12]
    assert tail(data, after=12) == ([], 12)
    await fill(store, 1)
    assert [event.seq for event in tail(data, after=12).events] == [13, 14, 15]


async def test_tail_finds_the_last_events_that_hold_words_however_far_back(store: AuditStore, data: Path) -> None:
    marked = [draft(mark="Here", n=n) for n in range(3)]
    await store.append([*marked, *(draft(n=n) for n in range(1100)), draft(invocation="inv_2", mark="here")])
    found = tail(data, limit=3, words=Words("HERE"))
    assert ([event.seq for event in found.events], found.end) == ([2, 3, 1104], 1104)
    await store.append([draft(), draft(mark="here"), draft()])
    later = tail(data, after=found.end, words=Words("here"))
    assert ([event.seq for event in later.events], later.end) == ([1106], 1107)
    assert [event.seq for event in show(data, "inv_2", Words("here"))] == [1104]
    assert show(data, "inv_2", Words("there")) == []
    assert tail(data, words=Words("there")) == ([], 1107)


async def test_an_event_that_cannot_be_read_is_not_passed_over_in_a_search(store: AuditStore, data: Path) -> None:
    await store.append([draft(mark="here"), draft(), draft()])
    with closing(sqlite3.connect(store.places.database)) as database:
        database.execute("DROP TRIGGER events_refuse_update")
        database.execute("UPDATE events SET body = '{' WHERE seq = 2")
        database.commit()
    assert [event.seq for event in tail(data, words=Words("here")).events] == [1, 2]


async def test_an_export_can_be_checked_without_this_program(store: AuditStore, data: Path, tmp_path: Path) -> None:
    await store.append([draft(n=n) for n in range(1200)])
    result = export(data, tmp_path / "log.jsonl")
    content = result.events.read_bytes()
    lines = content.splitlines()
    assert (result.count, len(lines)) == (1200, 1200)
    assert result.sha256 == hashlib.sha256(content).hexdigest()
    head = store.verifier.open(result.checkpoint.read_text())
    assert (head.size, head.root) == (1200, Frontier().extend(map(leaf_hash, lines)).root())


async def test_an_export_of_an_empty_log_is_empty(store: AuditStore, data: Path, tmp_path: Path) -> None:
    assert export(data, tmp_path / "log.jsonl").count == store.size == 0


@pytest.mark.parametrize("taken", ["log.jsonl", "log.jsonl.checkpoint"])
async def test_an_export_into_a_directory_is_refused_and_leaves_nothing(
    store: AuditStore, data: Path, tmp_path: Path, taken: str
) -> None:
    await fill(store)
    (tmp_path / "out" / taken).mkdir(parents=True)
    with pytest.raises(ValueError, match=f"{taken}` is a directory"):
        export(data, tmp_path / "out" / "log.jsonl")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [taken]


@pytest.mark.parametrize("taken", ["log.jsonl", "log.jsonl.checkpoint", "log.jsonl.checkpoint.partial"])
@pytest.mark.parametrize("kind", ["symbolic link", "link to nothing", "named pipe", "socket"])
async def test_an_export_replaces_nothing_but_files(
    store: AuditStore, data: Path, tmp_path: Path, taken: str, kind: str
) -> None:
    await fill(store)
    (tmp_path / "kept").write_text("kept")
    (tmp_path / "out").mkdir()
    place = tmp_path / "out" / taken
    with socket.socket(socket.AF_UNIX) as open_socket:
        match kind:
            case "symbolic link":
                place.symlink_to(tmp_path / "kept")
            case "link to nothing":
                place.symlink_to(tmp_path / "nothing")
            case "named pipe":
                os.mkfifo(place)
            case _:
                folder = os.open(tmp_path / "out", os.O_RDONLY)
                open_socket.bind(f"/proc/self/fd/{folder}/{taken}")  # whose own path may be too long for one
                os.close(folder)
        before = place.lstat()
        said = "symbolic link" if "link" in kind else kind
        with pytest.raises(ValueError, match=f"{taken}` is a {said}: valid is the name of a file"):
            export(data, tmp_path / "out" / "log.jsonl")
    assert place.lstat().st_ino == before.st_ino
    assert (tmp_path / "kept").read_text() == "kept"
    assert [path.name for path in (tmp_path / "out").iterdir()] == [taken]


async def test_an_export_replaces_a_file(store: AuditStore, data: Path, tmp_path: Path) -> None:
    await fill(store)
    for _ in range(2):
        assert export(data, tmp_path / "log.jsonl").count == 12


@pytest.mark.parametrize("name", ["reins.db", "new.jsonl", "new/new.jsonl", "../link/new.jsonl", "../linked.jsonl"])
async def test_an_export_into_the_data_directory_is_refused(store: AuditStore, data: Path, name: str) -> None:
    await fill(store)
    (data.parent / "link").symlink_to(data)
    (data.parent / "linked.jsonl").symlink_to(data / "reins.db")
    before = contents(data).keys()
    with pytest.raises(ValueError, match="lies in the data directory"):
        export(data, data / name)
    assert contents(data).keys() == before
    assert (await store.verify()).ok


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("DELETE FROM events WHERE seq = 5", "event `5` is missing or no event"),
        ("DELETE FROM events WHERE seq = 12", "event `12` is missing"),
        ("UPDATE events SET body = CAST(body AS TEXT) WHERE seq = 5", "event `5` is missing or no event"),
        ("UPDATE events SET body = x'7b7d' WHERE seq = 5", "the events up to `12` are not those that were signed"),
        ("UPDATE checkpoints SET note = (SELECT max(note) FROM checkpoints) WHERE size = 12", "the events up to `12`"),
        ("UPDATE checkpoints SET note = 'none' WHERE size = 12", "the checkpoint at `12`: "),
    ],
)
async def test_what_was_not_signed_is_not_exported(data: Path, tmp_path: Path, change: str, problem: str) -> None:
    store = AuditStore.open(data)
    await fill(store)
    await store.close()
    connection = sqlite3.connect(store.places.database)
    for kept in ("events_refuse_delete", "events_refuse_update", "checkpoints_refuse_update"):
        connection.execute(f"DROP TRIGGER {kept}")
    connection.execute(change)
    connection.commit()
    connection.close()
    (tmp_path / "out").mkdir()
    with pytest.raises(RecordDamaged, match=problem):
        export(data, tmp_path / "out" / "log.jsonl")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("fails", ["first write", "second write", "second rename"])
async def test_an_export_that_fails_leaves_nothing(
    store: AuditStore, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    await fill(store)
    (tmp_path / "out").mkdir()
    which, what = fails.split()
    calls = 0

    def full(*given: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == (1 if which == "first" else 2):
            raise OSError(28, "No space left on device")
        if what == "rename":
            given[0].rename(given[1])

    monkeypatch.setattr(*((os, "fsync") if what == "write" else (Path, "replace")), full)
    with pytest.raises(OSError, match="No space"):
        export(data, tmp_path / "out" / "log.jsonl")
    assert list((tmp_path / "out").iterdir()) == []
    monkeypatch.undo()
    assert export(data, tmp_path / "out" / "log.jsonl").count == 12
    assert len(list((tmp_path / "out").iterdir())) == 2


@pytest.mark.parametrize("crash", [1, 2])
async def test_an_export_that_crashes_leaves_no_events_beside_the_checkpoint_of_others(
    store: AuditStore, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, crash: int
) -> None:
    out, note = tmp_path / "log.jsonl", tmp_path / "log.jsonl.checkpoint"
    await fill(store)
    before = export(data, out)
    await fill(store)
    renames = 0

    def rename(this: Path, to: Path) -> None:
        nonlocal renames
        renames += 1
        if renames == crash:
            raise KeyboardInterrupt
        this.rename(to)

    monkeypatch.setattr(Path, "replace", rename)
    with pytest.raises(KeyboardInterrupt):
        export(data, out)
    monkeypatch.undo()
    assert not note.exists()
    assert len(out.read_bytes().splitlines()) == before.count * crash
    assert export(data, out).count == 2 * before.count
    assert note.exists()


async def test_refuses_another_format_and_what_is_no_place_for_a_file(
    store: AuditStore, data: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="jsonl"):
        export(data, tmp_path / "log.csv", "csv")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="valid is a name in one that is there"):
        export(data, tmp_path / "nowhere" / "log.jsonl")
    with pytest.raises(ValueError, match="is a directory: valid is the name of a file"):
        export(data, Path())
    assert store.healthy


@pytest.mark.parametrize("tool", [verify_file, tail, lambda data: show(data, "inv_1"), telemetry_problems])
async def test_says_that_there_is_no_log(tmp_path: Path, tool: object) -> None:
    assert callable(tool)
    with pytest.raises(RecordDamaged, match="no such"):
        tool(tmp_path / "nowhere")
    with pytest.raises(RecordDamaged, match="no such"):
        tool(tmp_path)


async def test_says_that_a_file_is_no_log(data: Path) -> None:
    await AuditStore.open(data).close()
    places = Places(data)
    places.database.unlink()
    places.database.write_bytes(b"not a database at all" * 500)
    with pytest.raises(RecordDamaged, match="cannot be read as a log"):
        verify_file(data)
    places.database.unlink()
    sqlite3.connect(places.database).execute("CREATE TABLE other (a)").connection.close()
    with pytest.raises(RecordDamaged, match="no such table"):
        tail(data)


async def test_says_that_a_key_is_none(store: AuditStore, data: Path) -> None:
    await fill(store, 1)
    Places(data).public_key.write_text("nothing")
    with pytest.raises(RecordDamaged, match=r"log\.pub"):
        verify_file(data)


async def test_finds_an_index_that_hides_an_event(data: Path) -> None:
    store = AuditStore.open(data)
    await fill(store)
    await store.close()
    assert database_problems(data) == []
    hide_from_index(Places(data).database, "inv_1")
    assert len(show(data, "inv_1")) == 11
    assert verify_file(data).ok, "the walk by place finds every event"
    found = database_problems(data)
    assert any("missing from index events_by_invocation" in problem for problem in found), found
    assert all(str(Places(data).database) in problem for problem in found)


async def test_says_nothing_where_the_time_ran_out(store: AuditStore, data: Path) -> None:
    await store.append([draft(n=n) for n in range(1500)])
    assert database_problems(data, within_s=0.0) is None
    assert database_problems(data, within_s=600.0) == []


async def test_compares_telemetry_files_with_the_log(store: AuditStore, data: Path) -> None:
    folder = Places(data).telemetry
    for name in ("a", "b", "c", "d"):
        writer = TelemetryWriter(folder / f"{name}.mcap", channels(("time_s", "q1_rad")), start_wall_s=0)
        writer.write_rows([(0.0, 1.0)])
        summary = await writer.aclose()
        await store.append([EventDraft(kind="telemetry", actor="server", invocation=name, body=summary.body())])
    await store.append([EventDraft(kind="telemetry", actor="server", body={"lost": "disk full"})])
    assert telemetry_problems(data) == []
    (folder / "b.mcap").write_bytes(b"other")
    (folder / "c.mcap").unlink()
    (folder / "d.mcap").unlink()
    os.mkfifo(folder / "d.mcap")  # nobody waits for who writes there
    changed, gone, pipe = telemetry_problems(data)
    assert "b.mcap` is not the file that was recorded" in changed
    assert "d.mcap` is not the file that was recorded" in pipe
    assert "No such file" in gone


async def test_what_one_reader_asks_is_not_compiled_anew_for_the_next(store: AuditStore, data: Path) -> None:
    await fill(store)
    COMPILED.clear()
    known: list[int] = []
    for _ in range(2):
        with closing(Reader(Places(data).database)) as reader:
            assert len(reader.events(kind="proposal", limit=3)) == 3
        known.append(len(COMPILED))
    assert known[0] > 0
    assert known[1] == known[0]
