"""What waits for approval is decided again: what launches then does so by somebody's word, and says by whose."""

from __future__ import annotations

import asyncio
import base64
import json
from dataclasses import replace
from typing import Any

import pytest

from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.clock import monotonic_s
from app.governance import control
from app.governance.model import EventKind, GrantScope
from app.protocol import Human
from app.runtime import succession
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, RuntimeRefusal
from app.runtime.escalation import Escalation
from app.runtime.grant import GrantRequest
from app.runtime.invocation import Principal, ProposalRequest
from app.runtime.register import Register
from app.runtime.succession import AGAIN_S

from .conftest import (
    AGENT,
    AT_BENCH,
    AT_TOOLS,
    CELL,
    ENGINEER,
    OPERATOR,
    OPERATOR_2,
    HandCell,
    House,
    grasp,
    press,
    stating,
    until,
)
from .test_desk import answer, asked, holding
from .test_races import Gate
from .test_versions import (
    ENGINEER_2,
    FASTER,
    FILES,
    NO_RETREAT,
    ORGANIZATION,
    SHARED,
    SLOWER,
    brought,
    edited,
    put_in_force,
)

pytestmark = pytest.mark.anyio

MUGS = GrantRequest(capability="grasp_object", agent=AGENT.name, cell=CELL, scope=GrantScope.TIME, minutes=10.0)
TWO = edited(SHARED, "approvers: {default: 1", "approvers: {default: 2")
LOOK = edited(
    ORGANIZATION,
    "rules:\n",
    "rules:\n  - {id: look, applies_to: [grasp_object, transport_object], then: escalate, because: Somebody looks.}\n",
)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have nobody lose the controls because the machine is busy: that is tested elsewhere."""
    monkeypatch.setattr(control, "LAPSE_S", 60.0)


async def test_a_profile_that_asks_nobody_launches_nothing_where_the_policy_changes_as_well(
    runtime: Runtime, cell: HandCell
) -> None:
    made, _ = await runtime.governor.propose(AGENT, grasp())
    entry = runtime.register.entry(made["id"])
    assert entry is not None
    async with entry.lock:  # something of it is being recorded, so that both changes wait
        profiling = asyncio.create_task(runtime.governor.set_profile(CELL, "sim-relaxed", ENGINEER))
        await until(lambda: runtime.fleet.cell(CELL).profile == "sim-relaxed")
        putting = asyncio.create_task(put_in_force(runtime, SLOWER))
        await until(lambda: runtime.kernel.policy.digest != made["policy_version"])
    await asyncio.gather(profiling, putting)
    document = await runtime.governor.invocation(made["id"], AGENT)
    assert (document["status"], cell.all("launch")) == ("deferred", [])
    assert document["admission"]["reasons"][-1]["code"] == "profile_changed"


async def test_an_edit_that_nobody_approved_is_not_launched_by_a_policy_that_asks_nobody(
    runtime: Runtime, cell: HandCell
) -> None:
    """It is neither what the agent proposed nor what a person approved."""
    seen = {"visible": True, "reachable": True, "x_m": 1.6, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
    cell.facts = {**AT_BENCH, "objects": {**AT_BENCH["objects"], "box_1": seen}}
    await cell.state()
    await runtime.governor.set_profile(CELL, "real-restricted", ENGINEER)
    unsure = ProposalRequest(capability="grasp_object", params={"object_id": "mug_1"}, metadata={"confidence": 0.2})
    made, question = await asked(runtime, unsure)
    assert (await answer(runtime, question, params={"object_id": "box_1"}))["status"] == "pending"
    files = edited(ORGANIZATION, "metadata.confidence < 0.5", "metadata.confidence < 0.1")
    files = edited(ORGANIZATION, "mass_kg > 0.8 * limits", "mass_kg > 0.99 * limits", files)
    await put_in_force(runtime, {name: text for name, text in files.items() if not name.startswith("tests/")})
    document = await runtime.governor.invocation(made["id"], AGENT)
    assert (document["status"], cell.all("launch")) == ("deferred", [])
    assert document["admission"]["reasons"][-1]["code"] == "edit_not_approved"


@pytest.mark.parametrize("revoked", [False, True])
async def test_what_a_grant_given_meanwhile_answers_for_is_counted_and_names_it(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, revoked: bool
) -> None:
    made = [(await runtime.governor.propose(AGENT, grasp()))[0] for _ in range(2)]
    commit, reached, go_on = runtime.desk.commit, asyncio.Event(), asyncio.Event()

    async def slow(*args: Any) -> None:
        if not reached.is_set():
            reached.set()
            await go_on.wait()
        await commit(*args)

    monkeypatch.setattr(runtime.desk, "commit", slow)
    putting = asyncio.create_task(put_in_force(runtime, SLOWER))
    await reached.wait()  # the first question is being asked anew, and the second waits for its turn
    given = await runtime.desk.grants.give(OPERATOR, MUGS)
    if revoked:
        await runtime.desk.grants.revoke(given["id"], OPERATOR)
    go_on.set()
    await putting
    await until(lambda: runtime.desk.pending_for(made[1]["id"]) is None or revoked)
    document = await runtime.governor.invocation(made[1]["id"], OPERATOR)
    (shown,), _ = await runtime.desk.grants.list()
    if revoked:
        assert (document["status"], shown["uses"]) == ("awaiting_approval", 0)
        return
    assert (document["status"], document["grant"], shown["uses"]) == ("running", given["id"], 1)
    assert permit(cell)["approvals"] == [f"grant:{given['id']}"]


@pytest.mark.parametrize("by", ["grant", "approval"])
async def test_a_grant_is_nobody_of_those_whom_a_hand_back_takes(runtime: Runtime, cell: HandCell, by: str) -> None:
    """Otherwise one person would be two: who gave the grant, and who hands back."""
    if by == "grant":
        await runtime.desk.grants.give(OPERATOR, MUGS)
    made, _ = await runtime.governor.propose(AGENT, grasp())
    if by == "approval":
        question = runtime.desk.pending_for(made["id"])
        assert question is not None
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.expect("launch")
    await cell.launched(made["id"])
    await put_in_force(runtime, TWO)
    await taken(runtime, cell, made["id"])
    async with stating(cell, status="running"):
        with pytest.raises(Conflict, match="more approvals") as refused:
            await runtime.governor.release(made["id"], OPERATOR, "resume")
    assert refused.value.code == "resume_refused"
    assert {why["remedy"] for why in refused.value.reasons} == {"roll it back, or end it"}
    assert permit(cell)["capability"] == "takeover"


async def test_who_may_approve_no_more_is_nobody_of_those_whom_a_hand_back_takes(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    session = await approved(runtime, cell, OPERATOR_2)
    await put_in_force(runtime, TWO)
    await taken(runtime, cell, session)
    house.withdrawn.add(OPERATOR_2.name)
    async with stating(cell, status="running"):
        with pytest.raises(Conflict, match="more approvals"):
            await runtime.governor.release(session, OPERATOR, "resume")
    assert permit(cell)["capability"] == "takeover"


@pytest.mark.parametrize("revoked", [False, True])
async def test_what_is_handed_back_names_the_grant_it_began_by_only_while_that_stands(
    runtime: Runtime, cell: HandCell, revoked: bool
) -> None:
    given = await runtime.desk.grants.give(OPERATOR_2, MUGS)
    made, _ = await runtime.governor.propose(AGENT, grasp())
    await cell.expect("launch")
    await cell.launched(made["id"])
    await runtime.governor.take_over(made["id"], OPERATOR)
    await cell.report("launch", made["id"], capability="takeover")
    if revoked:
        await runtime.desk.grants.revoke(given["id"], OPERATOR)
    told = await asked_first(runtime, cell, made["id"], "approval_required") if revoked else None
    await handed_back(runtime, cell, made["id"], told)
    assert permit(cell)["approvals"] == ([] if revoked else [f"grant:{given['id']}"]) + [OPERATOR.name]
    trace = await runtime.governor.trace(made["id"], ENGINEER)
    named = [event["body"].get("grant") for event in trace if event["kind"] == "authorization"]
    assert named == [given["id"], None, None if revoked else given["id"]]  # nobody's grant is what is driven by hand


async def granted(runtime: Runtime, cell: HandCell, approved_by: Principal | None = None) -> tuple[str, dict[str, Any]]:
    """Return a session that somebody has taken over, and a grant that answers for its going on."""
    session = None if approved_by is None else await approved(runtime, cell, approved_by)
    given = await runtime.desk.grants.give(OPERATOR_2, MUGS)
    if session is None:
        made, _ = await runtime.governor.propose(AGENT, grasp())
        session = made["id"]
        await cell.expect("launch")
        await cell.launched(session)
    await taken(runtime, cell, session)
    return session, given


async def test_what_is_handed_back_by_a_grant_given_since_names_it_and_counts_as_its_use(
    runtime: Runtime, cell: HandCell
) -> None:
    session, given = await granted(runtime, cell, OPERATOR)
    await handed_back(runtime, cell, session)
    assert permit(cell)["approvals"] == [OPERATOR.name, f"grant:{given['id']}"]
    (shown,), _ = await runtime.desk.grants.list()
    assert shown["uses"] == 1
    trace = await runtime.governor.trace(session, ENGINEER)
    named = [event["body"].get("grant") for event in trace if event["kind"] == "authorization"]
    assert named == [None, None, given["id"]]


async def test_a_hand_back_is_not_sent_when_its_grant_ends_while_it_is_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, given = await granted(runtime, cell)
    launched, before = len(cell.all("launch")), runtime.register.newest(session)
    gate = Gate(runtime, monkeypatch)
    back = asyncio.ensure_future(runtime.governor.release(session, OPERATOR, "resume"))
    async with stating(cell, status="running"):
        await gate.reached.wait()
    revoked = asyncio.create_task(runtime.desk.grants.revoke(given["id"], OPERATOR_2))
    await until(lambda: not runtime.desk.grants.stands(given["id"]))
    gate.open.set()
    with pytest.raises(Conflict, match="it was not sent") as refused:
        await back
    await revoked
    monkeypatch.undo()
    assert (refused.value.code, [why["code"] for why in refused.value.reasons]) == ("resume_refused", ["grant_ended"])
    assert len(cell.all("launch")) == launched
    control, newest = runtime.fleet.cell(CELL).control, runtime.register.newest(session)
    assert control is not None
    assert (control.holder, control.phase) == (OPERATOR.name, "held")
    assert before is not None
    assert newest is not None
    assert (newest.takeover, newest.terms) == (before.takeover, before.terms)
    told = [event["body"] for event in await runtime.governor.trace(session, ENGINEER) if event["kind"] == "cell"]
    unsent = permits(await runtime.governor.trace(session, ENGINEER))[-1]
    bound = {"authorization": unsent, "policy_version": before.policy_version}
    assert told == [{"what": "not_sent", "op": "resume", "code": "grant_ended", **bound}]
    again = await asked_first(runtime, cell, session, "approval_required")
    await handed_back(runtime, cell, session, again)
    assert permit(cell)["approvals"] == [OPERATOR.name]


async def test_a_hand_back_is_not_sent_when_its_cell_leaves_its_profile_while_it_is_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = await approved(runtime, cell, OPERATOR)
    await taken(runtime, cell, session)
    launched, gate = len(cell.all("launch")), Gate(runtime, monkeypatch)
    back = asyncio.ensure_future(runtime.governor.release(session, OPERATOR, "resume"))
    async with stating(cell, status="running"):
        await gate.reached.wait()
    monkeypatch.undo()  # the record takes what comes behind it first
    await runtime.governor.set_profile(CELL, "real-restricted", ENGINEER)
    gate.open.set()
    with pytest.raises(Conflict, match="it was not sent") as refused:
        await back
    assert [why["code"] for why in refused.value.reasons] == ["profile_changed"]
    assert len(cell.all("launch")) == launched


async def test_a_hand_back_is_not_sent_under_a_policy_that_gives_way_while_it_is_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it was bound to before it was taken over would go on under the new one; what it is being bound to not."""
    first = await put_in_force(runtime, NO_RETREAT)
    session = await approved(runtime, cell, OPERATOR)
    await runtime.versions.activate(await brought(runtime, FILES), ENGINEER, "it falls no more")
    await put_in_force(runtime, FILES)
    await taken(runtime, cell, session)
    launched, before = len(cell.all("launch")), runtime.register.newest(session)
    assert before is not None
    gate = Gate(runtime, monkeypatch)
    back = asyncio.ensure_future(runtime.governor.release(session, OPERATOR, "resume"))
    async with stating(cell, status="running"):
        await gate.reached.wait()
    monkeypatch.undo()  # the record takes what comes behind it first
    await put_in_force(runtime, NO_RETREAT)
    assert runtime.governor.loosen_hands() == [], "while a human drives nothing recovers by itself"
    gate.open.set()
    with pytest.raises(Conflict, match="it was not sent") as refused:
        await back
    assert refused.value.code == "resume_refused"
    assert [why["code"] for why in refused.value.reasons] == ["policy_changed", "no_retreat"]
    assert len(cell.all("launch")) == launched
    newest, control = runtime.register.newest(session), runtime.fleet.cell(CELL).control
    assert newest is not None
    assert control is not None
    assert (newest.terms, newest.takeover, newest.policy_version) == (before.terms, before.takeover, first)
    assert (control.holder, control.phase) == (OPERATOR.name, "held")
    after_a_start = Register(runtime.store, monotonic_s)
    await after_a_start.recall()
    assert after_a_start.unfounded == {}
    assert after_a_start.newest(session) == newest, "what the unsent authorization covered counts for nothing"
    await handed_back(runtime, cell, session)  # decided again under what is in force


