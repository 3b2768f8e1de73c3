"""The reference agent: a persistent subject A_t = (identity, memory, goals, plan) that proposes and never decides.

It stands where an LLM or VLA planner would: it turns a goal into a plan of proposals (paper, Stages 1 and 2), reads
what governance answers, and chooses its next proposal from it (Stage 7, re-entry into planning). All it knows of the
world it learned over HTTP: the site's names from the active policy, the rest from verdicts and traces. What it
proposes is deliberately ambitious; what policy takes away it remembers and asks for no more.

Its memory is a JSON file, written before each proposal, so that a restarted agent takes up its goal and the very
invocation it had under way.
"""

from __future__ import annotations

import asyncio
import os
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import orjson
from pydantic import TypeAdapter, ValidationError

from app.agent.client import AsyncReinsClient, NotCompleted, OnUpdate, Problem, Result, document

Site: TypeAlias = Mapping[str, Any]

AMBITION: Mapping[str, Mapping[str, Any]] = {
    "navigate_to": {"speed_mps": 0.3, "clearance_m": 0.3},
    "transport_object": {"speed_mps": 0.8},
    "grasp_object": {"force_n": 80.0, "speed_mps": 0.5},
    "place_object": {"speed_mps": 0.5},
    "operate_tool": {"speed_mps": 0.5},
    "inspect_area": {"dwell_s": 1.0},
}
"""What the agent asks for when it has not been told better."""

_EPISODES = 500
_REPAIRS = 6
_NEVER_MADE = frozenset({400, 413, 422})
"""How a server refuses a proposal itself: asked again under its key it would say the same.

After any other refusal, say of a token or of a poll, the key stays: what was proposed may be under way, or done.
"""


