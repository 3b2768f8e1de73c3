from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from app.agent.approver import parse_habits
from app.agent.client import Problem
from app.agent.story import Fetched, examine, fetch, narrate
from tests.agent.scripted_server import Turn, serve

NAVIGATE, INSPECT, GRASP, MOVE, PLACE = "inv_n", "inv_i", "inv_g", "inv_t", "inv_p"
CAPABILITY = {
    NAVIGATE: "navigate_to",
    INSPECT: "inspect_area",
    GRASP: "grasp_object",
    MOVE: "transport_object",
    PLACE: "place_object",
}
LOWERED = [
    {"param": "force_n", "requested": 80.0, "effective": 60.0, "rule": "human-shared/grip_force_n"},
    {"param": "speed_mps", "requested": 0.5, "effective": 0.25, "rule": "human-shared/tcp_speed_mps"},
]


def told() -> list[dict[str, object]]:
    """The whole story as a log would have it, in the fields the examiner reads."""
    events: list[tuple[str, str, dict[str, object]]] = []
    for invocation, capability in CAPABILITY.items():
        events.append(("proposal", invocation, {"capability": capability, "params": {"speed_mps": 0.5}}))
        events.append(("admission", invocation, {"outcome": "accept", "reasons": []}))
        changes = LOWERED if invocation == GRASP else []
        outcome = "modify" if changes else "allow"
        body = {"outcome": outcome, "changes": changes, "reasons": [], "profile": "human-shared"}
        events.append(("policy", invocation, body))
        if invocation in (GRASP, MOVE):
            events.append(("escalation", invocation, {"escalation": {"risk": "medium", "reasons": []}}))
            events.append(("approval", invocation, {"decision": "approve"}))
        events.append(("launch", invocation, {"capability": capability}))
        events += [(kind, invocation, body) for kind, body in HAPPENS.get(invocation, [])]
        ended = "recovered" if invocation == GRASP else "succeeded"
        events.append(("outcome", invocation, {"outcome": ended}))
    return [
        {"seq": seq, "kind": kind, "invocation": invocation, "actor": "somebody", "body": body}
        for seq, (kind, invocation, body) in enumerate(events, start=1)
    ]


HAPPENS: dict[str, list[tuple[str, dict[str, object]]]] = {
    GRASP: [
        (
            "alert",
            {"signal": "INSTABILITY", "rule": "slip", "value": 0.02, "threshold": 0.01, "failure": "object_lost"},
        ),
        (
            "recovery",
            {"strategy": "RECOVERY_CAPABILITY", "capability": "release_and_retract", "failure": "object_lost"},
        ),
        ("recovery", {"strategy": "RETRY", "capability": "grasp_object", "failure": "object_lost"}),
    ],
    MOVE: [
        ("alert", {"signal": "VIOLATION", "rule": "separation", "value": 1.0, "threshold": 1.04, "failure": ""}),
        ("intervention", {"intervention": "PAUSE", "rule": "separation"}),
        ("status", {"status": "paused", "before": "running", "reason": "separation"}),
        ("status", {"status": "running", "before": "paused", "reason": "clear"}),
    ],
}


def test_a_whole_story_shows_every_step():
    steps = examine(told())
    assert len(steps) == 13
    assert [step.words for step in steps if step.seq is None] == []


@pytest.mark.parametrize(
    ("kind", "field", "value", "missing"),
    [
        ("approval", "decision", "approve", "grasping approved by a human"),
        ("alert", "rule", "separation", "a person inside the protective separation noticed"),
        ("intervention", "intervention", "PAUSE", "paused within the control loop"),
        ("status", "reason", "clear", "resumed after clearance"),
        ("alert", "failure", "object_lost", "grip slip noticed"),
        ("recovery", "capability", "release_and_retract", "recovered by release-and-retract"),
        ("recovery", "strategy", "RETRY", "grasped anew"),
        ("outcome", "outcome", "recovered", "object secured, verified by sensors"),
    ],
)
def test_a_step_that_is_not_in_the_record_is_missed(kind: str, field: str, value: str, missing: str):
    events = [event for event in told() if not (event["kind"] == kind and event["body"].get(field) == value)]
    assert missing in [step.words for step in examine(events) if step.seq is None]


def test_a_navigation_that_somebody_was_asked_about_is_not_direct():
    events = told()
    events.insert(2, {**events[1], "kind": "escalation", "seq": 1.5, "body": {"escalation": {}}})
    assert examine(events)[0].seq is None


def test_a_failed_goal_is_never_complete():
    steps = examine(told())
    assert Fetched(steps=steps, invocations=()).complete
    assert not Fetched(steps=steps, invocations=(), failure="gave up").complete
    assert not Fetched(steps=(), invocations=()).complete


def test_every_event_of_the_story_has_its_words():
    lines = [narrate(event) for event in told()]
    words = " | ".join(line.words for line in lines if line is not None)
    assert "modify: force_n 80 → 60, speed_mps 0.5 → 0.25 (human-shared)" in words
    assert "PAUSE because of separation" in words
    assert "RECOVERY_CAPABILITY with release_and_retract after object_lost" in words
    assert "paused → running (clear)" in words


def test_approvals_that_are_taken_off_are_told_with_those_who_gave_them():
    void = {"kind": "approval", "actor": "server", "body": {"decision": "void", "givers": ["olivia", "oskar"]}}
    line = narrate(void)
    assert line is not None
    assert line.words == "olivia and oskar may approve nothing any more: asks on without their word"


@pytest.mark.anyio
async def test_nobody_stays_behind_where_the_server_refuses_midway(tmp_path: Path):
    before, once = asyncio.all_tasks(), iter([(200, {"size": 0})])

    def answer(turn: Turn) -> tuple[int, object]:
        return next(once, (401, {"code": "token_invalid", "detail": "gone"}))

    with serve(answer) as server, pytest.raises(Problem, match="token_invalid"):
        await fetch(
            server.url, {"agent": "a", "operator": "o"}, tmp_path / "m", habits=parse_habits({}), on_line=lambda _: None
        )
    assert asyncio.all_tasks() == before