@pytest.mark.parametrize("lapsed", [False, True])
async def test_what_was_let_go_on_while_its_cell_left_is_bound_by_what_it_was_bound_by(
    house: House, monkeypatch: pytest.MonkeyPatch, lapsed: bool
) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session = await approved(runtime, cell, OPERATOR)
        await put_in_force(runtime, FASTER)
        await taken(runtime, cell, session)
        if lapsed:
            await left(cell, session)
        question, before = runtime.desk.pending_for(session), runtime.register.newest(session)
        assert before is not None
        launched, gate = len(cell.all("launch")), Gate(runtime, monkeypatch)
        going = runtime.governor.release(session, OPERATOR, "resume")
        if question is not None:
            going.close()
            going = runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
        doing = asyncio.ensure_future(going)
        async with stating(cell, status="running"):
            await gate.reached.wait()
        monkeypatch.undo()
        await cell.hang_up()
        gate.open.set()
        if question is None:
            with pytest.raises(Conflict, match="it was not sent") as refused:
                await doing
            assert refused.value.code == "cell_offline"
        else:
            assert (await doing)["status"] == "approved"
        newest = runtime.register.newest(session)
        assert newest is not None
        assert (newest.policy_version, newest.terms) == (before.policy_version, before.terms)
        assert len(cell.all("launch")) == launched
        back = replace(cell, runtime=runtime, heard=[], closed=None, status="running")
        await (await back.dial()).state()
        if question is None:
            await until(lambda: set(back.ops()) == {"let_go"})  # by what it is owed, and by what it says to hold
            await left(back, session)
        async with stating(back, status="escalated"):
            await until(lambda: runtime.desk.pending_for(session) is not None)
        again = runtime.desk.pending_for(session)
        assert again is not None
        await runtime.desk.resolve(again.id, OPERATOR, "approve", again.digest)
        await back.expect("launch")


