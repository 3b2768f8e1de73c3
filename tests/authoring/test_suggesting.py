"""Suggestions from logs that the real runtime wrote: each with its evidence, none without enough of it."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import orjson
import pytest
import yaml
from typer.testing import CliRunner

from app.audit.errors import RecordDamaged
from app.authoring.habits import Habits, read_habits
from app.authoring.patches import Patching
from app.authoring.suggesting import Least, Suggestion, suggest
from app.authoring.vetting import Vetted, Vetting
from app.cli import app
from app.governance import cases
from app.governance.bundle import load, load_files, read_cases, read_properties
from app.governance.changes import Direction
from app.governance.errors import PolicyErrors
from app.governance.model import GrantScope
from app.governance.policy import PolicySet
from app.governance.policy_model import Effect
from app.runtime.assembly import Runtime
from app.runtime.grant import Offer
from app.runtime.invocation import ProposalRequest
from tests.proofs.planted import standing
from tests.runtime.conftest import AGENT, AT_BENCH, CELL, OPERATOR, HandCell, House

POLICIES = Path(__file__).resolve().parents[2] / "policies"
LEAST = Least(decisions=6, answers=4, silent=20, overrides=3)
SPEEDS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
CARRYING: dict[str, Any] = {**AT_BENCH, "gripper_empty": False, "holding": "mug_1"}
SEEN = {"visible": True, "reachable": True, "x_m": 1.5, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
AT_SHELF: dict[str, Any] = {**AT_BENCH, "objects": {"box_1": SEEN, "solvent_1": SEEN}}


@cache
def shipped() -> PolicySet:
    return load(POLICIES)


@dataclass
class Floor:
    """A runtime, its one cell, and what people and agents do with it."""

    runtime: Runtime
    cell: HandCell

    async def under(self, profile: str, facts: dict[str, Any] = AT_BENCH) -> None:
        self.cell.facts = facts
        self.runtime.fleet.cell(CELL).profile = profile
        await self.cell.state()

    async def ask(self, capability: str, metadata: dict[str, Any] | None = None, **params: Any) -> dict[str, Any]:
        request = ProposalRequest(capability=capability, params=params, metadata=metadata or {})
        made, _ = await self.runtime.governor.propose(AGENT, request)
        if made["status"] == "running":
            await self.cell.ended(made["id"], "succeeded")
        return made

    async def answered(self, decision: str, capability: str, **asked: Any) -> None:
        edit, offer = asked.pop("edit", None), asked.pop("offer", None)
        made = await self.ask(capability, **asked)
        question = self.runtime.desk.pending_for(made["id"])
        assert question is not None, made
        await self.runtime.desk.resolve(question.id, OPERATOR, decision, question.digest, params=edit, offer=offer)
        if decision == "approve":
            await self.cell.ended(made["id"], "succeeded")

    async def driven_by_hand(self) -> None:
        lease = await self.runtime.governor.take_cell(CELL, OPERATOR)
        await self.cell.launched(lease["invocation"])
        await self.cell.ended(lease["invocation"], "taken_over")


Life = Callable[[Floor], Awaitable[None]]


def lived(folder: Path, life: Life, policy: PolicySet | None = None) -> Habits:
    """Let something happen on a real runtime, and read its log."""
    policy = policy or shipped()

    async def live() -> None:
        async with House(folder, policy).open() as runtime:
            await life(Floor(runtime, await HandCell(runtime).dial()))

    asyncio.run(live())
    return read_habits(folder, policy)


def found(habits: Habits, policy: PolicySet | None = None) -> dict[tuple[str, str], Suggestion]:
    return {(one.kind, one.about): one for one in suggest(policy or shipped(), habits, LEAST)}


def vetted(suggestion: Suggestion) -> Vetted:
    vetting = Vetting(shipped(), read_cases(POLICIES), read_properties(POLICIES), now=standing)
    return vetting.vet(suggestion)


async def hurried(floor: Floor) -> None:
    await floor.under("human-shared")
    for speed in SPEEDS:
        await floor.ask("navigate_to", target="dock", speed_mps=speed)


# -- bounds -----------------------------------------------------------------------------------------------------------


def test_a_limit_that_every_named_value_is_beyond_comes_with_the_bound_that_lets_half_of_them_through(
    tmp_path: Path,
) -> None:
    (one,) = found(lived(tmp_path / "data", hurried)).values()
    assert (one.kind, one.about) == ("always-bound", "human-shared/base_speed_mps")
    assert one.counts == {"named": 6, "bound": 0.3, "proposed": 0.6}
    assert len(one.events) == 6
    assert one.first < one.last
    assert "from 0.4 to 0.9" in one.words
    limit = load_files({**shipped().files, **one.files}).profiles["human-shared"].limits["base_speed_mps"]
    assert (limit.maximum, limit.source) == (
        0.6,
        "to be justified: was 0.3 (shipped default; replace it by your own risk assessment)",
    )


def test_one_value_within_the_limit_is_enough_for_no_suggestion(tmp_path: Path) -> None:
    async def once_slower(floor: Floor) -> None:
        await hurried(floor)
        await floor.ask("navigate_to", target="dock", speed_mps=0.2)

    assert found(lived(tmp_path / "data", once_slower)) == {}


def test_what_no_agent_named_says_nothing_about_a_bound(tmp_path: Path) -> None:
    async def by_default(floor: Floor) -> None:
        await floor.under("human-shared")
        for _ in range(8):
            made = await floor.ask("navigate_to", target="dock")
            assert made["policy"]["changes"], "the default speed is above the limit"

    assert found(lived(tmp_path / "data", by_default)) == {}


def test_a_conditional_bound_is_judged_by_the_decisions_in_which_its_condition_held(tmp_path: Path) -> None:
    async def firm(floor: Floor) -> None:
        await floor.under("sim-relaxed")
        for force in range(30, 36):
            await floor.ask("grasp_object", object_id="glass_1", force_n=force)
            await floor.ask("grasp_object", object_id="mug_1", force_n=force)

    (one,) = found(lived(tmp_path / "data", firm)).values()
    assert one.about == "organization/fragile-grip (force_n)"
    assert one.counts == {"named": 6, "bound": 20, "proposed": 32}
    assert "+    set: {force_n: {max: 32}, speed_mps: {max: 0.15}}" in one.patch


def test_a_limit_raised_beyond_a_promise_is_said_to_break_it(tmp_path: Path) -> None:
    (one,) = found(lived(tmp_path / "data", hurried)).values()
    said = vetted(one)
    assert not said.sound
    assert any("slow-base-among-people" in line for line in said.refuted)
    assert said.cases
    assert said.comparison is not None
    assert said.comparison.loosens
    assert any(transition.example for transition in said.comparison.decisions)
    assert said.document()["comparison"]["direction"] == said.comparison.direction


# -- approvals --------------------------------------------------------------------------------------------------------


async def unsure(floor: Floor) -> None:
    await floor.under("real-restricted")
    for _ in range(4):
        await floor.answered("approve", "grasp_object", metadata={"confidence": 0.3}, object_id="mug_1")


def test_a_rule_whose_questions_were_all_granted_may_go(tmp_path: Path) -> None:
    (one,) = found(lived(tmp_path / "data", unsure)).values()
    assert (one.kind, one.about) == ("always-granted", "organization/low-confidence")
    assert one.counts == {"granted": 4, "in_advance": 0, "denied": 0}
    without = load_files({**shipped().files, **one.files})
    assert shipped().rules.keys() - without.rules.keys() == {"organization/low-confidence"}


@pytest.mark.parametrize("decision", ["deny", "edit"])
def test_one_denial_or_one_edit_is_enough_to_keep_a_question(tmp_path: Path, decision: str) -> None:
    async def mostly(floor: Floor) -> None:
        await unsure(floor)
        edit = {"force_n": 10} if decision == "edit" else None
        asked = {"metadata": {"confidence": 0.3}, "object_id": "mug_1", "edit": edit}
        await floor.answered("deny" if decision == "deny" else "approve", "grasp_object", **asked)

    assert found(lived(tmp_path / "data", mostly)) == {}


def test_no_rule_that_has_a_say_in_critical_risk_is_suggested_away(tmp_path: Path) -> None:
    habits = lived(tmp_path / "data", unsure)
    file = "capabilities/operate_tool.yaml"
    text = shipped().files[file]
    assert "risk: high" in text
    critical = load_files({**shipped().files, file: text.replace("risk: high", "risk: critical")})
    idle = Least(decisions=6, answers=4, silent=1, overrides=3)
    about = {one.about for one in suggest(shipped(), habits, idle)}
    spared = {one.about for one in suggest(critical, habits, idle)}
    assert about - spared == {"organization/low-confidence"}
    assert "organization/press-two-approvers" not in about


def test_what_could_not_be_decided_before_excuses_nothing_that_is_refuted_now(tmp_path: Path) -> None:
    (one,) = found(lived(tmp_path / "data", unsure)).values()
    now_s, step_s = 0.0, 3600.0

    def clock() -> float:
        nonlocal now_s
        now_s += step_s
        return now_s

    vetting = Vetting(shipped(), read_cases(POLICIES), read_properties(POLICIES), now=clock)
    vetting.vet(one)  # nothing is decided in time, of the policy as it stands neither
    step_s = 0.0
    said = vetting.vet(one)
    assert not said.sound
    assert any("unsure-passes-a-human" in line for line in said.refuted)


def test_what_was_always_denied_may_be_denied_at_once(tmp_path: Path) -> None:
    async def heavy(floor: Floor) -> None:
        await floor.under("real-restricted", AT_SHELF)
        for _ in range(4):
            await floor.answered("deny", "grasp_object", object_id="box_1")

    (one,) = found(lived(tmp_path / "data", heavy)).values()
    assert (one.kind, one.about) == ("never-granted", "organization/payload-margin")
    said = vetted(one)
    assert said.sound
    assert said.comparison is not None
    assert said.comparison.direction is Direction.TIGHTENS


def test_what_was_granted_where_something_else_asked_too_is_not_denied_at_once(tmp_path: Path) -> None:
    async def heavy(floor: Floor) -> None:
        await floor.under("real-restricted", AT_SHELF)
        for _ in range(4):
            await floor.answered("deny", "grasp_object", object_id="box_1")
        await floor.answered("approve", "grasp_object", metadata={"confidence": 0.3}, object_id="box_1")

    async def carrying(floor: Floor) -> None:
        await floor.under("human-shared", CARRYING)
        for _ in range(4):
            await floor.answered("deny", "transport_object", target="bench_a_stand")
        await floor.answered("approve", "transport_object", metadata={"confidence": 0.3}, target="bench_a_stand")

    assert found(lived(tmp_path / "by a rule", heavy)) == {}
    assert found(lived(tmp_path / "by authority", carrying)) == {}


def test_a_rule_that_has_two_people_asked_anywhere_is_not_suggested_away(tmp_path: Path) -> None:
    file = "profiles/real-restricted.yaml"
    text = shipped().files[file].replace("approvers: {default: 1, critical: 2}", "approvers: {default: 1, high: 2}")
    pairs = load_files({**shipped().files, file: text})
    assert pairs.digest != shipped().digest
    habits = lived(tmp_path / "data", unsure, pairs)
    idle = Least(decisions=6, answers=4, silent=1, overrides=3)
    assert "organization/low-confidence" not in {one.about for one in suggest(pairs, habits, idle)}


async def of_medium_risk(floor: Floor) -> None:
    for _ in range(4):
        await floor.under("human-shared")
        await floor.answered("approve", "grasp_object", object_id="mug_1")
        await floor.under("human-shared", CARRYING)
        await floor.answered("approve", "transport_object", target="bench_a_stand")


def test_a_risk_is_asked_about_no_more_only_where_everything_of_it_was_granted(tmp_path: Path) -> None:
    async def grasps_alone(floor: Floor) -> None:
        await floor.under("human-shared")
        for _ in range(8):
            await floor.answered("approve", "grasp_object", object_id="mug_1")

    assert found(lived(tmp_path / "grasps", grasps_alone)) == {}
    (one,) = found(lived(tmp_path / "both", of_medium_risk)).values()
    assert (one.kind, one.about) == ("always-granted", "medium risk in human-shared")
    assert one.counts == {"grasp_object": 4, "transport_object": 4, "in_advance": 0}
    changed = load_files({**shipped().files, **one.files})
    approval = changed.profiles["human-shared"].approval
    assert approval is not None
    assert {risk.value for risk in approval.risks} == {"high", "critical"}
    assert {
        changed.capabilities[name].env_profile["human-shared"] for name in ("grasp_object", "transport_object")
    } == {"guarded"}


def test_a_standing_grant_answers_for_what_it_launched(tmp_path: Path) -> None:
    async def in_advance(floor: Floor) -> None:
        await floor.under("human-shared", CARRYING)
        for _ in range(4):
            await floor.answered("approve", "transport_object", target="bench_a_stand")
        await floor.under("human-shared")
        offer = Offer(scope=GrantScope.OBJECT, minutes=5)
        await floor.answered("approve", "grasp_object", object_id="mug_1", offer=offer)
        for _ in range(3):
            made = await floor.ask("grasp_object", object_id="mug_1")
            assert made["status"] == "running"

    (one,) = found(lived(tmp_path / "data", in_advance)).values()
    assert one.counts == {"grasp_object": 4, "transport_object": 4, "in_advance": 3}
    assert "3 of them in advance, by standing grants" in one.words


def test_what_is_marked_and_always_denied_may_be_forbidden(tmp_path: Path) -> None:
    async def pressing(floor: Floor) -> None:
        await floor.under("human-shared", CARRYING)
        for _ in range(4):
            await floor.answered("deny", "transport_object", target="bench_a_stand")

    (one,) = found(lived(tmp_path / "data", pressing)).values()
    assert (one.kind, one.about) == ("never-granted", "transport_object in human-shared")
    changed = load_files({**shipped().files, **one.files})
    assert ("transport_object", "human-shared") not in changed.gates


# -- rules that decide nothing, and people who decide otherwise -------------------------------------------------------


def test_a_rule_that_decided_nothing_is_named_with_how_often_it_could_have(tmp_path: Path) -> None:
    async def careful(floor: Floor) -> None:
        await floor.under("sim-relaxed")
        for _ in range(20):
            await floor.ask("grasp_object", object_id="glass_1", force_n=10, speed_mps=0.1)

    idle = found(lived(tmp_path / "data", careful))
    names = [
        "hazardous",
        "forbidden-zone",
        "outside-site",
        "fragile-grip",
        "payload",
        "payload-margin",
        "low-confidence",
    ]
    assert idle.keys() == {("never-held", f"organization/{name}") for name in (*names, "low-confidence")}
    grip, zone = (idle["never-held", f"organization/{name}"] for name in ("fragile-grip", "forbidden-zone"))
    assert (grip.counts, zone.counts) == ({"applied": 20, "held": 20}, {"applied": 20, "held": 0})
    assert len(zone.events) == 20
    assert "organization/fragile-grip" not in load_files({**shipped().files, **grip.files}).rules
    assert "loosens policy" in grip.words
    guards = [
        one for one in idle.values() if one is not grip
    ]  # what denies or asks is not suggested away for its silence
    assert {shipped().rules[one.about].then for one in guards} == {Effect.DENY, Effect.ESCALATE}
    assert {(one.patch, one.unwritten != "", vetted(one).sound) for one in guards} == {("", True, False)}


def test_what_people_keep_lowering_becomes_a_bound(tmp_path: Path) -> None:
    async def gently(floor: Floor) -> None:
        await floor.under("human-shared")
        for force in (12, 15, 11):
            await floor.answered("approve", "grasp_object", object_id="mug_1", edit={"force_n": force})

    (one,) = found(lived(tmp_path / "data", gently)).values()
    assert (one.kind, one.about) == ("lowered-on-approval", "grasp_object in human-shared (force_n)")
    assert one.counts == {"lowered": 3, "approved": 3, "proposed": 15}
    rule = load_files({**shipped().files, **one.files}).rules["human-shared/grasp-object-force-n-as-approved"]
    assert [(setting.param, setting.maximum) for setting in rule.settings] == [("force_n", 15)]


async def carried(floor: Floor, *edits: dict[str, Any] | None, target: str = "bench_a_stand") -> None:
    await floor.under("human-shared", CARRYING)
    for edit in edits:
        await floor.answered("approve", "transport_object", target=target, edit=edit)


def test_what_people_keep_raising_becomes_a_bound_from_below(tmp_path: Path) -> None:
    async def widely(floor: Floor) -> None:
        await carried(floor, {"clearance_m": 0.5}, {"clearance_m": 0.4}, None, {"clearance_m": 0.6})

    one = found(lived(tmp_path / "data", widely))[
        "raised-on-approval", "transport_object in human-shared (clearance_m)"
    ]
    assert one.counts == {"raised": 3, "approved": 4, "proposed": 0.4}
    rule = load_files({**shipped().files, **one.files}).rules["human-shared/transport-object-clearance-m-as-approved"]
    assert [(setting.param, setting.minimum, setting.maximum) for setting in rule.settings] == [
        ("clearance_m", 0.4, None)
    ]
    comparison = vetted(one).comparison
    assert comparison is not None
    assert comparison.direction is Direction.TIGHTENS


def test_a_name_that_people_keep_putting_in_the_place_of_another_becomes_a_rule(tmp_path: Path) -> None:
    async def elsewhere(floor: Floor) -> None:
        await carried(floor, *[{"target": "dock"}] * 3)
        await carried(floor, None, None, None, None, target="bench_b_stand")

    one = found(lived(tmp_path / "data", elsewhere))["renamed-on-approval", "transport_object in human-shared (target)"]
    assert one.counts == {"renamed": 3, "approved": 3}
    assert len(one.events) == 3
    assert "shown with `bench_a_stand` made `target` `dock`" in one.words
    changed = load_files({**shipped().files, **one.files})
    rule = changed.rules["human-shared/transport-object-target-bench-a-stand-as-approved"]
    assert [(setting.param, setting.to) for setting in rule.settings] == [("target", '"dock"')]
    case = """
    cases:
    - {name: there, profile: human-shared, capability: transport_object, params: {target: bench_a_stand},
       context: {holding: mug_1}, expect: {status: awaiting_approval, rules: [%s]}}
    - {name: elsewhere, profile: human-shared, capability: transport_object, params: {target: bench_b_stand},
       context: {holding: mug_1}, expect: {status: awaiting_approval}}
    """
    there, other = cases.run(changed, {"tests/a.yaml": case % rule.id})
    assert there.differences == other.differences == ()
    (kept, _) = cases.run(shipped(), {"tests/a.yaml": case % rule.id})
    assert kept.differences


@pytest.mark.parametrize(
    "edits",
    [
        [{"clearance_m": 0.5}, {"clearance_m": 0.5}, {"clearance_m": 0.5}, {"clearance_m": 0.35}],
        [{"target": "dock"}, {"target": "dock"}, {"target": "dock"}, {"target": "tool_stand"}],
        [{"clearance_m": 0.5}, {"clearance_m": 0.5}, {"clearance_m": 0.5}, None, None, None, None],
        [{"clearance_m": 0.5}, {"clearance_m": 0.5}, None],
    ],
)
def test_edits_that_go_apart_or_are_no_habit_suggest_nothing(
    tmp_path: Path, edits: list[dict[str, Any] | None]
) -> None:
    async def now_so_now_so(floor: Floor) -> None:
        await floor.under("human-shared", CARRYING)
        for edit in edits:
            asked = {"target": "bench_a_stand", "clearance_m": 0.4}
            await floor.answered("approve", "transport_object", **asked, edit=edit)

    about = {about for _, about in found(lived(tmp_path / "data", now_so_now_so))}
    assert [one for one in about if "(clearance_m)" in one or "(target)" in one] == []


# -- permissions under supervision ------------------------------------------------------------------------------------


@cache
def watched() -> PolicySet:
    """Return the shipped policy, but that its planner looks around under supervision only."""
    file = "organization.yaml"
    text = shipped().files[file]
    was, now = "[navigation, perception, manipulation, tool_operation]", "[navigation, manipulation, tool_operation]"
    assert f"{{permissions: {was}}}" in text
    made = text.replace(f"{{permissions: {was}}}", f"{{permissions: {now}, supervised: [perception]}}")
    return load_files({**shipped().files, file: made})


async def looked(floor: Floor, decision: str, *profiles: str) -> None:
    for profile in profiles:
        await floor.under(profile)
        for _ in range(4):
            await floor.answered(decision, "inspect_area", area="bench_a_top")


def test_a_permission_whose_every_use_was_granted_may_be_held_without_supervision(tmp_path: Path) -> None:
    async def both(floor: Floor) -> None:
        await looked(floor, "approve", "human-shared", "real-restricted")

    habits = lived(tmp_path / "both", both, watched())
    one = found(habits, watched())["always-granted", "perception of planner"]
    assert (one.counts["granted"], len(one.events)) == (8, 8)
    changed = load_files({**watched().files, **one.files})
    assert changed.agents["planner"].permissions == shipped().agents["planner"].permissions
    assert changed.agents["planner"].supervised == frozenset()

    async def one_alone(floor: Floor) -> None:
        await looked(floor, "approve", "human-shared")

    assert found(lived(tmp_path / "one", one_alone, watched()), watched()) == {}


def test_a_permission_whose_every_use_was_denied_may_be_taken_away(tmp_path: Path) -> None:
    async def never(floor: Floor) -> None:
        await looked(floor, "deny", "human-shared")

    one = found(lived(tmp_path / "never", never, watched()), watched())["never-granted", "perception of planner"]
    changed = load_files({**watched().files, **one.files}).agents["planner"]
    assert "perception" not in changed.permissions | changed.supervised

    async def seldom(floor: Floor) -> None:
        await looked(floor, "deny", "human-shared")
        await floor.answered("approve", "inspect_area", area="bench_a_top")

    assert found(lived(tmp_path / "seldom", seldom, watched()), watched()) == {}


def test_a_refusal_after_which_a_person_took_the_cell_may_be_a_question(tmp_path: Path) -> None:
    async def by_hand(floor: Floor) -> None:
        await floor.under("human-shared", AT_SHELF)
        for _ in range(3):
            made = await floor.ask("grasp_object", object_id="solvent_1")
            assert made["status"] == "denied"
            await floor.driven_by_hand()
        await floor.driven_by_hand()

    one = found(lived(tmp_path / "data", by_hand))["taken-over", "organization/hazardous"]
    assert one.counts == {"taken_over": 3, "refused": 3}
    assert load_files({**shipped().files, **one.files}).rules["organization/hazardous"].then == "escalate"


# -- what is counted, and the command ---------------------------------------------------------------------------------


def test_another_version_and_an_earlier_time_count_for_nothing(tmp_path: Path) -> None:
    lived(tmp_path / "data", hurried)
    (one,) = found(read_habits(tmp_path / "data", shipped())).values()
    other = load_files({**shipped().files, **one.files})
    habits = read_habits(tmp_path / "data", other)
    assert (habits.decisions.count, habits.left_out) == (0, 6)
    assert suggest(other, habits, Least(decisions=1, answers=1, silent=1, overrides=1)) == []
    assert read_habits(tmp_path / "data", shipped(), since=4e9).decisions.count == 0


def test_a_directory_without_a_log_is_said(tmp_path: Path) -> None:
    with pytest.raises(RecordDamaged, match="no such log"):
        read_habits(tmp_path, shipped())


def test_a_rule_between_brackets_is_left_alone(tmp_path: Path) -> None:
    patching = Patching(shipped())
    with pytest.raises(PolicyErrors, match="brackets"):
        patching.drop_rule("authority/none")
    with pytest.raises(PolicyErrors, match="one line"):
        patching.set("organization.yaml", ("rules", 0), "x")


LISTS = {
    "on one line": ("a: {b: [x, y]}  # why\n", ["x"], "a: {b: [x]}  # why\n"),
    "over several lines": ("a:\n  b: [x,\n    y]  # why\nc: 1\n", ["y", "z"], "a:\n  b: [y, z]  # why\nc: 1\n"),
    "line by line, one less": ("a:\n  b:\n    - x  # one\n    - y\n    # end\n  c: 1\n", ["x"],
                               "a:\n  b:\n    - x  # one\n    # end\n  c: 1\n"),
    "line by line, one more": ("a:\n  b:\n  - x\n  # end\n  c: 1\n", ["w", "x"],
                               "a:\n  b:\n  - x\n  - w\n  # end\n  c: 1\n"),
    "line by line, another": ("a:\n  b:\n    - x\n    - y", ["x", "z"], "a:\n  b:\n    - x\n    - z\n"),
    "line by line, none left": ("a:\n  b:  # none\n    - x\n    - y\nc: 1\n", [], "a:\n  b: []  # none\nc: 1\n"),
    "not there, between brackets": ("a: {c: 1}\n", ["x"], "a: {b: [x], c: 1}\n"),
    "not there, and nothing else": ("a: {}\n", ["x"], "a: {b: [x]}\n"),
    "not there, line by line": ("# d\na:\n  c: 1\n", ["x"], "# d\na:\n  b: [x]\n  c: 1\n"),
}  # fmt: skip


@pytest.mark.parametrize(("before", "names", "after"), LISTS.values(), ids=LISTS)
def test_a_list_of_names_is_changed_however_it_is_written(before: str, names: list[str], after: str) -> None:
    patching = Patching(replace(shipped(), files={"o.yaml": before}))
    patching.hold("o.yaml", ("a", "b"), names)
    assert patching.changed == {"o.yaml": after}


@pytest.mark.parametrize("text", ["c: 1\n", "a:\n  b:\n    - x: 1\n", "a:\n  b:\n    - - x\n"])
def test_what_is_no_list_of_names_is_left_alone(text: str) -> None:
    with pytest.raises(PolicyErrors, match=r"a\.b: cannot be changed here: it "):
        Patching(replace(shipped(), files={"o.yaml": text})).hold("o.yaml", ("a", "b"), ["x"])


def test_a_permission_is_taken_away_where_each_has_a_line(tmp_path: Path) -> None:
    file, text = "organization.yaml", watched().files["organization.yaml"]
    was = "{permissions: [navigation, manipulation, tool_operation], supervised: [perception]}"
    assert was in text
    listed = "\n    permissions: [navigation, manipulation, tool_operation]\n    supervised:\n      - perception"
    policy = load_files({**watched().files, file: text.replace(f" {was}", listed)})

    async def never(floor: Floor) -> None:
        await looked(floor, "deny", "human-shared")

    (one,) = found(lived(tmp_path / "data", never, policy), policy).values()
    assert (one.kind, one.about, one.unwritten) == ("never-granted", "perception of planner", "")
    assert load_files({**policy.files, **one.files}).agents["planner"].supervised == frozenset()
    assert "-      - perception\n" in one.patch


def test_a_change_that_cannot_be_written_is_suggested_without_a_patch(tmp_path: Path) -> None:
    file, text = "organization.yaml", shipped().files["organization.yaml"]
    head, _, _ = text.partition("\nrules:\n")
    rules = orjson.dumps(yaml.safe_load(text)["rules"]).decode()
    policy = load_files({**shipped().files, file: f"{head}\nrules: {rules}\n"})
    (one,) = found(lived(tmp_path / "data", unsure, policy), policy).values()
    assert (one.kind, one.about, one.files, one.patch) == ("always-granted", "organization/low-confidence", {}, "")
    place = (
        f"organization.yaml:{head.count(chr(10)) + 2}: rules: cannot be changed here: it is written between brackets"
    )
    assert one.unwritten == place
    assert one.words.endswith("nobody would be asked. That loosens policy.")  # no comparison says it here
    said = vetted(one).document()
    assert (said["sound"], said["comparison"], said["unwritten"]) == (False, None, place)
    (tmp_path / "policies").mkdir()
    for name, content in {**policy.files, "properties.yaml": "order: []\n"}.items():
        file = tmp_path / "policies" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(content)
    command = ["policy", "suggest", "--data", str(tmp_path / "data"), "--policies", str(tmp_path / "policies")]
    told = CliRunner().invoke(app, [*command, "--least-answers", "4"])
    assert told.exit_code == 0
    assert f"no patch: {place}" in told.stdout


def test_the_command_prints_patches_that_apply(tmp_path: Path) -> None:
    lived(tmp_path / "data", unsure)
    before = {path: path.read_bytes() for path in POLICIES.rglob("*.yaml")}
    command = ["policy", "suggest", "--data", str(tmp_path / "data"), "--policies", str(POLICIES)]
    told = CliRunner().invoke(app, command)
    assert told.exit_code == 0
    assert "0 suggestions from 4 decisions" in told.stdout
    told = CliRunner().invoke(app, [*command, "--least-answers", "4", "--json"])
    assert told.exit_code == 0
    document = orjson.loads(told.stdout)
    (one,) = document["suggestions"]
    assert (document["decisions"], document["least"]["answers"]) == (4, 4)
    assert not one["sound"]
    assert any("unsure-passes-a-human" in line for line in one["refuted"])
    told = CliRunner().invoke(app, [*command, "--least-answers", "4"])
    assert "would be refused, for what is not true any more" in told.stdout
    assert one["patch"] in told.stdout
    shutil.copytree(POLICIES, tmp_path / "policies")
    subprocess.run(["git", "apply", "-"], input=one["patch"].encode(), cwd=tmp_path / "policies", check=True)
    assert "organization/low-confidence" not in load(tmp_path / "policies").rules
    assert {path: path.read_bytes() for path in POLICIES.rglob("*.yaml")} == before
    told = CliRunner().invoke(app, ["policy", "suggest", "--data", str(tmp_path), "--policies", str(POLICIES)])
    assert told.exit_code == 2


def test_a_printed_patch_applies_to_a_file_with_tabs(tmp_path: Path) -> None:
    shutil.copytree(POLICIES, tmp_path / "policies")
    file = tmp_path / "policies" / "organization.yaml"
    text = file.read_text().replace("    then: escalate\n", "    then: escalate\t# asks\n")
    file.write_text(text)
    lived(tmp_path / "data", unsure, load(tmp_path / "policies"))
    command = ["policy", "suggest", "--data", str(tmp_path / "data"), "--policies", str(tmp_path / "policies")]
    told = CliRunner().invoke(app, [*command, "--least-answers", "4"])
    assert told.exit_code == 0
    patch = told.stdout[told.stdout.index("--- a/") : told.stdout.index("1 suggestions from")]
    subprocess.run(["git", "apply", "-"], input=patch.encode(), cwd=tmp_path / "policies", check=True)
    assert "organization/low-confidence" not in load(tmp_path / "policies").rules