class GoalFailed(Exception):
    """The agent gave a goal up: says at which step and why."""

    def __init__(self, goal: Goal, step: Step, why: str) -> None:
        """Keep the facts; the message is made of them."""
        self.goal = goal
        self.step = step
        self.why = why
        super().__init__(f"gave up `{goal.text()}` at `{step.capability}`: {why}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """An active goal: `fetch` an object to a surface, `inspect` an area, `operate` a tool, `go` to a target."""

    kind: str
    subject: str
    destination: str = ""

    def text(self) -> str:
        """Return the goal in words."""
        return {
            "fetch": f"fetch {self.subject} and deliver it to {self.destination}",
            "inspect": f"inspect {self.subject}",
            "operate": f"{self.destination} the {self.subject}",
            "go": f"go to {self.subject}",
        }[self.kind]


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One intended proposal."""

    capability: str
    params: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """What the agent remembers of one proposal."""

    invocation: str
    capability: str
    params: Mapping[str, Any]
    status: str
    outcome: str | None
    codes: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class UnderWay:
    """A proposal that was sent and whose end is not yet known; asking again under its key finds the same invocation.

    A key stands for one proposal, metadata included: another goal, capability or parameter is another proposal.
    """

    key: str
    capability: str
    params: dict[str, Any]
    goal: Goal | None = None


@dataclass(slots=True, kw_only=True)
class Memory:
    """M_t: episodes, limits it ran into, the profile last decided under, and what was under way.

    Limits stand by profile, then by `capability(what it is about).param`: what holds for a glass says nothing of a box.
    """

    episodes: list[Episode] = field(default_factory=list[Episode])
    limits: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    profile: str | None = None
    under_way: UnderWay | None = None


@dataclass(slots=True, kw_only=True)
class AgentState:
    """A_t: identity, memory, goals (the first is active) and the plan for it."""

    identity: str
    memory: Memory = field(default_factory=Memory)
    goals: list[Goal] = field(default_factory=list[Goal])
    plan: list[Step] = field(default_factory=list[Step])


# -- goal interpretation and planning, pure -------------------------------------------------------


def plan_for(goal: Goal, site: Site) -> list[Step]:
    """Return the proposals that reach a goal from anywhere in the site.

    Raises `KeyError` naming what the site does not know.
    """
    match goal.kind:
        case "fetch":
            return [*_go_and_look(_surface_of(goal.subject, site), site), *_carry(goal.subject, goal.destination, site)]
        case "inspect":
            return [_go(_known(site, "areas", goal.subject)["target"]), _step("inspect_area", area=goal.subject)]
        case "operate":
            tool = _known(site, "tools", goal.subject)
            return [_go(tool["target"]), _step("operate_tool", tool=goal.subject, action=goal.destination)]
        case "go":
            return [_go(goal.subject)]
        case other:
            raise KeyError(f"unknown kind of goal `{other}`; known: fetch, inspect, operate, go")


def _known(site: Site, kind: str, name: str) -> Mapping[str, Any]:
    if name not in site[kind]:
        raise KeyError(f"the site has no {kind[:-1]} `{name}`; it has {', '.join(sorted(site[kind]))}")
    return site[kind][name]


def _surface_of(thing: str, site: Site) -> str:
    return str(_known(site, "objects", thing)["surface"])


def _step(capability: str, **params: Any) -> Step:  # noqa: ANN401 - the capability's own parameters
    return Step(capability=capability, params={**AMBITION.get(capability, {}), **params})


def _go(target: str) -> Step:
    return _step("navigate_to", target=target)


def _go_and_look(surface: str, site: Site) -> list[Step]:
    target = _known(site, "surfaces", surface)["target"]
    areas = [name for name, area in site["areas"].items() if area["target"] == target]
    return [_go(target), *(_step("inspect_area", area=area) for area in areas[:1])]


def _carry(thing: str, surface: str, site: Site) -> list[Step]:
    target = _known(site, "surfaces", surface)["target"]
    return [
        _step("grasp_object", object_id=thing),
        _step("transport_object", target=target),
        _step("place_object", surface=surface),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Repair:
    """What to do about a step that did not complete: wait, put steps before it, start the goal over, or give up."""

    why: str
    wait_s: float = 0.0
    first: tuple[Step, ...] = ()
    restart: bool = False
    give_up: bool = False


class _Repairer(Protocol):
    def __call__(self, step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair: ...


def _wait(step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair:
    seconds = float(document(failed.invocation.get("admission")).get("retry_after_s") or 1.0)
    return Repair(why="not now; waiting", wait_s=seconds)


def _look_again(step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair:
    thing = str(step.params.get("object_id") or goal.subject)
    if thing not in site["objects"]:
        return Repair(why=f"nothing known about `{thing}`", give_up=True)
    return Repair(why=f"going back to look for {thing}", first=tuple(_go_and_look(_surface_of(thing, site), site)))


def _go_there(step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair:
    kind, name = next(
        ((kind, step.params[key]) for key, kind in _STANDS.items() if key in step.params), ("objects", goal.subject)
    )
    if name not in site[kind]:
        return Repair(why=f"there is nowhere to go to reach `{name}`", give_up=True)
    place = site[kind][name]
    if kind == "objects":
        place = _known(site, "surfaces", place["surface"])
    return Repair(why=f"going to {place['target']} first", first=(_go(place["target"]),))


def _start_over(step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair:
    return Repair(why="starting the goal over", restart=True)


def _give_up(step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair:
    said = "; ".join(f"{reason.message} {reason.remedy}".strip() for reason in failed.reasons)
    return Repair(why=said or f"{failed.invocation['status']}, {failed.invocation.get('outcome')}", give_up=True)


_STANDS = {"object_id": "objects", "surface": "surfaces", "area": "areas", "tool": "tools"}

_BY_REPAIR: tuple[tuple[_Repairer, str], ...] = (
    (
        _wait,
        "cell_busy cell_offline conditions_changed sensors_fresh sensor_fault arm_ready arm_retracted blocked no_path",
    ),
    (_wait, "too_many_waiting grant_ended"),
    (_wait, "journal_unavailable holding used"),  # such a cell launched nothing: once it is back, again
    (_look_again, "object_visible area_inspected object_not_found grasp_failed perception_mismatch contact"),
    (_go_there, "object_reachable surface_reachable tool_reachable area_in_view unreachable"),
    (_start_over, "gripper_empty carrying object_secured object_placed at_target tool_actuated"),
    (_start_over, "object_lost placement_failed tool_failed postcondition_failed timeout stall"),
    (_start_over, "session_lost cell_lost cell_restarted launch_unconfirmed link_lost"),
    (_give_up, "overgrip overspeed zone instability retries_exhausted rollback_failed verified"),
    (
        _give_up,
        "recovery_failed guard_broken loop_broken not_held another_site unknown_capability unknown_name power_off",
    ),
    (_give_up, "permit_expired not_yet_valid clock_put_back"),  # until somebody sets a clock
    (_give_up, "operator expired taken_over control_lapsed cancelled estop shutdown"),
)
REPAIRS: Mapping[str, _Repairer] = {code: repairer for repairer, codes in _BY_REPAIR for code in codes.split()}
"""What the agent does about a reason: a precondition that is not met, a failure, or how a session was ended.

What needs a person, or a proposal that it cannot think of, ends the goal, and so does whatever is not here, unless it
was deferred: that is to be proposed again, whatever the reason. A denial is never argued with.
"""


def repair(step: Step, goal: Goal, site: Site, failed: NotCompleted) -> Repair:
    """Choose what to do about a proposal that did not complete, from its reasons' codes and conditions."""
    if failed.invocation["status"] in ("rejected", "denied") or failed.invocation.get("outcome") in _HUMAN_ENDINGS:
        return _give_up(step, goal, site, failed)
    names = [name for reason in failed.reasons for name in (reason.rule.rpartition("/")[2], reason.code)]
    otherwise = _wait if failed.invocation["status"] == "deferred" else _give_up
    chosen = next((REPAIRS[name] for name in names if name in REPAIRS), otherwise)
    return chosen(step, goal, site, failed)


_HUMAN_ENDINGS = frozenset({"stopped", "cancelled", "taken_over"})


def _about(step: Step, goal: Goal) -> str:
    """Return a step's capability with what it is about, as its limits depend on it: the things named and carried."""
    names = [str(value) for _, value in sorted(step.params.items()) if isinstance(value, str)]
    carried = [goal.subject] if step.capability in _CARRIES else []
    return f"{step.capability}({', '.join(carried + names)})"


_CARRIES = frozenset({"transport_object", "place_object"})


# -- the agent ------------------------------------------------------------------------------------

_STATE = TypeAdapter(AgentState)

OnThought: TypeAlias = Callable[[str], None]


class ReferenceAgent:
    """Carries goals out through a client, one proposal at a time, and remembers."""

    def __init__(self, client: AsyncReinsClient, memory: Path, *, identity: str = "planner") -> None:
        """Take up the memory at `memory` if there is one; the client should not retry a Defer itself (`defers=0`)."""
        self._client = client
        self._path = memory
        self.state = recall(memory, identity)

    async def pursue(
        self, goal: Goal, *, on_thought: OnThought = lambda _: None, on_update: OnUpdate | None = None
    ) -> list[Result]:
        """Reach a goal and return the results on the way; an unfinished plan for the same goal is taken up again.

        Raises `GoalFailed` when governance's reasons leave nothing to try, or a proposal itself was refused; what
        the client raises when the site cannot be read, or the server gives no answer.
        """
        site: Site = (await self._client.call("GET", "/v1/policies/active"))["site"]
        if self.state.goals[:1] != [goal]:  # one that is there with an empty plan was reached, and nobody was told yet
            plan = plan_for(goal, site)  # a goal without a plan of its own must not stand beside another one's
            self.state.goals, self.state.plan = [goal], plan
            on_thought(f"plan: {', '.join(step.capability for step in self.state.plan)}")
        results: list[Result] = []
        repairs = 0
        while self.state.plan:
            step = self.state.plan[0]
            try:
                results.append(await self._propose(step, on_update))
            except Problem as refused:
                raise GoalFailed(goal, step, str(refused)) from refused
            except NotCompleted as failed:
                self._remember(step, failed.invocation, tuple(failed.codes))
                chosen = repair(step, goal, site, failed)
                repairs += 1
                if chosen.give_up or repairs > _REPAIRS:
                    raise GoalFailed(goal, step, chosen.why) from failed
                on_thought(f"{step.capability} {failed.invocation['status']}: {chosen.why}")
                await self._apply(chosen, goal, site)
        self.state.goals = []
        self._save()
        return results

    async def _apply(self, chosen: Repair, goal: Goal, site: Site) -> None:
        if chosen.restart:
            self.state.plan = plan_for(goal, site)
        self.state.plan[:0] = chosen.first
        self._save()
        await asyncio.sleep(chosen.wait_s)

    async def _propose(self, step: Step, on_update: OnUpdate | None) -> Result:
        params = self._within_known_limits(step)
        under_way = self.state.memory.under_way
        goal = self.state.goals[0]
        if under_way is None or (under_way.goal, under_way.capability, under_way.params) != (
            goal,
            step.capability,
            params,
        ):
            under_way = UnderWay(key=uuid.uuid4().hex, capability=step.capability, params=params, goal=goal)
            self.state.memory.under_way = under_way
            self._save()
        try:
            result = await self._client.invoke(
                step.capability,
                idempotency_key=under_way.key,
                metadata={"confidence": 0.9, "intent": goal.text()},
                on_update=on_update,
                **under_way.params,
            )
        except Problem as refused:
            if refused.status in _NEVER_MADE and refused.invocation is None:
                self.state.memory.under_way = None
                self._save()
            raise
        self.state.plan.pop(0)  # saved together with what came of it: a restarted agent does no step again
        self._remember(step, result.invocation, ())
        return result

    def _within_known_limits(self, step: Step) -> dict[str, Any]:
        memory = self.state.memory
        known = memory.limits.get(memory.profile or "", {})
        about = _about(step, self.state.goals[0])
        return {
            name: min(value, known.get(f"{about}.{name}", value)) if isinstance(value, float) else value
            for name, value in step.params.items()
        }

    def _remember(self, step: Step, invocation: Mapping[str, Any], codes: tuple[str, ...]) -> None:
        """Keep the episode, and the limits it ran into, for this profile and what the step was about."""
        memory = self.state.memory
        memory.under_way = None
        memory.episodes.append(
            Episode(
                invocation=invocation["id"],
                capability=step.capability,
                params=dict(step.params),
                status=invocation["status"],
                outcome=invocation.get("outcome"),
                codes=codes,
            )
        )
        del memory.episodes[:-_EPISODES]
        memory.profile = invocation["profile"]
        limits = memory.limits.setdefault(invocation["profile"], {})
        about = _about(step, self.state.goals[0])
        for change in Result(invocation=dict(invocation)).changes:
            if isinstance(change["effective"], float | int):
                limits[f"{about}.{change['param']}"] = float(change["effective"])
        self._save()

    def _save(self) -> None:
        """Write the memory whole and swap it in, so that a crash leaves the old one or the new one."""
        scratch = self._path.with_suffix(".new")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with scratch.open("wb") as file:
            file.write(orjson.dumps(self.state, option=orjson.OPT_INDENT_2))
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave the new name with nothing in it
        scratch.replace(self._path)
        folder = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)  # else it may bring the old memory back, and a step is proposed under another key
        finally:
            os.close(folder)


def recall(path: Path, identity: str) -> AgentState:
    """Return the remembered state, or a blank one for `identity`.

    Raises `ValueError` when the file is there but not a memory of this agent: forgetting silently would repeat
    finished work.
    """
    if not path.exists():
        return AgentState(identity=identity)
    try:
        state = _STATE.validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        said = f"{first['msg']} at `{where}`"
        raise ValueError(f"`{path}` is not an agent's memory: {said}; move it away to start afresh") from error
    if state.identity != identity:
        raise ValueError(f"`{path}` is the memory of `{state.identity}`, not of `{identity}`")
    return state