async def test_what_goes_on_under_a_policy_that_gave_way_is_not_asked_what_was_said_of_what_bound_it_before(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor told to hold again and again: both that it is bound by anew and what is in force let it go on."""
    await put_in_force(runtime, edited(SHARED, "sensitivity: 0.9", "sensitivity: 0.8"))
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, FILES)
    await taken(runtime, cell, session)
    gate = Gate(runtime, monkeypatch)
    launched = len(cell.all("launch"))
    back = asyncio.ensure_future(runtime.governor.release(session, OPERATOR, "resume"))
    async with stating(cell, status="running"):
        await gate.reached.wait()
    monkeypatch.undo()  # the record takes what comes behind it first
    await put_in_force(runtime, FASTER)
    assert {why["code"] for why in runtime.desk.departures.standing(session)} == {"watched_tighter"}
    gate.open.set()
    await cell.expect("launch", launched + 1)
    told = cell.ops().count("escalate")
    await cell.report("status", session, status="running", before="recovering", reason="handed_back")
    await back
    await asyncio.sleep(2 * AGAIN_S)
    assert cell.ops().count("escalate") == told
    await cell.report("status", session, status="escalated", reason="policy_changed")
    question = runtime.desk.pending_for(session)
    assert question is not None
    assert codes(question) == {"policy_changed"}
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await until(lambda: cell.ops()[-1] == "resolve_continue")


async def test_what_is_bound_anew_is_not_asked_what_was_said_of_what_bound_it_before_however_soon_it_asks(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime.succession, "hold_again", lambda: None)  # it looks every 0.2 s: not in between
    await put_in_force(runtime, edited(SHARED, "sensitivity: 0.9", "sensitivity: 0.8"))
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, FILES)
    await taken(runtime, cell, session)
    await handed_back(runtime, cell, session)
    await cell.report("status", session, status="escalated", reason="separation")
    question = runtime.desk.pending_for(session)
    assert question is not None
    assert (codes(question), runtime.desk.outdated(question)) == ({"separation"}, None)


async def test_a_session_that_said_that_it_holds_is_not_told_again_though_it_went_on_at_once(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever took it over at once lost the controls to that."""
    hold_again = runtime.succession.hold_again
    monkeypatch.setattr(runtime.succession, "hold_again", lambda: None)  # it looks every 0.2 s: not in between
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, LOOK)
    await taken(runtime, cell, session)
    await cell.report("status", session, status="running", reason="taken_over")
    monkeypatch.setattr(succession, "AGAIN_S", 0.0)
    hold_again()
    monkeypatch.undo()
    assert cell.ops().count("escalate") == 1
    control = runtime.fleet.cell(CELL).control
    assert control is not None
    assert (control.holder, control.phase) == (OPERATOR.name, "held")


