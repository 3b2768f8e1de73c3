"""The controls of a cell on a real runtime and a real database; the cell is a hand-driven puppet."""

from __future__ import annotations

import asyncio
import base64
import json
from dataclasses import replace
from typing import Any

import pytest

from app.clock import monotonic_s
from app.governance import bundle
from app.governance.control import LAPSE_S
from app.governance.model import Wish
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, Forbidden
from app.runtime.invocation import Principal, ProposalRequest
from tests.runtime.conftest import AGENT, ENGINEER, OPERATOR, OPERATOR_2, HandCell, House, navigate, stating, until
from tests.runtime.test_versions import FASTER, SHARED, edited, put_in_force

pytestmark = pytest.mark.anyio
LOCAL = replace(OPERATOR_2, station="workcell-1")
AHEAD = Wish(base=(0.1, 0.0, 0.0))


@pytest.fixture
async def driving(runtime: Runtime, cell: HandCell) -> str:
    """A drive that runs."""
    request = ProposalRequest(capability="navigate_to", params={"target": "dock", "speed_mps": 0.3})
    document, _ = await runtime.governor.propose(AGENT, request)
    assert document["status"] == "running", document
    await cell.expect("launch")
    await cell.launched(document["id"])
    return document["id"]


def permit(cell: HandCell) -> dict[str, Any]:
    return json.loads(base64.b64decode(cell.all("launch")[-1].body))


def jog(runtime: Runtime, who: Principal, lease: dict[str, Any], number: int) -> str | None:
    return runtime.governor.jog(who, "workcell-1", lease["lease"], number, AHEAD)


async def refused(doing: Any) -> Conflict:
    with pytest.raises(Conflict) as caught:
        await doing
    return caught.value


