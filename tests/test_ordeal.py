"""The ordeal itself: it finds nothing in a cell that holds, what was planted in one that does not, and short."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from app.cell import governing
from app.cli import app
from app.governance.model import Bounds, Command
from app.ordeal.playing import play, shortened, words_of
from app.ordeal.story import Word
from tests.cell.workshop import policy

pytestmark = pytest.mark.physics


def test_draws_the_same_story_for_the_same_seed() -> None:
    assert words_of(7, 2500) == words_of(7, 2500) != words_of(8, 2500)


def test_finds_a_clamp_that_holds_nothing_and_tells_the_shortest_story_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def unclamped(command: Command, *_: Command | Bounds | tuple[float, ...] | float) -> tuple[Command, bool]:
        return command._replace(base_velocity=(3.0, 0.0, 0.0)), True

    monkeypatch.setattr(governing, "clamp", unclamped)
    words = [
        Word(5, "welcome", 0),
        Word(6, "launch", 1),
        Word(6, "pause", 2),
        Word(7, "resume", 3),
        Word(8, "stranger", 4),
    ]
    found = play(policy(), 5, words)
    assert found is not None
    assert found.invariant == "the base keeps its bound"
    assert [word.kind for word in shortened(policy(), found).words] == ["launch"]


def test_says_that_everything_held() -> None:
    ran = CliRunner().invoke(app, ["sim", "fuzz", "--seeds", "2", "--first", "5", "--ticks", "200"])
    assert ran.exit_code == 0
    assert "everything held" in ran.output
