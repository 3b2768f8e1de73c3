"""What an answer says beyond yes and no: reason codes, acknowledgements, versions, and phases that wait for a human."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

import orjson
import pytest

from app.audit.errors import RecordUnavailable
from app.clock import rfc3339
from app.governance.policy import PolicySet
from app.governance.policy_model import Confirmation
from app.runtime.assembly import Runtime
from app.runtime.errors import Conflict, InvalidParams
from app.runtime.escalation import read_escalation

from .conftest import AGENT, AUDITOR, OPERATOR, OPERATOR_2, PATIENCE_S, HandCell, House, grasp, navigate, until
from .test_desk import answer, asked, held

pytestmark = pytest.mark.anyio

WAITS = Confirmation(
    capability="navigate_to", profile="human-shared", phases=("drive",), within_s=60.0, on_deny="rollback",
    on_timeout="rollback",
)  # fmt: skip


AT = "2026-03-01T09:30:00.250Z"


async def broken(*_: Any) -> list[int]:
    raise RecordUnavailable("disk full")


# -- denying -----------------------------------------------------------------------------------------------------------


async def test_a_denial_tells_the_agent_its_code_and_policys_words_for_it(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    closed = await answer(runtime, question, decision="deny", code="person_in_the_way", comment="it is Anna again")
    assert {key: closed["denial"][key] for key in ("by", "code", "says")} == {
        "by": "olivia",
        "code": "person_in_the_way",
        "says": "a person is in the way",
    }
    seen = await runtime.governor.invocation(document["id"], AGENT)
    assert [reason["code"] for reason in seen["policy"]["reasons"][-2:]] == ["person_in_the_way", "denied_by_human"]
    assert seen["policy"]["reasons"][-2]["remedy"] == "propose it again when the person has left"
    assert seen["escalation"]["code"] == "person_in_the_way"
    assert b"Anna" not in orjson.dumps([seen, await runtime.governor.trace(document["id"], AGENT)])
    assert b"Anna" in orjson.dumps(await runtime.governor.trace(document["id"], AUDITOR))


async def test_a_denial_without_a_code_is_recorded_with_the_declared_default(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    closed = await answer(runtime, question, decision="deny")
    assert closed["denial"]["code"] == "unspecified"
    event = next(e for e in await runtime.governor.trace(document["id"], AUDITOR) if e["kind"] == "approval")
    assert event["body"]["escalation"]["denial"]["code"] == "unspecified"
    seen = await runtime.governor.invocation(document["id"], AGENT)
    assert seen["escalation"]["code"] == "unspecified"


@pytest.mark.parametrize(
    ("decision", "code", "said"),
    [
        ("deny", "bad_hair_day", "valid: `unspecified`, `person_in_the_way`"),
        ("approve", "not_needed", "with an approval"),
    ],
)
async def test_a_code_that_means_nothing_here_answers_nothing(
    runtime: Runtime, cell: HandCell, decision: str, code: str, said: str
) -> None:
    _, question = await asked(runtime)
    with pytest.raises(InvalidParams, match=said):
        await answer(runtime, question, decision=decision, code=code)
    assert (await runtime.desk.get(question["id"]))["status"] == "pending"


# -- what a question shows ---------------------------------------------------------------------------------------------


async def test_a_question_keeps_what_was_requested_what_policy_left_and_what_was_approved(
    runtime: Runtime, cell: HandCell
) -> None:
    _, question = await asked(runtime, replace(grasp(), params={"object_id": "mug_1", "force_n": 80}))
    assert (question["requested"]["force_n"], question["constrained"]["force_n"], question["approved"]) == (
        80,
        60,
        None,
    )
    assert (question["cell"], question["profile"], question["on_timeout"]) == (cell.id, "human-shared", "deny")
    closed = await answer(runtime, question, params={**question["effective"], "force_n": 30})
    forces = [closed[version]["force_n"] for version in ("requested", "constrained", "approved")]
    assert forces == [80, 60, 30]
    (edit,) = closed["edits"]
    assert (edit["by"], edit["params"]["force_n"], edit["digest"]) == ("olivia", 30, closed["approvals"][0]["digest"])


async def test_an_acknowledgement_shows_who_looks_at_it_and_decides_nothing(runtime: Runtime, cell: HandCell) -> None:
    document, question = await asked(runtime)
    shown: list[dict[str, Any]] = []
    runtime.desk.on_held = lambda escalation: shown.append(escalation.public())
    known = await runtime.desk.acknowledge(question["id"], OPERATOR)
    assert [word["by"] for word in known["acknowledged"]] == ["olivia"]
    assert shown == [known] == [await runtime.desk.get(question["id"])]
    assert await runtime.desk.acknowledge(question["id"], OPERATOR) == known, "saying it again changes nothing"
    both = await runtime.desk.acknowledge(question["id"], OPERATOR_2)
    assert [word["by"] for word in both["acknowledged"]] == ["olivia", "oskar"]
    said = [event.payload() for event in await runtime.store.events(kind="human", invocation=document["id"])]
    assert [body["op"] for body in said] == ["acknowledge", "acknowledge"]
    assert (await answer(runtime, question, who=OPERATOR_2))["status"] == "approved", "the digest is as it was"
    with pytest.raises(Conflict) as late:
        await runtime.desk.acknowledge(question["id"], OPERATOR)
    assert late.value.code == "already_resolved"


async def test_an_acknowledgement_survives_a_restart(house: House) -> None:
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        _, question = await asked(runtime)
        known = await runtime.desk.acknowledge(question["id"], OPERATOR)
    async with house.open() as runtime:
        assert await runtime.desk.get(question["id"]) == known


async def test_the_most_urgent_question_ends_first(house: House, runtime: Runtime, cell: HandCell) -> None:
    _, first = await asked(runtime)
    house.wall_s.offset_s = -60.0
    _, second = await asked(runtime)
    assert [one["id"] for one in runtime.desk.most_urgent()] == [second["id"], first["id"]]
    assert [one["id"] for one in runtime.desk.most_urgent(1)] == [second["id"]]
    held_one = read_escalation(orjson.dumps({**first, "risk": "critical"}))
    assert held_one.urgency < read_escalation(orjson.dumps(first)).urgency
    assert held_one.urgency < replace(held_one, expires_at=None).urgency


async def test_an_agent_that_asks_a_lot_leaves_nobody_else_out_of_a_short_list(
    house: House, runtime: Runtime, cell: HandCell
) -> None:
    first = read_escalation(orjson.dumps((await asked(runtime))[1]))
    ends = (first.deadline_s or 0.0) + 60.0
    few = replace(first, id="esc_few", agent="scout", expires_at=rfc3339(ends))
    held_one = replace(first, id="esc_held", kind="session", expires_at=rfc3339(ends + 1.0))
    many = [replace(first, id=f"esc_{number}") for number in range(9)]
    runtime.desk.hold(*many, few, held_one)
    assert [one["id"] for one in runtime.desk.most_urgent(4)][-2:] == ["esc_few", "esc_held"]
    runtime.desk.hold(*(replace(one, status="withdrawn") for one in (*many, few, held_one)))


def test_a_question_of_an_earlier_release_is_read_back() -> None:
    stored = {
        "id": "esc_1", "invocation": "inv_1", "kind": "approval", "capability": "grasp_object", "agent": "planner",
        "risk": "medium", "reasons": [], "requested": {}, "effective": {}, "digest": "sha256:00", "status": "pending",
        "approvals": [], "needed": 1, "expires_at": None,
        "_": {"constrained": {"force_n": 60}, "created_at": AT, "updated_at": AT},
    }  # fmt: skip
    read = read_escalation(orjson.dumps(stored))
    assert (read.constrained, read.acknowledged, read.on_timeout) == ({"force_n": 60}, (), "deny")
    assert read_escalation(read.row().values["document"]) == replace(
        read, approvals=[], edits=[], acknowledged=[], former_digests=[]
    )


# -- phases that wait --------------------------------------------------------------------------------------------------


@pytest.fixture
async def confirming(house: House, policy: PolicySet) -> AsyncIterator[tuple[Runtime, HandCell]]:
    """Serve a policy in which driving waits for a human's word, and is undone without it."""
    house.policy = replace(policy, authority=replace(policy.authority, confirm_before=(WAITS,)))
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        yield runtime, cell