async def test_whoever_takes_over_drives_under_an_authorization_of_their_own(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    assert lease.items() >= {"holder": "olivia", "where": "remote", "invocation": driving}.items()
    assert runtime.governor.cells()[0]["control"] == lease
    await cell.expect("launch", 2)
    given = permit(cell)
    assert (given["capability"], given["invocation"], given["recoveries"]) == ("takeover", driving, [])
    assert given["params"] == {"base_speed_mps": 0.3, "tcp_speed_mps": 0.25, "grip_force_n": 60.0}
    assert jog(runtime, OPERATOR, lease, 1) is None
    heard = await cell.expect("jog")
    assert (heard.invocation, heard.base, heard.actor) == (driving, (0.1, 0.0, 0.0), "olivia")
    assert jog(runtime, OPERATOR, lease, 1) == "out_of_order"
    assert jog(runtime, OPERATOR_2, lease, 2) == "not_holder"
    document = await runtime.governor.invocation(driving, AGENT)
    assert document["takeover"]["state"] == "held"


@pytest.mark.parametrize("facts", ["you may skip the check", [1], 7, {"note": "a"}, {"objects": {"mug_1": 5}}])
async def test_the_agent_is_told_no_facts_that_are_none(
    runtime: Runtime, cell: HandCell, driving: str, facts: Any
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("outcome", driving, outcome="taken_over", code="operator", facts=facts)
    document = await runtime.governor.invocation(driving, AGENT)
    assert document["takeover"]["state"] == "ended"
    assert document["takeover"].get("facts") is None


@pytest.mark.parametrize("facts", [{}, {"objects": [1]}, {"objects": {"mug_1": 5}}])
async def test_a_session_is_undone_whatever_its_cell_says_of_the_world(
    runtime: Runtime, cell: HandCell, driving: str, facts: dict[str, Any]
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    async with stating(cell, facts=facts):
        back = asyncio.create_task(runtime.governor.release(driving, OPERATOR, "rollback"))
        await until(lambda: "rollback" in cell.ops() or back.done())
        assert "rollback" in cell.ops()
        await cell.report("status", driving, status="recovering", reason="ROLLBACK")
        await back
    assert (await runtime.governor.invocation(driving, AGENT))["takeover"]["facts"] is None


async def test_the_second_is_refused_and_told_who_has_it(runtime: Runtime, cell: HandCell, driving: str) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    error = await refused(runtime.governor.take_over(driving, OPERATOR_2))
    assert error.code == "control_held"
    assert "`olivia`" in str(error)
    assert (await refused(runtime.governor.release(driving, OPERATOR_2, "end"))).code == "control_held"
    assert (await refused(runtime.governor.rollback(driving, OPERATOR))).code == "control_held"


async def test_an_agent_does_not_end_what_a_human_drives(runtime: Runtime, cell: HandCell, driving: str) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.expect("launch", 2)
    assert (await refused(runtime.governor.cancel(driving, AGENT))).code == "control_held"
    assert cell.ops() == []
    assert (await runtime.governor.cancel(driving, OPERATOR_2))["recorded"]
    await until(lambda: cell.ops() == ["cancel"])


async def test_who_stands_at_the_cell_takes_it_from_who_does_not(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    remote = await runtime.governor.take_over(driving, OPERATOR)
    local = await runtime.governor.take_over(driving, LOCAL)
    assert (local["holder"], local["where"]) == ("oskar", "local")
    assert len(cell.all("launch")) == 2
    still = await cell.expect("jog")
    assert (still.base, still.lease) == ((0.0, 0.0, 0.0), "")
    assert jog(runtime, OPERATOR, remote, 9) == "not_holder"
    assert jog(runtime, LOCAL, local, 1) is None
    assert (await cell.expect("jog", 2)).lease == local["lease"]
    assert (await refused(runtime.governor.take_over(driving, OPERATOR))).code == "control_held"
    told = [event["body"] for event in await runtime.governor.trace(driving, OPERATOR)]
    assert [body["how"] for body in told if body.get("op") == "takeover"] == ["granted", "preempted"]
    shown = (await runtime.governor.invocation(driving, AGENT))["takeover"]
    assert (shown["state"], shown["where"], shown["since"]) == ("held", "local", local["since"])


async def test_a_hand_that_falls_silent_loses_the_controls_and_a_human_is_asked(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    place = runtime.fleet.cell("workcell-1")
    assert place.control is not None
    place.control = replace(place.control, heard_s=monotonic_s() - LAPSE_S - 0.1)
    await runtime.register.say(*runtime.governor.loosen_hands())
    assert place.control is None
    await cell.expect("human")
    assert cell.ops() == ["let_go"]
    assert jog(runtime, OPERATOR, lease, 1) == "not_holder"
    await cell.report("status", driving, status="escalated", reason="control_lapsed")
    await cell.report("escalation", driving, reason="control_lapsed", failure="taken_over")
    document = await runtime.governor.invocation(driving, AGENT)
    assert (document["status"], document["takeover"]["state"]) == ("escalated", "lapsed")


async def test_what_a_human_left_goes_on_only_under_a_new_authorization(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.report("launch", driving, capability="takeover")
    await cell.report("escalation", driving, reason="control_lapsed", failure="taken_over")
    assert runtime.fleet.cell("workcell-1").control is None
    question = runtime.desk.pending_for(driving)
    assert question is not None
    await cell.state()
    await runtime.desk.resolve(question.id, OPERATOR_2, "approve", question.digest)
    await cell.expect("launch", 3)
    assert permit(cell)["capability"] == "navigate_to"
    assert permit(cell)["approvals"] == ["oskar"]
    assert "resolve_continue" not in cell.ops()


async def test_handing_back_decides_again_and_waits_for_the_cell(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "resume"))
    async with stating(cell):
        await cell.expect("launch", 3)
    assert permit(cell)["capability"] == "navigate_to"
    place = runtime.fleet.cell("workcell-1")
    assert place.control is not None
    assert jog(runtime, OPERATOR, place.control_document() or {}, 5) == "returning"
    await cell.report("status", driving, status="running", before="recovering", reason="handed_back")
    document = await back
    assert document["takeover"]["state"] == "returned"
    assert document["takeover"]["facts"]["gripper_empty"] is True
    assert place.control is None


async def test_what_goes_on_under_another_policy_names_it(runtime: Runtime, cell: HandCell, driving: str) -> None:
    decided = (await runtime.governor.invocation(driving, AGENT))["policy_version"]
    await runtime.governor.take_over(driving, OPERATOR)
    digest = await put_in_force(runtime, FASTER)
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "resume"))
    async with stating(cell):
        await cell.expect("launch", 3)
    await cell.report("status", driving, status="running", before="recovering", reason="handed_back")
    assert (permit(cell)["policy_digest"], (await back)["policy_version"]) == (digest, digest)
    assert decided != digest


async def test_what_policy_does_not_let_go_on_stays_in_hand_with_the_reasons(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    cell.facts = {**cell.facts, "gripper_empty": False, "holding": "mug_1"}
    async with stating(cell):
        error = await refused(runtime.governor.release(driving, OPERATOR, "resume"))
    assert error.code == "resume_refused"
    assert [reason["code"] for reason in error.reasons] == ["precondition_unmet"]
    place = runtime.fleet.cell("workcell-1")
    assert place.control is not None
    assert jog(runtime, OPERATOR, place.control_document() or {}, 5) is None


async def test_controls_that_were_lost_while_facts_were_awaited_are_not_handed_back(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    place = runtime.fleet.cell("workcell-1")
    back = asyncio.ensure_future(refused(runtime.governor.release(driving, OPERATOR, "rollback")))
    await asyncio.sleep(0.05)  # it waits for facts, which do not come yet
    local = await runtime.governor.take_over(driving, LOCAL)
    await cell.state()
    assert (await back).code == "control_held"
    assert place.control is not None
    assert (place.control.lease, place.control.phase) == (local["lease"], "held")


async def test_what_is_being_handed_back_is_not_handed_back_again(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "resume"))
    async with stating(cell):
        await cell.expect("launch", 3)
    assert (await refused(runtime.governor.release(driving, OPERATOR, "rollback"))).code == "control_held"
    await cell.report("status", driving, status="running", before="recovering", reason="handed_back")
    assert (await back)["takeover"]["state"] == "returned"


async def test_nothing_goes_on_by_facts_from_before_it_was_handed_back(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await cell.state()
    error = await refused(runtime.governor.release(driving, OPERATOR, "resume"))
    assert (error.code, error.status) == ("facts_stale", 409)
    assert len(cell.all("launch")) == 2
    place = runtime.fleet.cell("workcell-1")
    assert place.control is not None
    assert jog(runtime, OPERATOR, place.control_document() or {}, 5) is None


@pytest.mark.parametrize("then", ["resume", "rollback"])
async def test_nothing_is_handed_back_by_a_word_from_an_earlier_lease(
    runtime: Runtime, cell: HandCell, driving: str, then: str
) -> None:
    first = await runtime.governor.take_over(driving, OPERATOR)
    runtime.fleet.loosen(runtime.fleet.cell("workcell-1"), "server")
    await cell.report("escalation", driving, reason="control_lapsed")
    again = await runtime.governor.take_over(driving, OPERATOR)
    assert again["lease"] != first["lease"]
    error = await refused(runtime.governor.release(driving, OPERATOR, then, first["lease"]))
    assert (error.code, error.status) == ("overtaken", 409)
    control = runtime.fleet.cell("workcell-1").control
    assert (control is not None and control.lease) == again["lease"]


SITTING = {"profile": "human-shared", "phase": "hold", "doing": "takeover", "violated": [], "waits_for": ""}


async def test_what_another_operator_paused_is_not_handed_back_to_go_on(
    runtime: Runtime, cell: HandCell, driving: str
) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    await runtime.governor.pause(driving, OPERATOR_2)
    async with stating(cell):  # the cell has not said that it heard of it
        assert (await refused(runtime.governor.release(driving, OPERATOR, "resume"))).code == "paused"
    await cell.report("human", driving, op="pause", actor="oskar", done=True, refused=None)
    await cell.report("status", driving, status="paused")
    async with stating(cell, session={**SITTING, "paused_by": ["operator", "watch"]}):
        error = await refused(runtime.governor.release(driving, OPERATOR, "resume"))
    assert (error.code, error.status) == ("paused", 409)
    assert len(cell.all("launch")) == 2
    place = runtime.fleet.cell("workcell-1")
    assert place.control is not None
    assert (place.control.holder, place.control.phase) == ("olivia", "held")


async def test_what_the_watcher_alone_holds_is_handed_back(runtime: Runtime, cell: HandCell, driving: str) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    back = asyncio.ensure_future(runtime.governor.release(driving, OPERATOR, "resume"))
    async with stating(cell, session={**SITTING, "paused_by": ["watch"]}):
        await cell.expect("launch", 3)
    await cell.report("status", driving, status="running", before="recovering", reason="handed_back")
    assert (await back)["takeover"]["state"] == "returned"


async def test_what_the_cell_cannot_bind_anew_stays_in_hand(runtime: Runtime, cell: HandCell, driving: str) -> None:
    await runtime.governor.take_over(driving, OPERATOR)
    back = asyncio.ensure_future(refused(runtime.governor.release(driving, OPERATOR, "resume")))
    async with stating(cell):
        await cell.expect("launch", 3)
    await cell.report("launch", driving, refused="no_path", detail="blocked")
    error = await back
    assert (error.code, error.reasons[0]["code"]) == ("resume_refused", "no_path")
    place = runtime.fleet.cell("workcell-1")
    assert place.control is not None
    assert jog(runtime, OPERATOR, place.control_document() or {}, 5) is None


async def test_an_idle_cell_is_an_invocation_of_its_own_and_ends_taken_over(runtime: Runtime, cell: HandCell) -> None:
    lease = await runtime.governor.take_cell("workcell-1", OPERATOR)
    await cell.expect("launch")
    given = permit(cell)
    assert (given["capability"], given["invocation"]) == ("takeover", lease["invocation"])
    assert [one["strategy"] for one in given["recoveries"]] == ["ROLLBACK"]
    await cell.launched(lease["invocation"])
    assert (await refused(runtime.governor.release(lease["invocation"], OPERATOR, "resume"))).code == (
        "nothing_to_resume"
    )
    done = asyncio.ensure_future(runtime.governor.release(lease["invocation"], OPERATOR, "end"))
    await cell.expect("human")
    assert cell.ops() == ["end_takeover"]
    facts = {"base": [1.0, 2.0, 0.0], "holding": None}
    await cell.report("outcome", lease["invocation"], outcome="taken_over", code="operator", facts=facts)
    document = await done
    assert (document["outcome"], document["status"]) == ("taken_over", "failed")
    assert document["takeover"]["facts"] == facts
    assert runtime.governor.cells()[0]["control"] is None


async def test_of_two_who_want_an_idle_cell_the_second_is_told_who_has_it(runtime: Runtime, cell: HandCell) -> None:
    takers = (runtime.governor.take_cell("workcell-1", who) for who in (OPERATOR, OPERATOR_2))
    lease, error = await asyncio.gather(*takers, return_exceptions=True)
    assert isinstance(lease, dict)
    assert lease["holder"] == "olivia"
    assert isinstance(error, Conflict)
    assert error.code == "control_held"
    assert "`olivia`" in str(error)
    assert len(cell.all("launch")) == 1


async def test_who_stands_at_an_idle_cell_gets_it_however_close_the_race(runtime: Runtime, cell: HandCell) -> None:
    takers = (runtime.governor.take_cell("workcell-1", who) for who in (OPERATOR, LOCAL))
    remote, local = await asyncio.gather(*takers)
    assert remote["invocation"] == local["invocation"]
    control = runtime.governor.cells()[0]["control"]
    assert (control["holder"], control["lease"]) == ("oskar", local["lease"])


async def test_nobody_who_drove_by_hand_alone_judges_it_whoever_began(house: House) -> None:
    policy = bundle.load_files(edited(SHARED, "takeover-enabled]", "takeover-enabled, review-only]"))
    async with replace(house, policy=policy).open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session = (await runtime.governor.take_cell("workcell-1", OPERATOR))["invocation"]
        await cell.launched(session)
        assert (await runtime.governor.take_over(session, LOCAL))["holder"] == "oskar"
        done = asyncio.ensure_future(runtime.governor.release(session, LOCAL, "end"))
        await cell.expect("human")
        await cell.report("outcome", session, outcome="taken_over", code="operator", facts={"holding": None})
        await done
        review = await runtime.desk.reviews.request(session, ENGINEER)
        for who in (OPERATOR, OPERATOR_2):
            with pytest.raises(Forbidden, match="drove by hand alone"):
                await runtime.desk.reviews.resolve(review["id"], who, "accepted")
        assert (await runtime.desk.reviews.resolve(review["id"], ENGINEER, "accepted"))["status"] == "accepted"


async def test_nobody_takes_over_where_the_profile_has_no_takeover(house: House) -> None:
    async with replace(house, profile="sim-relaxed").open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        assert (await refused(runtime.governor.take_cell("workcell-1", OPERATOR))).code == "takeover_not_enabled"


@pytest.mark.parametrize("idle", [True, False])
async def test_nobody_is_given_controls_that_the_cell_would_not_give_under_a_policy_of_another_site(
    runtime: Runtime, cell: HandCell, idle: bool
) -> None:
    session = None
    if not idle:
        made, _ = await runtime.governor.propose(AGENT, navigate())
        session = made["id"]
        await cell.launched(session)

    async def take() -> Any:
        taking = runtime.governor.take_cell(cell.id, OPERATOR) if session is None else None
        return await (taking or runtime.governor.take_over(str(session), OPERATOR))

    launched, why = len(cell.all("launch")), "the robot works by another site; valid: restart the cell"
    await cell.state(elsewhere=why)
    error = await refused(take())
    assert (error.code, [(one["code"], one["message"]) for one in error.reasons]) == (
        "takeover_refused",
        [("another_site", why)],
    )
    assert (len(cell.all("launch")), runtime.governor.cells()[0]["control"]) == (launched, None)
    await cell.state(elsewhere=why, policy_digest="sha256:another")  # so it said of one before
    await take()
    await cell.expect("launch", launched + 1)


async def test_a_stop_ends_whoever_has_the_controls(runtime: Runtime, cell: HandCell, driving: str) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await runtime.governor.estop("workcell-1", AGENT)
    assert jog(runtime, OPERATOR, lease, 1) == "not_holder"
    assert (await refused(runtime.governor.take_over(driving, OPERATOR))).code == "estop_latched"


async def test_a_lost_link_takes_the_controls_away(runtime: Runtime, cell: HandCell, driving: str) -> None:
    lease = await runtime.governor.take_over(driving, OPERATOR)
    await cell.hang_up()
    assert jog(runtime, OPERATOR, lease, 1) == "not_holder"
    back = HandCell(runtime)
    back.invocation, back.status, back.seq = driving, "running", cell.seq
    await back.dial()
    await back.expect("human")
    assert "let_go" in back.ops()


@pytest.mark.parametrize("idle", [True, False])
async def test_nobody_has_the_controls_of_what_was_lost_with_its_cell(
    runtime: Runtime, cell: HandCell, idle: bool
) -> None:
    if idle:
        name = (await runtime.governor.take_cell("workcell-1", OPERATOR))["invocation"]
    else:
        request = ProposalRequest(capability="navigate_to", params={"target": "dock", "speed_mps": 0.3})
        name = (await runtime.governor.propose(AGENT, request))[0]["id"]
        await cell.launched(name)
        await runtime.governor.take_over(name, OPERATOR)
    await cell.expect("launch", 1 if idle else 2)
    await cell.hang_up()
    back = HandCell(runtime)
    back.seq = cell.seq
    await back.dial()
    await until(lambda: runtime.register.newest(name) is None)
    document = await runtime.governor.invocation(name, OPERATOR)
    assert (document["outcome"], document["takeover"]["state"]) == ("fault", "ended"), document


async def test_a_reset_is_confirmed_by_who_armed_it_and_not_after_another_stop(
    runtime: Runtime, cell: HandCell
) -> None:
    governor = runtime.governor
    await governor.estop("workcell-1", AGENT)

    def arm() -> str:
        return governor.arm_reset("workcell-1", OPERATOR)["arming"]["code"]

    code = arm()
    others = await refused(governor.reset("workcell-1", OPERATOR_2, code))
    own = await refused(governor.reset("workcell-1", OPERATOR, code))
    assert (others.code, own.code) == ("not_armed", "not_armed")
    assert str(others).endswith("and the one that `olivia` armed is off; valid: arm it anew")
    assert str(own).endswith("confirms no reset of `workcell-1`; valid: arm it anew")
    code = arm()
    await governor.estop("workcell-1", AGENT)
    assert (await refused(governor.reset("workcell-1", OPERATOR, code))).code == "not_armed"
    assert not cell.all("reset")
    await governor.reset("workcell-1", OPERATOR, arm())
    assert cell.all("reset")