async def test_whoever_drives_what_had_departed_drives_on_after_a_pause(runtime: Runtime, cell: HandCell) -> None:
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, NO_RETREAT)
    await taken(runtime, cell, session)
    await cell.report("status", session, status="running", reason="taken_over")
    await runtime.governor.pause(session, OPERATOR)
    await cell.report("human", session, op="pause")
    await cell.report("status", session, status="paused", reason="operator")
    await runtime.governor.resume(session, OPERATOR)
    await until(lambda: cell.told() == ["escalate", "pause", "resume"])


async def test_whoever_takes_over_what_departed_while_it_recovers_keeps_the_controls(
    runtime: Runtime, cell: HandCell
) -> None:
    await put_in_force(runtime, edited(SHARED, "sensitivity: 0.9", "sensitivity: 0.8"))
    session = await approved(runtime, cell, OPERATOR)
    await cell.report("status", session, status="recovering", reason="RETRY")
    await put_in_force(runtime, FILES)
    await until(lambda: cell.ops() == ["escalate"])
    await runtime.governor.take_over(session, OPERATOR)
    await cell.report("launch", session, capability="takeover")
    await cell.report("status", session, status="running", reason="taken_over")
    await asyncio.sleep(3 * AGAIN_S)
    control = runtime.fleet.cell(CELL).control
    assert control is not None
    assert (control.holder, control.phase) == (OPERATOR.name, "held")
    await handed_back(runtime, cell, session)
    await asyncio.sleep(3 * AGAIN_S)
    assert cell.ops() == ["escalate"], "nothing stands against what is bound anew"


@pytest.mark.parametrize("driven", [False, True])
async def test_what_a_hand_has_led_is_held_where_something_is_anywhere_in_its_way_back(
    runtime: Runtime, cell: HandCell, driven: bool
) -> None:
    session = await approved(runtime, cell, OPERATOR)
    if driven:
        await taken(runtime, cell, session)
        await handed_back(runtime, cell, session)
    wet = "  wet: {kind: restricted, polygon: [[1.0, 1.5], [4.0, 1.5], [4.0, 2.5], [1.0, 2.5]]}\n"
    files = edited("site.yaml", "zones:\n", f"zones:\n{wet}")
    await put_in_force(runtime, {name: text for name, text in files.items() if not name.startswith("tests/")})
    standing = runtime.desk.departures.standing(session)
    assert [why["code"] for why in standing or ()] == ["place_changed"] * driven


async def test_an_answer_after_a_lapse_is_not_sent_when_its_grant_ends_while_it_is_recorded(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, given = await granted(runtime, cell)
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await cell.state(status="escalated")
    launched, question = len(cell.all("launch")), runtime.desk.pending_for(session)
    assert question is not None
    gate = Gate(runtime, monkeypatch)
    answering = asyncio.ensure_future(runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest))
    await gate.reached.wait()
    revoked = asyncio.create_task(runtime.desk.grants.revoke(given["id"], OPERATOR_2))
    await until(lambda: not runtime.desk.grants.stands(given["id"]))
    gate.open.set()
    with pytest.raises(Conflict, match="it was not sent") as refused:
        await answering
    await revoked
    monkeypatch.undo()
    assert (refused.value.code, len(cell.all("launch"))) == ("resume_refused", launched)
    async with stating(cell, status="escalated"):
        await until(lambda: runtime.desk.pending_for(session) is not None)
    asked = runtime.desk.pending_for(session)
    assert asked is not None
    assert codes(asked) == {"not_gone_on"}


def permits(trace: list[dict[str, Any]]) -> list[str]:
    return [event["body"]["authorization"]["id"] for event in trace if event["kind"] == "authorization"]