async def waiting(runtime: Runtime, cell: HandCell) -> tuple[str, dict[str, Any]]:
    document, _ = await runtime.governor.propose(AGENT, navigate())
    session = str(document["id"])
    await cell.launched(session)
    cell.status = "escalated"
    await cell.report("status", session, status="escalated", reason="confirm:drive")
    await cell.report("escalation", session, reason="confirm:drive", failure=None)
    question = runtime.desk.pending_for(session)
    assert question is not None
    return session, question.public()


async def test_a_phase_that_waits_says_which_and_what_follows(confirming: tuple[Runtime, HandCell]) -> None:
    runtime, cell = confirming
    _, question = await waiting(runtime, cell)
    assert (question["kind"], question["phase"]) == ("session", "drive")
    assert (question["on_deny"], question["on_timeout"]) == ("rollback", "rollback")
    assert (question["reasons"][0]["rule"], "`drive`" in question["reasons"][0]["message"]) == (
        "authority/confirm_before",
        True,
    )
    deadline_s = read_escalation(orjson.dumps(question)).deadline_s
    assert deadline_s is not None
    assert deadline_s - runtime.register.now_s() <= 60.0, "the phase's own deadline, not that of every session"
    await answer(runtime, question)
    await until(lambda: cell.ops() == ["confirm"])


