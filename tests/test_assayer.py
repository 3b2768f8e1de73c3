"""A policy is examined by a process of its own, and comes back compiled; what has a fault does not come back."""

from __future__ import annotations

import asyncio
import os
from dataclasses import asdict
from typing import Any

import pytest

from app import assay, assayer
from app.assay import examined
from app.assayer import Assayer
from app.governance import bundle
from app.governance.changes import Direction
from app.governance.decision import decide
from app.governance.errors import PolicyErrors, Undecided
from app.runtime.errors import ExaminationFailed
from app.runtime.examining import Candidate
from tests.governance.policy_world import POLICIES, context, files, proposal, shipped

pytestmark = [pytest.mark.anyio, pytest.mark.process, pytest.mark.timeout(240)]
SHARED, ORGANIZATION = "profiles/human-shared.yaml", "organization.yaml"
PROMISES = bundle.read_properties(POLICIES)
assert PROMISES is not None


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


def edited(name: str, before: str, after: str) -> dict[str, str]:
    text = files()[name]
    assert before in text
    return {**files(), name: text.replace(before, after, 1)}


def candidate(changed: dict[str, str], promises: str | None = PROMISES, *, prove: bool = True) -> Candidate:
    return Candidate(files=changed, cases={}, promises=promises, prove=prove)


def asked(one: Candidate, against: Candidate | None = None) -> dict[str, Any]:
    """Examine in this process: what the other one would say."""
    fields = [None if found is None else asdict(found) for found in (one, against)]
    return examined({"candidate": fields[0], "against": fields[1]})[0]


async def test_what_another_process_compiled_decides_as_what_this_one_did() -> None:
    slower = edited(SHARED, "base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.2")
    found = await Assayer()(candidate(slower), candidate(files(), prove=False))
    assert "no contradiction" in found.proved
    assert found.comparison is not None
    assert (found.comparison.direction, found.comparison.proved) == (Direction.TIGHTENS, True)
    here = bundle.load_files(slower)
    assert (found.policy.digest, found.policy.rules.keys(), found.policy.gates.keys()) == (
        here.digest, here.rules.keys(), here.gates.keys(),
    )  # fmt: skip
    for params in (
        {"object_id": name, "force_n": 80.0, "speed_mps": 0.3} for name in ("mug_1", "solvent_1", "glass_1", "box_1")
    ):
        asking = (proposal("grasp_object", **params), context("human-shared"))
        one, other = (decide(policy, *asking) for policy in (found.policy, here))
        assert one == other


def test_what_is_not_proved_is_a_fault_with_the_case_that_shows_it() -> None:
    weaker = edited(ORGANIZATION, "force_n: {max: 20}", "force_n: {max: 25}")
    (problem, *_) = asked(candidate(weaker))["problems"]
    assert problem["file"] == "properties.yaml"
    assert "refuted" in problem["message"]
    assert "expect:" in problem["message"]
    assert asked(candidate(weaker, prove=False))["problems"] == []


@pytest.mark.parametrize(("left_s", "kind"), [(240.0, PolicyErrors), (0.0, Undecided)])
def test_says_whether_a_policy_is_refuted_or_only_not_decided(
    monkeypatch: pytest.MonkeyPatch, left_s: float, kind: type[PolicyErrors]
) -> None:
    monkeypatch.setattr(assay, "PROOFS_S", left_s)
    answer = asked(candidate(edited(ORGANIZATION, "force_n: {max: 20}", "force_n: {max: 25}")))
    assert answer["undecided"] is (kind is Undecided)
    with pytest.raises(PolicyErrors) as caught:
        assayer._refuse(answer)
    assert type(caught.value) is kind
    assert {problem.message.partition(":")[0] for problem in caught.value.problems} == {
        "undecided" if kind is Undecided else "refuted"
    }


def test_a_case_that_does_not_hold_is_a_fault() -> None:
    case = (
        "cases:\n  - {name: it is denied, profile: human-shared, capability: navigate_to, params: {target: dock}, "
        "expect: {status: denied}}\n"
    )
    one = Candidate(files=files(), cases={"tests/mine.yaml": case}, promises=None)
    (problem,) = asked(one)["problems"]
    assert (problem["file"], problem["line"], problem["key"]) == ("tests/mine.yaml", 2, "it is denied")


def test_a_promise_that_is_given_up_loosens() -> None:
    less = PROMISES.replace("  - id: payload-margin\n", "  - id: other-margin\n")
    found = asked(candidate(files(), less, prove=False), candidate(files()))["comparison"]
    assert found["direction"] == "loosens"
    assert {one["part"]: one["direction"] for one in found["differences"]} == {
        "properties/payload-margin": "loosens", "properties/other-margin": "same",
    }  # fmt: skip
    assert asked(candidate(files(), None, prove=False), candidate(files()))["comparison"]["direction"] == "loosens"
    assert asked(candidate(files(), prove=False), candidate(files()))["comparison"]["direction"] == "same"


async def test_a_fault_comes_back_with_its_place() -> None:
    with pytest.raises(PolicyErrors) as found:
        await Assayer()(candidate(edited(ORGANIZATION, "when: target.hazardous", "when: target.hazardus")), None)
    assert (found.value.file, found.value.line > 0) == (ORGANIZATION, True)


async def test_an_examination_that_breaks_off_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assayer, "COMMAND", ("false",))
    with pytest.raises(ExaminationFailed, match="ended with `1`"):
        await Assayer()(candidate(files()), None)
    monkeypatch.setattr(assayer, "COMMAND", ("no-such-command-here",))
    with pytest.raises(ExaminationFailed):
        await Assayer()(candidate(files()), None)


async def test_a_server_that_ends_does_not_wait_for_an_examination(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assayer, "COMMAND", ("sleep", "200"))
    examining = Assayer()
    waiting = asyncio.ensure_future(examining(candidate(files()), None))
    while examining._child is None:  # it begins on a thread, which says nothing
        await asyncio.sleep(0.01)
    assert os.getpriority(os.PRIO_PROCESS, examining._child.pid) == assayer.NICENESS  # from its first moment
    examining.close()
    with pytest.raises(ExaminationFailed, match="the server is stopping"):
        await waiting
    monkeypatch.setattr(assayer, "COMMAND", ("no-such-command-here",))
    with pytest.raises(ExaminationFailed, match="the server is stopping"):
        await examining(candidate(files()), None)
    assert shipped().digest == bundle.digest(files())
