import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.agent.client import AsyncReinsClient, ExecutionFailed, Refused, Unreachable
from app.agent.planner import REPAIRS, Goal, GoalFailed, ReferenceAgent, Step, plan_for, recall, repair
from app.governance.conditions import TESTS
from app.runtime.failures import KNOWN as KNOWN_FAILURES
from app.runtime.kernel import ANOTHER_PROFILE

from .scripted_server import Turn, serve

SITE = {
    "targets": {"bench_a_stand": {}, "bench_b_stand": {}, "tool_stand": {}},
    "surfaces": {"bench_a": {"target": "bench_a_stand"}, "bench_b": {"target": "bench_b_stand"}},
    "areas": {"bench_a_top": {"target": "bench_a_stand"}},
    "objects": {"mug_1": {"surface": "bench_a"}},
    "tools": {"lever": {"target": "tool_stand"}},
}
FETCH = Goal(kind="fetch", subject="mug_1", destination="bench_b")


def ended(status: str, *reasons: tuple[str, str], outcome: str | None = None, **more: object) -> dict[str, object]:
    return {
        "id": "inv_1", "status": status, "capability": "grasp_object", "profile": "human-shared", "outcome": outcome,
        "admission": {"outcome": "defer", "retry_after_s": 0.01,
                      "reasons": [{"rule": rule, "code": code} for rule, code in reasons]},
        "policy": {"reasons": [], "changes": []}, "updated_at": "t", **more,
    }  # fmt: skip


def failed_of(code: str) -> dict[str, object]:
    failure = {"reasons": [{"rule": "cell/session", "code": code, "message": f"it was {code}", "remedy": ""}]}
    return ended("failed", outcome="terminated", admission={"outcome": "accept", "reasons": []}, failure=failure)


def test_a_fetch_is_planned_as_the_papers_sequence():
    assert [step.capability for step in plan_for(FETCH, SITE)] == [
        "navigate_to", "inspect_area", "grasp_object", "transport_object", "place_object",
    ]  # fmt: skip


@pytest.mark.parametrize("code", sorted({*KNOWN_FAILURES, *TESTS, "cell_busy", "cell_offline", "conditions_changed"}))
def test_knows_what_to_do_about_every_reason_it_may_be_given(code: str):
    assert code in REPAIRS


@pytest.mark.parametrize("code", sorted(REPAIRS))
def test_no_repair_asks_for_more_than_the_site_has(code: str):
    for goal in (FETCH, Goal(kind="go", subject="bench_b_stand")):
        for step in plan_for(goal, SITE):
            chosen = repair(step, goal, SITE, ExecutionFailed(failed_of(code)))
            assert chosen.why
            assert chosen.give_up + chosen.restart + bool(chosen.first) + bool(chosen.wait_s) == 1


def test_planning_names_what_the_site_does_not_know():
    with pytest.raises(KeyError, match=r"no object `cup_9`; it has mug_1"):
        plan_for(Goal(kind="fetch", subject="cup_9", destination="bench_b"), SITE)


@pytest.mark.parametrize(
    ("failed", "gives_up", "first"),
    [
        (Refused(ended("deferred", ("admission/cell_busy", "cell_busy"))), False, ()),
        (Refused(ended("deferred", tuple(ANOTHER_PROFILE[:2]))), False, ()),
        (
            Refused(ended("deferred", ("grasp_object/object_visible", "precondition_unmet"))),
            False,
            ("navigate_to", "inspect_area"),
        ),
        (Refused(ended("deferred", ("grasp_object/object_reachable", "precondition_unmet"))), False, ("navigate_to",)),
        (Refused(ended("denied", ("organization/hazmat", "rule"))), True, ()),
        (Refused(ended("rejected", ("admission", "unknown_capability"))), True, ()),
        (ExecutionFailed(ended("failed", outcome="stopped")), True, ()),
        (ExecutionFailed(failed_of("holding")), False, ()),
        (ExecutionFailed(failed_of("grasp_failed")), False, ("navigate_to", "inspect_area")),
        (ExecutionFailed(failed_of("object_lost")), False, ()),
        (ExecutionFailed(failed_of("blocked")), False, ()),
        (ExecutionFailed(failed_of("shutdown")), True, ()),
        (ExecutionFailed(failed_of("never_heard_of")), True, ()),
        (ExecutionFailed(ended("failed", outcome="terminated", failure=None)), True, ()),
    ],
)
def test_a_repair_follows_from_the_reasons(failed, gives_up, first):
    step = Step(capability="grasp_object", params={"object_id": "mug_1"})
    chosen = repair(step, FETCH, SITE, failed)
    assert chosen.give_up is gives_up
    assert tuple(item.capability for item in chosen.first) == first


def _answers(*proposals: dict[str, object]):
    queue = iter(proposals)

    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": SITE}
        return 201, next(queue)

    return answer


