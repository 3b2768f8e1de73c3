"""Other sensors, fault sizes and ways of walking: asked for in words, and found in what is drawn and run."""

from __future__ import annotations

import pytest

from app.evaluation.circumstances import AS_REPORTED, Circumstances
from app.evaluation.draws import Drawn, of_type
from app.evaluation.jobs import Job
from app.evaluation.model import Violation
from app.evaluation.physical_protocol import run
from app.evaluation.physical_trial import Bench, prepare
from app.evaluation.truth import OVER
from tests.evaluation.physical_world import bench
from tests.governance.policy_world import shipped

SEED = 7


@pytest.mark.parametrize(
    "one", [AS_REPORTED, Circumstances(noise=1.5, walks="other"), Circumstances(fault_size=0.5, dropout=0.25)]
)
def test_what_is_written_is_what_is_read(one: Circumstances) -> None:
    assert Circumstances.read(one.text) == one


def test_what_is_reported_needs_no_words() -> None:
    assert AS_REPORTED.text == ""
    assert Circumstances(noise=2.0, walks="other").text == "noise=2.0,walks=other"


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"noise": -1.0}, "sensor noise `-1.0`"),
        ({"dropout": 1.5}, "tracker dropout `1.5`"),
        ({"fault_size": float("nan")}, "fault size `nan`"),
        ({"fault_size": 0.0}, "fault size `0.0`"),
        ({"walks": "moon"}, "walks `moon`: valid are usual, other"),
    ],
)
def test_refuses_what_nothing_can_be_run_in(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Circumstances(**wrong)  # type: ignore[arg-type]


def drawn(violation: Violation, number: int, size: float = 1.0) -> Drawn:
    return of_type(shipped(), SEED, number, violation, size=size)


def test_a_fault_size_scales_what_is_beyond_the_limit_and_nothing_else() -> None:
    policy = shipped()
    for number in range(20):
        usual, small = drawn(Violation.SPEED, number), drawn(Violation.SPEED, number, 0.5)
        assert (usual.capability, usual.profile, usual.params) == (small.capability, small.profile, small.params)
        asked = usual.params.get("speed_mps")
        limit = asked if isinstance(asked, float) else policy.profiles[usual.profile].limits["tcp_speed_mps"].maximum
        assert small.size - OVER * limit == pytest.approx(0.5 * (usual.size - OVER * limit))
        assert drawn(Violation.ZONE, number, 2.0).size == pytest.approx(2.0 * drawn(Violation.ZONE, number).size)
        slips = drawn(Violation.POSTCONDITION, number), drawn(Violation.POSTCONDITION, number, 2.0)
        assert slips[1].size == pytest.approx(slips[0].size / 2.0)


def test_people_come_by_other_ways_where_that_is_asked_for() -> None:
    usual = prepare(bench(), SEED, 0, wanted=Violation.PEOPLE, whole=False).drawn
    elsewhere = Bench(shipped(), bench().stage, Circumstances(walks="other"))
    other = prepare(elsewhere, SEED, 0, wanted=Violation.PEOPLE, whole=False).drawn
    assert (usual.capability, usual.profile) == (other.capability, other.profile)
    assert usual.scenario.people[0].points != other.scenario.people[0].points


def test_a_job_is_run_in_the_circumstances_that_it_names() -> None:
    job = Job("a", "reins", "violation-speed", SEED, 0, 2)
    usual, same, other = (
        [{**row, "decision_us": None} for row in run(job._replace(under=under), shipped())]
        for under in ("", "", "fault_size=3.0")
    )
    assert usual == same
    assert [row["size"] for row in other] != [row["size"] for row in usual]