async def asked_first(runtime: Runtime, cell: HandCell, invocation: str, *codes: str, digest: str | None = None) -> str:
    """Hand back, having seen all of the record, and return the digest of the refusal, which is recorded once."""
    seen = runtime.store.size
    async with stating(cell, status="running"):
        with pytest.raises(Conflict, match="whoever hands back again approves that") as refused:
            await runtime.governor.release(invocation, OPERATOR, "resume", after=seen, digest=digest)
    assert refused.value.code == "resume_refused"
    assert [why["code"] for why in refused.value.reasons] == list(codes)
    assert {why["remedy"] for why in refused.value.reasons} == {"hand back again, with the `digest` of this refusal"}
    assert permit(cell)["capability"] == "takeover"
    told = [event for event in await runtime.governor.trace(invocation, ENGINEER) if event["kind"] == "policy"]
    told = [event["body"] for event in told if event["body"].get("hand_back", {}).get("digest") == refused.value.digest]
    assert [body["outcome"] for body in told] == ["escalate" if "look" in codes else "allow"]
    said = told[0]["hand_back"]
    assert (said["by"], [why["code"] for why in said["refused"]["reasons"]]) == (OPERATOR.name, list(codes))
    return said["digest"]


async def handed_back(runtime: Runtime, cell: HandCell, invocation: str, digest: str | None = None) -> None:
    back = asyncio.ensure_future(runtime.governor.release(invocation, OPERATOR, "resume", digest=digest))
    async with stating(cell, status="running"):
        await cell.expect("launch", len(cell.all("launch")) + 1)
    await cell.report("status", invocation, status="running", before="recovering", reason="handed_back")
    await back


async def approved(runtime: Runtime, cell: HandCell, by: Principal, request: ProposalRequest | None = None) -> str:
    """Return a session, a grasp if not said, that was launched on one approval."""
    made, _ = await runtime.governor.propose(AGENT, request or grasp())
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    await runtime.desk.resolve(question.id, by, "approve", question.digest)
    await cell.expect("launch")
    await cell.launched(made["id"])
    return made["id"]


async def taken(runtime: Runtime, cell: HandCell, invocation: str) -> None:
    """Take a session over; where another policy has told it to hold, its cell has said by then that it does."""
    if any(isinstance(said, Human) and said.op == "escalate" for said in cell.heard):
        await cell.report("status", invocation, status="escalated", reason="policy_changed")
    await runtime.governor.take_over(invocation, OPERATOR)
    await cell.report("launch", invocation, capability="takeover")


@pytest.mark.parametrize("by", [OPERATOR, OPERATOR_2], ids=["the same", "another"])
async def test_what_policy_has_come_to_ask_is_approved_by_whom_a_refused_hand_back_told(
    runtime: Runtime, cell: HandCell, by: Principal
) -> None:
    """An approval is of what was shown: who drove was not asked, and who approved was asked about something else."""
    session = await approved(runtime, cell, by)
    await put_in_force(runtime, LOOK)
    await taken(runtime, cell, session)
    told = await asked_first(runtime, cell, session, "look", "approval_required")
    seq = runtime.store.size
    for unseen in (None, told[:-1]):  # a word that was sent twice, or before the refusal was seen
        assert await asked_first(runtime, cell, session, "look", "approval_required", digest=unseen) == told
    await handed_back(runtime, cell, session, told)
    assert permit(cell)["approvals"] == [OPERATOR.name]
    trace = await runtime.governor.trace(session, ENGINEER)
    assert [event["body"].get("approves") for event in trace if event["body"].get("op") == "release"] == [seq]
    (refusal,) = [event for event in trace if event["seq"] == seq]
    assert (refusal["kind"], refusal["body"]["hand_back"]["digest"]) == ("policy", told)


async def test_what_one_hand_back_was_told_of_is_told_again_at_the_next(runtime: Runtime, cell: HandCell) -> None:
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, LOOK)
    await taken(runtime, cell, session)
    told = await asked_first(runtime, cell, session, "look", "approval_required")
    await handed_back(runtime, cell, session, told)
    await taken(runtime, cell, session)
    assert await asked_first(runtime, cell, session, "look", "approval_required", digest=told) != told


