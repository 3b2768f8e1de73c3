"""Standing grants: what they spare a human, what they never do, and everything that ends them."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import replace
from typing import Any

import orjson
import pytest

from app.audit.errors import RecordUnavailable
from app.audit.store import AuditStore
from app.governance import bundle
from app.governance.model import GrantScope, Risk, Role
from app.governance.policy import PolicySet
from app.governance.policy_model import GrantTerms
from app.runtime import roster
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, Forbidden, InvalidParams, NotFound
from app.runtime.grant import GrantRequest, Offer, read_standing
from app.runtime.grants import MOST_GRANTS
from app.runtime.invocation import Principal, ProposalRequest

from .conftest import AGENT, AUDITOR, CELL, ENGINEER, OPERATOR, HandCell, House, grasp, until
from .test_desk import answer, asked, holding

pytestmark = pytest.mark.anyio

REQUEST = GrantRequest(capability="grasp_object", agent="planner", cell=CELL, scope=GrantScope.TIME, minutes=10.0)
MUGS = replace(REQUEST, scope=GrantScope.OBJECT, object="mug_1")


async def grant(runtime: Runtime, request: GrantRequest = REQUEST) -> dict[str, Any]:
    return await runtime.desk.grants.give(OPERATOR, request)


async def status(runtime: Runtime, request: ProposalRequest | None = None) -> str:
    return str((await runtime.governor.check(AGENT, request or grasp()))["status"])


async def newest(runtime: Runtime) -> dict[str, Any]:
    return (await runtime.desk.grants.list())[0][0]


async def test_a_grant_launches_what_would_be_asked_about_and_all_of_it_says_so(
    runtime: Runtime, cell: HandCell
) -> None:
    assert await status(runtime) == "awaiting_approval"
    given = await grant(runtime)
    assert await status(runtime) == "allowed"
    document, _ = await runtime.governor.propose(AGENT, replace(grasp(), params={"object_id": "mug_1", "force_n": 140}))
    assert (document["status"], document["grant"], document["escalation"]) == ("running", given["id"], None)
    assert document["effective"]["force_n"] == 60, "a grant widens nothing"
    trace = await runtime.governor.trace(document["id"], AUDITOR)
    said = {event["kind"]: event["body"].get("grant") for event in trace if event["kind"] != "proposal"}
    assert said == dict.fromkeys(("admission", "policy", "authorization"), given["id"])
    assert trace[-1]["body"]["authorization"]["approvals"] == [f"grant:{given['id']}"]
    used = await newest(runtime)
    assert (used["uses"], used["used_at"] is not None) == (1, True)
    await cell.launched(document["id"])
    await cell.ended(document["id"], "succeeded")
    assert (await runtime.governor.invocation(document["id"], AGENT))["grant"] == given["id"]


async def test_a_grant_for_an_object_asks_about_another(runtime: Runtime, cell: HandCell) -> None:
    await grant(runtime, MUGS)
    assert await status(runtime) == "allowed"
    assert await status(runtime, replace(grasp(), params={"object_id": "driver_1"})) == "awaiting_approval"


async def test_a_grant_is_given_with_an_approval_and_with_its_record(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    closed = await answer(runtime, question, offer=Offer(scope=GrantScope.OBJECT, minutes=5.0))
    given = await newest(runtime)
    assert (closed["grant"], given["object"], given["invocation"]) == (given["id"], "mug_1", document["id"])
    kinds = [event["kind"] for event in await runtime.governor.trace(document["id"], AUDITOR)]
    assert kinds[4:6] == ["approval", "grant"]
    await cell.launched(document["id"])
    await cell.ended(document["id"], "succeeded")
    assert await status(runtime) == "allowed"


async def test_a_grant_for_a_task_takes_the_task_that_was_asked_about(runtime: Runtime, cell: HandCell) -> None:
    tidying = grasp(metadata={"task": "tidy up"})
    document, question = await asked(runtime, tidying)
    assert (question["names_task"], question["task"]) == (True, "tidy up")
    await answer(runtime, question, offer=Offer(scope=GrantScope.TASK, minutes=5.0))
    await cell.launched(document["id"])
    await cell.ended(document["id"], "succeeded")
    assert (await status(runtime, tidying), await status(runtime)) == ("allowed", "awaiting_approval")


@pytest.mark.parametrize("metadata", [{}, {"task": None}, {"task": ["tidy up"]}])
async def test_a_question_about_no_task_says_so_and_no_grant_is_for_it(
    runtime: Runtime, cell: HandCell, metadata: dict[str, Any]
) -> None:
    _, question = await asked(runtime, grasp(metadata=metadata))
    assert (question["names_task"], question["task"]) == (False, None)
    with pytest.raises(InvalidParams, match="`task` goes with the scope `task`"):
        await answer(runtime, question, offer=Offer(scope=GrantScope.TASK, minutes=5.0))


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ({"object": "glass_1"}, "`grant.object` `glass_1` is not what was shown; valid: `mug_1`"),
        ({"task": "tidy down"}, "`grant.task` `tidy down` is not what was shown; valid: `tidy up`"),
    ],
)
async def test_a_grant_that_goes_with_an_approval_is_for_nothing_else_than_was_shown(
    runtime: Runtime, cell: HandCell, named: dict[str, str], said: str
) -> None:
    _, question = await asked(runtime, grasp(metadata={"task": "tidy up"}))
    (scope,) = named
    with pytest.raises(InvalidParams, match=said):
        await answer(runtime, question, offer=Offer(scope=GrantScope(scope), minutes=5.0, **named))
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"
    assert runtime.desk.grants.active() == []
    shown = {"object": "mug_1", "task": "tidy up"}[scope]
    await answer(runtime, question, offer=Offer(scope=GrantScope(scope), minutes=5.0, **{scope: shown}))
    assert (await newest(runtime))[scope] == shown


async def test_a_grant_with_an_approval_of_a_carry_is_for_what_is_held(runtime: Runtime, cell: HandCell) -> None:
    await holding(cell, "mug_1")
    carry = ProposalRequest(capability="transport_object", params={"target": "dock"})
    _, question = await asked(runtime, carry)
    with pytest.raises(InvalidParams, match="`driver_1` is not what was shown; valid: `mug_1`"):
        await answer(runtime, question, offer=Offer(scope=GrantScope.OBJECT, minutes=5.0, object="driver_1"))
    await answer(runtime, question, offer=Offer(scope=GrantScope.OBJECT, minutes=5.0, object="mug_1"))
    assert (await newest(runtime))["object"] == "mug_1"


@pytest.mark.parametrize("more", [{"decision": "deny"}, {"params": {"object_id": "mug_1", "force_n": 10}}])
async def test_no_grant_goes_with_a_denial_or_an_edit(runtime: Runtime, cell: HandCell, more: dict[str, Any]) -> None:
    _, question = await asked(runtime)
    with pytest.raises(InvalidParams, match="goes with an approval"):
        await answer(runtime, question, offer=Offer(scope=GrantScope.TIME, minutes=5.0), **more)
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"
    assert runtime.desk.grants.active() == []


@pytest.mark.parametrize(
    ("differs", "said"),
    [
        ({"object": "mug_1"}, "`object` goes with the scope `object`"),
        ({"scope": GrantScope.TASK}, "`task` goes with the scope `task`"),
        ({"minutes": 1e-9}, "`minutes` `1e-09` is too short: valid are at least 0.01"),
    ],
)
async def test_a_grant_that_fits_nothing_is_refused_by_name(
    runtime: Runtime, cell: HandCell, differs: dict[str, Any], said: str
) -> None:
    with pytest.raises(InvalidParams, match=said):
        await grant(runtime, replace(REQUEST, **differs))
    assert await runtime.desk.grants.list() == ([], None)


@pytest.mark.parametrize(
    ("differs", "code", "said"),
    [
        ({"capability": "dance"}, "unknown_capability", "`capability` names no capability there is: `dance`; valid: "),
        ({"agent": "stranger"}, "unknown_agent", "names no agent there is: `stranger`; valid: `planner`"),
        ({"cell": "elsewhere"}, "unknown_cell", "names no cell there is: `elsewhere`; valid: "),
        ({"scope": GrantScope.OBJECT, "object": "unicorn"}, "unknown_object", "names no object there is: `unicorn`"),
        ({"minutes": 15.5}, "too_long", "`minutes` `15.5` is longer than policy allows; valid: at most 15"),
        ({"profile": "sim-relaxed"}, None, "valid is `human-shared`"),
    ],
)
async def test_a_grant_that_does_not_go_as_things_stand_is_a_conflict(
    runtime: Runtime, cell: HandCell, differs: dict[str, Any], code: str | None, said: str
) -> None:
    with pytest.raises(Conflict, match=said) as refused:
        await grant(runtime, replace(REQUEST, **differs))
    found = (refused.value.status, refused.value.code, [reason["code"] for reason in refused.value.reasons])
    assert found == ((409, "profile_changed", []) if code is None else (409, "grant_refused", [code]))
    assert await runtime.desk.grants.list() == ([], None)


async def test_what_policy_does_not_let_be_granted_is_refused_with_its_reason(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    async def reason(request: GrantRequest) -> str:
        with pytest.raises(Conflict) as refused:
            await grant(runtime, request)
        assert refused.value.code == "grant_refused"
        return str(refused.value.reasons[0]["code"])

    assert await reason(replace(REQUEST, capability="navigate_to")) == "nothing_to_grant"
    with pytest.raises(Forbidden, match="themselves"):
        await runtime.desk.grants.give(Principal(name="planner", role=Role.OPERATOR), REQUEST)
    for _ in range(MOST_GRANTS):
        await grant(runtime)
    assert await reason(REQUEST) == "too_many"
    await runtime.governor.estop(CELL, ENGINEER)
    assert await reason(REQUEST) == "estop_latched"


async def test_critical_risk_is_never_granted(house: House, policy: PolicySet) -> None:
    package = replace(policy.capabilities["grasp_object"], risk=Risk.CRITICAL)
    gates = {
        pair: replace(gate, capability=package) if pair[0] == "grasp_object" else gate
        for pair, gate in policy.gates.items()
    }
    everything = replace(policy.authority, grants=GrantTerms(up_to_s=900.0, risks=frozenset(Risk)))
    capabilities = {**policy.capabilities, "grasp_object": package}
    house.policy = replace(policy, capabilities=capabilities, gates=gates, authority=everything)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        with pytest.raises(Conflict) as refused:
            await grant(runtime)
        assert refused.value.reasons[0]["code"] == "risk_not_granted"


# -- ending ------------------------------------------------------------------------------------------------------------


async def end(runtime: Runtime) -> tuple[str, str]:
    """Return how the newest grant ended and who did it, once it has and the record says so."""
    await until(lambda: runtime.desk.grants.active() == [])
    await runtime.desk.grants.record_ends()
    ended = (await newest(runtime))["ended"]
    event = (await runtime.store.events(kind="grant"))[-1]
    assert (event.actor, event.payload()["op"]) == (ended["by"], "ended")
    assert await status(runtime) in {"awaiting_approval", "rejected"}
    return ended["code"], ended["by"]


async def test_a_revoked_grant_ends_at_once_and_once(runtime: Runtime, cell: HandCell) -> None:
    given = await grant(runtime)
    shown: list[str] = []
    runtime.desk.grants.on_changed = lambda standing: shown.append(standing.status)
    revoked = await runtime.desk.grants.revoke(given["id"], OPERATOR)
    assert (revoked["status"], revoked["recorded"], shown) == ("ended", True, ["ended"])
    assert await end(runtime) == ("revoked", "olivia")
    with pytest.raises(Conflict) as again:
        await runtime.desk.grants.revoke(given["id"], OPERATOR)
    assert again.value.code == "grant_ended"
    with pytest.raises(NotFound):
        await runtime.desk.grants.revoke("gr_none", OPERATOR)


async def test_a_grant_ends_with_its_time(house: House, runtime: Runtime, cell: HandCell) -> None:
    await grant(runtime)
    house.wall_s.offset_s = 601.0
    assert await status(runtime) == "awaiting_approval", "even before anybody has looked"
    assert await end(runtime) == ("expired", "server")


@pytest.mark.parametrize("restarted", [False, True])
async def test_a_grant_lasts_no_longer_because_the_clock_is_put_back(house: House, restarted: bool) -> None:
    async with house.open() as runtime, asyncio.timeout(10.0):
        cell = await HandCell(runtime).dial()
        await cell.state()
        await grant(runtime, replace(REQUEST, minutes=0.02))
        if not restarted:
            await ended_while_the_clock_is_put_back(house, runtime)
            await runtime.desk.grants.record_ends()
            assert (await newest(runtime))["ended"]["code"] == "expired"
    if restarted:
        async with house.open() as runtime, asyncio.timeout(10.0):
            await ended_while_the_clock_is_put_back(house, runtime)


async def ended_while_the_clock_is_put_back(house: House, runtime: Runtime) -> None:
    """Return once nothing is granted, although it never gets later by the clock than when it was."""
    while runtime.desk.grants.active():
        await asyncio.sleep(0.05)
        house.wall_s.offset_s -= 0.05


async def test_a_grant_ends_with_a_start_that_finds_the_clock_put_back(house: House) -> None:
    async with house.open() as runtime:
        await (await HandCell(runtime).dial()).state()
        await grant(runtime)
    async with house.open() as runtime:
        assert len(runtime.desk.grants.active()) == 1
    house.wall_s.offset_s = -3600.0
    async with house.open() as runtime:
        assert runtime.desk.grants.active() == []
        assert (await newest(runtime))["ended"]["code"] == "expired"


async def test_an_emergency_stop_ends_every_grant_on_its_cell(runtime: Runtime, cell: HandCell) -> None:
    await grant(runtime)
    await runtime.governor.estop(CELL, ENGINEER)
    assert await end(runtime) == ("estop", "erin")
    cell.latched = True
    await cell.state()
    cell.latched = False
    await runtime.governor.reset(CELL, OPERATOR)
    await cell.state()
    assert await status(runtime) == "awaiting_approval", "a reset gives nothing back"


@pytest.mark.parametrize("with_an_approval", [False, True])
async def test_a_grant_that_was_being_recorded_ends_with_the_stop_that_was_said_and_left_meanwhile(
    runtime: Runtime, cell: HandCell, with_an_approval: bool
) -> None:
    question = (await asked(runtime))[1] if with_an_approval else {}
    slow = threading.Event()
    runtime.register.store._committer.submit(slow.wait)
    if with_an_approval:
        offer = Offer(scope=GrantScope.TIME, minutes=10.0)
        given = asyncio.create_task(answer(runtime, question, grant=offer))
    else:
        given = asyncio.create_task(runtime.desk.grants.give(OPERATOR, REQUEST))
    await asyncio.sleep(0)
    stopped = asyncio.create_task(runtime.governor.estop(CELL, ENGINEER))
    await asyncio.sleep(0)
    left = asyncio.create_task(runtime.governor.reset(CELL, OPERATOR))
    await asyncio.sleep(0)
    slow.set()
    await asyncio.gather(given, stopped, left, return_exceptions=True)
    assert not runtime.fleet.cell(CELL).latched
    assert runtime.desk.grants.active() == []


async def test_a_stop_that_the_cell_latched_itself_ends_them_too(runtime: Runtime, cell: HandCell) -> None:
    await grant(runtime)
    cell.latched = True
    await cell.state()
    assert await end(runtime) == ("estop", "server")


async def test_another_profile_ends_them(runtime: Runtime, cell: HandCell) -> None:
    await grant(runtime)
    await runtime.governor.set_profile(CELL, "human-shared", ENGINEER)
    assert len(runtime.desk.grants.active()) == 1, "the same profile is no other"
    await runtime.governor.set_profile(CELL, "real-restricted", ENGINEER)
    await runtime.governor.set_profile(CELL, "human-shared", ENGINEER)
    assert await end(runtime) == ("profile_changed", "erin")


async def test_a_grant_on_a_cell_that_makes_room_for_others_stands(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await grant(runtime)
    await cell.hang_up()
    monkeypatch.setattr(roster, "MOST_CELLS", 1)
    monkeypatch.setattr(roster, "FORGOTTEN_S", 0.0)
    other = await HandCell(runtime, id="workcell-2").dial()
    assert not runtime.fleet.knows(CELL)
    runtime.desk.grants.look()
    assert len(runtime.desk.grants.active()) == 1
    await other.hang_up()
    back = await HandCell(runtime).dial()
    await back.state()
    assert await status(runtime) == "allowed"


async def test_a_grant_ends_with_the_authority_of_who_gave_it(house: House, runtime: Runtime, cell: HandCell) -> None:
    given = await grant(runtime)
    house.withdrawn.add("olivia")
    assert await status(runtime) == "awaiting_approval", "even before anybody has looked"
    assert not runtime.desk.grants.stands(given["id"])
    assert await end(runtime) == ("giver_withdrawn", "server")
    house.withdrawn.clear()
    assert await status(runtime) == "awaiting_approval", "a new token gives nothing back"


async def test_a_grant_ends_with_who_gave_it_while_no_server_ran(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        await grant(runtime)
    house.withdrawn.add("olivia")
    async with house.open() as runtime:
        assert runtime.desk.grants.active() == []
        assert (await newest(runtime))["ended"]["code"] == "giver_withdrawn"


async def test_a_grant_survives_a_restart_and_not_another_policy(house: House, policy: PolicySet) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        given = await grant(runtime, MUGS)
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        assert [one.public() for one in runtime.desk.grants.active()] == [given]
        assert await status(runtime) == "allowed"
    house.policy = bundle.load_files({**policy.files, "site.yaml": f"{policy.files['site.yaml']}# surveyed again\n"})
    async with house.open() as runtime:
        assert (await newest(runtime))["ended"]["code"] == "policy_changed"


@pytest.mark.parametrize(
    "changes",
    [{"id": "grant_forged"}, {"ended": None, "status": "active"}, {"agent": "somebody"}],
    ids=["never given", "ended", "for another agent"],
)
async def test_a_grant_that_only_its_row_knows_holds_for_nothing(house: House, changes: dict[str, Any]) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        given = await grant(runtime, MUGS)
        if "ended" in changes:
            await runtime.desk.grants.revoke(given["id"], OPERATOR)
    forged = {**given, **changes}
    store = AuditStore.open(house.folder)
    row = read_standing(orjson.dumps(forged)).row()
    await store.append([], [row])
    await store.close()
    house.sound = False  # what is left is not what the log says
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        assert forged["id"] not in [one.id for one in runtime.desk.grants.active()]
        listed, _ = await runtime.desk.grants.list()
        assert forged["id"] not in [one["id"] for one in listed]
        assert forged["id"] in (runtime.desk.grants.trouble() or "")
        with pytest.raises(NotFound):
            await runtime.desk.grants.revoke(forged["id"], OPERATOR)
        held = "id" in changes  # then what was given in truth holds as before
        assert await status(runtime) == ("allowed" if held else "awaiting_approval")


async def test_an_end_that_cannot_be_recorded_holds_all_the_same(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = await grant(runtime)

    async def broken(*_: Any) -> list[int]:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", broken)
    revoked = await runtime.desk.grants.revoke(given["id"], OPERATOR)
    assert (revoked["status"], revoked["recorded"]) == ("ended", False)
    assert await status(runtime) == "awaiting_approval"
    assert (await newest(runtime))["status"] == "ended"
    monkeypatch.undo()
    assert await end(runtime) == ("revoked", "olivia")


@pytest.mark.parametrize("how", ["revoked", "giver withdrawn"])
async def test_a_launch_is_not_sent_when_its_grant_ends_while_it_is_recorded(
    house: House, runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    await grant(runtime)
    grants, use = runtime.desk.grants, runtime.desk.grants.use
    monkeypatch.setattr(grants, "look", lambda: None)  # nobody looks in time

    def end() -> None:
        if how == "revoked":
            grants.drop(CELL, "revoked", "olivia")
        else:
            house.withdrawn.add("olivia")

    def soon(grant_id: str | None) -> Any:
        asyncio.get_running_loop().call_soon(end)
        return use(grant_id)

    monkeypatch.setattr(grants, "use", soon)
    document, _ = await runtime.governor.propose(AGENT, grasp())
    await until(lambda: runtime.register.newest(document["id"]) is None)
    over = await runtime.governor.invocation(document["id"], AGENT)
    assert over["failure"]["reasons"][0]["code"] == "grant_ended"
    assert runtime.fleet.cell(CELL).claim is None
    assert not cell.all("launch")


async def test_a_grant_whose_giver_is_withdrawn_between_decision_and_record_answers_for_nothing(
    house: House, runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await grant(runtime)
    use = runtime.desk.grants.use

    def late(grant_id: str | None) -> Any:
        house.withdrawn.add("olivia")
        return use(grant_id)

    monkeypatch.setattr(runtime.desk.grants, "use", late)
    document, _ = await runtime.governor.propose(AGENT, grasp())
    assert (document["status"], "grant" in document) == ("awaiting_approval", False)
    assert not cell.all("launch")


async def test_a_grant_that_ends_between_decision_and_record_answers_for_nothing(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    await grant(runtime)
    use = runtime.desk.grants.use

    def late(grant_id: str | None) -> Any:
        runtime.desk.grants.drop(CELL, "revoked", "olivia")
        return use(grant_id)

    monkeypatch.setattr(runtime.desk.grants, "use", late)
    document, _ = await runtime.governor.propose(AGENT, grasp())
    assert (document["status"], "grant" in document) == ("awaiting_approval", False)
    assert runtime.fleet.cell(CELL).claim is None
    assert not cell.all("launch")


async def test_a_launch_that_could_not_be_recorded_is_no_use_of_its_grant(
    runtime: Runtime, cell: HandCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = await grant(runtime)

    async def fails(*_: Any) -> Any:
        raise RecordUnavailable("disk full")

    monkeypatch.setattr(runtime.store, "append", fails)
    with pytest.raises(RecordUnavailable):
        await runtime.governor.propose(AGENT, grasp())
    monkeypatch.undo()
    (standing,) = runtime.desk.grants.active()
    assert (standing.id, standing.uses, standing.used_at) == (given["id"], 0, None)
    await runtime.governor.propose(AGENT, grasp())
    assert (await newest(runtime))["uses"] == 1
