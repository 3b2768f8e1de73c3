"""Whatever the disk does and whoever writes: what was taken is written once and in order, what was refused never is."""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from app.cell.journal import USED, Entry, Journal, JournalUnavailable
from app.cell.recorder import Recorder
from app.cell.telling import Saying

STEPS = st.lists(
    st.sampled_from(
        ["say", "say_anyway", "say_first", "sync", "catch_up", "acknowledged", "when_written", "fills_up", "has_room"]
    ),
    max_size=40,
)


class Desk:
    """One recorder on a real file, and what it took."""

    def __init__(self, folder: Path, *, behind: bool) -> None:
        self.journal = Journal(folder / "journal", boot="boot-1")
        self.told: list[Entry] = []
        self.taken: list[int] = []
        self.handed: list[tuple[int, int, str]] = []
        self.fault = ""
        self.recorder = Recorder(self.journal, lambda: float(self.recorder.tick), self.told.append)
        if behind:
            self.recorder.write_behind()

    def do(self, number: int, step: str) -> None:
        match step:
            case "say" | "say_anyway" | "say_first":
                self._say(number, step)
            case "acknowledged":
                self.recorder.acknowledged(len(self.told) // 2)
            case "when_written":
                self._when_written()
            case "fills_up":
                soft(self.journal.path.stat().st_size)
            case "has_room":
                soft(resource.RLIM_INFINITY)
            case _:
                try_out(getattr(self.recorder, step))

    def _say(self, number: int, how: str) -> None:
        self.recorder.tick = number
        say = getattr(self.recorder, how)
        if try_out(lambda: say(Saying("cell", None, "cell", {"number": number}), {f"{USED}{number}": 1e9})):
            self.taken.append(number)

    def _when_written(self) -> None:
        """Note how much was taken and how much is written when the word is handed out, and what is wrong then."""
        taken = len(self.taken)
        self.recorder.when_written(lambda: self.handed.append((taken, len(self.told), self.recorder.fault)))

    def end(self) -> tuple[Entry, ...]:
        """Give the disk room, have everything written, and read it back as another run of the cell would."""
        soft(resource.RLIM_INFINITY)
        self.recorder.require_room()
        self.recorder.sync()
        self.fault = self.recorder.fault
        self.journal.close()
        again = Journal(self.journal.path, boot="boot-2")
        again.close()
        return again.recall(0, again.last_seq + 1)


def try_out(step: Callable[[], None]) -> bool:
    """Say whether it was taken."""
    try:
        step()
    except JournalUnavailable:
        return False
    return True


def soft(limit: int) -> None:
    """Let no file of this process grow beyond so many bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@contextmanager
def desk(*, behind: bool) -> Generator[Desk]:
    with tempfile.TemporaryDirectory() as folder:
        try:
            yield Desk(Path(folder), behind=behind)
        finally:
            soft(resource.RLIM_INFINITY)


@pytest.mark.parametrize("behind", [False, True], ids=["whoever speaks", "a thread"])
@settings(max_examples=40)
@given(steps=STEPS)
@example(steps=["fills_up", "say_anyway", "say", "has_room", "say_first"])
@example(steps=["say", "fills_up", "say", "when_written", "say_first", "has_room", "catch_up"])
def test_what_was_taken_is_written_once_in_order_and_what_was_refused_never(behind: bool, steps: list[str]) -> None:
    with desk(behind=behind) as one:
        for number, step in enumerate(steps):
            one.do(number, step)
        written = one.end()
        assert [entry.body["number"] for entry in written] == one.taken
        assert [entry.tick for entry in written] == one.taken, "dated by when it was said"
        assert list(written) == one.told
        assert one.recorder.used_permits() == {str(number) for number in one.taken}
        assert one.fault == ""


@pytest.mark.parametrize("behind", [False, True], ids=["whoever speaks", "a thread"])
@settings(max_examples=40)
@given(steps=STEPS)
def test_a_word_is_handed_out_behind_what_was_said_before_it_unless_that_cannot_be_written(
    behind: bool, steps: list[str]
) -> None:
    with desk(behind=behind) as one:
        for number, step in enumerate(steps):
            one.do(number, step)
        one.end()
        assert bool(one.handed) == ("when_written" in steps)
        for taken, told, fault in one.handed:
            assert told >= taken or fault


@settings(max_examples=40)
@given(steps=STEPS.map(lambda steps: [step for step in steps if step != "fills_up"]))
def test_a_thread_writes_what_whoever_speaks_would_have_written(steps: list[str]) -> None:
    with desk(behind=False) as one, desk(behind=True) as other:
        for number, step in enumerate(steps):
            one.do(number, step)
            other.do(number, step)
        assert one.end() == other.end()