async def test_a_denied_phase_is_undone_where_policy_says_so(confirming: tuple[Runtime, HandCell]) -> None:
    runtime, cell = confirming
    session, question = await waiting(runtime, cell)
    closed = await answer(runtime, question, decision="deny", code="unsafe_now")
    assert (closed["status"], closed["denial"]["code"]) == ("denied", "unsafe_now")
    await until(lambda: cell.ops() == ["rollback"])
    assert [word.expired for word in cell.all("human")] == [False]
    await cell.report("status", session, status="recovering")
    seen = await runtime.governor.invocation(session, AGENT)
    assert (seen["status"], seen["escalation"]["code"]) == ("recovering", "unsafe_now")


async def test_silence_about_a_phase_does_what_policy_says_of_it(
    house: House, confirming: tuple[Runtime, HandCell]
) -> None:
    runtime, cell = confirming
    _, question = await waiting(runtime, cell)
    house.wall_s.offset_s = 61.0
    await until(lambda: cell.ops() == ["rollback"])
    assert [word.expired for word in cell.all("human")] == [True]
    await until(lambda: runtime.desk.pending() == [])
    assert (await runtime.desk.get(question["id"]))["status"] == "expired"


async def test_what_cannot_be_recorded_is_not_undone_but_comes_to_rest(
    confirming: tuple[Runtime, HandCell], monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime, cell = confirming
    _, question = await waiting(runtime, cell)
    monkeypatch.setattr(runtime.store, "append", broken)
    with pytest.raises(RecordUnavailable):
        await answer(runtime, question, decision="deny")
    await until(lambda: cell.ops() == ["resolve_terminate"])


async def test_a_cell_that_is_away_is_owed_rest_and_no_undoing(confirming: tuple[Runtime, HandCell]) -> None:
    runtime, cell = confirming
    session, question = await waiting(runtime, cell)
    await cell.hang_up()
    await answer(runtime, question, decision="deny")
    back = await HandCell(runtime, seq=cell.seq, invocation=session, status="escalated").dial()
    await until(lambda: back.ops() == ["resolve_terminate"])


async def test_a_session_that_was_held_already_waits_on_the_phases_terms(confirming: tuple[Runtime, HandCell]) -> None:
    runtime, cell = confirming
    document, question = await held(runtime, cell)
    polling = asyncio.ensure_future(
        runtime.governor.wait(document["id"], AGENT, PATIENCE_S, known_updated_at=document["updated_at"])
    )
    await cell.report("escalation", document["id"], reason="confirm:drive", failure=None)
    again = await runtime.desk.get(question["id"])
    assert (question["phase"], again["phase"], again["on_deny"]) == (None, "drive", "rollback")
    assert again["expires_at"] < question["expires_at"]
    shown = (await runtime.governor.invocation(document["id"], AGENT))["escalation"]
    assert shown == {"id": again["id"], "status": "pending", "expires_at": again["expires_at"]}
    assert (await polling)["escalation"] == shown, "whoever waits for a change hears of this one"


TERMS = ("id", "digest", "phase", "on_deny", "on_timeout", "expires_at", "created_at")


def terms(question: dict[str, Any]) -> dict[str, Any]:
    return {name: question[name] for name in TERMS}


async def test_a_lost_link_leaves_a_phase_its_terms_and_is_said_once(confirming: tuple[Runtime, HandCell]) -> None:
    runtime, cell = confirming
    session, question = await waiting(runtime, cell)
    before = await runtime.governor.invocation(session, AGENT)
    for _ in range(2):
        await cell.report("escalation", session, reason="link", failure=None)
    after = await runtime.desk.get(question["id"])
    assert terms(after) == terms(question)
    assert [one["code"] for one in after["reasons"]] == ["confirm:drive", "link"]
    assert await runtime.governor.invocation(session, AGENT) == before
    await answer(runtime, question)
    await until(lambda: cell.ops() == ["confirm"])


async def test_a_lost_link_takes_no_reason_away_from_a_question(confirming: tuple[Runtime, HandCell]) -> None:
    """Whoever answers for a session that a person stands in the way of is not told of the link alone."""
    runtime, cell = confirming
    document, question = await held(runtime, cell)
    for kind, more in (("status", {"status": "escalated"}), ("escalation", {"failure": None})) * 2:
        await cell.report(kind, document["id"], reason="link", **more)
    after = await runtime.desk.get(question["id"])
    assert [*after["reasons"]][:-1] == [*question["reasons"]]
    assert after["reasons"][-1]["code"] == "link"
    assert after["digest"] == question["digest"]


async def test_a_phase_keeps_its_terms_over_a_restart_of_the_server(house: House, policy: PolicySet) -> None:
    house.policy = replace(policy, authority=replace(policy.authority, confirm_before=(WAITS,)))
    async with house.open() as runtime:
        cell = await HandCell(runtime).dial()
        await cell.state()
        session, question = await waiting(runtime, cell)
    async with house.open() as runtime:
        back = await HandCell(runtime, seq=cell.seq, invocation=session, status="escalated").dial()
        await back.report("escalation", session, reason="link", failure=None)
        assert terms(await runtime.desk.get(question["id"])) == terms(question)
        await answer(runtime, question)
        await until(lambda: back.ops() == ["confirm"])


async def test_a_phase_whose_confirmation_was_lost_is_asked_about_as_that_phase(
    confirming: tuple[Runtime, HandCell],
) -> None:
    runtime, cell = confirming
    session, question = await waiting(runtime, cell)
    await answer(runtime, question)
    await cell.hang_up()
    away = runtime.fleet.cell(cell.id)
    assert away.absent_since_s is not None
    away.absent_since_s -= 0.5
    back = await HandCell(runtime, seq=cell.seq, invocation=session, status="escalated").dial()
    await until(lambda: runtime.desk.pending_for(session) is not None)
    again = runtime.desk.pending_for(session)
    assert again is not None
    assert (again.phase, again.on_deny, again.reasons[0]["code"]) == ("drive", "rollback", "link_returned")
    await answer(runtime, again.public())
    await until(lambda: back.ops() == ["confirm"])
