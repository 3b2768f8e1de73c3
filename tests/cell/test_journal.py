from __future__ import annotations

import errno
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from app.cell import journal as module
from app.cell.journal import Entry, Journal, JournalUnavailable
from app.disk import ROOM_BYTES
from app.governance.model import Json
from tests.conftest import until


def write(journal: Journal, count: int = 1, **changes: Json) -> list[Entry]:
    return [
        journal.append(
            at_s=1.5, tick=number, kind="alert", invocation="inv-1", actor="cell", body={"n": number, **changes}
        )
        for number in range(count)
    ]


def test_what_was_written_is_there_again_in_order(tmp_path: Path) -> None:
    first = Journal(tmp_path / "journal", boot="a")
    written = write(first, 5, text="öl\nzwei")
    first.close()
    again = Journal(tmp_path / "journal", boot="b")
    assert list(again.unacknowledged()) == written
    assert again.unacknowledged(after=3) == tuple(written[3:])
    assert (again.last_seq, again.torn_bytes) == (5, 0)
    assert write(again)[0].seq == 6


def test_numbers_go_on_after_everything_was_acknowledged_and_compacted(tmp_path: Path) -> None:
    first = Journal(tmp_path / "journal", boot="a")
    write(first, 7)
    first.acknowledge(7)
    first.compact()
    assert first.unacknowledged() == ()
    assert write(first)[0].seq == 8
    first.close()
    assert Journal(tmp_path / "journal", boot="b").last_seq == 8


def test_a_journal_keeps_its_name_and_one_made_anew_has_another(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    first = Journal(path, boot="a")
    write(first, 2)
    first.compact()
    first.close()
    again = Journal(path, boot="b")
    assert again.id == first.id != ""
    again.close()
    path.unlink()
    assert Journal(path, boot="c").id not in {"", first.id}


def test_a_journal_from_before_there_were_names_gets_one_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    named = Journal(path, boot="a")
    write(named, 3)
    named.close()
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[1:]))
    first = Journal(path, boot="b")
    assert first.id
    assert write(first)[0].seq == 4
    first.close()
    assert Journal(path, boot="c").id == first.id


@pytest.mark.parametrize("held", [4, 5, 6, 9], ids=["as many", "one more", "two more", "many more"])
def test_what_is_written_after_the_end_was_lost_passes_for_nothing_that_the_log_holds(
    tmp_path: Path, held: int
) -> None:
    path = tmp_path / "journal"
    first = Journal(path, boot="a")
    write(first, 9)
    first.close()
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-5]))  # a power cut takes what was not synced
    again = Journal(path, boot="b")
    own = [entry._replace(seq=0) for entry in write(again, 2, after="the cut")]
    again.number_behind(held)
    again.acknowledge(held)
    told = again.unacknowledged()
    assert [entry.seq for entry in told] == [held + 1, held + 2]
    assert [entry._replace(seq=0) for entry in told] == own
    assert write(again)[0].seq == held + 3
    again.close()
    back = Journal(path, boot="c")
    assert [entry.seq for entry in back.unacknowledged(after=held)] == [held + 1, held + 2, held + 3]
    assert (back.last_seq, back.id) == (held + 3, first.id)


def test_what_the_log_has_not_got_yet_keeps_its_numbers(tmp_path: Path) -> None:
    first = Journal(tmp_path / "journal", boot="a")
    write(first, 4)
    first.close()
    again = Journal(tmp_path / "journal", boot="b")
    write(again)
    again.number_behind(3)
    assert [entry.seq for entry in again.unacknowledged(after=3)] == [4, 5]


