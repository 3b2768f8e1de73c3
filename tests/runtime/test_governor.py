"""One invocation's way, seen from the governor."""

from __future__ import annotations

import asyncio
import base64
from collections import Counter
from dataclasses import replace
from typing import Any

import orjson
import pytest

from app.audit.errors import RecordUnavailable
from app.governance.permit import SignedAuthorization, verify
from app.runtime import cell_controls, register
from app.runtime import fleet as fleet_module
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, InvalidParams, NotFound
from app.runtime.governor import Governor
from app.runtime.invocation import ProposalRequest

from .conftest import (
    AGENT,
    AUDITOR,
    CELL,
    ENGINEER,
    KEY,
    OPERATOR,
    OPERATOR_2,
    STRANGER,
    HandCell,
    House,
    grasp,
    navigate,
    until,
)

pytestmark = pytest.mark.anyio


def test_no_part_of_the_governor_takes_a_name_of_another():
    names = Counter(name for part in Governor.__mro__[:-1] for name in vars(part) if not name.startswith("__"))
    assert [name for name, times in names.items() if times > 1] == []


async def kinds(runtime: Runtime, invocation: str) -> list[str]:
    return [event["kind"] for event in await runtime.governor.trace(invocation, AUDITOR)]


# -- the pipeline ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["planner", "governance"])
async def test_no_agent_proposes_what_recovers_whatever_its_name_is(
    runtime: Runtime, cell: HandCell, name: str
) -> None:
    retreat = ProposalRequest(capability="safe_retreat", params={})
    document, _ = await runtime.governor.propose(replace(AGENT, name=name), retreat)
    assert document["status"] == "rejected"
    assert [reason["code"] for reason in document["admission"]["reasons"]] == ["recovery_only"]


async def test_launches_what_needs_no_approval(runtime: Runtime, cell: HandCell) -> None:
    document, created = await runtime.governor.propose(AGENT, navigate())
    assert created
    assert document["status"] == "running"
    assert document["outcome"] is None
    assert document["cell"] == CELL
    launch = await cell.expect("launch")
    grant = verify(
        SignedAuthorization(base64.b64decode(launch.body), base64.b64decode(launch.signature)),
        key=KEY.public_key(),
        cell=CELL,
        policy_digest=runtime.kernel.policy.digest,
        now_s=runtime.register.now_s(),
        used=frozenset(),
    )
    assert dict(grant.authorization.params) == document["effective"]
    assert grant.authorization.invocation == document["id"]
    assert await kinds(runtime, document["id"]) == ["proposal", "admission", "policy", "authorization"]


