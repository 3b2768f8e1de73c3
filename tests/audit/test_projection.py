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
ADMISSION = ("admission", {"cell": "workcell-1", "profile": "human-shared", "status": "awaiting_approval"})
POLICY = ("policy", {"effective": BOUND, "policy_version": "sha256:a"})
APPROVAL = ("approval", {"escalation": {"effective": {"speed_mps": 0.1}}})


def permitted(capability: str, digest: str, params: dict[str, float]) -> tuple[str, dict[str, Any]]:
    return "authorization", {"authorization": {"capability": capability, "params": params, "policy_digest": digest}}


AUTHORIZATION = permitted("navigate_to", "sha256:b", BOUND)
ASKING = ("escalation", {"escalation": {"kind": "session", "status": "pending"}})
STOPPED = ("outcome", {"outcome": "stopped"})
TAKEN = ("human", {"op": "takeover"})
Told = tuple[str, dict[str, Any]]


def event(place: int, told: Told, actor: str = "planner") -> Event:
    kind, body = told
    return prepare(EventDraft(kind=kind, actor=actor, invocation="inv_1", body=body), TIME).seal(place)


def told(*events: Told) -> dict[str, Any]:
    return rebuild([event(place, found) for place, found in enumerate(events, 7)])


def status(name: str) -> Told:
    return ("status", {"status": name})


def test_nothing_told_is_nothing_known() -> None:
    assert rebuild([]) == {}


def test_a_whole_way_from_proposal_to_outcome() -> None:
    assert told(PROPOSAL, ADMISSION, POLICY, APPROVAL, AUTHORIZATION, status("paused"), STOPPED) == {
        "id": "inv_1", "created_seq": 7, "status": "failed", "capability": "navigate_to", "agent": "planner",
        "cell": "workcell-1", "profile": "human-shared", "policy_version": "sha256:b", "requested": ASKED,
        "effective": BOUND, "outcome": "stopped",
    }  # fmt: skip


RUN = (PROPOSAL, ADMISSION, POLICY, AUTHORIZATION)
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
    ((("telemetry", {}), PROPOSAL), {"created_seq": 7, "capability": "navigate_to"}),
]  # fmt: skip


@pytest.mark.parametrize(("events", "states"), STATES)
def test_what_each_event_states(events: tuple[Told, ...], states: dict[str, Any]) -> None:
    known = told(*events)
    assert {name: known.get(name, "nothing") for name in states} == states
    assert not [name for name in known if name.startswith("_")]


@pytest.mark.parametrize(
    "odd", [("proposal", {}), status("asleep"), ("outcome", {"outcome": 3}), ("approval", {"escalation": None})]
)
def test_an_event_that_no_server_wrote_is_named(odd: Told) -> None:
    with pytest.raises(ValueError, match="event `7` cannot be followed"):
        told(odd)


def row(known: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {**known, "document": orjson.dumps(known), **changes}


def test_says_where_a_row_is_not_what_the_log_makes_of_it() -> None:
    known = told(*RUN)
    assert differences(row(known), known) == []
    assert differences(row(known, status="completed"), known) == [
        "column `status` is `completed`, the log makes it `running`"
    ]
    changed = {**known, "effective": {"speed_mps": 2.0}}
    assert differences(row(known, document=orjson.dumps(changed)), known) == [
        '`effective` is `{"speed_mps":2.0}`, the log makes it `{"speed_mps":0.25}`'
    ]
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