async def test_what_nobody_was_told_of_in_the_record_is_approved_by_no_digest(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One may know it all the same: from a refusal that could not be recorded."""
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, LOOK)
    await taken(runtime, cell, session)
    unrecorded: list[EventDraft] = []

    async def full(drafts: list[EventDraft]) -> None:
        unrecorded.extend(drafts)
        raise RecordUnavailable("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(runtime.register, "append", full)
        async with stating(cell, status="running"):
            with pytest.raises(RecordUnavailable):
                await runtime.governor.release(session, OPERATOR, "resume")
    unread = unrecorded[-1].body["hand_back"]["digest"]
    assert await asked_first(runtime, cell, session, "look", "approval_required", digest=unread) == unread
    await handed_back(runtime, cell, session, unread)


async def test_what_a_hand_back_was_told_of_is_told_again_to_whom_others_have_overtaken(
    runtime: Runtime, cell: HandCell
) -> None:
    """The refusal that told them may be lost, and the one that was heard since says nothing of it, nor a digest."""
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, LOOK)
    await taken(runtime, cell, session)
    seen = runtime.store.size
    told = await asked_first(runtime, cell, session, "look", "approval_required")
    await runtime.governor.pause(session, OPERATOR_2)
    await cell.report("status", session, status="paused", reason="operator")
    await runtime.governor.resume(session, OPERATOR_2)
    await cell.report("status", session, status="running", reason="operator")
    async with stating(cell, status="running"):
        with pytest.raises(Conflict) as refused:
            await runtime.governor.release(session, OPERATOR, "resume", after=seen)
    assert (refused.value.code, refused.value.digest) == ("overtaken", None)
    assert await asked_first(runtime, cell, session, "look", "approval_required") == told
    await handed_back(runtime, cell, session, told)


async def test_an_approval_of_what_was_carried_is_none_of_what_a_grant_answers_for_since(
    runtime: Runtime, cell: HandCell
) -> None:
    await holding(cell, "mug_1")
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"})
    made, _ = await runtime.governor.propose(AGENT, carry)
    question = runtime.desk.pending_for(made["id"])
    assert question is not None
    await holding(cell, "driver_1")
    await runtime.desk.grants.give(OPERATOR_2, replace(MUGS, capability="transport_object"))
    with pytest.raises(Conflict) as refused:
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    assert (refused.value.code, cell.all("launch")) == ("digest_mismatch", [])
    asked = runtime.desk.pending_for(question.invocation)
    assert asked is not None
    assert (asked.reasons, asked.expires_at) == (question.reasons, question.expires_at)
    await runtime.desk.resolve(asked.id, OPERATOR, "approve", asked.digest)
    await cell.expect("launch")
    assert permit(cell)["approvals"] == [OPERATOR.name]


async def carrying(runtime: Runtime, cell: HandCell, thing: str, files: dict[str, str] | None = None) -> str:
    """Return a carry that one person approved and another took over, of what is held; policy is of `files` by then."""
    await holding(cell, thing)
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"})
    session = await approved(runtime, cell, OPERATOR_2, carry)
    if files is not None:
        await put_in_force(runtime, files)
    await taken(runtime, cell, session)
    return session


async def test_who_approved_one_load_is_nobody_of_those_who_let_another_go_on(runtime: Runtime, cell: HandCell) -> None:
    """A human who drives may put down what was to be carried, and take something else."""
    session = await carrying(runtime, cell, "mug_1")
    await holding(cell, "driver_1")
    await asked_first(runtime, cell, session, "approval_required")
    await holding(cell, "mug_1")
    await handed_back(runtime, cell, session)
    assert permit(cell)["approvals"] == [OPERATOR_2.name, OPERATOR.name]


@pytest.mark.parametrize("by", ["grant", "approval"])
async def test_who_approved_one_load_is_not_named_where_a_grant_answers_for_another(
    runtime: Runtime, cell: HandCell, by: str
) -> None:
    carries = replace(MUGS, capability="transport_object", scope=GrantScope.OBJECT, object="driver_1")
    if by == "grant":
        given = await runtime.desk.grants.give(OPERATOR, carries)
        await runtime.desk.grants.give(OPERATOR_2, replace(carries, object="mug_1"))
        await holding(cell, "mug_1")
        made, _ = await runtime.governor.propose(
            AGENT, ProposalRequest(capability="transport_object", params={"target": "dock"})
        )
        session = made["id"]
        await cell.expect("launch")
        await cell.launched(session)
        await taken(runtime, cell, session)
    else:
        session = await carrying(runtime, cell, "mug_1")
        given = await runtime.desk.grants.give(OPERATOR, carries)
    await holding(cell, "driver_1")
    await handed_back(runtime, cell, session)
    assert permit(cell)["approvals"] == [f"grant:{given['id']}", OPERATOR.name]


async def test_what_a_refused_hand_back_told_of_one_load_approves_none_of_another(
    runtime: Runtime, cell: HandCell
) -> None:
    session = await carrying(runtime, cell, "mug_1", LOOK)
    told = await asked_first(runtime, cell, session, "look", "approval_required")
    await holding(cell, "driver_1")
    again = await asked_first(runtime, cell, session, "look", "approval_required", digest=told)
    assert again != told
    await handed_back(runtime, cell, session, again)


async def test_what_is_asked_of_one_load_after_a_lapse_lets_none_other_go_on(runtime: Runtime, cell: HandCell) -> None:
    session = await carrying(runtime, cell, "mug_1", LOOK)
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await until(lambda: (asked := runtime.desk.pending_for(session)) is not None and "look" in codes(asked))
    launched, said = len(cell.all("launch")), set[str]()
    for thing in ("mug_1", "driver_1", "mug_1"):
        await holding(cell, thing)
        question = runtime.desk.pending_for(session)
        assert question is not None
        with pytest.raises(Conflict) as refused:
            await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
        assert refused.value.code == "digest_mismatch"
        asked = runtime.desk.pending_for(session)
        assert asked is not None
        assert (asked.carried, len(cell.all("launch"))) == (thing, launched)
        assert {"control_lapsed", "look", "approval_required"} <= codes(asked)
        said.add(asked.digest)
    assert len(said) == 2
    await runtime.desk.resolve(question.id, OPERATOR, "approve", asked.digest)
    await cell.expect("launch", launched + 1)
    assert permit(cell)["approvals"] == [OPERATOR.name]


@pytest.mark.parametrize("meanwhile", ["withdrawn", "driven"])
async def test_what_a_hand_left_goes_on_by_nobody_who_is_late_by_the_time_that_is_decided(
    house: House, runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    session = await approved(runtime, cell, OPERATOR)
    await taken(runtime, cell, session)
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await cell.state(status="escalated")
    left, launched = runtime.desk.pending_for(session), len(cell.all("launch"))
    assert left is not None
    events, reached, go_on = runtime.store.events, asyncio.Event(), asyncio.Event()

    async def slow(**of: Any) -> Any:
        if of.get("kind") == EventKind.AUTHORIZATION:  # who approved it
            reached.set()
            await go_on.wait()
        return await events(**of)

    monkeypatch.setattr(runtime.store, "events", slow)
    answering = asyncio.ensure_future(runtime.desk.resolve(left.id, OPERATOR, "approve", left.digest))
    await reached.wait()
    taking = None
    if meanwhile == "withdrawn":
        house.withdrawn.add(OPERATOR.name)
    else:
        taking = asyncio.ensure_future(runtime.governor.take_over(session, OPERATOR_2))
        await until(lambda: runtime.fleet.cell(CELL).driven(session))
    go_on.set()
    with pytest.raises(RuntimeRefusal) as refused:
        await answering
    assert refused.value.code == ("role_forbidden" if taking is None else "control_held")
    if taking is not None:
        await taking
    assert [permit(cell)["capability"], len(cell.all("launch"))] == ["takeover", launched + (taking is not None)]


async def test_of_two_equal_answers_after_a_lapse_none_counts_for_what_was_not_asked(
    runtime: Runtime, cell: HandCell
) -> None:
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, LOOK)
    await taken(runtime, cell, session)
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await until(lambda: (asked := runtime.desk.pending_for(session)) is None or runtime.desk.outdated(asked) is None)
    question = runtime.desk.pending_for(session)
    assert question is not None
    launched = len(cell.all("launch"))
    answers = [runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest) for _ in range(2)]
    found = await asyncio.gather(*answers, return_exceptions=True)
    assert [error.code for error in found if isinstance(error, Conflict)] == ["digest_mismatch"] * 2
    assert len(cell.all("launch")) == launched
    asked = runtime.desk.pending_for(session)
    assert asked is not None
    assert {"control_lapsed", "look", "approval_required"} <= {why["code"] for why in asked.reasons}
    await runtime.desk.resolve(asked.id, OPERATOR, "approve", asked.digest)
    await cell.expect("launch", launched + 1)


async def test_what_a_session_asks_more_of_is_another_question_also_under_the_policy_that_it_was_asked_under(
    runtime: Runtime, cell: HandCell
) -> None:
    """Who answers what was asked at first has not seen what was added, whichever policy was in force in between."""
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, LOOK)
    look = runtime.kernel.policy.digest
    await taken(runtime, cell, session)
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await until(lambda: (asked := runtime.desk.pending_for(session)) is not None and "look" in codes(asked))
    first = runtime.desk.pending_for(session)
    assert first is not None
    assert "approval_required" not in codes(first)
    with pytest.raises(Conflict):
        await runtime.desk.resolve(first.id, OPERATOR, "approve", first.digest)
    await put_in_force(runtime, SLOWER)
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(look, engineer, "no need")
    await until(lambda: (asked := runtime.desk.pending_for(session)) is not None and asked.policy_version == look)
    again = runtime.desk.pending_for(session)
    assert again is not None
    assert {"look", "approval_required"} <= codes(again)
    launched = len(cell.all("launch"))
    with pytest.raises(Conflict, match="has changed"):
        await runtime.desk.resolve(first.id, OPERATOR, "approve", first.digest)
    assert len(cell.all("launch")) == launched
    await runtime.desk.resolve(again.id, OPERATOR, "approve", again.digest)
    await cell.expect("launch", launched + 1)


async def test_what_a_session_was_held_for_before_it_was_bound_anew_is_asked_of_it_again_after_a_start(
    house: House,
) -> None:
    """It is asked by the policy that the session is bound to: as somebody has approved once, and not for good."""
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session = await approved(runtime, cell, OPERATOR)
        await put_in_force(runtime, LOOK)
        await taken(runtime, cell, session)
        told = await asked_first(runtime, cell, session, "look", "approval_required")
        await handed_back(runtime, cell, session, told)
        await taken(runtime, cell, session)
        await left(cell, session)
        await cell.hang_up()
    async with house.open() as runtime:
        back = replace(cell, runtime=runtime, heard=[], closed=None, status="escalated")
        await (await back.dial()).state()
        question = runtime.desk.pending_for(session)
        assert question is not None
        with pytest.raises(Conflict, match="something else by now"):
            await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
        asked = runtime.desk.pending_for(session)
        assert asked is not None
        assert codes(asked) >= {"control_lapsed", "look", "approval_required"}
        assert runtime.desk.outdated(asked) is None
        await runtime.desk.resolve(asked.id, OPERATOR, "approve", asked.digest)
        await back.expect("launch")
        assert permit(back)["approvals"] == [OPERATOR.name]


async def test_what_a_policy_asks_from_here_is_answered_although_one_that_gave_way_asked_it_as_well(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    session, before = await approved(runtime, cell, OPERATOR_2), runtime.kernel.policy.digest
    await put_in_force(runtime, TWO)
    for engineer in (ENGINEER, ENGINEER_2):
        await runtime.versions.activate(before, engineer, "no need")
    await taken(runtime, cell, session)
    house.withdrawn.add(OPERATOR_2.name)
    await left(cell, session)
    question = runtime.desk.pending_for(session)
    assert question is not None
    with pytest.raises(Conflict, match="something else by now"):
        await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    asked = runtime.desk.pending_for(session)
    assert asked is not None
    assert codes(asked) == {"control_lapsed", "approval_required"}
    assert runtime.desk.outdated(asked) is None
    launched = len(cell.all("launch"))
    await runtime.desk.resolve(asked.id, OPERATOR, "approve", asked.digest)
    await cell.expect("launch", launched + 1)
    assert permit(cell)["approvals"] == [OPERATOR.name]


async def test_an_answer_that_comes_behind_a_rollback_leaves_its_end_to_people(
    runtime: Runtime, cell: HandCell
) -> None:
    session = await approved(runtime, cell, OPERATOR_2)
    await taken(runtime, cell, session)
    await left(cell, session)
    question = runtime.desk.pending_for(session)
    assert question is not None
    await runtime.governor.rollback(session, OPERATOR_2)
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)  # the cell has not said a word yet
    await cell.expect("launch", 3)
    assert cell.ops()[-1] == "rollback"
    await cell.report("status", session, status="recovering", reason="ROLLBACK")
    await cell.report("human", session, op="rollback")
    await cell.report("launch", session, refused="busy", permit=permit(cell)["id"])
    with pytest.raises(Conflict) as refused:
        await runtime.governor.cancel(session, AGENT)
    assert refused.value.code == "rollback_ordered"


async def test_what_goes_on_by_an_answer_after_all_its_agent_may_end_as_well(runtime: Runtime, cell: HandCell) -> None:
    session = await approved(runtime, cell, OPERATOR_2)
    await runtime.governor.rollback(session, OPERATOR_2)
    await taken(runtime, cell, session)
    await left(cell, session)
    question = runtime.desk.pending_for(session)
    assert question is not None
    await runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    await cell.report("launch", session, permit=permit(cell)["id"])
    await cell.report("status", session, status="recovering", reason="handed_back")
    await cell.report("status", session, status="running", reason="handed_back")
    await runtime.governor.cancel(session, AGENT)


async def test_a_session_whose_capability_takes_other_parameters_by_now_is_held_and_goes_on_by_nobody(
    house: House,
) -> None:
    """So are all others that depart; and a start says the same."""
    manifest = "capabilities/operate_tool.yaml"
    renamed = edited(manifest, "[tool, action]", "[device, action]", edited(manifest, "    tool: {", "    device: {"))
    renamed = edited(manifest, "version: 1.0.0", "version: 2.0.0", renamed)
    renamed = {name: text for name, text in renamed.items() if not name.startswith("tests/")}
    async with house.open() as runtime:
        cell = await HandCell(runtime, facts=dict(AT_TOOLS)).dial()
        await cell.state()
        lever = ProposalRequest(capability="operate_tool", params={"tool": "lever", "action": "pull_down"})
        session = await approved(runtime, cell, OPERATOR, lever)
        await put_in_force(runtime, renamed)
        await until(lambda: "escalate" in cell.ops())
        await cell.report("status", session, status="escalated", reason="policy_changed")
        await taken(runtime, cell, session)
        async with stating(cell, status="running"):
            with pytest.raises(Conflict) as refused:
                await runtime.governor.release(session, OPERATOR, "resume")
        assert [why["code"] for why in refused.value.reasons] == ["params_invalid"]
        await cell.hang_up()
    async with house.open() as runtime:
        assert {why["code"] for why in runtime.desk.departures.standing(session)} == {"params_invalid"}


async def test_what_was_launched_without_what_its_capability_takes_besides_by_now_goes_on_but_is_not_bound_anew(
    runtime: Runtime, cell: HandCell
) -> None:
    manifest, extra = "capabilities/grasp_object.yaml", "{type: number, unit: m, minimum: 0, maximum: 5, default: 1.0}"
    more = edited(manifest, "  properties:\n", f"  properties:\n    extra_m: {extra}\n")
    more = edited(manifest, "version: 1.0.0", "version: 1.1.0", more)
    session = await approved(runtime, cell, OPERATOR)
    await put_in_force(runtime, more)
    assert cell.ops() == []
    await taken(runtime, cell, session)
    async with stating(cell, status="running"):
        with pytest.raises(Conflict) as refused:
            await runtime.governor.release(session, OPERATOR, "resume")
    assert [(why["code"], "`extra_m`" in why["message"]) for why in refused.value.reasons] == [("params_invalid", True)]


async def left(cell: HandCell, session: str) -> None:
    """Have a cell say that whoever drove has let go without a word."""
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await cell.state(status="escalated")


async def test_who_may_not_let_go_on_alone_what_was_left_is_told_to_deny_it(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    cell.facts = dict(AT_TOOLS)
    await cell.state()
    made, question = await asked(runtime, press())
    for who in (OPERATOR, OPERATOR_2):
        await answer(runtime, question, who=who)
    session = made["id"]
    await cell.expect("launch")
    await cell.launched(session)
    await taken(runtime, cell, session)
    house.withdrawn.add(OPERATOR_2.name)
    await cell.report("status", session, status="escalated", reason="control_lapsed")
    await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
    await cell.state(status="escalated")
    left = runtime.desk.pending_for(session)
    assert left is not None
    with pytest.raises(Conflict, match="more approvals") as refused:
        await runtime.desk.resolve(left.id, OPERATOR, "approve", left.digest)
    assert {why["remedy"] for why in refused.value.reasons} == {"deny it"}


def codes(asked: Escalation) -> set[str]:
    return {why["code"] for why in asked.reasons}


def permit(cell: HandCell) -> dict[str, Any]:
    return json.loads(base64.b64decode(cell.all("launch")[-1].body))


@pytest.mark.parametrize("lapsed", [False, True])
async def test_nothing_goes_on_anew_under_a_profile_that_its_cell_has_left(
    runtime: Runtime, cell: HandCell, lapsed: bool
) -> None:
    """Going on takes a new authorization: somebody may have put the cell under a stricter profile for a reason."""
    session = await approved(runtime, cell, OPERATOR)
    await taken(runtime, cell, session)
    await runtime.governor.set_profile(CELL, "real-restricted", ENGINEER)
    going = runtime.governor.release(session, OPERATOR, "resume")
    if lapsed:
        going.close()
        await cell.report("status", session, status="escalated", reason="control_lapsed")
        await cell.report("escalation", session, reason="control_lapsed", failure="taken_over")
        await until(lambda: runtime.desk.pending_for(session) is not None)
        question = runtime.desk.pending_for(session)
        assert question is not None
        going = runtime.desk.resolve(question.id, OPERATOR, "approve", question.digest)
    launched = len(cell.all("launch"))
    async with stating(cell, status="running"):
        with pytest.raises(Conflict) as refused:
            await going
    assert (refused.value.code, [why["code"] for why in refused.value.reasons]) == (
        "resume_refused",
        ["profile_changed"],
    )
    assert len(cell.all("launch")) == launched