async def test_the_document_has_the_agreed_fields_and_survives_json(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert list(document) == [
        "id", "status", "capability", "agent", "cell", "profile", "policy_version", "requested", "effective",
        "admission", "policy", "escalation", "outcome", "created_at", "updated_at",
    ]  # fmt: skip
    assert orjson.loads(orjson.dumps(document)) == await runtime.governor.invocation(document["id"], AGENT)


async def test_an_authorization_covers_constrained_recoveries(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    launch = await cell.expect("launch")
    authorization = orjson.loads(base64.b64decode(launch.body))
    covered = {(item["strategy"], item["capability"]): item["params"] for item in authorization["recoveries"]}
    assert ("ROLLBACK", "retrace") in covered
    limit = runtime.kernel.policy.profiles["human-shared"].limits["tcp_speed_mps"].maximum
    assert covered["ROLLBACK", "retrace"]["speed_mps"] <= limit
    assert document["status"] == "running"


async def test_rejects_what_nobody_registered_and_records_it(runtime: Runtime, cell: HandCell) -> None:
    document, created = await runtime.governor.propose(AGENT, ProposalRequest(capability="fly", params={"up": 1}))
    assert created
    assert (document["status"], document["outcome"]) == ("rejected", "rejected")
    assert document["admission"]["reasons"][0]["code"] == "unknown_capability"
    assert document["policy"] is None
    assert await kinds(runtime, document["id"]) == ["proposal", "admission"]
    assert not cell.all("launch")


async def test_denies_by_rule_and_says_which(runtime: Runtime, cell: HandCell) -> None:
    cell.facts["objects"] = {
        "solvent_1": {"visible": True, "reachable": True, "x_m": 7.3, "y_m": 2.8, "z_m": 0.8, "stamp_s": 1.0}
    }
    await cell.state()
    request = ProposalRequest(capability="grasp_object", params={"object_id": "solvent_1"})
    document, _ = await runtime.governor.propose(AGENT, request)
    assert (document["status"], document["outcome"]) == ("denied", "denied")
    assert document["policy"]["outcome"] == "deny"
    assert any("hazard" in reason["rule"] for reason in document["policy"]["reasons"])


async def test_defers_while_the_cell_is_away_and_says_when_to_come_back(runtime: Runtime) -> None:
    cell = await HandCell(runtime).dial()
    await cell.hang_up()
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert (document["status"], document["outcome"]) == ("deferred", "deferred")
    assert document["admission"]["retry_after_s"] > 0
    assert document["admission"]["reasons"][0]["code"] == "cell_offline"


async def test_defers_where_no_cell_was_ever_seen(runtime: Runtime) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert document["status"] == "deferred"
    assert document["cell"] is None
    with pytest.raises(Conflict, match="`stop` is not possible while the invocation is `deferred`"):
        await runtime.governor.stop(document["id"], OPERATOR)


async def test_defers_on_an_unmet_precondition(runtime: Runtime, cell: HandCell) -> None:
    cell.facts["objects"] = {}
    await cell.state()
    document, _ = await runtime.governor.propose(AGENT, grasp())
    assert document["status"] == "deferred"
    assert document["admission"]["reasons"][0]["code"] == "precondition_unmet"


async def test_modifies_and_reports_every_change(runtime: Runtime, cell: HandCell) -> None:
    request = ProposalRequest(capability="navigate_to", params={"target": "dock", "speed_mps": 1.5})
    document, _ = await runtime.governor.propose(AGENT, request)
    assert document["status"] == "running"
    assert document["policy"]["outcome"] == "modify"
    assert document["effective"]["speed_mps"] <= 0.3
    assert "speed_mps" in {change["param"] for change in document["policy"]["changes"]}
    assert document["requested"]["speed_mps"] == 1.5


@pytest.mark.parametrize(
    "params",
    [
        {"target": 7},
        {"target": "dock", "unknown": 1},
        {"target": "dock", "speed_mps": float("nan")},
        {"target": "dock", "speed_mps": 1e308},
        {},
    ],
)
async def test_refuses_params_that_do_not_fit_the_schema(
    runtime: Runtime, cell: HandCell, params: dict[str, Any]
) -> None:
    before = runtime.store.size
    with pytest.raises(InvalidParams) as refusal:
        await runtime.governor.propose(AGENT, ProposalRequest(capability="navigate_to", params=params))
    assert all(problem["path"].startswith("params") for problem in refusal.value.problems)
    assert runtime.store.size == before


async def test_refuses_a_cell_nobody_knows(runtime: Runtime, cell: HandCell) -> None:
    with pytest.raises(InvalidParams, match="workcell-1"):
        await runtime.governor.propose(AGENT, navigate(cell="nowhere"))


async def test_facts_that_are_malformed_count_as_none(runtime: Runtime, cell: HandCell) -> None:
    cell.facts["surprise"] = 1
    await cell.state()
    document, _ = await runtime.governor.propose(AGENT, grasp())
    assert document["status"] == "deferred"
    assert "surprise" in runtime.governor.ready()[f"cell/{CELL}"]


async def test_only_one_of_two_racing_proposals_gets_the_cell(runtime: Runtime, cell: HandCell) -> None:
    answers = await asyncio.gather(*(runtime.governor.propose(AGENT, navigate()) for _ in range(8)))
    statuses = sorted(document["status"] for document, _ in answers)
    assert statuses == ["deferred"] * 7 + ["running"]
    deferred = next(document for document, _ in answers if document["status"] == "deferred")
    assert deferred["admission"]["reasons"][0]["code"] == "cell_busy"
    await cell.expect("launch")
    assert len(cell.all("launch")) == 1


async def test_the_cell_is_free_again_after_the_outcome(runtime: Runtime, cell: HandCell) -> None:
    for count in (1, 2):
        document, _ = await runtime.governor.propose(AGENT, navigate())
        assert document["status"] == "running"
        await cell.expect("launch", count)
        await cell.launched(document["id"])
        await cell.ended(document["id"], "succeeded")


async def test_a_cancelled_caller_leaves_nothing_half_done(runtime: Runtime, cell: HandCell) -> None:
    task = asyncio.create_task(runtime.governor.propose(AGENT, navigate()))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await cell.expect("launch")
    (live,) = runtime.register.live()
    assert live.status == "running"


# -- checking --------------------------------------------------------------------------------------------------------


async def test_check_records_nothing_and_says_allowed(runtime: Runtime, cell: HandCell) -> None:
    before = runtime.store.size
    verdict = await runtime.governor.check(AGENT, navigate())
    assert verdict["status"] == "allowed"
    assert "id" not in verdict
    assert (await runtime.governor.check(AGENT, grasp()))["status"] == "awaiting_approval"
    assert runtime.store.size == before
    assert not cell.all("launch")


# -- idempotency -----------------------------------------------------------------------------------------------------


async def test_the_same_key_and_body_give_the_same_invocation(runtime: Runtime, cell: HandCell) -> None:
    first, created = await runtime.governor.propose(AGENT, navigate(), "key-1")
    again, created_again = await runtime.governor.propose(AGENT, navigate(), "key-1")
    assert (created, created_again) == (True, False)
    assert again["id"] == first["id"]
    await cell.expect("launch")
    assert len(cell.all("launch")) == 1


async def test_the_same_key_and_numbers_give_the_same_invocation(runtime: Runtime, cell: HandCell) -> None:
    first, _ = await runtime.governor.propose(AGENT, grasp(metadata={"force_n": 80.0}), "key-1")
    again, created_again = await runtime.governor.propose(AGENT, grasp(metadata={"force_n": 80}), "key-1")
    assert (again["id"], created_again) == (first["id"], False)
    with pytest.raises(Conflict):
        await runtime.governor.propose(AGENT, grasp(metadata={"force_n": 80.5}), "key-1")


async def test_the_same_key_with_another_body_is_refused(runtime: Runtime, cell: HandCell) -> None:
    await runtime.governor.propose(AGENT, navigate(), "key-1")
    with pytest.raises(Conflict) as refusal:
        await runtime.governor.propose(AGENT, grasp(), "key-1")
    assert (refusal.value.code, refusal.value.status) == ("idempotency_mismatch", 422)


async def test_a_key_in_flight_is_refused(runtime: Runtime, cell: HandCell) -> None:
    answers = await asyncio.gather(
        *(runtime.governor.propose(AGENT, navigate(), "key-1") for _ in range(3)), return_exceptions=True
    )
    refusals = [answer for answer in answers if isinstance(answer, Conflict)]
    assert [refusal.code for refusal in refusals] == ["in_flight", "in_flight"]
    assert refusals[0].status == 409


async def test_a_key_is_its_agents_own(runtime: Runtime, cell: HandCell) -> None:
    first, _ = await runtime.governor.propose(AGENT, navigate(), "key-1")
    other, created = await runtime.governor.propose(STRANGER, navigate(), "key-1")
    assert created
    assert other["id"] != first["id"]


# -- the record ------------------------------------------------------------------------------------------------------


async def test_nothing_is_sent_when_the_record_fails(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    with pytest.raises(RecordUnavailable):
        await runtime.governor.propose(AGENT, navigate())
    monkeypatch.undo()
    assert not cell.all("launch")
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert document["status"] == "running", "the claim was given back"


async def test_a_stop_is_sent_even_when_the_record_fails(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])

    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    stopped = await runtime.governor.stop(document["id"], OPERATOR)
    assert (stopped["id"], stopped["recorded"]) == (document["id"], False)
    await until(lambda: cell.ops() == ["stop"])
    answer = await runtime.governor.estop(CELL, ENGINEER)
    assert answer["latched"]
    assert answer["recorded"] is False
    await cell.expect("estop")
    assert runtime.register.unsaid() == [f"human {document['id']}"] * 2
    monkeypatch.undo()
    await runtime.fleet.tend_once()
    assert runtime.register.unsaid() == []
    said = [event.payload() for event in await runtime.store.events(kind="human")]
    assert [body["op"] for body in said] == ["stop", "estop"], "it is recorded as soon as that is possible"
    assert all(body["said_at"] for body in said)


async def test_the_record_says_how_many_words_it_lacks(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    monkeypatch.setattr(register, "MAX_UNSAID", 2)
    with monkeypatch.context() as disk:
        disk.setattr(runtime.store, "append", broken)
        for _ in range(5):
            await runtime.governor.pause(document["id"], OPERATOR)
    for _ in range(2):
        await runtime.fleet.tend_once()
    said = [event.payload() for event in await runtime.store.events(after=runtime.store.size - 3)]
    assert [body.get("count", body.get("op")) for body in said] == [3, "pause", "pause"]


async def test_what_loosens_is_not_sent_when_the_record_fails(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    await cell.report("status", document["id"], status="paused")

    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    with pytest.raises(RecordUnavailable):
        await runtime.governor.resume(document["id"], OPERATOR)
    assert cell.ops() == []


# -- people's words --------------------------------------------------------------------------------------------------


async def test_an_operator_pauses_resumes_rolls_back_and_stops(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await runtime.governor.pause(name, OPERATOR)
    await cell.report("status", name, status="paused")
    await runtime.governor.resume(name, OPERATOR)
    await cell.report("status", name, status="running")
    await runtime.governor.rollback(name, OPERATOR)
    await cell.report("status", name, status="recovering")
    assert (await runtime.governor.invocation(name, AGENT))["status"] == "recovering"
    await runtime.governor.stop(name, OPERATOR)
    await until(lambda: cell.ops() == ["pause", "resume", "rollback", "stop"])
    await cell.ended(name, "stopped")
    final = await runtime.governor.invocation(name, AGENT)
    assert (final["status"], final["outcome"]) == ("failed", "stopped")
    said = [event for event in await runtime.governor.trace(name, AUDITOR) if event["kind"] == "human"]
    assert [(event["actor"], event["body"]["op"]) for event in said] == [
        ("olivia", "pause"), ("olivia", "resume"), ("olivia", "rollback"), ("olivia", "stop")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("op", "status"),
    [("resume", "running"), ("resume", "escalated"), ("rollback", "recovering")],
)
async def test_a_word_out_of_place_is_refused(runtime: Runtime, cell: HandCell, op: str, status: str) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    await cell.report("status", document["id"], status=status)
    with pytest.raises(Conflict) as refusal:
        await getattr(runtime.governor, op)(document["id"], OPERATOR)
    assert (refusal.value.code, refusal.value.status) == ("wrong_status", 409)
    assert cell.ops() == []


async def test_a_pause_that_the_record_cannot_take_is_left_by_no_resume_that_it_cannot_take_either(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    with monkeypatch.context() as full:
        full.setattr(runtime.store, "append", broken)
        paused = await runtime.governor.pause(name, OPERATOR)
        assert (paused["status"], paused["recorded"]) == ("running", False)
        await cell.state(status="paused")
        with pytest.raises(RecordUnavailable, match="disk full"):
            await runtime.governor.resume(name, OPERATOR)
        assert cell.ops() == ["pause"]
    await runtime.governor.resume(name, OPERATOR)
    await until(lambda: cell.ops() == ["pause", "resume"])


@pytest.mark.parametrize("op", ["pause", "resume", "rollback", "cancel"])
async def test_what_was_stopped_only_comes_to_rest(runtime: Runtime, cell: HandCell, op: str) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await cell.report("status", name, status="paused")
    await runtime.governor.stop(name, OPERATOR)
    with pytest.raises(Conflict) as refusal:
        await getattr(runtime.governor, op)(name, OPERATOR)
    assert (refusal.value.code, refusal.value.status) == ("ending", 409)
    await runtime.governor.stop(name, OPERATOR)
    await until(lambda: cell.ops() == ["stop", "stop"])
    said = [event["body"]["op"] for event in await runtime.governor.trace(name, AUDITOR) if event["kind"] == "human"]
    assert said == ["stop", "stop"]


@pytest.mark.parametrize("op", ["pause", "resume", "rollback"])
async def test_nothing_becomes_of_a_word_after_an_emergency_stop(runtime: Runtime, cell: HandCell, op: str) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await cell.report("status", name, status="paused")
    await runtime.governor.estop(CELL, OPERATOR)
    with pytest.raises(Conflict) as refusal:
        await getattr(runtime.governor, op)(name, OPERATOR)
    assert (refusal.value.code, refusal.value.status) == ("estop_latched", 409)
    await runtime.governor.stop(name, OPERATOR)
    await until(lambda: cell.ops() == ["stop"])


async def test_a_cancelled_session_may_be_cancelled_again(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    for _ in range(2):
        await runtime.governor.cancel(document["id"], AGENT)
    await until(lambda: cell.ops() == ["cancel", "cancel"])


async def test_an_operator_stops_what_its_agent_has_cancelled(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await runtime.governor.cancel(name, AGENT)
    assert (await runtime.governor.stop(name, OPERATOR))["recorded"]
    await until(lambda: cell.ops() == ["cancel", "stop"])
    await cell.ended(name, "stopped")
    final = await runtime.governor.invocation(name, AGENT)
    assert (final["status"], final["outcome"]) == ("failed", "stopped")
    assert (await runtime.store.verify()).ok


async def test_a_held_session_that_was_stopped_is_not_let_go(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    await cell.report("escalation", document["id"], reason="separation")
    question = runtime.desk.pending_for(document["id"])
    assert question is not None
    await runtime.governor.stop(document["id"], OPERATOR)
    with pytest.raises(Conflict) as refusal:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert refusal.value.code == "ending"


@pytest.mark.parametrize("op", ["pause", "resume", "stop", "rollback", "cancel"])
async def test_nothing_can_be_done_to_what_is_over(runtime: Runtime, cell: HandCell, op: str) -> None:
    document, _ = await runtime.governor.propose(AGENT, ProposalRequest(capability="fly", params={}))
    with pytest.raises(Conflict) as refusal:
        await getattr(runtime.governor, op)(document["id"], OPERATOR)
    assert refusal.value.code == "wrong_status"


async def test_an_agent_cancels_its_own_session_and_nobody_elses(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    with pytest.raises(NotFound):
        await runtime.governor.cancel(document["id"], STRANGER)
    assert cell.ops() == []
    await runtime.governor.cancel(document["id"], AGENT)
    await until(lambda: cell.ops() == ["cancel"])
    await cell.ended(document["id"], "cancelled")
    assert (await runtime.governor.invocation(document["id"], AGENT))["outcome"] == "cancelled"


async def test_a_rollback_that_a_human_ordered_is_not_the_agents_to_call_off(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await runtime.governor.rollback(name, OPERATOR)
    for status in ("running", "recovering", "escalated"):  # on its way to the cell, under way, and after it failed
        if status != "running":
            await cell.report("status", name, status=status)
        with pytest.raises(Conflict) as refusal:
            await runtime.governor.cancel(name, AGENT)
        assert (refusal.value.code, refusal.value.status) == ("rollback_ordered", 409)
    assert cell.ops() == ["rollback"]
    await runtime.governor.cancel(name, OPERATOR)
    await until(lambda: cell.ops() == ["rollback", "cancel"])


@pytest.mark.parametrize("status", ["running", "recovering", "paused", "escalated"])
async def test_a_rollback_may_be_ordered_again_whatever_its_cell_has_said_of_it(
    runtime: Runtime, cell: HandCell, status: str
) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await runtime.governor.rollback(name, OPERATOR)
    if status != "running":
        await cell.report("status", name, status=status)
    assert (await runtime.governor.rollback(name, OPERATOR_2))["status"] == status
    await until(lambda: cell.ops() == ["rollback", "rollback"])
    said = [event["actor"] for event in await runtime.governor.trace(name, AUDITOR) if event["kind"] == "human"]
    assert said == ["olivia", "oskar"]


async def test_two_operators_who_order_a_rollback_at_the_same_moment_are_both_obeyed(
    runtime: Runtime, cell: HandCell
) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await asyncio.gather(*(runtime.governor.rollback(name, who) for who in (OPERATOR, OPERATOR_2)))
    await until(lambda: cell.ops() == ["rollback", "rollback"])
    known = runtime.register.newest(name)
    assert known is not None
    assert known.terms.undone_by == "olivia"


async def test_a_rollback_that_a_denial_ordered_is_not_the_agents_to_call_off(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await cell.report("escalation", name, reason="separation")
    question = runtime.desk.pending_for(name)
    assert question is not None
    undoing = replace(question, on_deny="rollback")
    runtime.desk.hold(undoing)
    await runtime.desk.resolve(question.id, OPERATOR, "deny", question.digest)
    await until(lambda: cell.ops() == ["rollback"])
    with pytest.raises(Conflict) as refusal:
        await runtime.governor.cancel(name, AGENT)
    assert refusal.value.code == "rollback_ordered"
    await runtime.governor.rollback(name, OPERATOR_2)
    await until(lambda: cell.ops() == ["rollback", "rollback"])


async def test_a_session_that_goes_on_after_all_is_the_agents_to_end_again(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    name = document["id"]
    await cell.launched(name)
    await runtime.governor.rollback(name, OPERATOR)
    await cell.report("status", name, status="escalated", reason="rollback_unavailable")
    await cell.report("status", name, status="running")
    await runtime.governor.cancel(name, AGENT)
    await until(lambda: cell.ops() == ["rollback", "cancel"])


async def test_the_agent_calls_off_a_recovery_that_no_human_ordered(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    await cell.report("status", document["id"], status="recovering")
    await runtime.governor.cancel(document["id"], AGENT)
    await until(lambda: cell.ops() == ["cancel"])


async def test_an_emergency_stop_is_latched_and_launches_are_rejected(runtime: Runtime, cell: HandCell) -> None:
    answer = await runtime.governor.estop(CELL, AGENT)
    assert answer["latched"]
    assert answer["recorded"]
    await cell.expect("estop")
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert document["status"] == "rejected"
    assert document["admission"]["reasons"][0]["code"] == "estop_latched"
    reset = await runtime.governor.reset(CELL, OPERATOR)
    assert not reset["latched"]
    await cell.expect("reset")
    with pytest.raises(Conflict) as refusal:
        await runtime.governor.reset(CELL, OPERATOR)
    assert refusal.value.code == "not_latched"


async def test_a_reset_is_answered_when_the_cell_says_so_itself(runtime: Runtime, cell: HandCell) -> None:
    cell.obeys = False
    await runtime.governor.estop(CELL, AGENT)
    resetting = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    told = await cell.expect("reset")
    for latched in (False, True):  # said before it heard of the stop, and before it heard of the reset
        await cell.state(latched=latched)
        document, _ = await runtime.governor.propose(AGENT, navigate())
        assert document["admission"]["reasons"][0]["code"] == "estop_latched"
    assert not resetting.done()
    await cell.state(reset=told.id)
    assert not (await resetting)["latched"]
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert document["status"] == "running"


async def test_a_reset_that_the_cell_does_not_confirm_says_that_it_is_latched(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_module, "RESET_S", 0.05)
    cell.obeys = False
    await runtime.governor.estop(CELL, AGENT)
    await cell.state()
    assert (await runtime.governor.reset(CELL, OPERATOR))["latched"]
    said = [(event.kind, event.payload()) for event in await runtime.store.events()][-2:]
    assert [kind for kind, _ in said] == ["human", "cell"]
    assert said[-1][1] == {"what": "not_confirmed", "op": "reset", "cell": CELL, "journal": cell.journal}
    monkeypatch.undo()
    cell.obeys = True
    assert not (await runtime.governor.reset(CELL, OPERATOR))["latched"]


@pytest.mark.parametrize("server", ["runs", "is started again"])
async def test_a_stop_whose_reset_the_cell_refused_is_latched_for_its_next_run_as_well(
    house: House, server: str
) -> None:
    async with house.open() as first:
        cell = await HandCell(first).dial()
        await first.governor.estop(CELL, AGENT)
        cell.tripped = 9  # no reset counts that is said of a state before, and its disk takes no word of either
        assert (await first.governor.reset(CELL, OPERATOR))["latched"]
        await cell.hang_up()
        if server == "runs":
            again = await HandCell(first, boot="boot-2").dial()
            await again.expect("estop")
            assert not (await first.governor.reset(CELL, OPERATOR))["latched"]
            return
    async with house.open() as second:
        again = await HandCell(second, boot="boot-2").dial()
        await again.expect("estop")
        assert second.register.unfounded == {}


async def test_who_may_take_the_second_step_of_a_reset_is_known_until_it_is_void(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def armed_by() -> str | None:
        return runtime.governor.cells()[0]["armed_by"]

    await runtime.governor.estop(CELL, AGENT)
    assert armed_by() is None
    assert runtime.governor.arm_reset(CELL, OPERATOR)["armed_by"] == OPERATOR.name == armed_by()
    with pytest.raises(Conflict, match="is off"):
        await runtime.governor.reset(CELL, OPERATOR_2, "12345678")
    assert armed_by() is None
    runtime.governor.arm_reset(CELL, OPERATOR_2)
    await runtime.governor.estop(CELL, AGENT)
    assert armed_by() is None
    monkeypatch.setattr(cell_controls, "CONFIRM_S", -1.0)
    runtime.governor.arm_reset(CELL, OPERATOR_2)
    assert armed_by() is None


async def test_a_reset_does_not_leave_a_stop_that_came_while_it_was_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await runtime.governor.estop(CELL, AGENT)
    append, reached, goes_on = runtime.store.append, asyncio.Event(), asyncio.Event()

    async def slow(*args: Any) -> Any:
        reached.set()
        await goes_on.wait()
        return await append(*args)

    monkeypatch.setattr(runtime.store, "append", slow)
    resetting = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    await reached.wait()
    stopping = asyncio.create_task(runtime.governor.estop(CELL, AGENT))
    await until(lambda: len(cell.all("estop")) == 2)
    goes_on.set()
    assert (await stopping)["latched"]
    assert (await resetting)["latched"]
    assert not cell.all("reset")
    assert runtime.fleet.latched(runtime.fleet.cell(CELL))


async def test_an_emergency_stop_overtakes_everything_that_waits(runtime: Runtime, cell: HandCell) -> None:
    for _ in range(20):
        await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
    gate = asyncio.Event()
    send, cell.send = cell.send, None  # type: ignore[method-assign,assignment]

    async def slow(frame: str) -> None:
        await gate.wait()
        await send(frame)

    cell.send = slow  # type: ignore[method-assign]
    await until(lambda: len(cell.heard) > 20)
    cell.heard.clear()
    for _ in range(5):
        await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
    await runtime.governor.estop(CELL, OPERATOR)
    gate.set()
    await until(lambda: len([m for m in cell.heard if m.type == "profile"]) == 5)
    first = [message.type for message in cell.heard].index("estop")
    assert first <= 1, "only the frame already handed to the socket may precede it"


async def test_the_profile_changes_what_is_decided(runtime: Runtime, cell: HandCell) -> None:
    with pytest.raises(NotFound):
        await runtime.governor.set_profile(CELL, "lax", OPERATOR)
    await runtime.governor.set_profile(CELL, "sim-relaxed", ENGINEER)
    assert (await cell.expect("profile")).profile == "sim-relaxed"
    document, _ = await runtime.governor.propose(AGENT, grasp())
    assert (document["status"], document["profile"]) == ("running", "sim-relaxed")
    (event,) = await runtime.store.events(kind="profile_changed")
    assert event.payload() == {"cell": CELL, "before": "human-shared", "profile": "sim-relaxed"}


# -- who sees what ---------------------------------------------------------------------------------------------------


async def test_an_agent_sees_its_own_invocations_alone(runtime: Runtime, cell: HandCell) -> None:
    mine, _ = await runtime.governor.propose(AGENT, navigate())
    theirs, _ = await runtime.governor.propose(STRANGER, navigate())
    for principal in (OPERATOR, ENGINEER, AUDITOR):
        items, following = await runtime.governor.list(principal, {})
        assert [item["id"] for item in items] == [theirs["id"], mine["id"]]
        assert following is None
        assert (await runtime.governor.invocation(mine["id"], principal))["id"] == mine["id"]
    assert [item["id"] for item in (await runtime.governor.list(AGENT, {}))[0]] == [mine["id"]]
    assert (await runtime.governor.list(AGENT, {"agent": "stranger"}))[0] == []
    for read in (runtime.governor.invocation, runtime.governor.trace):
        with pytest.raises(NotFound):
            await read(theirs["id"], AGENT)
    with pytest.raises(NotFound):
        await runtime.governor.wait(theirs["id"], AGENT, 0.1)


async def test_lists_page_newest_first_and_filter(runtime: Runtime, cell: HandCell) -> None:
    names = [(await runtime.governor.propose(STRANGER, navigate()))[0]["id"] for _ in range(5)]
    assert names == sorted(names), "identifiers sort by time"
    seen: list[str] = []
    cursor = None
    for _ in range(3):
        items, cursor = await runtime.governor.list(OPERATOR, {"status": "rejected"}, limit=2, cursor=cursor)
        seen += [item["id"] for item in items]
    assert seen == names[::-1]
    assert cursor is None
    assert (await runtime.governor.list(OPERATOR, {"status": "running"}))[0] == []


async def test_a_long_poll_returns_at_the_next_change(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    waiting = asyncio.create_task(runtime.governor.wait(document["id"], AGENT, 30.0, document["updated_at"]))
    await asyncio.sleep(0)
    await cell.launched(document["id"])
    changed = await waiting
    assert changed["updated_at"] > document["updated_at"]
    at_once = await runtime.governor.wait(document["id"], AGENT, 30.0, document["updated_at"])
    assert at_once["updated_at"] >= changed["updated_at"]
    again = await runtime.governor.invocation(document["id"], AGENT)
    unchanged = await runtime.governor.wait(document["id"], AGENT, 0.01, again["updated_at"])
    assert unchanged == again
    await cell.ended(document["id"], "succeeded")
    final = await runtime.governor.wait(document["id"], AGENT, 30.0)
    assert (final["status"], final["outcome"]) == ("completed", "succeeded")


async def test_readiness_names_what_is_broken(runtime: Runtime) -> None:
    assert runtime.governor.ready() == {"cells": "no cell has ever attached"}
    cell = await HandCell(runtime).dial()
    await cell.state()
    assert runtime.governor.ready() == {}
    await cell.state(holding=True)
    assert "lease" in runtime.governor.ready()[f"cell/{CELL}"]
    await cell.state(elsewhere="the robot works by another site; valid: restart the cell")
    assert "restart" in runtime.governor.ready()[f"cell/{CELL}"]
    assert "restart" in runtime.fleet.document(runtime.fleet.cell(CELL))["fault"]
    await cell.hang_up()
    assert "not attached" in runtime.governor.ready()[f"cell/{CELL}"]


async def test_a_server_is_ready_while_one_cell_is_whatever_ails_the_others(runtime: Runtime, cell: HandCell) -> None:
    other = await HandCell(runtime, id="workcell-2").dial()
    assert runtime.governor.ready() == {}, "one that has said nothing yet"
    cell.facts["surprise"] = 1
    await cell.state()
    assert set(runtime.governor.ready()) == {f"cell/{CELL}", "cell/workcell-2"}
    await other.state()
    assert runtime.governor.ready() == {}
    assert "surprise" in runtime.fleet.unusable()[f"cell/{CELL}"]
    document, _ = await runtime.governor.propose(AGENT, navigate())
    assert (document["status"], document["cell"]) == ("running", "workcell-2")


async def test_a_failed_session_tells_the_agent_what_went_wrong_first_and_how_it_ended(
    runtime: Runtime, cell: HandCell
) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.expect("launch")
    await cell.report("launch", document["id"], permit="auth", capability="navigate_to")
    await cell.report("outcome", document["id"], outcome="terminated", code="operator", failure="blocked")
    ended = await runtime.governor.invocation(document["id"], AGENT)
    assert [one["code"] for one in ended["failure"]["reasons"]] == ["blocked", "operator"]
    assert all(set(one) == {"rule", "code", "message", "remedy"} for one in ended["failure"]["reasons"])


async def test_a_session_that_did_its_task_has_no_failure(runtime: Runtime, cell: HandCell) -> None:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.expect("launch")
    await cell.report("outcome", document["id"], outcome="succeeded", code="verified")
    assert "failure" not in await runtime.governor.invocation(document["id"], AGENT)
