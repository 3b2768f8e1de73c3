"""What the store does when the disk takes no more, and when it does again."""

from __future__ import annotations

import asyncio
import os
import threading
from pathlib import Path

import pytest

from app.audit.archive import verify_file
from app.audit.errors import RecordUnavailable
from app.audit.ledger import Staged
from app.audit.store import AuditStore
from app.disk import ROOM_BYTES
from tests.audit.conftest import draft, fill, until

pytestmark = pytest.mark.anyio


def limit_pages(store: AuditStore, pages: int | None) -> None:
    """Let the database have only so many pages, which SQLite answers as a full disk."""
    connection = store._ledger._connection
    used = connection.exec_driver_sql("PRAGMA page_count").scalar()
    connection.exec_driver_sql(f"PRAGMA max_page_count={used if pages is None else pages}")


async def test_a_full_database_refuses_everyone_in_the_batch_and_nothing_is_recorded(store: AuditStore) -> None:
    await fill(store)
    limit_pages(store, None)
    answers = await asyncio.gather(
        *(store.append([draft(filler="x" * 100_000)]) for _ in range(5)), return_exceptions=True
    )
    assert [type(answer) for answer in answers] == [RecordUnavailable] * 5
    assert all(answer.__cause__ is not None for answer in answers if isinstance(answer, BaseException))
    assert (store.healthy, store.reason) == (False, "database or disk is full")
    assert store.size == 12
    assert (await store.verify()).size == 12
    limit_pages(store, 1_000_000)
    assert await store.append([draft()]) == [13]
    assert store.healthy
    assert (await store.verify()).ok


