"""What the cell's record holds after its disk failed, its clock was put back, or its machine lost power."""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from app.cell import telling
from app.cell.journal import USED, Entry, Journal, JournalUnavailable
from app.governance.model import Json, Status
from tests.cell.rig import NOW_S, PERMIT, Rig, signed
from tests.conftest import PATIENCE_S, until

CATCHING_UP = 101  # ticks within which a cell looks once whether its journal can be written again


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    if made.journal.healthy:
        made.journal.close()


@contextmanager
def full(journal: Journal, room: int = 0) -> Generator[None]:
    """Let no file of this process grow beyond so many bytes more than the journal has."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (journal.path.stat().st_size + room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def after_a_restart(rig: Rig) -> Journal:
    rig.journal.close()
    rig.journal = Journal(rig.journal.path, boot="boot-2")
    return rig.journal


# -- what was kept while the disk was full ---------------------------------------------------------------------------


def test_a_reset_is_recorded_behind_the_stop_that_could_not_be_and_the_cell_stays_free(rig: Rig) -> None:
    with full(rig.journal):
        rig.runner.estop("anyone")
        assert rig.runner.reset("operator") == "journal_unavailable"
    assert rig.runner.reset("operator") is None
    rig.ticks(CATCHING_UP)
    assert [body["what"] for body in rig.of("cell")] == ["estop", "reset"]
    assert not after_a_restart(rig).marks.get("latched")


def test_an_end_that_could_not_be_recorded_does_not_close_the_session_that_came_after_it(rig: Rig) -> None:
    rig.cell.script.ticks = 400.0
    rig.launch()
    rig.ticks(20)
    with full(rig.journal):
        rig.runner.human("inv-1", "stop", "operator")
        rig.until(lambda: rig.runner.invocation is None)
    rig.launch(id="auth-2", invocation="inv-2")
    rig.ticks(CATCHING_UP)
    told = [(entry.kind, entry.invocation) for entry in rig.entries if entry.kind in {"launch", "outcome"}]
    assert told[:3] == [("launch", "inv-1"), ("outcome", "inv-1"), ("launch", "inv-2")]
    assert after_a_restart(rig).marks["open"] == "inv-2"


def test_nothing_launches_while_something_that_happened_cannot_be_recorded(rig: Rig) -> None:
    """There would be room for the launch alone: what was kept needs more."""
    rig.launch()
    rig.finish()
    with full(rig.journal, room=2000):
        rig.runner._record.say_anyway(telling.cell("broken", telling.CELL, "x" * 4000))
        told = len(rig.entries)
        assert rig.runner.launch(signed(id="auth-2", invocation="inv-2")) == "journal_unavailable"
        assert (rig.runner.invocation, len(rig.entries)) == (None, told)
        assert "File too large" in rig.runner.view().fault
    rig.launch(id="auth-3", invocation="inv-3")
    assert [entry.kind for entry in rig.entries[told:]] == ["cell", "launch", "launch", "status"]


# -- a latch ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def synced(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, tuple[int, ...], str | None]]:
    """How far the journal was each time it was synced, what had been stopped by then, and what still ran."""
    found: list[tuple[int, tuple[int, ...], str | None]] = []
    sync = rig.journal.sync

    def noted() -> None:
        sync()
        found.append((rig.journal.last_seq, tuple(rig.cell.stops), rig.runner.invocation))

    monkeypatch.setattr(rig.journal, "sync", noted)
    return found


def test_a_latch_is_on_the_disk_once_power_is_cut_and_the_session_is_over(
    rig: Rig, synced: list[tuple[int, tuple[int, ...], str | None]]
) -> None:
    rig.launch()
    rig.ticks(20)
    rig.runner.estop("anyone")
    assert synced[1:] == [(rig.journal.last_seq, (0,), None)]
    assert rig.last("outcome")["code"] == "estop"


def test_a_latch_that_could_not_be_recorded_is_on_the_disk_once_it_is(
    rig: Rig, synced: list[tuple[int, tuple[int, ...], str | None]]
) -> None:
    with full(rig.journal):
        rig.runner.estop("anyone")
    rig.ticks(CATCHING_UP)
    assert rig.last("cell")["what"] == "estop"
    assert synced[-1][0] == rig.journal.last_seq
    assert rig.runner.view().fault == ""
    syncs = len(synced)
    rig.ticks(CATCHING_UP)
    assert len(synced) == syncs, "a cell at rest leaves its disk alone"


def test_why_a_stop_cannot_be_left_is_said_for_as_long_as_nothing_can_be_written(rig: Rig) -> None:
    rig.runner.estop("anyone")
    with full(rig.journal):
        assert rig.runner.reset("operator") == "journal_unavailable"
        for _ in range(3):
            rig.ticks(CATCHING_UP)
            assert "File too large" in rig.runner.view().fault, "there is room on the disk, but none for this file"
    rig.ticks(CATCHING_UP)
    assert (rig.runner.view().fault, rig.runner.reset("operator")) == ("", None)
    assert not after_a_restart(rig).marks.get("latched")


def test_a_latch_holds_though_the_disk_does_not_take_it_and_that_is_said(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int) -> None:
        raise OSError(5, "Input/output error")

    rig.launch()
    rig.ticks(20)
    monkeypatch.setattr(os, "fsync", broken)
    rig.runner.estop("anyone")
    assert (rig.runner.latched, rig.runner.invocation, rig.cell.stops) == (True, None, [0])
    assert "cannot sync the journal: Input/output error" in rig.runner.view().fault
    with pytest.raises(JournalUnavailable):
        rig.journal.require_room()


# -- a permit that was used ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("forgotten", [False, True])
def test_a_permit_is_good_for_one_launch_though_the_clock_ran_ahead_and_was_put_back(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, *, forgotten: bool, restarted: bool
) -> None:
    if forgotten:
        monkeypatch.setattr("app.cell.journal.KEEP_PERMITS", 1)
        monkeypatch.setattr("app.cell.journal.MOST_MARKS", 1)
        rig.journal.mark({"used:auth-0": NOW_S + 31.0})
    rig.launch()
    rig.finish()
    rig.now_s = NOW_S + 86_400.0
    rig.runner.acknowledged(rig.journal.last_seq)
    rig.now_s = NOW_S + 5.0
    if restarted:
        after_a_restart(rig)
        rig.runner = rig.start()
    assert rig.runner.launch(signed()) == ("clock_put_back" if forgotten else "used")
    assert rig.runner.launch(signed(id="auth-2", issued_at_s=NOW_S + 4.0, expires_at_s=NOW_S + 34.0)) is None


def test_a_launch_that_was_written_and_not_synced_is_over_for_whoever_heard_of_it(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was written is reported, so a refusal behind it would come too late: the server knows of a session."""

    def busy() -> None:
        raise JournalUnavailable("the disk has not taken what was to be recorded")

    monkeypatch.setattr(rig.journal, "sync", busy)
    assert rig.runner.launch(signed()) == "journal_unavailable"
    monkeypatch.undo()
    rig.ticks(CATCHING_UP)
    assert [(entry.kind, entry.body.get("refused"), entry.body.get("code")) for entry in rig.entries] == [
        ("launch", None, None),
        ("outcome", None, "journal_unavailable"),
    ]
    assert not rig.runner.view().fault
    assert after_a_restart(rig).marks.get("open") is None