@pytest.mark.anyio
async def test_replans_after_a_deferral_and_reaches_the_goal(tmp_path: Path):
    done = ended("completed", outcome="succeeded")
    unseen = ended("deferred", ("grasp_object/object_visible", "precondition_unmet"))
    with serve(_answers(done, done, unseen, done, done, done, done, done)) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            results = await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
    assert len(results) == 7
    assert [turn.body["capability"] for turn in server.turns if turn.method == "POST"] == [
        "navigate_to", "inspect_area", "grasp_object",
        "navigate_to", "inspect_area", "grasp_object", "transport_object", "place_object",
    ]  # fmt: skip


@pytest.mark.anyio
async def test_gives_a_denied_goal_up_and_says_why(tmp_path: Path):
    denied = ended("denied", ("organization/hazmat", "rule"))
    with serve(_answers(denied)) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            with pytest.raises(GoalFailed, match="gave up `fetch mug_1 and deliver it to bench_b` at `navigate_to`"):
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)


@pytest.mark.anyio
async def test_what_it_remembers_is_there_after_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    synced: list[bool] = []
    monkeypatch.setattr(os, "fsync", lambda one: synced.append(os.path.samestat(os.fstat(one), tmp_path.stat())))
    with serve(_answers(ended("denied", ("organization/hazmat", "rule")))) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            with pytest.raises(GoalFailed):
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
    assert synced
    assert synced == [False, True] * (len(synced) // 2), "each time the memory, and then the folder that names it"


@pytest.mark.anyio
async def test_remembers_a_limit_and_asks_for_no_more(tmp_path: Path):
    change = {"param": "force_n", "requested": 80.0, "effective": 60.0, "rule": "human-shared/grip_force_n"}
    done = ended("completed", outcome="succeeded")
    modified = ended("completed", outcome="succeeded", policy={"reasons": [], "changes": [change]})
    with serve(_answers(done, done, modified, done, done, done, done, done, done, done)) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
            await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
    asked = [
        turn.body["params"]["force_n"]
        for turn in server.turns
        if turn.body and turn.body["capability"] == "grasp_object"
    ]
    assert asked == [80.0, 60.0]


TWO_THINGS = {**SITE, "objects": {"glass_1": {"surface": "bench_a"}, "box_1": {"surface": "bench_a"}}}


def _constrains(profiles: Iterator[str]):
    """Constrain the glass: 20 N of grip, and 0.2 m/s while it is carried; each proposal under the next profile."""
    limits = {"grasp_object": ("force_n", 20.0), "transport_object": ("speed_mps", 0.2)}

    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": TWO_THINGS}
        param, most = limits.get(turn.body["capability"], ("", 0.0))
        change = {"param": param, "requested": turn.body["params"].get(param), "effective": most, "rule": "x"}
        changes = [change] if param and "glass_1" in turn.body["metadata"]["intent"] else []
        return 201, ended(
            "completed", outcome="succeeded", profile=next(profiles), policy={"reasons": [], "changes": changes}
        )

    return answer


def _asked(turns: list[Turn], capability: str, param: str) -> list[float]:
    return [turn.body["params"][param] for turn in turns if turn.body and turn.body["capability"] == capability]


@pytest.mark.anyio
async def test_limits_of_one_object_are_not_those_of_another(tmp_path: Path):
    with serve(_constrains(itertools.repeat("human-shared"))) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            for thing in ("glass_1", "box_1", "glass_1"):
                goal = Goal(kind="fetch", subject=thing, destination="bench_b")
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(goal)
    assert _asked(server.turns, "grasp_object", "force_n") == [80.0, 80.0, 20.0]
    assert _asked(server.turns, "transport_object", "speed_mps") == [0.8, 0.8, 0.2]


@pytest.mark.anyio
async def test_limits_of_one_profile_are_not_those_of_another(tmp_path: Path):
    fetch = Goal(kind="fetch", subject="glass_1", destination="bench_b")
    profiles = itertools.chain(["strict"] * 5, itertools.repeat("relaxed"))
    with serve(_constrains(profiles)) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            for _ in range(3):
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(fetch)
    assert _asked(server.turns, "grasp_object", "force_n") == [80.0, 80.0, 20.0]


@pytest.mark.anyio
async def test_a_restarted_agent_asks_for_the_same_invocation_under_the_same_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("app.agent.conversation._SEND_ATTEMPTS", 1)
    lost = {"now": True}
    done = ended("completed", outcome="succeeded")

    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": SITE}
        return None if lost["now"] else (201, done)

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            with pytest.raises(Exception, match="no answer"):
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
            lost["now"] = False
            results = await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
    posts = [turn for turn in server.turns if turn.method == "POST"]
    assert posts[0].headers["idempotency-key"] == posts[1].headers["idempotency-key"]
    assert len(results) == 5


class Killed(BaseException):
    """The process is gone."""


class Mortal(ReferenceAgent):
    """An agent that is killed right after so many writes of its memory."""

    saves = 0

    def _save(self) -> None:
        super()._save()
        self.saves -= 1
        if self.saves == 0:
            raise Killed


@pytest.mark.anyio
@pytest.mark.parametrize("saves", range(1, 12))
async def test_an_agent_killed_after_any_write_of_its_memory_does_no_step_twice(tmp_path: Path, saves: int):
    done: dict[str, str] = {}

    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": SITE}
        done.setdefault(turn.headers["idempotency-key"], turn.body["capability"])
        return 201, ended("completed", outcome="succeeded")

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            agent = Mortal(client, tmp_path / "memory.json")
            agent.saves = saves
            with pytest.raises(Killed):
                await agent.pursue(FETCH)
            if recall(tmp_path / "memory.json", "planner").goals:
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
    assert list(done.values()) == [
        "navigate_to", "inspect_area", "grasp_object", "transport_object", "place_object",
    ]  # fmt: skip


@pytest.mark.anyio
async def test_an_agent_restarted_with_another_goal_proposes_under_a_new_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("app.agent.conversation._SEND_ATTEMPTS", 1)
    lost = {"now": True}

    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": SITE}
        return None if lost["now"] else (201, ended("completed", outcome="succeeded"))

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            with pytest.raises(Unreachable):
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
            lost["now"] = False
            await ReferenceAgent(client, tmp_path / "memory.json").pursue(Goal(kind="inspect", subject="bench_a_top"))
    lost_one, asked, *_ = [turn for turn in server.turns if turn.method == "POST"]
    assert lost_one.body["params"] == asked.body["params"]
    assert lost_one.body["metadata"] != asked.body["metadata"]
    assert lost_one.headers["idempotency-key"] != asked.headers["idempotency-key"]


@pytest.mark.anyio
@pytest.mark.parametrize("method", ["POST", "GET"])
@pytest.mark.parametrize("refusal", [401, 403, 404, 429, 503])
async def test_an_agent_refused_while_a_step_may_be_under_way_takes_that_step_up_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, refusal: int
):
    monkeypatch.setattr("app.agent.conversation._SEND_ATTEMPTS", 1)
    refused = {"now": True}

    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": SITE}
        if refused["now"] and turn.method == method:
            return refusal, {"code": "token_invalid", "detail": "expired"}
        if turn.method == "POST" and refused["now"]:
            return 201, ended("running")
        return 200, ended("completed", outcome="succeeded")

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            with pytest.raises(GoalFailed, match="expired"):
                await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
            refused["now"] = False
            await ReferenceAgent(client, tmp_path / "memory.json").pursue(FETCH)
    keys = [turn.headers["idempotency-key"] for turn in server.turns if turn.method == "POST"]
    assert keys[0] == keys[1]
    assert len(set(keys)) == 5


