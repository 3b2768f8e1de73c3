"""The ordeal itself: it finds nothing in a cell that holds, what was planted in one that does not, and short."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from app.cell import governing
from app.cli import app
from app.governance.intervention import Decision, InterventionState, Responses
from app.governance.model import Alert, Bounds, Command
from app.ordeal.playing import play, shortened, words_of
from app.ordeal.story import Finding, Scene, Story, Word
from app.sim import skills_arm
from app.sim.body import Body, Moves
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from app.sim.people import Walk
from tests.cell.workshop import policy

pytestmark = pytest.mark.physics

GRASPS = 10  # a word of this seed launches a grasp, by normal mode and with nothing to confirm


def told(folder: Path, words: list[Word], *, faults: tuple[Fault, ...] = (), people: tuple[Walk, ...] = ()) -> Finding:
    """Play a story that is known to break something."""
    found = Story(policy(), 5, Scene("human-shared", faults, people), words, folder).play()
    assert found is not None
    return found


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


def test_finds_a_hand_that_lets_go_of_something_in_the_air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(body: Body, _: float) -> Moves:
        return body.open()

    monkeypatch.setattr(skills_arm, "_emptied", opened)
    verifies = Trigger(capability="grasp_object", phase="verify")
    hung = Fault(kind="habit", at=verifies, sizes={"habit": "hung"}, for_s=6.0)
    words = [Word(5, "welcome", 0), Word(6, "launch", GRASPS), Word(2500, "welcome", 0)]
    assert told(tmp_path, words, faults=(hung,)).invariant == "what is let go of does not fall"


def test_finds_a_session_that_waits_and_asks_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(invocation: str, *_: object, **__: object) -> governing.telling.Saying:
        return governing.telling.human(invocation, "escalate", "cell", None)

    monkeypatch.setattr(governing.telling, "escalation", silent)
    words = [Word(5, "welcome", 0), Word(6, "launch", GRASPS), Word(60, "escalate", 0), Word(90, "welcome", 0)]
    assert told(tmp_path, words).invariant == "who waits has asked"


def test_finds_a_hold_that_lasts_for_ever_without_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    intervene = Responses.intervene

    def patient(
        self: Responses, state: InterventionState, alerts: tuple[Alert, ...], tick: int
    ) -> tuple[InterventionState, Decision]:
        young = tuple(one._replace(since=tick) for one in state.engaged)
        return intervene(self, state._replace(engaged=young) if young else state, alerts, tick)

    monkeypatch.setattr(Responses, "intervene", patient)
    stays = Walk(points=((1.6, 3.6),), start=Trigger(time_s=1.0), leaves=False)
    words = [Word(5, "welcome", 0), Word(6, "launch", GRASPS), Word(1200, "welcome", 0)]
    assert told(tmp_path, words, people=(stays,)).invariant == "nothing waits without a word"


def test_says_that_everything_held() -> None:
    ran = CliRunner().invoke(app, ["sim", "fuzz", "--seeds", "2", "--first", "5", "--ticks", "200"])
    assert ran.exit_code == 0
    assert "everything held" in ran.output
