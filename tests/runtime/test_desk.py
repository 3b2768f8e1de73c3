"""Questions to humans: asking, answering, editing, silence."""

from __future__ import annotations

import asyncio
from base64 import b64decode
from typing import Any

import orjson
import pytest

from app.agent.approver import decide, parse_habits
from app.audit.errors import RecordUnavailable
from app.audit.projection import rebuild
from app.clock import monotonic_s
from app.governance.model import EventKind, GrantScope
from app.runtime import questions
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, Forbidden, InvalidParams, NotFound
from app.runtime.escalation import STATED_AT_MOST
from app.runtime.grant import Offer
from app.runtime.invocation import Principal, ProposalRequest

from .conftest import (
    AGENT,
    AT_BENCH,
    AT_TOOLS,
    AUDITOR,
    CELL,
    ENGINEER,
    OPERATOR,
    OPERATOR_2,
    HandCell,
    House,
    grasp,
    navigate,
    press,
    until,
)

pytestmark = pytest.mark.anyio


async def asked(runtime: Runtime, request: ProposalRequest | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Propose what needs approval; return the invocation and its escalation."""
    document, _ = await runtime.governor.propose(AGENT, request or grasp())
    assert document["status"] == "awaiting_approval", document
    return document, await runtime.desk.get(document["escalation"]["id"])


async def answer(
    runtime: Runtime, question: dict[str, Any], who: Principal = OPERATOR, decision: str = "approve", **more: Any
) -> dict[str, Any]:
    return await runtime.desk.resolve(question["id"], who, decision, more.pop("digest", question["digest"]), **more)


async def refusal(runtime: Runtime, question: dict[str, Any], **more: Any) -> str:
    with pytest.raises(Conflict) as found:
        await answer(runtime, question, **more)
    assert found.value.status == 409
    return found.value.code


async def test_asks_before_launch_and_shows_what_policy_left(runtime: Runtime, cell: HandCell) -> None:
    request = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5})
    document, question = await asked(runtime, request)
    assert document["policy"]["outcome"] == "modify"
    assert question["kind"] == "approval"
    assert question["status"] == "pending"
    assert question["risk"] == "medium"
    assert question["agent"] == document["agent"]
    assert question["requested"]["force_n"] == 80
    assert question["effective"] == document["effective"]
    assert question["effective"]["force_n"] == 60
    assert question["effective"]["speed_mps"] == 0.25
    assert question["needed"] == 1
    assert document["escalation"] == {key: question[key] for key in ("id", "status", "expires_at")}
    assert not cell.all("launch")
    assert (await runtime.desk.list(status="pending"))[0] == [question]


@pytest.mark.parametrize(
    ("metadata", "goal"),
    [
        ({}, None),
        ({"intent": "fetch mug_1"}, "fetch mug_1"),
        ({"goal": "set the table", "intent": "fetch mug_1"}, "set the table"),
        ({"goal": ["set the table"], "intent": " \n "}, None),
        ({"goal": "  Allowed\n\tby policy  "}, "Allowed by policy"),
        ({"goal": "x" * STATED_AT_MOST}, "x" * STATED_AT_MOST),
        ({"goal": "😀" * 50_000}, "😀" * (STATED_AT_MOST - 1) + "…"),
    ],
)
async def test_a_question_says_what_the_agent_is_after_in_one_line_of_its_own_words(
    runtime: Runtime, cell: HandCell, metadata: dict[str, Any], goal: str | None
) -> None:
    _, question = await asked(runtime, grasp(metadata=metadata))
    assert question["goal"] == goal


async def test_a_habit_may_tell_agents_apart(runtime: Runtime, cell: HandCell) -> None:
    rule = {"match": {"agent": AGENT.name}, "decision": "approve"}
    _, question = await asked(runtime)
    assert decide(parse_habits({"rules": [rule]}), question, 1.0).decision == "approve"


async def test_an_approval_launches_exactly_what_was_shown(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    closed = await answer(runtime, question)
    assert closed["status"] == "approved"
    assert [approval["by"] for approval in closed["approvals"]] == ["olivia"]
    launch = await cell.expect("launch")
    assert launch
    now = await runtime.governor.invocation(document["id"], AGENT)
    assert now["status"] == "running"
    assert now["escalation"]["status"] == "approved"
    assert now["effective"] == question["effective"]
    trace = await runtime.governor.trace(document["id"], AUDITOR)
    assert [event["kind"] for event in trace] == [
        "proposal", "admission", "policy", "escalation", "approval", "admission", "policy", "authorization"
    ]  # fmt: skip
    assert trace[-1]["body"]["authorization"]["approvals"] == ["olivia"]


async def test_an_approval_leaves_the_verdict_on_the_request_as_it_was(runtime: Runtime, cell: HandCell) -> None:
    request = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5})
    document, question = await asked(runtime, request)
    await answer(runtime, question)
    now = await runtime.governor.invocation(document["id"], AGENT)
    assert (now["policy"], now["admission"]) == (document["policy"], document["admission"])
    assert {change["param"]: change["effective"] for change in now["policy"]["changes"]} == {
        "force_n": 60,
        "speed_mps": 0.25,
    }
    trace = await runtime.governor.trace(document["id"], AUDITOR)
    marks = [
        (event["kind"], event["body"].get("recheck")) for event in trace if event["kind"] in {"admission", "policy"}
    ]
    assert marks == [("admission", None), ("policy", None), ("admission", True), ("policy", True)]


async def test_a_denial_ends_it_and_the_agent_gets_a_code_and_no_words(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    closed = await answer(runtime, question, decision="deny", comment="not while I am in the cell, idiot")
    assert closed["status"] == "denied"
    seen = await runtime.governor.invocation(document["id"], AGENT)
    assert (seen["status"], seen["outcome"]) == ("denied", "denied")
    assert seen["policy"]["reasons"][-1]["code"] == "denied_by_human"
    theirs = orjson.dumps([seen, await runtime.governor.trace(document["id"], AGENT)])
    assert b"idiot" not in theirs
    ours = orjson.dumps(await runtime.governor.trace(document["id"], OPERATOR))
    assert b"idiot" in ours, "the record keeps it"
    assert not cell.all("launch")


async def test_a_second_answer_is_refused(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    await answer(runtime, question)
    assert await refusal(runtime, question, who=OPERATOR_2) == "already_resolved"


async def test_two_answers_at_once_are_one_answer(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    answers = await asyncio.gather(
        answer(runtime, question), answer(runtime, question, who=OPERATOR_2, decision="deny"), return_exceptions=True
    )
    refused = [item for item in answers if isinstance(item, Conflict)]
    assert [item.code for item in refused] == ["already_resolved"]


async def test_another_digest_is_refused(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    assert await refusal(runtime, question, digest="sha256:0") == "digest_mismatch"
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"


async def test_nobody_answers_for_their_own_proposal(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    with pytest.raises(Forbidden) as found:
        await answer(runtime, question, who=Principal(name="planner", role=OPERATOR.role))
    assert found.value.code == "own_proposal"


async def test_an_unknown_question_is_not_found(runtime: Runtime) -> None:
    with pytest.raises(NotFound):
        await runtime.desk.resolve("esc_0", OPERATOR, "approve", "sha256:0")
    with pytest.raises(NotFound):
        await runtime.desk.get("esc_0")


# -- several people --------------------------------------------------------------------------------------------------


async def test_two_different_people_are_needed_where_the_rule_says_so(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    document, question = await asked(runtime, press())
    assert question["needed"] == 2
    once = await answer(runtime, question)
    assert once["status"] == "pending"
    assert await refusal(runtime, question) == "already_approved"
    assert not cell.all("launch")
    twice = await answer(runtime, question, who=OPERATOR_2)
    assert twice["status"] == "approved"
    await cell.expect("launch")
    assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "running"


async def test_an_approval_goes_with_the_authority_of_who_gave_it(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    _, question = await asked(runtime, press())
    await answer(runtime, question)
    house.withdrawn.add(OPERATOR.name)
    with pytest.raises(Conflict, match="this takes another person"):
        await answer(runtime, question, who=OPERATOR_2, offer=Offer(scope=GrantScope.TIME, minutes=1.0))
    alone = await answer(runtime, question, who=OPERATOR_2)
    assert (alone["status"], [one["by"] for one in alone["approvals"]]) == ("pending", [OPERATOR_2.name])
    assert not cell.all("launch")
    house.withdrawn.clear()
    assert (await answer(runtime, question))["status"] == "approved"
    await cell.expect("launch")


async def test_an_approval_of_who_may_approve_no_more_is_taken_off_what_waits_and_recorded(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    made, question = await asked(runtime, press())
    await answer(runtime, question)
    house.withdrawn.add(OPERATOR.name)

    await until(lambda: [one.approvals for one in runtime.desk.pending()] == [()])
    events = await runtime.register.store.events(invocation=made["id"], kind=EventKind.APPROVAL)
    said = events[-1].payload()
    assert (events[-1].actor, said["decision"], said["givers"]) == ("server", "void", [OPERATOR.name])
    assert said["escalation"]["status"] == "pending"
    house.withdrawn.clear()  # a token anew is no word anew
    alone = await answer(runtime, question, who=OPERATOR_2)
    assert (alone["status"], len(alone["approvals"])) == ("pending", 1)
    assert (await answer(runtime, question))["status"] == "approved"
    await cell.expect("launch")


async def test_the_log_says_what_policy_made_of_an_edit_whose_approval_counts_no_more(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    made, question = await asked(runtime, press())
    await answer(runtime, question, params={"force_n": 30})
    house.withdrawn.add(OPERATOR.name)
    await until(lambda: [one.approvals for one in runtime.desk.pending()] == [()])
    known = rebuild(await runtime.register.store.events(invocation=made["id"]))
    assert known["policy"] == (await runtime.governor.invocation(made["id"], AGENT))["policy"]


async def test_who_may_approve_no_more_once_their_turn_comes_launches_nothing(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    made, question = await asked(runtime)
    entry = runtime.register.entry(made["id"])
    assert entry is not None
    async with entry.lock:  # something of it is being recorded
        word = asyncio.ensure_future(runtime.desk.resolve(question["id"], OPERATOR, "approve", question["digest"]))
        await asyncio.sleep(0.05)
        house.withdrawn.add(OPERATOR.name)
    with pytest.raises(Forbidden) as refused:
        await word
    assert (refused.value.code, cell.all("launch")) == ("role_forbidden", [])
    assert runtime.desk.pending_for(made["id"]) is not None


@pytest.mark.parametrize("withdrawn", [False, True])
async def test_what_lapses_with_too_few_approvals_says_so_and_keeps_none_that_counts_no_more(
    house: House, runtime: Runtime, cell: HandCell, withdrawn: bool
) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    made, question = await asked(runtime, press())
    await answer(runtime, question)
    if withdrawn:
        house.withdrawn.add(OPERATOR.name)
    house.wall_s.offset_s = 121.0  # nobody has looked at the question in between
    await until(lambda: not runtime.desk.pending())
    over = await runtime.desk.get(question["id"])
    assert (over["status"], len(over["approvals"])) == ("expired", 0 if withdrawn else 1)
    ended = await runtime.governor.invocation(made["id"], AGENT)
    (why,) = [reason for reason in ended["policy"]["reasons"] if reason["code"] == "approval_expired"]
    assert why["message"] == "too few people approved this in time"
    approvals = await runtime.register.store.events(invocation=made["id"], kind=EventKind.APPROVAL)
    assert [event.payload()["decision"] for event in approvals] == ["approve", "void"][: 1 + withdrawn]


async def test_an_edit_voids_earlier_approvals_and_gets_a_new_digest(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    document, question = await asked(runtime, press())
    await answer(runtime, question)
    edited = await answer(runtime, question, who=OPERATOR_2, params={"force_n": 30})
    assert edited["status"] == "pending"
    assert edited["digest"] != question["digest"]
    assert [approval["by"] for approval in edited["approvals"]] == ["oskar"]
    assert edited["effective"]["force_n"] == 30
    assert await refusal(runtime, question) == "digest_mismatch"
    assert (await answer(runtime, edited))["status"] == "approved"
    assert (await runtime.governor.invocation(document["id"], AGENT))["effective"]["force_n"] == 30


async def test_an_edit_that_policy_cuts_to_what_is_asked_voids_no_approval(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    hard = ProposalRequest(capability="operate_tool", params={"tool": "press", "action": "press", "force_n": 250})
    _, question = await asked(runtime, hard)
    await answer(runtime, question)
    edited = await answer(runtime, question, who=OPERATOR_2, params={"force_n": 300})
    assert (edited["status"], edited["digest"]) == ("pending", question["digest"])
    assert [approval["by"] for approval in edited["approvals"]] == ["olivia"], "what was approved is what is asked"
    assert (await answer(runtime, edited, who=OPERATOR_2))["status"] == "approved"


# -- edits -----------------------------------------------------------------------------------------------------------


async def test_an_edit_within_policy_launches_as_edited(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    closed = await answer(runtime, question, params={"speed_mps": 0.1})
    assert closed["status"] == "approved"
    assert closed["requested"] == question["requested"]
    assert closed["effective"]["speed_mps"] == 0.1
    await cell.expect("launch")
    assert (await runtime.governor.invocation(document["id"], AGENT))["effective"]["speed_mps"] == 0.1


async def test_the_verdict_tells_what_policy_changed_from_what_the_approver_did(
    runtime: Runtime, cell: HandCell
) -> None:
    request = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5})
    document, question = await asked(runtime, request)
    rules = {change["param"]: change["rule"] for change in document["policy"]["changes"]}
    await answer(runtime, question, params={"speed_mps": 0.1})
    verdict = (await runtime.governor.invocation(document["id"], AGENT))["policy"]
    assert verdict["outcome"] == "modify"
    assert {
        change["param"]: (change["requested"], change["effective"], change["rule"]) for change in verdict["changes"]
    } == {
        "force_n": (80, 60, rules["force_n"]),
        "speed_mps": (0.5, 0.1, "authority/edit"),
    }
    assert verdict["reasons"][-1]["code"] == "edited_by_human"
    assert verdict["reasons"][:-1] == document["policy"]["reasons"]


async def test_an_edit_that_policy_cuts_to_what_was_asked_before_is_none(runtime: Runtime, cell: HandCell) -> None:
    request = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5})
    document, question = await asked(runtime, request)
    again = await answer(runtime, question, params={"force_n": 120, "speed_mps": 1.0})
    assert (again["digest"], again["status"]) == (question["digest"], "pending")
    verdict = (await runtime.governor.invocation(document["id"], AGENT))["policy"]
    assert "edited_by_human" not in {reason["code"] for reason in verdict["reasons"]}


async def test_an_edit_of_what_policy_allowed_makes_it_a_modify(runtime: Runtime, cell: HandCell) -> None:
    params = {"object_id": "mug_1", "force_n": 40, "speed_mps": 0.2}
    document, question = await asked(runtime, ProposalRequest(capability="grasp_object", params=params))
    assert document["policy"]["outcome"] == "allow"
    await answer(runtime, question, params={"force_n": 30})
    verdict = (await runtime.governor.invocation(document["id"], AGENT))["policy"]
    assert verdict["outcome"] == "modify"
    assert verdict["changes"] == [{"param": "force_n", "requested": 40, "effective": 30, "rule": "authority/edit"}]


async def test_an_edit_beyond_policy_is_constrained_and_asked_again(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    edited = await answer(runtime, question, params={"force_n": 139.0})
    assert edited["status"] == "pending"
    assert edited["approvals"] == []
    assert edited["effective"]["force_n"] == 60
    assert not cell.all("launch")
    assert (await answer(runtime, edited))["status"] == "approved"
    changes = (await runtime.governor.invocation(document["id"], AGENT))["policy"]["changes"]
    (change,) = [change for change in changes if change["param"] == "force_n"]
    assert (change["requested"], change["effective"]) == (40, 60)
    assert change["rule"] == "human-shared/grip_force_n"


async def test_an_edit_that_policy_denies_is_refused_with_its_reasons(runtime: Runtime, cell: HandCell) -> None:
    seen = {"visible": True, "reachable": True, "x_m": 1.5, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
    cell.facts = {**AT_BENCH, "objects": {"mug_1": seen, "solvent_1": seen}}
    await cell.state()
    _, question = await asked(runtime)
    with pytest.raises(Conflict) as found:
        await answer(runtime, question, params={"object_id": "solvent_1"})
    assert found.value.code == "edit_refused"
    assert found.value.reasons
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"


async def test_a_denial_takes_no_edit(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    with pytest.raises(InvalidParams, match="valid: none with a denial"):
        await answer(runtime, question, decision="deny", params={"speed_mps": 0.1})
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"


async def test_an_edit_that_finds_the_cell_busy_is_no_matter_of_policys(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    await runtime.governor.propose(AGENT, navigate())
    await answer(runtime, question, params={"speed_mps": 0.1})
    late = await runtime.governor.invocation(document["id"], AGENT)
    assert (late["status"], late["outcome"]) == ("deferred", "deferred")
    assert [reason["code"] for reason in late["admission"]["reasons"]] == ["cell_busy"]
    assert {reason["code"] for reason in late["policy"]["reasons"]} <= {"limit", "edited_by_human"}
    assert {change["param"]: change["effective"] for change in late["policy"]["changes"]} == {"speed_mps": 0.1}


async def test_an_edit_that_policy_denies_is_not_said_to_wait_for_the_cell(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    await runtime.governor.propose(AGENT, navigate())
    with pytest.raises(Conflict, match="policy denies") as found:
        await answer(runtime, question, params={"object_id": "solvent_1"})
    assert "cell_busy" not in [reason["code"] for reason in found.value.reasons]
    assert "hazardous" in [reason["code"] for reason in found.value.reasons]


async def test_an_edit_that_is_not_admitted_is_no_denial_of_policys(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    with pytest.raises(Conflict, match="not be admitted") as found:
        await answer(runtime, question, params={"object_id": "unicorn"})
    assert [reason["code"] for reason in found.value.reasons] == ["unknown_object"]


async def test_an_edit_that_does_not_fit_the_schema_is_refused(runtime: Runtime, cell: HandCell) -> None:
    _, question = await asked(runtime)
    with pytest.raises(InvalidParams):
        await answer(runtime, question, params={"force_n": "much"})


async def test_an_edit_that_takes_more_people_says_why(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    lever = ProposalRequest(capability="operate_tool", params={"tool": "lever", "action": "pull_down"})
    _, question = await asked(runtime, lever)
    assert question["needed"] == 1
    edited = await answer(runtime, question, params={"tool": "press", "action": "press"})
    assert (edited["status"], edited["needed"], edited["approvals"]) == ("pending", 2, [])
    assert "organization/press-two-approvers" in [reason["rule"] for reason in edited["reasons"]]
    assert (await answer(runtime, edited))["status"] == "pending"  # nor has the one who edited it been shown that
    assert (await answer(runtime, edited, who=OPERATOR_2))["status"] == "approved"


LEVER = {"tool": "lever", "action": "pull_down"}
PRESS = {"tool": "press", "action": "press"}


@pytest.mark.parametrize("restarted", [False, True])
async def test_an_edit_that_takes_fewer_people_again_waits_for_no_more_than_were_asked_first(
    house: House, restarted: bool
) -> None:
    async with house.open() as runtime:
        cell = await at_tools(runtime)
        _, question = await asked(runtime, ProposalRequest(capability="operate_tool", params=LEVER))
        edited = await answer(runtime, question, params=PRESS)
        assert (question["needed"], edited["needed"]) == (1, 2)
        if not restarted:
            await goes_by_one(runtime, cell, edited)
    if restarted:
        async with house.open() as runtime:
            await goes_by_one(runtime, await at_tools(runtime), edited)


async def at_tools(runtime: Runtime) -> HandCell:
    cell = await HandCell(runtime, facts=dict(AT_TOOLS)).dial()
    await cell.state()
    return cell


async def goes_by_one(runtime: Runtime, cell: HandCell, edited: dict[str, Any]) -> None:
    once = await answer(runtime, edited)
    assert (once["status"], len(once["approvals"])) == ("pending", 1)
    back = await answer(runtime, once, who=OPERATOR_2, params=LEVER)
    assert (back["status"], back["needed"]) == ("approved", 1)
    assert [said["by"] for said in back["approvals"]] == [OPERATOR_2.name], "the other approved something else"
    await cell.expect("launch")


async def test_an_edit_that_takes_fewer_people_waits_for_as_many_as_were_asked_first(
    runtime: Runtime, cell: HandCell
) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    _, question = await asked(runtime, press())
    edited = await answer(runtime, question, params=LEVER)
    assert (edited["status"], edited["needed"]) == ("pending", 2)
    again = await answer(runtime, edited, params=LEVER | {"force_n": 5}, who=OPERATOR_2)
    assert (again["status"], again["needed"], len(again["approvals"])) == ("pending", 2, 1)
    assert not cell.all("launch")


async def test_what_another_profile_has_asked_anew_is_asked_first_by_that(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    slow = {**PRESS, "force_n": 20, "speed_mps": 0.1}
    request = ProposalRequest(capability="operate_tool", params=slow, metadata={"confidence": 0.2})
    _, question = await asked(runtime, request)
    await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
    now = await runtime.desk.get(question["id"])
    edited = await answer(runtime, now, params=LEVER)
    assert (question["needed"], now["needed"], edited["status"], edited["needed"]) == (1, 2, "pending", 2)


async def test_a_world_that_takes_more_people_says_why(runtime: Runtime, cell: HandCell) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    request = ProposalRequest(
        capability="operate_tool",
        params={"tool": "press", "action": "press", "force_n": 20, "speed_mps": 0.1},
        metadata={"confidence": 0.2},
    )
    _, question = await asked(runtime, request)
    assert question["needed"] == 1
    await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
    now = await runtime.desk.get(question["id"])
    assert (now["status"], now["needed"]) == ("pending", 2)
    assert "organization/press-two-approvers" in [reason["rule"] for reason in now["reasons"]]


@pytest.mark.parametrize("latched", [False, True])
async def test_a_proposal_approved_too_late_still_says_what_policy_changed(
    runtime: Runtime, cell: HandCell, latched: bool
) -> None:
    request = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1", "force_n": 80, "speed_mps": 0.5})
    document, question = await asked(runtime, request)
    said = (await runtime.governor.invocation(document["id"], AGENT))["policy"]
    assert said["outcome"] == "modify"
    if latched:
        await runtime.governor.estop(CELL, OPERATOR)
    else:
        await runtime.governor.propose(AGENT, navigate())
    await answer(runtime, question)
    late = await runtime.governor.invocation(document["id"], AGENT)
    assert late["status"] in {"deferred", "rejected"}
    assert late["policy"]["outcome"] == "modify"
    assert late["policy"]["changes"] == said["changes"]
    trace = await runtime.governor.trace(document["id"], AUDITOR)
    (told,) = [event for event in trace if event["kind"] == "policy" and event["body"].get("recheck")]
    assert told["body"]["changes"] == said["changes"]


# -- the world went on -----------------------------------------------------------------------------------------------


async def test_an_approval_that_finds_the_cell_busy_defers(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    await runtime.governor.propose(AGENT, navigate())
    closed = await answer(runtime, question)
    assert closed["status"] == "approved"
    late = await runtime.governor.invocation(document["id"], AGENT)
    assert (late["status"], late["outcome"]) == ("deferred", "deferred")
    assert late["admission"]["reasons"][0]["code"] == "cell_busy"
    assert late["admission"]["retry_after_s"] > 0
    assert len(cell.all("launch")) == 1


async def holding(cell: HandCell, thing: str) -> None:
    cell.facts = {**AT_BENCH, "gripper_empty": False, "holding": thing}
    await cell.state()


@pytest.mark.parametrize("params", [None, {"speed_mps": 0.1}])
async def test_an_approval_is_no_answer_to_what_policy_asks_about_since(
    runtime: Runtime, cell: HandCell, params: dict[str, Any] | None
) -> None:
    """Whoever approved a carry of the mug was never shown that a box near the payload limit wants a human's look."""
    await holding(cell, "mug_1")
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"}, metadata={"confidence": 0.2})
    document, question = await asked(runtime, carry)
    assert "payload_margin" not in {reason["code"] for reason in question["reasons"]}
    await holding(cell, "box_1")

    with pytest.raises(Conflict) as found:
        await answer(runtime, question, params=params)
    assert found.value.code == "digest_mismatch"
    assert "payload_margin" in {reason["code"] for reason in found.value.reasons}
    assert not cell.all("launch")
    anew = await runtime.desk.get(question["id"])
    assert (anew["status"], anew["approvals"], anew["effective"]) == ("pending", [], question["effective"])
    assert {"low_confidence", "payload_margin"} <= {reason["code"] for reason in anew["reasons"]}
    assert anew["expires_at"] > question["expires_at"]
    assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "awaiting_approval"

    assert await refusal(runtime, question, who=OPERATOR_2) == "digest_mismatch"  # nor is anybody else's of before
    assert (await answer(runtime, anew))["status"] == "approved"
    assert len(cell.all("launch")) == 1


@pytest.mark.parametrize("params", [None, {"speed_mps": 0.1}])
async def test_an_approval_of_one_load_is_none_of_another(
    runtime: Runtime, cell: HandCell, params: dict[str, Any] | None
) -> None:
    """No parameter of a carry names what is carried: it is what the gripper holds."""
    await holding(cell, "mug_1")
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"})
    _, question = await asked(runtime, carry)
    await holding(cell, "driver_1")
    assert await refusal(runtime, question, params=params) == "digest_mismatch"
    assert not cell.all("launch")
    anew = await runtime.desk.get(question["id"])
    assert (anew["status"], anew["approvals"], anew["reasons"]) == ("pending", [], question["reasons"])
    assert (question["carried"], anew["carried"]) == ("mug_1", "driver_1")
    assert await refusal(runtime, question, who=OPERATOR_2) == "digest_mismatch"
    await holding(cell, "mug_1")
    assert await refusal(runtime, anew) == "digest_mismatch"  # nor is that one's of what is held by now
    last = await answer(runtime, await runtime.desk.get(question["id"]), params=params)
    assert (last["status"], last["effective"]) == ("approved", {**question["effective"], **(params or {})})
    assert len(cell.all("launch")) == 1


async def test_an_edit_of_what_policy_would_cut_by_now_approves_no_other_load(runtime: Runtime, cell: HandCell) -> None:
    await holding(cell, "mug_1")
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"})
    _, question = await asked(runtime, carry)
    await holding(cell, "glass_1")  # fragile: what was asked about is faster than policy lets it be carried
    edited = await answer(runtime, question, params={"speed_mps": 0.1})
    assert (edited["status"], edited["approvals"], cell.all("launch")) == ("pending", [], [])
    assert (question["carried"], edited["carried"]) == ("mug_1", "glass_1")
    assert await refusal(runtime, question, who=OPERATOR_2) == "digest_mismatch"
    assert (await answer(runtime, edited))["status"] == "approved"
    assert len(cell.all("launch")) == 1


async def test_an_edit_that_policy_asks_more_about_is_asked_about_before_it_counts(
    runtime: Runtime, cell: HandCell
) -> None:
    box = {"visible": True, "reachable": True, "x_m": 1.6, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
    cell.facts = {**AT_BENCH, "objects": {**AT_BENCH["objects"], "box_1": box}}
    await cell.state()
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    grasping = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1"}, metadata={"confidence": 0.2})
    _, question = await asked(runtime, grasping)
    assert [reason["code"] for reason in question["reasons"]] == ["low_confidence"]
    edited = await answer(runtime, question, params={"object_id": "box_1"})
    assert (edited["status"], edited["approvals"], edited["effective"]["object_id"]) == ("pending", [], "box_1")
    assert {"low_confidence", "payload_margin"} == {reason["code"] for reason in edited["reasons"]}
    assert not cell.all("launch")
    assert (await answer(runtime, edited))["status"] == "approved"
    assert len(cell.all("launch")) == 1


async def test_an_edit_leads_no_old_answer_back_to_what_is_asked_anew(runtime: Runtime, cell: HandCell) -> None:
    await holding(cell, "mug_1")
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"}, metadata={"confidence": 0.2})
    _, question = await asked(runtime, carry)
    await holding(cell, "box_1")
    assert await refusal(runtime, question) == "digest_mismatch"
    anew = await runtime.desk.get(question["id"])
    back = await answer(runtime, anew, params={"clearance_m": 0.1})  # which policy raises to what was asked
    assert (back["status"], back["effective"]) == ("pending", question["effective"])
    assert await refusal(runtime, question, who=OPERATOR_2) == "digest_mismatch"
    assert not cell.all("launch")


async def test_a_question_is_put_anew_when_its_cell_comes_under_a_stricter_profile(
    runtime: Runtime, cell: HandCell
) -> None:
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    request = ProposalRequest(
        capability="grasp_object", params={"object_id": "mug_1", "force_n": 75}, metadata={"confidence": 0.2}
    )
    _, question = await asked(runtime, request)
    assert question["effective"]["force_n"] == 75
    await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
    assert await refusal(runtime, question) == "profile_changed"
    assert (await runtime.desk.get(question["id"]))["effective"]["force_n"] == 60
    assert not cell.all("launch")


async def test_a_question_shown_under_one_profile_is_not_approved_under_another(
    runtime: Runtime, cell: HandCell
) -> None:
    """The same parameters under another profile would be watched by other rules, and that is not what was shown."""
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    params = {"object_id": "mug_1", "force_n": 30, "speed_mps": 0.1}
    request = ProposalRequest(capability="grasp_object", params=params, metadata={"confidence": 0.2})
    document, question = await asked(runtime, request)
    await runtime.governor.set_profile(CELL, "human-shared", OPERATOR)
    assert await refusal(runtime, question) == "profile_changed"
    assert await refusal(runtime, question, decision="deny") == "profile_changed"
    anew = await runtime.desk.get(question["id"])
    assert (anew["status"], anew["profile"], anew["renewed"]) == ("pending", "human-shared", "profile_changed")
    assert anew["effective"] == question["effective"]
    assert anew["former_digests"] == [question["digest"]]
    assert (await runtime.governor.invocation(document["id"], AGENT))["profile"] == "human-shared"
    assert not cell.all("launch")
    assert (await answer(runtime, anew))["status"] == "approved"
    (launch,) = cell.all("launch")
    assert orjson.loads(b64decode(launch.body))["profile"] == "human-shared"


async def test_a_question_is_answered_where_its_cell_is_under_the_former_profile_again(
    runtime: Runtime, cell: HandCell
) -> None:
    await runtime.governor.set_profile(CELL, "real-restricted", OPERATOR)
    params = {"object_id": "mug_1", "force_n": 30, "speed_mps": 0.1}
    request = ProposalRequest(capability="grasp_object", params=params, metadata={"confidence": 0.2})
    _, question = await asked(runtime, request)
    for profile in ("human-shared", "real-restricted"):
        await runtime.governor.set_profile(CELL, profile, OPERATOR)
    again = await runtime.desk.get(question["id"])
    assert (again["profile"], again["digest"] in again["former_digests"]) == ("real-restricted", False)
    assert (await answer(runtime, again))["status"] == "approved"
    (launch,) = cell.all("launch")
    assert orjson.loads(b64decode(launch.body))["profile"] == "real-restricted"


async def test_nothing_launches_by_a_cell_s_coming_under_a_profile_that_asks_nobody(
    runtime: Runtime, cell: HandCell
) -> None:
    document, question = await asked(runtime)
    await runtime.governor.set_profile(CELL, "sim-relaxed", ENGINEER)
    late = await runtime.governor.invocation(document["id"], AGENT)
    assert (late["status"], late["outcome"]) == ("deferred", "deferred")
    assert late["admission"]["reasons"][-1]["code"] == "profile_changed"
    assert late["admission"]["retry_after_s"] > 0
    assert late["escalation"]["status"] == "withdrawn"
    assert await refusal(runtime, question) == "profile_changed"
    assert not cell.all("launch")
    again, _ = await runtime.governor.propose(AGENT, grasp())
    assert again["status"] == "running"


async def test_an_answer_that_comes_before_the_question_is_put_anew_is_refused(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, question = await asked(runtime)
    append = runtime.store.append

    async def broken(*_: Any) -> list[int]:
        monkeypatch.setattr(runtime.store, "append", append)
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.fleet.cell(CELL), "profile", "real-restricted")
    assert await refusal(runtime, question) == "profile_changed"
    monkeypatch.setattr(runtime.store, "append", broken)
    await runtime.desk.decide_again()
    assert (await runtime.desk.get(question["id"]))["profile"] == "human-shared"
    assert await refusal(runtime, question) == "profile_changed"
    await runtime.desk.decide_again()
    assert (await runtime.governor.invocation(document["id"], AGENT))["status"] != "awaiting_approval"


async def test_nothing_launches_when_the_approval_cannot_be_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, question = await asked(runtime)

    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    with pytest.raises(RecordUnavailable):
        await answer(runtime, question)
    monkeypatch.undo()
    assert not cell.all("launch")
    assert (await answer(runtime, question))["status"] == "approved"
    await cell.expect("launch")


async def test_a_denial_that_cannot_be_recorded_holds_until_it_can(
    house: House, runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, question = await asked(runtime)

    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    asked_at = runtime.register.now()
    with pytest.raises(RecordUnavailable):
        await answer(runtime, question, decision="deny")
    said_at = runtime.register.now()
    house.wall_s.offset_s = 130.0  # its time is over meanwhile, and it was answered
    with pytest.raises(RecordUnavailable):
        await runtime.desk.expire_due()
    monkeypatch.undo()
    assert await refusal(runtime, question, who=OPERATOR_2) == "already_resolved"
    monkeypatch.setattr(runtime.fleet.cell(CELL), "profile", "sim-relaxed")
    await runtime.desk.decide_again()  # nobody would be asked there
    assert not cell.all("launch")
    await runtime.desk.expire_due()
    ended = await runtime.governor.invocation(document["id"], AGENT)
    assert (ended["status"], ended["outcome"]) == ("denied", "denied")
    (said,) = [event for event in await runtime.governor.trace(document["id"], AUDITOR) if event["kind"] == "approval"]
    denial = said["body"]["escalation"]["denial"]
    assert (said["actor"], said["body"]["decision"]) == (OPERATOR.name, "deny")
    assert asked_at <= denial["at"] <= said_at  # when it was said, not when there was room
    assert await refusal(runtime, question) == "already_resolved"


# -- silence and withdrawal ------------------------------------------------------------------------------------------


async def test_silence_expires_and_is_nobodys_answer(house: House, runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    house.wall_s.offset_s = 119.0
    await runtime.desk.expire_due()
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"
    house.wall_s.offset_s = 120.5
    assert await refusal(runtime, question) == "escalation_expired"
    ended = await runtime.governor.invocation(document["id"], AGENT)
    assert (ended["status"], ended["outcome"]) == ("denied", "expired")
    assert ended["escalation"]["status"] == "expired"
    assert await refusal(runtime, question) == "escalation_expired"
    trace = await runtime.governor.trace(document["id"], AUDITOR)
    assert "approval" not in [event["kind"] for event in trace]
    assert {event["actor"] for event in trace[3:]} == {"server"}


async def test_silence_lasts_no_longer_because_the_clock_is_put_back(
    house: House, runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, question = await asked(runtime)
    house.wall_s.offset_s = -3600.0
    await runtime.desk.expire_due()
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"
    monkeypatch.setattr(questions, "monotonic_s", lambda: monotonic_s() + 120.5)
    assert await refusal(runtime, question) == "escalation_expired"
    assert (await runtime.governor.invocation(document["id"], AGENT))["outcome"] == "expired"


async def test_the_deadline_is_kept_without_anybody_asking(house: House, runtime: Runtime, cell: HandCell) -> None:
    document, _ = await asked(runtime)
    waiting = asyncio.create_task(runtime.governor.wait(document["id"], AGENT, 5.0))
    await asyncio.sleep(0)
    house.wall_s.offset_s = 120.5
    assert (await waiting)["outcome"] == "expired"


async def test_cancelling_withdraws_the_question(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    ended = await runtime.governor.cancel(document["id"], AGENT)
    assert (ended["status"], ended["outcome"]) == ("denied", "cancelled")
    assert ended["escalation"]["status"] == "withdrawn"
    assert await refusal(runtime, question) == "already_resolved"
    assert (await runtime.desk.list(status="pending"))[0] == []


# -- in mid-execution ------------------------------------------------------------------------------------------------


async def held(
    runtime: Runtime, cell: HandCell, why: str = "separation", failed: str = "zone"
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Bring a session to where it waits for a human."""
    document, _ = await runtime.governor.propose(AGENT, navigate())
    await cell.launched(document["id"])
    cell.status = "escalated"
    await cell.report("status", document["id"], status="escalated", reason=why)
    await cell.report("escalation", document["id"], reason=why, failure=failed or None)
    document = await runtime.governor.invocation(document["id"], AGENT)
    assert document["status"] == "escalated"
    return document, await runtime.desk.get(document["escalation"]["id"])


async def test_a_held_session_asks_once_and_says_why(runtime: Runtime, cell: HandCell) -> None:
    document, question = await held(runtime, cell)
    assert question["kind"] == "session"
    assert question["reasons"][0]["code"] == "separation"
    assert "zone" in question["reasons"][0]["message"]
    assert len((await runtime.desk.list())[0]) == 1
    trace = await runtime.governor.trace(document["id"], AUDITOR)
    recorded = next(event for event in trace if event["kind"] == "escalation")
    assert recorded["body"]["escalation"]["id"] == question["id"]
    assert recorded["actor"] == CELL


@pytest.mark.parametrize(
    ("why", "failed", "message", "remedy"),
    [
        ("separation", "", "the session is held (`separation`)", "from where it is held"),
        ("separation", "zone", "a forbidden zone (`zone`); the session is held (`separation`)", "with a new attempt"),
        ("rollback_failed", "rollback_failed", "verified (`rollback_failed`); the session is held", "a new attempt"),
        ("separation", "unheard_of", "`unheard_of`; the session is held (`separation`)", "with a new attempt"),
    ],
)
async def test_a_held_session_says_what_went_wrong_and_what_going_on_means(
    runtime: Runtime, cell: HandCell, why: str, failed: str, message: str, remedy: str
) -> None:
    _, question = await held(runtime, cell, why, failed)
    (reason,) = question["reasons"]
    assert message in reason["message"]
    assert remedy in reason["remedy"]


async def test_approving_lets_a_held_session_go_on(runtime: Runtime, cell: HandCell) -> None:
    document, question = await held(runtime, cell)
    assert (await answer(runtime, question))["status"] == "approved"
    await until(lambda: cell.ops() == ["resolve_continue"])
    await cell.report("status", document["id"], status="running")
    assert (await runtime.governor.invocation(document["id"], AGENT))["status"] == "running"


async def test_a_session_that_has_its_answer_is_paused_before_its_cell_has_said_that_it_moves(
    runtime: Runtime, cell: HandCell
) -> None:
    document, question = await held(runtime, cell)
    await cell.state()
    with pytest.raises(Conflict, match="`pause` is not possible while the invocation is `escalated`"):
        await runtime.governor.pause(document["id"], OPERATOR)
    await answer(runtime, question)
    assert (await runtime.governor.pause(document["id"], OPERATOR))["recorded"]
    await until(lambda: cell.ops() == ["resolve_continue", "pause"])


async def test_people_are_asked_only_so_much_at_once(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "MOST_OF_AGENT", 2)
    made = [(await runtime.governor.propose(AGENT, grasp()))[0] for _ in range(3)]
    assert [document["status"] for document in made] == ["awaiting_approval", "awaiting_approval", "deferred"]
    (reason,) = (one for one in made[2]["admission"]["reasons"] if one["code"] == "too_many_waiting")
    assert "`2` proposals of `planner`" in reason["message"]
    assert made[2]["admission"]["retry_after_s"] > 0
    await runtime.governor.cancel(made[0]["id"], AGENT)
    assert (await runtime.governor.propose(AGENT, grasp()))[0]["status"] == "awaiting_approval"
    monkeypatch.setattr(questions, "MOST_ASKED", 2)
    monkeypatch.setattr(questions, "MOST_OF_AGENT", 9)
    assert (await runtime.governor.propose(AGENT, grasp()))[0]["status"] == "deferred"


async def test_a_held_session_cannot_be_edited(runtime: Runtime, cell: HandCell) -> None:
    _, question = await held(runtime, cell)
    with pytest.raises(InvalidParams, match="cannot be edited"):
        await answer(runtime, question, params={"speed_mps": 0.1})
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"
    assert cell.ops() == []


async def test_denying_terminates_a_held_session(runtime: Runtime, cell: HandCell) -> None:
    document, question = await held(runtime, cell)
    assert (await answer(runtime, question, decision="deny", code="person_in_the_way"))["status"] == "denied"
    await until(lambda: cell.ops() == ["resolve_terminate"])
    await cell.ended(document["id"], "terminated")
    over = await runtime.governor.invocation(document["id"], AGENT)
    assert over["outcome"] == "terminated"
    assert over["failure"]["reasons"][0]["message"] == "a person is in the way"


async def test_a_held_session_is_not_let_go_while_its_cell_is_away(runtime: Runtime, cell: HandCell) -> None:
    _, question = await held(runtime, cell)
    await cell.hang_up()
    assert await refusal(runtime, question) == "cell_offline"
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"


async def test_a_denial_reaches_a_cell_that_was_away(runtime: Runtime, cell: HandCell) -> None:
    document, question = await held(runtime, cell)
    await cell.hang_up()
    await answer(runtime, question, decision="deny")
    back = await HandCell(runtime, seq=cell.seq, invocation=document["id"], status="escalated").dial()
    await until(lambda: "resolve_terminate" in back.ops())
    assert "resolve_continue" not in back.ops()


async def test_a_question_is_withdrawn_when_its_session_ends(runtime: Runtime, cell: HandCell) -> None:
    document, question = await held(runtime, cell)
    await cell.ended(document["id"], "stopped")
    assert (await runtime.desk.get(question["id"]))["status"] == "withdrawn"
    assert await refusal(runtime, question) == "already_resolved"


async def test_silence_about_a_held_session_terminates_it(house: House, runtime: Runtime, cell: HandCell) -> None:
    document, question = await held(runtime, cell)
    house.wall_s.offset_s = runtime.kernel.policy.authority.within_s + 1.0
    await until(lambda: cell.ops() == ["resolve_terminate"])
    await until(lambda: runtime.desk.pending_for(document["id"]) is None)
    assert (await runtime.desk.get(question["id"]))["status"] == "expired"
    assert [word.expired for word in cell.all("human")] == [True]
    await cell.report("outcome", document["id"], outcome="terminated", code="expired")
    over = await runtime.governor.invocation(document["id"], AGENT)
    assert over["outcome"] == "terminated"
    assert [(reason["code"], reason["message"]) for reason in over["failure"]["reasons"]] == [
        ("expired", "nobody answered in time")
    ]
