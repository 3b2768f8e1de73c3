"""The paper's Algorithm 1, told from the record: a mobile manipulator fetches an object in a human-shared workspace.

`fetch` lets the reference agent (and, if wanted, a scripted approver) loose on a running server and narrates what the
log says while it happens. `examine` then reads the recorded trace alone and says for each step of the algorithm whether
it is there, with the sequence number of the event that shows it.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import httpx
import orjson

from app.agent.approver import Habits, ScriptedApprover
from app.agent.client import AsyncReinsClient, Document
from app.agent.planner import Goal, GoalFailed, ReferenceAgent

Event: TypeAlias = Mapping[str, Any]

_LAST_WORDS = 20
_VERBS = {"approve": "approves", "deny": "denies"}

FETCH = Goal(kind="fetch", subject="mug_1", destination="bench_b")


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One line of the story: who speaks, the mood (`agent`, `policy`, `human`, `warn`, `act`, `good`), the words."""

    who: str
    mood: str
    words: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step of Algorithm 1 and the event that shows it; `seq` is None where the trace does not."""

    words: str
    seq: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Fetched:
    """How the story ended: the steps found in the record, its invocations, and why it failed if it did."""

    steps: tuple[Step, ...]
    invocations: tuple[str, ...]
    failure: str = ""

    @property
    def complete(self) -> bool:
        """Say whether the goal was reached and the record shows every step."""
        return not self.failure and bool(self.steps) and all(step.seq is not None for step in self.steps)


OnLine: TypeAlias = Callable[[Line], None]


# -- the narrator ---------------------------------------------------------------------------------


def narrate(event: Event) -> Line | None:
    """Return what an event means to somebody who looks on, or None for what is only for the record."""
    telling = _TELLING.get(event["kind"])
    return None if telling is None else telling(event, event["body"])


def _proposal(event: Event, body: Event) -> Line:
    asked = ", ".join(f"{name}={_value(value)}" for name, value in body["params"].items())
    return Line(who=event["actor"], mood="agent", words=f"proposes {body['capability']}({asked})")


def _policy(_: Event, body: Event) -> Line:
    outcome = body["outcome"]
    if outcome in ("modify", "escalate") and body["changes"]:
        changes = ", ".join(
            f"{change['param']} {_value(change['requested'])} → {_value(change['effective'])}"
            for change in body["changes"]
        )
        return Line(who="policy", mood="policy", words=f"{outcome}: {changes} ({body['profile']})")
    reasons = "; ".join(reason["message"] for reason in body["reasons"])
    mood = "good" if outcome == "allow" else "policy"
    return Line(who="policy", mood=mood, words=f"{outcome}{': ' if reasons else ''}{reasons}")


def _admission(_: Event, body: Event) -> Line | None:
    if body["outcome"] == "accept":
        return None
    reasons = "; ".join(reason["message"] for reason in body["reasons"])
    return Line(who="admission", mood="warn", words=f"{body['outcome']}: {reasons}")


def _escalation(_: Event, body: Event) -> Line | None:
    asked = body.get("escalation")
    if not asked:
        return Line(who="cell", mood="warn", words=f"asks for a human: {body.get('reason', '')}")
    why = "; ".join(reason["message"] for reason in asked["reasons"])
    return Line(who="desk", mood="human", words=f"waits for a human ({asked['risk']} risk): {why}")


def _approval(event: Event, body: Event) -> Line:
    if body.get("decision") == "void":
        givers = " and ".join(body.get("givers", ()))
        return Line(who="desk", mood="warn", words=f"{givers} may approve nothing any more: asks on without their word")
    return Line(
        who=event["actor"], mood="human", words=f"{_VERBS.get(body.get('decision', ''), 'answers')} the proposal"
    )


def _launch(_: Event, body: Event) -> Line:
    if "refused" in body:
        return Line(who="cell", mood="warn", words=f"refuses the permit: {body['detail']}")
    return Line(who="cell", mood="good", words=f"permit verified, {body['capability']} starts under watch")


def _alert(_: Event, body: Event) -> Line | None:
    match body["signal"]:
        case "NORMAL":
            return None
        case "COMPLETION":
            verified = ", ".join(body["verified"]) or "no postcondition"
            return Line(who="watcher", mood="good", words=f"{body['capability']} done, verified by sensors: {verified}")
        case signal:
            value, threshold = _value(body["value"]), _value(body["threshold"])
            return Line(who="watcher", mood="warn", words=f"{signal}: {body['rule']}, {value} against {threshold}")


def _intervention(_: Event, body: Event) -> Line:
    return Line(who="cell", mood="act", words=f"{body['intervention']} because of {body['rule']}")


def _recovery(_: Event, body: Event) -> Line:
    with_what = f" with {body['capability']}" if body.get("capability") else ""
    return Line(who="recovery", mood="act", words=f"{body['strategy']}{with_what} after {body['failure']}")


def _status(_: Event, body: Event) -> Line | None:
    if body["before"] is None or body["status"] in ("completed", "failed"):
        return None
    return Line(who="cell", mood="act", words=f"{body['before']} → {body['status']} ({body['reason']})")


def _human(event: Event, body: Event) -> Line:
    return Line(who=event["actor"], mood="human", words=str(body.get("op", "speaks")))


def _outcome(_: Event, body: Event) -> Line:
    good = body["outcome"] in ("succeeded", "recovered")
    return Line(who="outcome", mood="good" if good else "warn", words=body["outcome"])


_TELLING: Mapping[str, Callable[[Event, Event], Line | None]] = {
    "proposal": _proposal,
    "admission": _admission,
    "policy": _policy,
    "escalation": _escalation,
    "approval": _approval,
    "launch": _launch,
    "alert": _alert,
    "intervention": _intervention,
    "recovery": _recovery,
    "status": _status,
    "human": _human,
    "outcome": _outcome,
}


def _value(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


# -- the examiner ---------------------------------------------------------------------------------


def examine(events: Iterable[Event]) -> tuple[Step, ...]:
    """Look for every step of Algorithm 1 in recorded events, in their order.

    A step counts only with what it needs before it: a resumption after its pause, a new grasp after the release that
    followed the slip.
    """
    log = sorted(events, key=lambda event: event["seq"])
    capability = {e["invocation"]: e["body"]["capability"] for e in log if e["kind"] == "proposal"}

    def find(kind: str, after: int | None, *, of: str = "", **wanted: object) -> int | None:
        """Return the first event after `after` (None: never happened) of a kind, of a capability, with these fields."""
        if after is None:
            return None
        for event in log:
            if event["seq"] <= after or event["kind"] != kind or (of and capability.get(event["invocation"]) != of):
                continue
            if all(event["body"].get(name) in _among(value) for name, value in wanted.items()):
                return int(event["seq"])
        return None

    reduced = _reduced_grasp(log, capability)
    approved = find("approval", reduced, of="grasp_object", decision="approve")
    launched = find("launch", approved, of="grasp_object", capability="grasp_object")
    person = find("alert", launched, rule=_rules(log, "separation"))
    paused = find("intervention", person, intervention="PAUSE", rule=_rules(log, "separation"))
    resumed = find("status", find("status", paused, status="paused"), status=("running", "recovering"), before="paused")
    slipped = find("alert", launched, failure="object_lost")
    released = find("recovery", slipped, strategy="RECOVERY_CAPABILITY", capability="release_and_retract")
    again = find("recovery", released, strategy="RETRY", capability="grasp_object")
    secured = find("outcome", again, of="grasp_object", outcome="recovered")
    delivered = find("outcome", secured, of="place_object", outcome=("succeeded", "recovered"))
    return (
        Step(words="navigation admitted directly", seq=_direct(log, capability, "navigate_to")),
        Step(words="localization admitted directly", seq=_direct(log, capability, "inspect_area")),
        Step(words="grasping modified: lower force, lower speed", seq=reduced),
        Step(words="grasping approved by a human", seq=approved),
        Step(words="constrained grasp launched under watch", seq=launched),
        Step(words="a person inside the protective separation noticed", seq=person),
        Step(words="paused within the control loop", seq=paused),
        Step(words="resumed after clearance", seq=resumed),
        Step(words="grip slip noticed", seq=slipped),
        Step(words="recovered by release-and-retract", seq=released),
        Step(words="grasped anew", seq=again),
        Step(words="object secured, verified by sensors", seq=secured),
        Step(words="delivered", seq=delivered),
    )


def _among(value: object) -> Collection[object]:
    return cast("Collection[object]", value) if isinstance(value, tuple | frozenset) else (value,)


def _rules(log: list[Event], ending: str) -> frozenset[object]:
    """Return the names of the rules that end in a given word, whatever the profile."""
    return frozenset(e["body"]["rule"] for e in log if str(e["body"].get("rule", "")).rpartition("/")[2] == ending)


def _direct(log: list[Event], capability: Mapping[str, str], name: str) -> int | None:
    """Return the admission of the first invocation of a capability that was accepted and launched with nobody asked."""
    asked = {event["invocation"] for event in log if event["kind"] == "escalation"}
    launched = {event["invocation"] for event in log if event["kind"] == "launch"}
    for event in log:
        invocation = event["invocation"]
        accepted = event["kind"] == "admission" and event["body"]["outcome"] == "accept"
        if accepted and capability.get(invocation) == name and invocation in launched - asked:
            return int(event["seq"])
    return None


def _reduced_grasp(log: list[Event], capability: Mapping[str, str]) -> int | None:
    """Return the policy decision that lowered both force and speed of a grasp."""
    for event in log:
        if event["kind"] == "policy" and capability.get(event["invocation"]) == "grasp_object":
            lowered = {c["param"] for c in event["body"]["changes"] if c["effective"] < c["requested"]}
            if {"force_n", "speed_mps"} <= lowered:
                return int(event["seq"])
    return None


# -- the scene ------------------------------------------------------------------------------------


async def fetch(
    url: str, tokens: Mapping[str, str], memory: Path, *, habits: Habits | None, on_line: OnLine, goal: Goal = FETCH
) -> Fetched:
    """Have the reference agent reach a goal on the server at `url`, narrate it, and examine what was recorded.

    `tokens` needs `agent` and `operator`. With `habits`, a scripted approver answers escalations; without, people do.
    Raises `ReinsError` where the server refuses, or is gone.
    """
    async with (
        AsyncReinsClient(url, tokens["agent"], defers=0) as agent_client,
        AsyncReinsClient(url, tokens["operator"]) as operator_client,
    ):
        seen: list[Event] = []
        start = (await operator_client.call("GET", "/v1/audit/checkpoint"))["size"]
        bystanders = [asyncio.create_task(_listen(url, tokens["operator"], start, seen, on_line))]
        if habits is not None:
            approver = ScriptedApprover(operator_client, habits)
            bystanders.append(asyncio.create_task(approver.run()))
        agent = ReferenceAgent(agent_client, memory)
        failure = ""
        on_line(Line(who="agent", mood="agent", words=f"goal: {goal.text()}"))
        try:
            try:
                await agent.pursue(goal, on_thought=lambda words: on_line(Line(who="agent", mood="agent", words=words)))
            except GoalFailed as given_up:
                failure = str(given_up)
                on_line(Line(who="agent", mood="warn", words=failure))
            await _heard_all(operator_client, seen)
        finally:  # a server that is gone has no more to tell, and nobody stays behind to ask it
            for bystander in bystanders:
                bystander.cancel()
            await asyncio.gather(*bystanders, return_exceptions=True)
        recorded = await _recorded(operator_client, start)
    invocations = tuple(dict.fromkeys(event["invocation"] for event in recorded if event["kind"] == "proposal"))
    return Fetched(steps=examine(recorded), invocations=invocations, failure=failure)


async def _heard_all(client: AsyncReinsClient, seen: list[Event]) -> None:
    """Wait until the narrator has come to the end of the record, or has had long enough to."""
    size = (await client.call("GET", "/v1/audit/checkpoint"))["size"]
    for _ in range(_LAST_WORDS):
        if seen and seen[-1]["seq"] >= size:
            return
        await asyncio.sleep(0.1)


async def _recorded(client: AsyncReinsClient, after: int) -> list[Document]:
    """Return everything recorded since, page by page."""
    events: list[Document] = []
    while True:
        page = await client.call("GET", "/v1/audit/events", query={"after": str(after), "limit": "500"})
        events += page["items"]
        if not page["items"] or page["next"] is None:
            return events
        after = events[-1]["seq"]


async def _listen(url: str, token: str, after: int, seen: list[Event], on_line: OnLine) -> None:
    """Narrate events as the server sends them, until cancelled; a broken stream is taken up where it broke."""
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=httpx.Timeout(10.0, read=None)) as http:
        while True:
            last = seen[-1]["seq"] if seen else after
            with suppress(httpx.TransportError):
                async with http.stream("GET", "/v1/events", headers={"Last-Event-ID": str(last)}) as stream:
                    async for event in _events(stream):
                        seen.append(event)
                        line = narrate(event)
                        if line is not None:
                            on_line(line)
            await asyncio.sleep(0.2)


async def _events(stream: httpx.Response) -> AsyncIterator[Event]:
    """Return the events of a server-sent stream."""
    async for text in stream.aiter_lines():
        if text.startswith("data:"):
            yield orjson.loads(text[5:])