def test_an_acknowledgement_beyond_what_was_said_forgets_nothing_to_come(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    write(journal, 2)
    journal.acknowledge(99)
    assert write(journal)[0].seq == 3
    assert [entry.seq for entry in journal.unacknowledged()] == [3]


def test_a_log_that_was_put_back_is_owed_again_what_the_file_still_holds(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    written = write(journal, 6)
    journal.acknowledge(5)
    assert journal.first_seq == 1
    journal.acknowledge(2)
    assert list(journal.unacknowledged()) == written[2:]
    journal.compact()
    assert journal.first_seq == 3
    again = Journal(tmp_path / "journal", boot="b")
    assert (again.acknowledged, again.first_seq) == (2, 3)
    assert list(again.unacknowledged()) == written[2:]
    again.acknowledge(0)  # the first two are in no file any more
    assert (again.acknowledged, list(again.unacknowledged())) == (2, written[2:])


def test_says_what_its_file_holds_between_two_numbers_while_it_is_written(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    written = write(journal, 4)
    journal.acknowledge(4)
    with journal.path.open("ab") as file:
        file.write(b"half a li")
    assert list(journal.recall(1, 4)) == written[1:3]
    journal.path.unlink()
    with pytest.raises(JournalUnavailable, match="cannot read the journal"):
        journal.recall(0, 4)


def test_compaction_keeps_marks_and_what_is_not_acknowledged(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.mark({"latched": True, "used:auth-1": 50.0, "gone": 1})
    journal.mark({"gone": None})
    written = write(journal, 6)
    journal.acknowledge(4)
    before = (tmp_path / "journal").stat().st_size
    journal.compact()
    assert (tmp_path / "journal").stat().st_size < before
    write(journal)
    journal.close()
    again = Journal(tmp_path / "journal", boot="b")
    assert again.unacknowledged()[:2] == tuple(written[4:])
    assert again.marks == {"latched": True, "used:auth-1": 50.0}
    assert again.acknowledged == 4


def test_the_file_is_compacted_by_itself_when_it_has_grown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "COMPACT_BYTES", 2000)
    journal = Journal(tmp_path / "journal", boot="a")
    for _ in range(10):
        journal.acknowledge(write(journal, 20)[-1].seq)
    assert (tmp_path / "journal").stat().st_size < 4000


def test_a_compaction_that_leaves_its_name_in_doubt_counts_nothing_as_written_until_that_is_made_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old file has no name by then: what went there would be gone with the process."""
    journal = Journal(tmp_path / "journal", boot="a")
    written = write(journal, 2)

    def broken(_: Path) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patched:
        patched.setattr(module, "sync_folder", broken)
        for deed in (journal.compact, lambda: write(journal), journal.sync, journal.require_room):
            with pytest.raises(JournalUnavailable, match="sync the journal's folder: Input/output error"):
                deed()
        assert not journal.healthy
    journal.require_room()
    assert journal.healthy
    journal.mark({"latched": True, "used:auth-1": 50.0})
    written += write(journal)
    journal.close()
    again = Journal(tmp_path / "journal", boot="b")
    assert again.unacknowledged() == tuple(written)
    assert again.marks == {"latched": True, "used:auth-1": 50.0}
    assert [path.name for path in tmp_path.iterdir()] == ["journal"]


def test_a_compaction_that_cannot_be_written_leaves_the_old_file_in_use(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    written = write(journal, 2)
    (tmp_path / "journal.new").mkdir()
    with pytest.raises(JournalUnavailable, match="cannot compact the journal: Is a directory"):
        journal.compact()
    assert journal.healthy
    written += write(journal)
    journal.close()
    assert Journal(tmp_path / "journal", boot="b").unacknowledged() == tuple(written)


def test_marks_become_durable_with_the_entry_that_carries_them(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.append(
        at_s=0.0, tick=0, kind="launch", invocation="inv-1", actor="cell", body={}, marks={"used:auth-1": 99.0}
    )
    journal.close()
    again = Journal(tmp_path / "journal", boot="b")
    assert again.used_permits() == {"auth-1"}


def used(*moments: float) -> dict[str, Json]:
    return {f"used:auth-{moment:g}": moment for moment in moments}


def test_used_permits_are_kept_beyond_their_expiry_until_they_are_many(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.mark(used(*range(module.MOST_MARKS)))
    journal.forget_permits(1e9)
    assert len(journal.used_permits()) == module.MOST_MARKS
    assert journal.forgotten_s == -math.inf, "a clock that ran ahead and was put back bars nothing"
    journal.mark(used(module.MOST_MARKS))
    journal.forget_permits(1e9)
    kept = {f"auth-{number}" for number in range(module.MOST_MARKS + 1)[-module.KEEP_PERMITS :]}
    assert journal.used_permits() == kept
    assert journal.forgotten_s == module.MOST_MARKS - module.KEEP_PERMITS
    journal.compact()
    journal.close()
    again = Journal(tmp_path / "journal", boot="b")
    assert (again.used_permits(), again.forgotten_s) == (kept, module.MOST_MARKS - module.KEEP_PERMITS)


def test_used_permits_are_forgotten_only_once_time_refuses_them(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.mark(used(*range(100, 101 + module.MOST_MARKS)))
    journal.forget_permits(100.0)
    assert len(journal.used_permits()) == module.MOST_MARKS + 1
    journal.forget_permits(102.0)
    assert len(journal.used_permits()) == module.MOST_MARKS - 1
    assert journal.forgotten_s == 101.0


def test_what_was_used_while_a_clock_ran_ahead_is_not_forgotten_before_what_expired_earlier(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.mark({"used:ahead": 9000.0, **used(*range(module.MOST_MARKS))})
    journal.forget_permits(9001.0)
    assert "ahead" in journal.used_permits()
    assert journal.forgotten_s == module.MOST_MARKS - module.KEEP_PERMITS


def test_the_latest_expiry_of_what_was_forgotten_never_falls(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.mark({"forgotten_s": 5000.0, **used(*range(1 + module.MOST_MARKS))})
    journal.forget_permits(1e9)
    assert len(journal.used_permits()) == module.KEEP_PERMITS
    assert journal.forgotten_s == 5000.0


def test_when_it_was_begun_is_known_of_a_file_that_was_made_then(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    journal = Journal(path, boot="a", now_s=50.0)
    assert journal.begun_s == 50.0
    journal.compact()
    journal.close()
    assert Journal(path, boot="b", now_s=60.0).begun_s == 50.0
    path.unlink()
    assert Journal(path, boot="c", now_s=70.0).begun_s == 70.0
    path.unlink()
    assert Journal(path, boot="d").begun_s == -math.inf


@pytest.mark.parametrize("cut", [1, 5, 12, 30])
def test_a_torn_last_line_is_cut_off_and_said(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "journal"
    journal = Journal(path, boot="a")
    written = write(journal, 3)
    journal.close()
    path.write_bytes(path.read_bytes()[:-cut])
    again = Journal(path, boot="b")
    assert list(again.unacknowledged()) == written[:2]
    assert again.torn_bytes > 0
    assert write(again)[0].seq == 3
    again.close()
    assert Journal(path, boot="c").torn_bytes == 0


@pytest.mark.parametrize("at", [0, 12, 40])
def test_damage_before_the_last_line_is_refused(tmp_path: Path, at: int) -> None:
    path = tmp_path / "journal"
    journal = Journal(path, boot="a")
    write(journal, 3)
    journal.close()
    data = bytearray(path.read_bytes())
    data[at] ^= 0x01
    path.write_bytes(data)
    with pytest.raises(JournalUnavailable, match="damaged at byte `0`"):
        Journal(path, boot="b")


def test_a_repeated_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    journal = Journal(path, boot="a")
    write(journal, 2)
    journal.close()
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines, lines[2]]))
    with pytest.raises(JournalUnavailable, match="repeats sequence number `2`"):
        Journal(path, boot="b")


def test_a_directory_that_is_missing_or_no_directory_is_unavailable(tmp_path: Path) -> None:
    with pytest.raises(JournalUnavailable, match="cannot open"):
        Journal(tmp_path / "nowhere" / "journal", boot="a")
    with pytest.raises(JournalUnavailable, match="cannot open"):
        Journal(tmp_path, boot="a")


def test_a_body_that_is_no_json_is_unavailable_and_writes_nothing(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    with pytest.raises(JournalUnavailable):
        write(journal, bad=object())  # type: ignore[arg-type]
    assert write(journal)[0].seq == 1


def test_a_closed_journal_is_out_of_use(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    assert journal.healthy
    journal.close()
    assert not journal.healthy
    for deed in (lambda: write(journal), journal.sync, journal.compact, lambda: journal.mark({"a": 1})):
        with pytest.raises(JournalUnavailable, match="out of use"):
            deed()


def test_says_whether_there_is_room_for_the_record_of_a_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path / "journal", boot="a")
    journal.require_room()
    disk = os.fstatvfs(0)
    free = ROOM_BYTES // disk.f_frsize - 1
    for changed, why in (
        ((*disk[:3], free, free, *disk[5:]), f"`{free * disk.f_frsize}` bytes are free"),
        ((*disk[:8], disk.f_flag | os.ST_RDONLY, *disk[9:]), "read-only"),
    ):
        monkeypatch.setattr(os, "statvfs", lambda _, changed=changed: os.statvfs_result(changed))
        with pytest.raises(JournalUnavailable, match=why):
            journal.require_room()


def test_a_file_that_was_deleted_or_replaced_takes_nothing_more_until_it_is_back(tmp_path: Path) -> None:
    journal, aside = Journal(tmp_path / "journal", boot="a"), tmp_path / "aside"
    write(journal)
    journal.path.rename(aside)  # as good as deleted, and can be undone
    for refused in (lambda: write(journal), journal.sync, journal.require_room, journal.compact):
        with pytest.raises(JournalUnavailable, match="the journal was deleted under the process that writes it"):
            refused()
    Journal(journal.path, boot="b").close()
    with pytest.raises(JournalUnavailable, match="another file stands in the place of the journal"):
        journal.require_room()
    aside.replace(journal.path)
    assert [entry.seq for entry in write(journal)] == [2]
    journal.sync()


LIMITED = """
import resource, signal, sys
from pathlib import Path
from app.cell.journal import Journal, JournalUnavailable
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
path = Path(sys.argv[1])
journal = Journal(path, boot="a")
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
done = 0
try:
    while True:
        journal.append(at_s=0.0, tick=done, kind="alert", invocation=None, actor="cell", body={"n": done})
        done += 1
except JournalUnavailable as error:
    assert "cannot write" in str(error), error
assert path.stat().st_size <= 2000
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
entry = journal.append(at_s=0.0, tick=done, kind="alert", invocation=None, actor="cell", body={"n": done})
assert entry.seq == done + 1
print(done + 1)
"""


@pytest.mark.process
def test_a_full_disk_is_unavailable_leaves_no_half_line_and_goes_on_when_there_is_room(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    child = subprocess.run([sys.executable, "-c", LIMITED, str(path)], capture_output=True, text=True, timeout=170)
    assert child.returncode == 0, child.stderr
    again = Journal(path, boot="b")
    assert again.torn_bytes == 0
    assert [entry.body["n"] for entry in again.unacknowledged()] == list(range(int(child.stdout)))


WRITING = """
import sys
from pathlib import Path
from app.cell.journal import Journal
journal = Journal(Path(sys.argv[1]), boot="a")
number = 0
while True:
    number += 1
    body = {"n": number, "pad": "x" * 200}
    journal.append(at_s=0.0, tick=number, kind="alert", invocation=None, actor="cell", body=body)
    journal.sync()
    print(number, flush=True)
"""


@pytest.mark.process
def test_what_was_synced_survives_a_kill_in_the_middle_of_writing(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    out = tmp_path / "out"
    with out.open("wb") as told:
        child = subprocess.Popen([sys.executable, "-c", WRITING, str(path)], stdout=told)
        until(lambda: len(out.read_bytes().splitlines()) > 20, what="the child writes")
        os.kill(child.pid, signal.SIGKILL)
        child.wait(10)
    synced = int(out.read_bytes().rsplit(b"\n", 2)[-2])
    again = Journal(path, boot="b")
    numbers = [entry.body["n"] for entry in again.unacknowledged()]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) >= synced
    assert write(again)[0].seq == len(numbers) + 1
