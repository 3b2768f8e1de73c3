"""What policy has against a session, as one policy follows another and people answer."""

from __future__ import annotations

import pytest

from app.runtime.departures import Departures

SPEED = {"rule": "r", "code": "speed_mps", "message": "slower"}
FORCE = {"rule": "r", "code": "force_n", "message": "gentler"}
AGAIN = dict(SPEED)  # the same said anew


@pytest.fixture
def departures() -> Departures:
    made = Departures()
    made.conform("s", [SPEED])
    made.depart("s", [SPEED], 1.0)
    return made


def test_a_question_says_what_stands_and_nothing_that_is_over(departures: Departures) -> None:
    assert departures.misstated("s", [])
    assert not departures.misstated("s", [FORCE, AGAIN])
    departures.conform("s", [FORCE])
    departures.depart("s", [FORCE], 2.0)
    assert (departures.standing("s"), departures.over("s")) == ((FORCE,), (SPEED,))
    assert departures.misstated("s", [FORCE, AGAIN])
    assert not departures.misstated("s", [FORCE])


def test_what_a_policy_has_once_more_is_not_over(departures: Departures) -> None:
    departures.conform("s", [])
    assert (departures.standing("s"), departures.over("s")) == (None, (SPEED,))
    departures.conform("s", [AGAIN])
    departures.depart("s", [AGAIN], 2.0)
    assert (departures.standing("s"), departures.over("s")) == ((SPEED,), ())


def test_what_people_are_asked_for_is_not_over(departures: Departures) -> None:
    departures.conform("s", [])
    departures.ask("s", [AGAIN])
    assert not departures.misstated("s", [SPEED])


def test_a_word_answers_what_stood_and_not_what_another_policy_has_against_it_since(departures: Departures) -> None:
    answered = departures.standing("s")
    departures.conform("s", [AGAIN])
    departures.depart("s", [AGAIN], 2.0)
    departures.let_go("s", answered)
    assert departures.standing("s") == (SPEED,)
    departures.let_go("s", departures.standing("s"))
    assert departures.standing("s") is None


def test_what_was_said_before_a_start_joins_what_was_found_since_each_once(departures: Departures) -> None:
    departures.recall("s", [AGAIN, FORCE], [SPEED, FORCE, AGAIN])
    assert (departures.standing("s"), departures.over("s")) == ((SPEED, FORCE), ())
    departures.recall("t", [], [SPEED, AGAIN])
    assert (departures.standing("t"), departures.over("t")) == (None, (SPEED,))


def test_a_session_is_told_until_it_holds_and_is_known_until_it_is_over(departures: Departures) -> None:
    departures.tell("s", 3.0)
    assert departures.telling() == (("s", 3.0),)
    departures.holds("s")
    assert departures.telling() == ()
    departures.tell("s", 3.0)
    departures.conform("s", [])
    assert (departures.standing("s"), departures.telling()) == (None, ())
    assert departures.sessions() == {"s"}
    departures.forget("s")
    assert departures.sessions() == frozenset()