async def test_health_comes_back_by_itself(store: AuditStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.audit.store.PROBE_AFTER_S", 0.01)
    limit_pages(store, None)
    with pytest.raises(RecordUnavailable):
        await store.append([draft(filler="x" * 100_000)])
    probed = store._probe
    await until(lambda: store._probe is not probed)  # it tried again, and the disk is still full
    assert not store.healthy
    limit_pages(store, 1_000_000)
    await until(lambda: store.healthy)
    assert store.size == 0
    assert (await store.verify()).ok


async def test_whoever_asks_hears_of_a_disk_that_filled_up_since_the_last_write(store: AuditStore) -> None:
    await store.look()
    assert store.healthy
    await until(lambda: not store._writing)
    limit_pages(store, None)
    store._wrote_s = 0.0  # long ago
    connection = store._ledger._connection
    connection.exec_driver_sql("DELETE FROM probes")
    connection.exec_driver_sql("VACUUM")  # the room that the first look left would do for a second one
    limit_pages(store, None)
    await store.look()
    assert (store.healthy, store.reason) == (False, "database or disk is full")
    limit_pages(store, 1_000_000)
    await until(lambda: store.healthy)
    assert store.size == 0


async def test_a_disk_that_says_it_takes_no_more_is_believed_until_it_does(
    store: AuditStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the database has got already may do for another probe, and for nothing else."""
    await store.look()  # a first probe, which is over before the disk is full
    await until(lambda: not store._writing)
    monkeypatch.setattr("app.audit.store.PROBE_AFTER_S", 0.01)
    disk = os.statvfs(store.places.folder)
    blocks = ROOM_BYTES // disk.f_frsize - 1
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*disk[:3], blocks, blocks, *disk[5:])))
    await store.look()
    assert store.reason is not None
    assert store.reason.startswith(f"the disk of the record is full: `{blocks * disk.f_frsize}` bytes are free")
    probed = store._probe
    await until(lambda: store._probe is not probed)
    assert not store.healthy
    monkeypatch.undo()
    await until(lambda: store.healthy)


async def test_no_second_batch_is_committed_while_the_file_outside_lacks_the_first(store: AuditStore) -> None:
    await fill(store, 1)
    await until(lambda: store._ledger._file.last == store.checkpoint)
    descriptor = store._ledger._file._descriptor
    kept = os.dup(descriptor)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, descriptor)
    assert await store.append([draft(n=1)]) == [4]  # it is durable, so it is acknowledged, but not unseen
    await until(lambda: not store.healthy)
    assert "No space left" in (store.reason or "")
    with pytest.raises(RecordUnavailable):
        await store.append([draft(n=2)])
    assert store.size == 4
    os.dup2(kept, descriptor)
    os.close(kept)
    os.close(full)
    assert await store.append([draft(n=3)]) == [5]
    assert store.healthy
    assert store.places.checkpoints.read_text().count("\n\n— ") == 3
    assert (await store.verify()).ok


async def test_a_first_batch_that_failed_leaves_nothing_in_the_file_outside(store: AuditStore) -> None:
    limit_pages(store, None)
    with pytest.raises(RecordUnavailable):
        await store.append([draft(filler="x" * 100_000)])
    limit_pages(store, 1_000_000)
    assert await store.append([draft(n=1)]) == [1]
    await store.close()
    assert store.places.checkpoints.read_text() == f"{store.checkpoint}\n"
    found = verify_file(store.places.folder)
    assert (found.ok, found.size, found.problem) == (True, 1, None)


async def test_the_next_batch_waits_for_the_checkpoint_of_the_last(
    store: AuditStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Callers are answered while it is written, so it has to be there before anything more is committed."""
    seen: list[tuple[str, int]] = []
    follow, commit = store._ledger.follow, store._ledger.commit
    answered = threading.Event()

    def slowly(staged: Staged) -> str | None:
        assert answered.wait(10)  # the caller of this batch has its answer by now
        seen.append(("outside", staged.frontier.size))
        return follow(staged)

    def noted(staged: Staged) -> None:
        seen.append(("commit", staged.frontier.size))
        commit(staged)

    monkeypatch.setattr(store._ledger, "follow", slowly)
    monkeypatch.setattr(store._ledger, "commit", noted)
    assert await store.append([draft(n=1)]) == [1]
    second = asyncio.ensure_future(store.append([draft(n=2)]))
    await asyncio.sleep(0)
    answered.set()
    assert await second == [2]
    await store.close()
    assert seen == [("commit", 1), ("outside", 1), ("commit", 2), ("outside", 2)]


async def test_whatever_keeps_a_checkpoint_from_its_file_shows_in_the_health(
    store: AuditStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault of the program's own would end in a thread nobody listens to; the next batch writes what is missing."""

    def broken(descriptor: int, data: bytes) -> int:
        raise RuntimeError(f"no way to write {len(data)} bytes to {descriptor}")

    with monkeypatch.context() as patched:
        patched.setattr("app.audit.checkpoint_file.os.write", broken)
        assert await store.append([draft(n=1)]) == [1]
        await until(lambda: not store.healthy)
        assert store.reason is not None
        assert store.reason.startswith("checkpoint file: no way to write")
    assert await store.append([draft(n=2)]) == [2]
    assert store.healthy
    await store.close()
    assert verify_file(store.places.folder).ok
    assert store.places.checkpoints.read_text().count("reins/log") == 4  # an origin and a signature each


async def test_a_commit_that_failed_but_reached_the_disk_is_taken_in(
    store: AuditStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one thing a caller cannot be told exactly: refused, yet recorded. The log must stay one log."""
    commit = store._ledger.commit

    def fail_afterwards(staged: object) -> None:
        commit(staged)  # pyright: ignore[reportArgumentType]
        raise OSError("lost the answer")

    with monkeypatch.context() as broken:
        broken.setattr(store._ledger, "commit", fail_afterwards)
        with pytest.raises(RecordUnavailable, match="lost the answer"):
            await store.append([draft(n=1)])
    assert await store.append([draft(n=2)]) == [2]
    assert (await store.verify()).ok


@pytest.mark.parametrize("name", ["reins.db", "reins.db-wal", "checkpoints.log", "log.lock"])
async def test_a_log_whose_file_was_deleted_takes_nothing_more_until_it_is_back(
    store: AuditStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("app.audit.store.PROBE_AFTER_S", 0.01)
    await fill(store)
    await store.look()
    assert store.healthy
    recorded = store.size
    path, aside = store.places.folder / name, tmp_path / "aside"
    path.rename(aside)  # as good as deleted, and can be undone
    with pytest.raises(RecordUnavailable, match=f"the record's file `{name}` was deleted"):
        await store.append([draft()])
    path.write_bytes(b"")  # another one in its place is no record either
    await until(lambda: store.reason == f"another file stands in the place of the record's file `{name}`")
    with pytest.raises(RecordUnavailable):
        await store.append([draft()])
    aside.replace(path)
    await until(lambda: store.healthy)
    assert await store.append([draft()]) == [recorded + 1], "what was refused is not in the log"
    assert (await store.verify()).ok


async def test_a_server_whose_lock_another_one_took_anew_writes_nothing_beside_it(store: AuditStore) -> None:
    await fill(store)
    store.places.lock.unlink()
    second = AuditStore.open(store.places.folder)
    try:
        with pytest.raises(
            RecordUnavailable, match=r"another file stands in the place of the record's file `log\.lock`"
        ):
            await store.append([draft()])
        assert await second.append([draft()]) == [store.size + 1]
        with pytest.raises(RecordUnavailable):
            await store.append([draft()])
        assert (await second.verify()).ok
    finally:
        await second.close()


async def test_whoever_asks_hears_of_a_log_that_was_deleted_since_the_last_write(store: AuditStore) -> None:
    await fill(store)
    for path in store.places.folder.iterdir():
        path.unlink()
    await store.look()
    assert store.reason == (
        "the record's file `reins.db` was deleted under the process that writes it: nothing more would be kept"
    )


async def test_a_data_directory_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(RecordUnavailable, match="file"):
        AuditStore.open(blocked / "data")


async def test_a_connection_beyond_undoing_still_answers_its_callers(store: AuditStore) -> None:
    await fill(store, 1)
    store._ledger._connection.close()
    with pytest.raises(RecordUnavailable):
        await store.append([draft()])
    assert "taking it back" in (store.reason or "")
    assert (store.size, (await store.verify()).ok) == (3, True)