@pytest.mark.anyio
async def test_a_refused_request_ends_the_goal_in_the_servers_words(tmp_path: Path):
    def answer(turn: Turn):
        if turn.path == "/v1/policies/active":
            return 200, {"site": SITE}
        return 422, {"code": "idempotency_mismatch", "detail": "another proposal bore this key"}

    with serve(answer) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            agent = ReferenceAgent(client, tmp_path / "memory.json")
            with pytest.raises(GoalFailed, match="idempotency_mismatch: another proposal bore this key"):
                await agent.pursue(FETCH)
    assert recall(tmp_path / "memory.json", "planner").memory.under_way is None


@pytest.mark.anyio
async def test_a_goal_that_cannot_be_planned_is_never_taken_for_reached(tmp_path: Path):
    """Nor pursued by what is left of another goal's plan."""
    denied = ended("denied", ("organization/hazmat", "rule"))
    with serve(_answers(denied)) as server:
        async with AsyncReinsClient(server.url, "t", defers=0) as client:
            agent = ReferenceAgent(client, tmp_path / "memory.json")
            unknown = Goal(kind="inspect", subject="attic")
            for _ in range(2):
                with pytest.raises(KeyError, match="the site has no area `attic`"):
                    await agent.pursue(unknown)
            with pytest.raises(GoalFailed):
                await agent.pursue(FETCH)
            for _ in range(2):
                with pytest.raises(KeyError, match="the site has no area `attic`"):
                    await agent.pursue(unknown)
    assert len([turn for turn in server.turns if turn.method == "POST"]) == 1


def test_a_damaged_memory_is_named_instead_of_forgotten(tmp_path: Path):
    path = tmp_path / "memory.json"
    path.write_text('{"identity": "planner", "goals": 3}')
    with pytest.raises(ValueError, match="is not an agent's memory"):
        recall(path, "planner")


def test_a_memory_of_another_agent_is_refused(tmp_path: Path):
    path = tmp_path / "memory.json"
    path.write_text('{"identity": "other", "memory": {}, "goals": [], "plan": []}')
    with pytest.raises(ValueError, match="memory of `other`"):
        recall(path, "planner")
