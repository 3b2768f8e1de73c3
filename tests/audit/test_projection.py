"""What the log states of an invocation, event by event, and what the table `invocations` must say of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import orjson
import pytest

from app.audit.event import Event, EventDraft, prepare
from app.audit.places import Places
from app.audit.projection import PAGE, differences, projection_problems, rebuild
from app.audit.reader import Reader
from app.audit.store import AuditStore
from tests.audit.conftest import TIME, draft, invocation_row

ASKED, BOUND = {"speed_mps": 0.5}, {"speed_mps": 0.25}
PROPOSAL = ("proposal", {"capability": "navigate_to", "filled": ASKED})
WHY, NO = {"rule": "speed", "code": "limited"}, {"rule": "runtime", "code": "denied_by_human"}
ADMITTED, WAITING = {"outcome": "accept", "reasons": []}, {"outcome": "defer", "reasons": [WHY], "retry_after_s": 2}
SAID, EDITED = ({"outcome": name, "reasons": [WHY], "changes": []} for name in ("modify", "allow"))
DECIDED = {"cell": "workcell-1", "profile": "human-shared", "status": "awaiting_approval"}
ADMISSION = ("admission", {**DECIDED, **ADMITTED})
POLICY = ("policy", {"effective": BOUND, "policy_version": "sha256:a", **SAID})
ASKED_FOR = {"id": "esc_1", "kind": "approval", "status": "pending", "expires_at": TIME}
APPROVAL = ("approval", {"escalation": {"effective": {"speed_mps": 0.1}}})


def permitted(capability: str, digest: str, params: dict[str, float]) -> tuple[str, dict[str, Any]]:
    return "authorization", {"authorization": {"capability": capability, "params": params, "policy_digest": digest}}


AUTHORIZATION = permitted("navigate_to", "sha256:b", BOUND)
ASKING = ("escalation", {"escalation": {"kind": "session", "status": "pending"}})
STOPPED = ("outcome", {"outcome": "stopped"})
UNSENT_WORD = ("cell", {"what": "not_sent", "op": "resume", "code": "grant_ended"})
UNSENT = ("cell", {**UNSENT_WORD[1], "authorization": "auth_2", "policy_version": "sha256:b"})
TAKEN = ("human", {"op": "takeover"})
Told = tuple[str, dict[str, Any]]


def event(place: int, told: Told, actor: str = "planner") -> Event:
    kind, body = told
    return prepare(EventDraft(kind=kind, actor=actor, invocation="inv_1", body=body), TIME).seal(place)


def told(*events: Told) -> dict[str, Any]:
    return rebuild([event(place, found) for place, found in enumerate(events, 7)])


def status(name: str) -> Told:
    return ("status", {"status": name})


def question(word: str = "escalation", **changes: Any) -> Told:
    return (word, {"escalation": {**ASKED_FOR, "effective": BOUND, **changes}})


def again(told: Told, **changes: Any) -> Told:
    return (told[0], {**told[1], "recheck": True, **changes})


def test_nothing_told_is_nothing_known() -> None:
    assert rebuild([]) == {}


def test_a_whole_way_from_proposal_to_outcome() -> None:
    proposal = ("proposal", {**PROPOSAL[1], "created_at": TIME})
    assert told(proposal, ADMISSION, POLICY, APPROVAL, AUTHORIZATION, status("paused"), STOPPED) == {
        "id": "inv_1", "created_seq": 7, "status": "failed", "capability": "navigate_to", "agent": "planner",
        "cell": "workcell-1", "profile": "human-shared", "policy_version": "sha256:b", "requested": ASKED,
        "effective": BOUND, "outcome": "stopped", "admission": ADMITTED, "policy": SAID, "escalation": None,
        "created_at": TIME,
    }  # fmt: skip


RUN = (PROPOSAL, ADMISSION, POLICY, AUTHORIZATION)
ASKING_FIRST = (PROPOSAL, ADMISSION, POLICY, question())
APPROVED = question("approval", status="approved")
EDITED_BY_HUMAN = ("approval", {**question("approval", status="approved", edits=[{}])[1], "policy": EDITED})
DENIED = question("approval", status="denied", denial={"code": "unsafe", "says": "not now"})
ENDED = ("outcome", {"outcome": "denied", "status": "denied", "reasons": [NO]})
OVER_TIME = ("outcome", {"outcome": "expired", "status": "denied", "reasons": [NO]})
UNFIT = ("outcome", {"outcome": "rejected", "status": "rejected", "reasons": [NO]})
GONE = ("outcome", {"outcome": "stopped", "withdrawn": "esc_1"})
LATE = again(ADMISSION, status="deferred", **WAITING)
ALTERED = again(POLICY, outcome="allow")
REFUSED = ("admission", {**ADMISSION[1], "status": "rejected"})
UNCHECKED = ("admission", {**REFUSED[1], "context": {"policy_version": "sha256:d"}})
STATES: list[tuple[tuple[Told, ...], dict[str, Any]]] = [
    ((PROPOSAL,), {"effective": ASKED, "outcome": None}),
    ((PROPOSAL, ADMISSION), {"status": "awaiting_approval", "outcome": None}),
    ((PROPOSAL, REFUSED), {"status": "rejected", "outcome": "rejected"}),
    ((PROPOSAL, ADMISSION, POLICY), {"effective": BOUND, "policy_version": "sha256:a"}),
    ((PROPOSAL, ADMISSION, POLICY, UNCHECKED), {"effective": BOUND, "policy_version": "sha256:d"}),  # decided again
    ((PROPOSAL, ADMISSION, POLICY, APPROVAL), {"effective": {"speed_mps": 0.1}}),
    (RUN, {"status": "running", "effective": BOUND, "policy_version": "sha256:b"}),
    ((*RUN, REFUSED), {"status": "running", "outcome": None}),  # asked again within the session
    ((*RUN, ("policy", {"effective": ASKED, "policy_version": "sha256:c"})), {"effective": BOUND, "policy_version": "sha256:b"}),
    ((*RUN, APPROVAL), {"effective": BOUND}),
    ((*RUN, permitted("takeover", "sha256:c", {})), {"effective": BOUND, "policy_version": "sha256:b"}),
    ((*RUN, permitted("navigate_to", "sha256:c", {})), {"effective": BOUND, "policy_version": "sha256:c"}),
    ((*RUN, permitted("navigate_to", "sha256:c", {}), UNSENT), {"policy_version": "sha256:b"}),
    ((*RUN, permitted("navigate_to", "sha256:c", {}), UNSENT_WORD), {"policy_version": "sha256:c"}),  # as earlier releases said it
    ((*RUN, status("paused")), {"status": "paused"}),
    ((*RUN, status("completed")), {"status": "running"}),  # the outcome says it
    ((*RUN, ASKING), {"status": "escalated"}),
    ((*RUN, ("escalation", {"escalation": {"kind": "session", "status": "approved"}})), {"status": "running"}),
    ((*RUN, ("escalation", {"escalation": {"kind": "approval", "status": "pending"}})), {"status": "running"}),
    ((*RUN, ("escalation", {})), {"status": "running"}),
    ((*RUN, STOPPED, ASKING), {"status": "failed"}),
    ((*RUN, STOPPED, status("running")), {"status": "failed"}),
    ((*RUN, STOPPED, ("outcome", {"outcome": "succeeded"})), {"status": "failed", "outcome": "stopped"}),
    ((*RUN, ("outcome", {"outcome": "succeeded"})), {"status": "completed", "outcome": "succeeded"}),
    ((PROPOSAL, ADMISSION, ("outcome", {"outcome": "expired", "status": "denied"})), {"status": "denied", "outcome": "expired"}),
    ((TAKEN,), {"capability": "takeover", "agent": "planner", "outcome": None}),
    ((PROPOSAL, TAKEN), {"capability": "navigate_to"}),
    ((("human", {"op": "stop"}),), {"id": "inv_1"}),
    (ASKING_FIRST, {"admission": ADMITTED, "policy": SAID, "escalation": {"id": "esc_1", "status": "pending", "expires_at": TIME}}),
    ((PROPOSAL, ADMISSION), {"admission": ADMITTED, "policy": None, "escalation": None}),
    ((PROPOSAL, ("admission", DECIDED)), {"status": "awaiting_approval", "admission": "nothing", "policy": "nothing"}),
    ((PROPOSAL, LATE), {"admission": WAITING, "policy": None}),
    ((*ASKING_FIRST, again(ADMISSION), ALTERED), {"policy": {**SAID, "outcome": "allow"}}),  # under another policy
    ((*ASKING_FIRST, APPROVED, again(ADMISSION, outcome="x"), ALTERED), {"admission": ADMITTED, "policy": SAID}),  # only checked
    ((*ASKING_FIRST, APPROVED, LATE, ALTERED), {"admission": WAITING, "policy": {**SAID, "outcome": "allow"}}),  # ended by it
    ((*ASKING_FIRST, EDITED_BY_HUMAN, again(ADMISSION), ALTERED), {"policy": EDITED}),
    ((*ASKING_FIRST, question("approval", edits=[{}])), {"policy": "nothing"}),  # as earlier releases recorded an edit
    ((*ASKING_FIRST, DENIED, ENDED), {"policy": {**SAID, "reasons": [WHY, NO]}, "escalation": {"id": "esc_1", "status": "denied", "expires_at": TIME, "code": "unsafe"}}),
    ((*ASKING_FIRST, OVER_TIME), {"policy": {**SAID, "reasons": [WHY, NO]}, "admission": ADMITTED}),
    ((PROPOSAL, ADMISSION, OVER_TIME), {"policy": None, "outcome": "expired"}),
    ((*ASKING_FIRST, UNFIT), {"policy": SAID, "admission": {"outcome": "reject", "reasons": [NO]}}),
    ((*RUN, question(), ("launch", {"withdrawn": "esc_2"})), {"escalation": {"id": "esc_1", "status": "pending", "expires_at": TIME}}),
    ((*RUN, question(), ("launch", {"withdrawn": "esc_1"})), {"escalation": {"id": "esc_1", "status": "withdrawn", "expires_at": TIME}}),
    ((*RUN, question(), GONE), {"escalation": {"id": "esc_1", "status": "withdrawn", "expires_at": TIME}, "outcome": "stopped"}),
    ((*RUN, question(), STOPPED, question(status="withdrawn")), {"escalation": {"id": "esc_1", "status": "withdrawn", "expires_at": TIME}}),
    ((*RUN, STOPPED, question()), {"escalation": None}),  # a late word of the cell's
    ((*RUN, question("approval", edits=[{}])), {"policy": SAID}),
    ((("telemetry", {}), PROPOSAL), {"created_seq": 8, "capability": "navigate_to"}),
    ((("human", {"op": "estop"}), PROPOSAL, ADMISSION), {"created_seq": 8, "agent": "planner", "capability": "navigate_to"}),
    ((PROPOSAL, ("human", {"op": "estop"}), PROPOSAL), {"created_seq": 7}),
    ((TAKEN, ("human", {"op": "estop"})), {"created_seq": 7, "capability": "takeover"}),
    ((("human", {"op": "estop"}), ("human", {"op": "reset"}), TAKEN), {"created_seq": 9, "capability": "takeover"}),
]  # fmt: skip


@pytest.mark.parametrize(("events", "states"), STATES)
def test_what_each_event_states(events: tuple[Told, ...], states: dict[str, Any]) -> None:
    known = told(*events)
    assert {name: known.get(name, "nothing") for name in states} == states
    assert not [name for name in known if name.startswith("_")]


def test_no_cell_says_by_which_version_its_session_is_bound() -> None:
    reported = ("cell", {**UNSENT[1], "cell_seq": 7})
    assert told(*RUN, permitted("navigate_to", "sha256:c", {}), reported)["policy_version"] == "sha256:c"


@pytest.mark.parametrize(
    "odd", [("proposal", {}), status("asleep"), ("outcome", {"outcome": 3}), ("approval", {"escalation": None})]
)
def test_an_event_that_no_server_wrote_is_named(odd: Told) -> None:
    with pytest.raises(ValueError, match="event `7` cannot be followed"):
        told(odd)


def row(known: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {**known, "document": orjson.dumps(known), **changes}


def test_says_where_a_row_is_not_what_the_log_makes_of_it() -> None:
    known = {**told(*RUN, question()), "created_at": TIME}
    assert differences(row(known), known) == []
    assert differences(row(known, status="completed"), known) == [
        "column `status` is `completed`, the log makes it `running`"
    ]
    changed = {**known, "effective": {"speed_mps": 2.0}}
    assert differences(row(known, document=orjson.dumps(changed)), known) == [
        '`effective` is `{"speed_mps":2.0}`, the log makes it `{"speed_mps":0.25}`'
    ]
    later = {
        **known,
        "escalation": {**known["escalation"], "expires_at": "later"},
    }  # another phase of the same question
    assert differences(row(known, document=orjson.dumps(later)), known) == []
    for other in (None, {}, {**known["escalation"], "status": "approved"}, {**known["escalation"], "code": "unsafe"}):
        (problem,) = differences(row(known, document=orjson.dumps({**known, "escalation": other})), known)
        assert problem.startswith("`escalation` is `")
    for name, other in (("admission", WAITING), ("policy", EDITED), ("policy", None), ("created_at", "1999")):
        (problem,) = differences(row(known, document=orjson.dumps({**known, name: other})), known)
        assert problem.startswith(f"`{name}` is `")
    (long,) = differences(row(known, agent="x" * 99), known)
    assert f"`{'x' * 77}…`" in long
    assert differences(row(known, document=b"{"), known) == ["its document is no JSON"]
    assert differences(row(known, document=None), known) == ["its document is no JSON"]
    assert differences(row(known, document=b"[]"), known) == ["its document is no object"]


@pytest.mark.anyio
async def test_compares_every_row_of_a_record_page_by_page(store: AuditStore, data: Path) -> None:
    for number in range(PAGE + 2):
        name = f"inv_{number:03}"
        document = {"id": name, "status": "running", "capability": "navigate_to", "agent": "planner"}
        kept = {**document, "requested": ASKED, "effective": ASKED}
        columns = {"capability": "navigate_to", "document": orjson.dumps(kept)}
        await store.append([draft(invocation=name, **PROPOSAL[1])], rows=[invocation_row(name, **columns)])
    reader = Reader(Places(data).database)
    assert projection_problems(reader, limit=5) == []
    await store.append([], rows=[invocation_row("inv_051", **{**columns, "agent": "stranger"})])
    await store.append([], rows=[invocation_row("inv_x")])
    await store.append([draft("admission", "inv_y")])
    await store.append([draft("admission", "inv_z")], rows=[invocation_row("inv_z")])
    lost, changed, alone, odd = projection_problems(reader, limit=5)
    assert lost == "`inv_y`: the log knows it, the table `invocations` does not"
    assert changed.startswith("`inv_051`: column `agent` is `stranger`")
    assert alone == "`inv_x`: the log knows nothing of it"
    assert "`inv_z`: event" in odd
    assert projection_problems(reader, limit=2) == [lost, changed]
    assert projection_problems(reader, limit=1) == [lost]
    reader.close()