# -- a disk that takes its time --------------------------------------------------------------------------------------


class SlowDisk:
    """Takes nothing while it is busy; whoever writes waits."""

    def __init__(self, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        self.idle = threading.Event()
        self.idle.set()
        append = rig.journal.append

        def waits(**entry: Any) -> Entry:
            assert self.idle.wait(PATIENCE_S)
            return append(**entry)

        monkeypatch.setattr(rig.journal, "append", waits)


@pytest.fixture
def slow(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowDisk]:
    disk = SlowDisk(rig, monkeypatch)
    rig.runner.write_behind()
    yield disk
    disk.idle.set()
    rig.runner.settle()


def somebody_near(rig: Rig) -> None:
    rig.cell.people = lambda _: ((rig.cell.x_m + 0.2, rig.cell.y_m),)


def test_a_robot_stands_before_the_disk_has_taken_why(rig: Rig, slow: SlowDisk) -> None:
    rig.launch()
    rig.ticks(60)
    assert rig.moving()
    rig.runner.settle()
    told = len(rig.entries)
    slow.idle.clear()
    somebody_near(rig)
    rig.ticks(80)
    assert (rig.runner.status, rig.moving(), len(rig.entries)) == (Status.PAUSED, False, told)
    slow.idle.set()
    rig.runner.settle()
    alert, intervention, paused = rig.entries[told:]
    assert [alert.kind, intervention.kind, paused.kind] == ["alert", "intervention", "status"]
    assert {alert.tick, intervention.tick, paused.tick} == {alert.tick}, "all of it was said in one tick"
    assert alert.tick < 70, "and is dated by when it was said"


def test_what_a_session_does_is_recorded_alike_by_a_thread_and_by_whoever_ticks(tmp_path: Path) -> None:
    def story(*, behind: bool) -> list[tuple[int, str, str | None, dict[str, Json]]]:
        folder = tmp_path / f"{behind}"
        folder.mkdir()
        rig = Rig(folder)
        if behind:
            rig.runner.write_behind()
        rig.cell.script.fails = {("grasp_object", 1): "object_lost"}
        rig.launch()
        rig.until(lambda: rig.runner.invocation is None)
        rig.runner.settle()
        rig.journal.close()
        again = Journal(rig.journal.path, boot="boot-2").unacknowledged()
        assert list(again) == rig.entries
        return [(entry.tick, entry.kind, entry.invocation, entry.body) for entry in again]

    assert story(behind=True) == story(behind=False)


def test_a_recovery_moves_nothing_before_the_disk_has_its_decision(rig: Rig, slow: SlowDisk) -> None:
    rig.cell.script.fails = {("grasp_object", 1): "object_lost"}
    rig.launch()
    rig.until(lambda: rig.runner.status is Status.RUNNING)
    rig.runner.settle()
    slow.idle.clear()
    ticking = threading.Thread(target=rig.until, args=(lambda: rig.runner.invocation is None,))
    ticking.start()
    session = rig.runner.session
    assert session is not None
    until(lambda: session.run.status is Status.RECOVERING and session.run.still(session.seen))
    assert rig.runs("release_and_retract") == 0
    assert not rig.of("recovery")
    slow.idle.set()
    ticking.join(PATIENCE_S)
    rig.runner.settle()
    assert rig.runs("release_and_retract") == 1
    assert rig.last("outcome")["outcome"] == "recovered"


def test_a_disk_that_takes_nothing_for_long_ends_the_session_and_launches_none(
    rig: Rig, slow: SlowDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.cell.script.ticks = 10_000.0
    rig.launch()
    rig.ticks(60)
    slow.idle.clear()
    monkeypatch.setattr("app.cell.recorder.STALL_S", 0.05)
    rig.runner.human("inv-1", "no_such_word", "operator")
    until(lambda: rig.ticks(1) or rig.runner.invocation is None)
    assert not rig.moving()
    assert "the disk has not taken what was to be recorded" in rig.runner.view().fault
    assert rig.runner.view().unsaid == {"inv-1": ("fault", "journal_unavailable")}
    assert rig.runner.launch(signed(id="auth-2", invocation="inv-2")) == "journal_unavailable"
    slow.idle.set()
    monkeypatch.undo()
    until(lambda: rig.ticks(CATCHING_UP) or not rig.runner.view().fault)
    assert rig.last("outcome")["code"] == "journal_unavailable"
    assert rig.runner.launch(signed(id="auth-3", invocation="inv-3")) is None


def test_what_cannot_be_written_by_the_thread_ends_the_session(rig: Rig, slow: SlowDisk) -> None:
    rig.cell.script.ticks = 10_000.0
    rig.launch()
    rig.ticks(60)
    rig.runner.settle()
    with full(rig.journal):
        somebody_near(rig)
        until(lambda: rig.ticks(1) or rig.runner.invocation is None)
    assert not rig.moving()
    until(lambda: rig.ticks(CATCHING_UP) or not rig.runner.view().fault)
    assert [entry.kind for entry in rig.entries[2:]][:3] == ["alert", "intervention", "status"]
    assert rig.last("outcome")["code"] == "journal_unavailable"
    assert after_a_restart(rig).marks.get("open") is None


@pytest.mark.parametrize("behind", [False, True], ids=["whoever ticks", "a thread"])
def test_a_session_that_has_nothing_to_say_stops_where_its_journal_is_gone(rig: Rig, behind: bool) -> None:
    rig.cell.script.ticks = 10_000.0
    if behind:
        rig.runner.write_behind()
    rig.launch()
    rig.ticks(60)
    rig.runner.settle()
    told = len(rig.entries)
    rig.journal.path.unlink()
    rig.ticks(CATCHING_UP)
    until(lambda: rig.ticks(1) or rig.runner.invocation is None)
    assert not rig.moving()
    assert "deleted under the process" in rig.runner.view().fault
    assert (rig.runner.view().unsaid, rig.entries[told:]) == ({"inv-1": ("fault", "journal_unavailable")}, [])


def test_nothing_moves_where_what_writes_the_journal_broke(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.cell.script.ticks = 10_000.0
    rig.runner.write_behind()
    rig.launch()
    rig.ticks(60)
    rig.runner.settle()
    monkeypatch.setattr(rig.journal, "append", lambda **_: 1 / 0)
    somebody_near(rig)
    until(lambda: rig.ticks(1) or rig.runner.invocation is None)
    assert not rig.moving()
    assert rig.runner.view().fault == "what writes the journal broke: ZeroDivisionError('division by zero')"
    monkeypatch.undo()
    rig.ticks(CATCHING_UP)
    assert rig.runner.launch(signed(id="auth-2", invocation="inv-2")) == "journal_unavailable"


def test_a_state_is_handed_out_behind_what_was_said_before_it_and_at_once_where_that_cannot_be_written(
    rig: Rig, slow: SlowDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, int]] = []

    def say(name: str) -> Callable[[], None]:
        return lambda: told.append((name, len(rig.entries)))

    rig.runner.when_written(say("at once"))
    slow.idle.clear()
    elsewhere = signed(cell="workcell-2")
    for _ in range(2):
        assert rig.runner.launch(elsewhere) == "wrong_cell"
    assert told == [("at once", 0)]
    rig.runner.when_written(say("older"))
    rig.runner.when_written(say("newest"))
    slow.idle.set()
    until(lambda: len(told) == 2)
    assert told == [("at once", 0), ("newest", 2)]
    monkeypatch.setattr("app.cell.recorder.STALL_S", 0.0)
    slow.idle.clear()
    rig.runner.launch(elsewhere)
    rig.ticks(1)
    rig.runner.when_written(say("in vain"))
    assert told[2:] == [("in vain", 2)]


def test_a_permit_counts_as_used_while_that_stands_in_line(rig: Rig, slow: SlowDisk) -> None:
    rig.launch()
    slow.idle.clear()
    rig.runner._record.say(telling.launch(PERMIT), marks={f"{USED}auth-9": NOW_S})
    assert rig.runner._record.used_permits() == {"auth-1", "auth-9"}
    assert rig.journal.used_permits() == {"auth-1"}
