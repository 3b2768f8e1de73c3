"""What the cell's record holds after its disk failed, its clock was put back, or its machine lost power."""

from __future__ import annotations

import os
import resource
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from app.cell import telling
from app.cell.journal import Journal, JournalUnavailable
from tests.cell.rig import NOW_S, Rig, signed

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
def test_a_permit_is_good_for_one_launch_though_the_clock_ran_ahead_and_was_put_back(
    rig: Rig, *, restarted: bool
) -> None:
    rig.launch()
    rig.finish()
    rig.now_s = NOW_S + 86_400.0
    rig.runner.acknowledged(rig.journal.last_seq)
    rig.now_s = NOW_S + 5.0
    if restarted:
        after_a_restart(rig)
        rig.runner = rig.start()
    assert rig.runner.launch(signed()) == "expired"
    assert "this cell's clock was beyond that before" in str(rig.last("launch")["detail"])
    assert rig.runner.launch(signed(id="auth-2", issued_at_s=NOW_S + 4.0, expires_at_s=NOW_S + 34.0)) is None
