"""Suggestions from logs that the real runtime wrote: each with its evidence, none without enough of it."""
from tests.proofs.planted import standing

from tests.proofs.planted import standing
from __future__ import annotations
from tests.proofs.planted import standing

from tests.proofs.planted import standing
import asyncio
from tests.proofs.planted import standing
import shutil
from tests.proofs.planted import standing
import subprocess
from tests.proofs.planted import standing
from collections.abc import Awaitable, Callable
from tests.proofs.planted import standing
from dataclasses import dataclass, replace
from tests.proofs.planted import standing
from functools import cache
from tests.proofs.planted import standing
from pathlib import Path
from tests.proofs.planted import standing
from typing import Any
from tests.proofs.planted import standing

from tests.proofs.planted import standing
import orjson
from tests.proofs.planted import standing
import pytest
from tests.proofs.planted import standing
import yaml
from tests.proofs.planted import standing
from typer.testing import CliRunner
from tests.proofs.planted import standing

from tests.proofs.planted import standing
from app.audit.errors import RecordDamaged
from tests.proofs.planted import standing
from app.authoring.habits import Habits, read_habits
from tests.proofs.planted import standing
from app.authoring.patches import Patching
from tests.proofs.planted import standing
from app.authoring.suggesting import Least, Suggestion, suggest
from tests.proofs.planted import standing
from app.authoring.vetting import Vetted, Vetting
from tests.proofs.planted import standing
from app.cli import app
from tests.proofs.planted import standing
from app.governance import cases
from tests.proofs.planted import standing
from app.governance.bundle import load, load_files, read_cases, read_properties
from tests.proofs.planted import standing
from app.governance.changes import Direction
from tests.proofs.planted import standing
from app.governance.errors import PolicyErrors
from tests.proofs.planted import standing
from app.governance.model import GrantScope
from tests.proofs.planted import standing
from app.governance.policy import PolicySet
from tests.proofs.planted import standing
from app.runtime.assembly import Runtime
from tests.proofs.planted import standing
from app.runtime.grant import Offer
from tests.proofs.planted import standing
from app.runtime.invocation import ProposalRequest
from tests.proofs.planted import standing
from tests.runtime.conftest import AGENT, AT_BENCH, CELL, OPERATOR, HandCell, House
from tests.proofs.planted import standing

from tests.proofs.planted import standing
POLICIES = Path(__file__).resolve().parents[2] / "policies"
from tests.proofs.planted import standing
LEAST = Least(decisions=6, answers=4, silent=20, overrides=3)
from tests.proofs.planted import standing
SPEEDS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
from tests.proofs.planted import standing
CARRYING: dict[str, Any] = {**AT_BENCH, "gripper_empty": False, "holding": "mug_1"}
from tests.proofs.planted import standing
SEEN = {"visible": True, "reachable": True, "x_m": 1.5, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
from tests.proofs.planted import standing
AT_SHELF: dict[str, Any] = {**AT_BENCH, "objects": {"box_1": SEEN, "solvent_1": SEEN}}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@cache
from tests.proofs.planted import standing
def shipped() -> PolicySet:
from tests.proofs.planted import standing
    return load(POLICIES)
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@dataclass
from tests.proofs.planted import standing
class Floor:
from tests.proofs.planted import standing
    """A runtime, its one cell, and what people and agents do with it."""
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    runtime: Runtime
from tests.proofs.planted import standing
    cell: HandCell
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def under(self, profile: str, facts: dict[str, Any] = AT_BENCH) -> None:
from tests.proofs.planted import standing
        self.cell.facts = facts
from tests.proofs.planted import standing
        self.runtime.fleet.cell(CELL).profile = profile
from tests.proofs.planted import standing
        await self.cell.state()
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def ask(self, capability: str, metadata: dict[str, Any] | None = None, **params: Any) -> dict[str, Any]:
from tests.proofs.planted import standing
        request = ProposalRequest(capability=capability, params=params, metadata=metadata or {})
from tests.proofs.planted import standing
        made, _ = await self.runtime.governor.propose(AGENT, request)
from tests.proofs.planted import standing
        if made["status"] == "running":
from tests.proofs.planted import standing
            await self.cell.ended(made["id"], "succeeded")
from tests.proofs.planted import standing
        return made
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def answered(self, decision: str, capability: str, **asked: Any) -> None:
from tests.proofs.planted import standing
        edit, offer = asked.pop("edit", None), asked.pop("offer", None)
from tests.proofs.planted import standing
        made = await self.ask(capability, **asked)
from tests.proofs.planted import standing
        question = self.runtime.desk.pending_for(made["id"])
from tests.proofs.planted import standing
        assert question is not None, made
from tests.proofs.planted import standing
        await self.runtime.desk.resolve(question.id, OPERATOR, decision, question.digest, params=edit, offer=offer)
from tests.proofs.planted import standing
        if decision == "approve":
from tests.proofs.planted import standing
            await self.cell.ended(made["id"], "succeeded")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def driven_by_hand(self) -> None:
from tests.proofs.planted import standing
        lease = await self.runtime.governor.take_cell(CELL, OPERATOR)
from tests.proofs.planted import standing
        await self.cell.launched(lease["invocation"])
from tests.proofs.planted import standing
        await self.cell.ended(lease["invocation"], "taken_over")
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
Life = Callable[[Floor], Awaitable[None]]
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def lived(folder: Path, life: Life, policy: PolicySet | None = None) -> Habits:
from tests.proofs.planted import standing
    """Let something happen on a real runtime, and read its log."""
from tests.proofs.planted import standing
    policy = policy or shipped()
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def live() -> None:
from tests.proofs.planted import standing
        async with House(folder, policy).open() as runtime:
from tests.proofs.planted import standing
            await life(Floor(runtime, await HandCell(runtime).dial()))
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    asyncio.run(live())
from tests.proofs.planted import standing
    return read_habits(folder, policy)
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def found(habits: Habits, policy: PolicySet | None = None) -> dict[tuple[str, str], Suggestion]:
from tests.proofs.planted import standing
    return {(one.kind, one.about): one for one in suggest(policy or shipped(), habits, LEAST)}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def vetted(suggestion: Suggestion) -> Vetted:
from tests.proofs.planted import standing
    vetting = Vetting(shipped(), read_cases(POLICIES), read_properties(POLICIES), now=standing)
from tests.proofs.planted import standing
    return vetting.vet(suggestion)
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
async def hurried(floor: Floor) -> None:
from tests.proofs.planted import standing
    await floor.under("human-shared")
from tests.proofs.planted import standing
    for speed in SPEEDS:
from tests.proofs.planted import standing
        await floor.ask("navigate_to", target="dock", speed_mps=speed)
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
# -- bounds -----------------------------------------------------------------------------------------------------------
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_limit_that_every_named_value_is_beyond_comes_with_the_bound_that_lets_half_of_them_through(
from tests.proofs.planted import standing
    tmp_path: Path,
from tests.proofs.planted import standing
) -> None:
from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", hurried)).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about) == ("always-bound", "human-shared/base_speed_mps")
from tests.proofs.planted import standing
    assert one.counts == {"named": 6, "bound": 0.3, "proposed": 0.6}
from tests.proofs.planted import standing
    assert len(one.events) == 6
from tests.proofs.planted import standing
    assert one.first < one.last
from tests.proofs.planted import standing
    assert "from 0.4 to 0.9" in one.words
from tests.proofs.planted import standing
    limit = load_files({**shipped().files, **one.files}).profiles["human-shared"].limits["base_speed_mps"]
from tests.proofs.planted import standing
    assert (limit.maximum, limit.source) == (
from tests.proofs.planted import standing
        0.6,
from tests.proofs.planted import standing
        "to be justified: was 0.3 (shipped default; replace it by your own risk assessment)",
from tests.proofs.planted import standing
    )
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_one_value_within_the_limit_is_enough_for_no_suggestion(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def once_slower(floor: Floor) -> None:
from tests.proofs.planted import standing
        await hurried(floor)
from tests.proofs.planted import standing
        await floor.ask("navigate_to", target="dock", speed_mps=0.2)
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    assert found(lived(tmp_path / "data", once_slower)) == {}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_what_no_agent_named_says_nothing_about_a_bound(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def by_default(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared")
from tests.proofs.planted import standing
        for _ in range(8):
from tests.proofs.planted import standing
            made = await floor.ask("navigate_to", target="dock")
from tests.proofs.planted import standing
            assert made["policy"]["changes"], "the default speed is above the limit"
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    assert found(lived(tmp_path / "data", by_default)) == {}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_conditional_bound_is_judged_by_the_decisions_in_which_its_condition_held(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def firm(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("sim-relaxed")
from tests.proofs.planted import standing
        for force in range(30, 36):
from tests.proofs.planted import standing
            await floor.ask("grasp_object", object_id="glass_1", force_n=force)
from tests.proofs.planted import standing
            await floor.ask("grasp_object", object_id="mug_1", force_n=force)
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", firm)).values()
from tests.proofs.planted import standing
    assert one.about == "organization/fragile-grip (force_n)"
from tests.proofs.planted import standing
    assert one.counts == {"named": 6, "bound": 20, "proposed": 32}
from tests.proofs.planted import standing
    assert "+    set: {force_n: {max: 32}, speed_mps: {max: 0.15}}" in one.patch
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_limit_raised_beyond_a_promise_is_said_to_break_it(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", hurried)).values()
from tests.proofs.planted import standing
    said = vetted(one)
from tests.proofs.planted import standing
    assert not said.sound
from tests.proofs.planted import standing
    assert any("slow-base-among-people" in line for line in said.refuted)
from tests.proofs.planted import standing
    assert said.cases
from tests.proofs.planted import standing
    assert said.comparison is not None
from tests.proofs.planted import standing
    assert said.comparison.loosens
from tests.proofs.planted import standing
    assert any(transition.example for transition in said.comparison.decisions)
from tests.proofs.planted import standing
    assert said.document()["comparison"]["direction"] == said.comparison.direction
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
# -- approvals --------------------------------------------------------------------------------------------------------
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
async def unsure(floor: Floor) -> None:
from tests.proofs.planted import standing
    await floor.under("real-restricted")
from tests.proofs.planted import standing
    for _ in range(4):
from tests.proofs.planted import standing
        await floor.answered("approve", "grasp_object", metadata={"confidence": 0.3}, object_id="mug_1")
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_rule_whose_questions_were_all_granted_may_go(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", unsure)).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about) == ("always-granted", "organization/low-confidence")
from tests.proofs.planted import standing
    assert one.counts == {"granted": 4, "in_advance": 0, "denied": 0}
from tests.proofs.planted import standing
    without = load_files({**shipped().files, **one.files})
from tests.proofs.planted import standing
    assert shipped().rules.keys() - without.rules.keys() == {"organization/low-confidence"}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@pytest.mark.parametrize("decision", ["deny", "edit"])
from tests.proofs.planted import standing
def test_one_denial_or_one_edit_is_enough_to_keep_a_question(tmp_path: Path, decision: str) -> None:
from tests.proofs.planted import standing
    async def mostly(floor: Floor) -> None:
from tests.proofs.planted import standing
        await unsure(floor)
from tests.proofs.planted import standing
        edit = {"force_n": 10} if decision == "edit" else None
from tests.proofs.planted import standing
        asked = {"metadata": {"confidence": 0.3}, "object_id": "mug_1", "edit": edit}
from tests.proofs.planted import standing
        await floor.answered("deny" if decision == "deny" else "approve", "grasp_object", **asked)
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    assert found(lived(tmp_path / "data", mostly)) == {}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_no_rule_that_has_a_say_in_critical_risk_is_suggested_away(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    habits = lived(tmp_path / "data", unsure)
from tests.proofs.planted import standing
    file = "capabilities/operate_tool.yaml"
from tests.proofs.planted import standing
    text = shipped().files[file]
from tests.proofs.planted import standing
    assert "risk: high" in text
from tests.proofs.planted import standing
    critical = load_files({**shipped().files, file: text.replace("risk: high", "risk: critical")})
from tests.proofs.planted import standing
    idle = Least(decisions=6, answers=4, silent=1, overrides=3)
from tests.proofs.planted import standing
    about = {one.about for one in suggest(shipped(), habits, idle)}
from tests.proofs.planted import standing
    spared = {one.about for one in suggest(critical, habits, idle)}
from tests.proofs.planted import standing
    assert about - spared == {"organization/low-confidence"}
from tests.proofs.planted import standing
    assert "organization/press-two-approvers" not in about
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_what_was_always_denied_may_be_denied_at_once(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def heavy(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("real-restricted", AT_SHELF)
from tests.proofs.planted import standing
        for _ in range(4):
from tests.proofs.planted import standing
            await floor.answered("deny", "grasp_object", object_id="box_1")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", heavy)).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about) == ("never-granted", "organization/payload-margin")
from tests.proofs.planted import standing
    said = vetted(one)
from tests.proofs.planted import standing
    assert said.sound
from tests.proofs.planted import standing
    assert said.comparison is not None
from tests.proofs.planted import standing
    assert said.comparison.direction is Direction.TIGHTENS
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
async def of_medium_risk(floor: Floor) -> None:
from tests.proofs.planted import standing
    for _ in range(4):
from tests.proofs.planted import standing
        await floor.under("human-shared")
from tests.proofs.planted import standing
        await floor.answered("approve", "grasp_object", object_id="mug_1")
from tests.proofs.planted import standing
        await floor.under("human-shared", CARRYING)
from tests.proofs.planted import standing
        await floor.answered("approve", "transport_object", target="bench_a_stand")
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_risk_is_asked_about_no_more_only_where_everything_of_it_was_granted(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def grasps_alone(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared")
from tests.proofs.planted import standing
        for _ in range(8):
from tests.proofs.planted import standing
            await floor.answered("approve", "grasp_object", object_id="mug_1")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    assert found(lived(tmp_path / "grasps", grasps_alone)) == {}
from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "both", of_medium_risk)).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about) == ("always-granted", "medium risk in human-shared")
from tests.proofs.planted import standing
    assert one.counts == {"grasp_object": 4, "transport_object": 4, "in_advance": 0}
from tests.proofs.planted import standing
    changed = load_files({**shipped().files, **one.files})
from tests.proofs.planted import standing
    approval = changed.profiles["human-shared"].approval
from tests.proofs.planted import standing
    assert approval is not None
from tests.proofs.planted import standing
    assert {risk.value for risk in approval.risks} == {"high", "critical"}
from tests.proofs.planted import standing
    assert {
from tests.proofs.planted import standing
        changed.capabilities[name].env_profile["human-shared"] for name in ("grasp_object", "transport_object")
from tests.proofs.planted import standing
    } == {"guarded"}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_standing_grant_answers_for_what_it_launched(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def in_advance(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared", CARRYING)
from tests.proofs.planted import standing
        for _ in range(4):
from tests.proofs.planted import standing
            await floor.answered("approve", "transport_object", target="bench_a_stand")
from tests.proofs.planted import standing
        await floor.under("human-shared")
from tests.proofs.planted import standing
        offer = Offer(scope=GrantScope.OBJECT, minutes=5)
from tests.proofs.planted import standing
        await floor.answered("approve", "grasp_object", object_id="mug_1", offer=offer)
from tests.proofs.planted import standing
        for _ in range(3):
from tests.proofs.planted import standing
            made = await floor.ask("grasp_object", object_id="mug_1")
from tests.proofs.planted import standing
            assert made["status"] == "running"
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", in_advance)).values()
from tests.proofs.planted import standing
    assert one.counts == {"grasp_object": 4, "transport_object": 4, "in_advance": 3}
from tests.proofs.planted import standing
    assert "3 of them in advance, by standing grants" in one.words
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_what_is_marked_and_always_denied_may_be_forbidden(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def pressing(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared", CARRYING)
from tests.proofs.planted import standing
        for _ in range(4):
from tests.proofs.planted import standing
            await floor.answered("deny", "transport_object", target="bench_a_stand")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", pressing)).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about) == ("never-granted", "transport_object in human-shared")
from tests.proofs.planted import standing
    changed = load_files({**shipped().files, **one.files})
from tests.proofs.planted import standing
    assert ("transport_object", "human-shared") not in changed.gates
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
# -- rules that decide nothing, and people who decide otherwise -------------------------------------------------------
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_rule_that_decided_nothing_is_named_with_how_often_it_could_have(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def careful(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("sim-relaxed")
from tests.proofs.planted import standing
        for _ in range(20):
from tests.proofs.planted import standing
            await floor.ask("grasp_object", object_id="glass_1", force_n=10, speed_mps=0.1)
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    idle = found(lived(tmp_path / "data", careful))
from tests.proofs.planted import standing
    names = [
from tests.proofs.planted import standing
        "hazardous",
from tests.proofs.planted import standing
        "forbidden-zone",
from tests.proofs.planted import standing
        "outside-site",
from tests.proofs.planted import standing
        "fragile-grip",
from tests.proofs.planted import standing
        "payload",
from tests.proofs.planted import standing
        "payload-margin",
from tests.proofs.planted import standing
        "low-confidence",
from tests.proofs.planted import standing
    ]
from tests.proofs.planted import standing
    assert idle.keys() == {("never-held", f"organization/{name}") for name in (*names, "low-confidence")}
from tests.proofs.planted import standing
    grip, zone = (idle["never-held", f"organization/{name}"] for name in ("fragile-grip", "forbidden-zone"))
from tests.proofs.planted import standing
    assert (grip.counts, zone.counts) == ({"applied": 20, "held": 20}, {"applied": 20, "held": 0})
from tests.proofs.planted import standing
    assert len(zone.events) == 20
from tests.proofs.planted import standing
    assert "organization/forbidden-zone" not in load_files({**shipped().files, **zone.files}).rules
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_what_people_keep_lowering_becomes_a_bound(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def gently(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared")
from tests.proofs.planted import standing
        for force in (12, 15, 11):
from tests.proofs.planted import standing
            await floor.answered("approve", "grasp_object", object_id="mug_1", edit={"force_n": force})
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", gently)).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about) == ("lowered-on-approval", "grasp_object in human-shared (force_n)")
from tests.proofs.planted import standing
    assert one.counts == {"lowered": 3, "approved": 3, "proposed": 15}
from tests.proofs.planted import standing
    rule = load_files({**shipped().files, **one.files}).rules["human-shared/grasp-object-force-n-as-approved"]
from tests.proofs.planted import standing
    assert [(setting.param, setting.maximum) for setting in rule.settings] == [("force_n", 15)]
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
async def carried(floor: Floor, *edits: dict[str, Any] | None, target: str = "bench_a_stand") -> None:
from tests.proofs.planted import standing
    await floor.under("human-shared", CARRYING)
from tests.proofs.planted import standing
    for edit in edits:
from tests.proofs.planted import standing
        await floor.answered("approve", "transport_object", target=target, edit=edit)
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_what_people_keep_raising_becomes_a_bound_from_below(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def widely(floor: Floor) -> None:
from tests.proofs.planted import standing
        await carried(floor, {"clearance_m": 0.5}, {"clearance_m": 0.4}, None, {"clearance_m": 0.6})
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    one = found(lived(tmp_path / "data", widely))[
from tests.proofs.planted import standing
        "raised-on-approval", "transport_object in human-shared (clearance_m)"
from tests.proofs.planted import standing
    ]
from tests.proofs.planted import standing
    assert one.counts == {"raised": 3, "approved": 4, "proposed": 0.4}
from tests.proofs.planted import standing
    rule = load_files({**shipped().files, **one.files}).rules["human-shared/transport-object-clearance-m-as-approved"]
from tests.proofs.planted import standing
    assert [(setting.param, setting.minimum, setting.maximum) for setting in rule.settings] == [
from tests.proofs.planted import standing
        ("clearance_m", 0.4, None)
from tests.proofs.planted import standing
    ]
from tests.proofs.planted import standing
    comparison = vetted(one).comparison
from tests.proofs.planted import standing
    assert comparison is not None
from tests.proofs.planted import standing
    assert comparison.direction is Direction.TIGHTENS
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_name_that_people_keep_putting_in_the_place_of_another_becomes_a_rule(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def elsewhere(floor: Floor) -> None:
from tests.proofs.planted import standing
        await carried(floor, *[{"target": "dock"}] * 3)
from tests.proofs.planted import standing
        await carried(floor, None, None, None, None, target="bench_b_stand")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    one = found(lived(tmp_path / "data", elsewhere))["renamed-on-approval", "transport_object in human-shared (target)"]
from tests.proofs.planted import standing
    assert one.counts == {"renamed": 3, "approved": 3}
from tests.proofs.planted import standing
    assert len(one.events) == 3
from tests.proofs.planted import standing
    assert "shown with `bench_a_stand` made `target` `dock`" in one.words
from tests.proofs.planted import standing
    changed = load_files({**shipped().files, **one.files})
from tests.proofs.planted import standing
    rule = changed.rules["human-shared/transport-object-target-bench-a-stand-as-approved"]
from tests.proofs.planted import standing
    assert [(setting.param, setting.to) for setting in rule.settings] == [("target", '"dock"')]
from tests.proofs.planted import standing
    case = """
from tests.proofs.planted import standing
    cases:
from tests.proofs.planted import standing
    - {name: there, profile: human-shared, capability: transport_object, params: {target: bench_a_stand},
from tests.proofs.planted import standing
       context: {holding: mug_1}, expect: {status: awaiting_approval, rules: [%s]}}
from tests.proofs.planted import standing
    - {name: elsewhere, profile: human-shared, capability: transport_object, params: {target: bench_b_stand},
from tests.proofs.planted import standing
       context: {holding: mug_1}, expect: {status: awaiting_approval}}
from tests.proofs.planted import standing
    """
from tests.proofs.planted import standing
    there, other = cases.run(changed, {"tests/a.yaml": case % rule.id})
from tests.proofs.planted import standing
    assert there.differences == other.differences == ()
from tests.proofs.planted import standing
    (kept, _) = cases.run(shipped(), {"tests/a.yaml": case % rule.id})
from tests.proofs.planted import standing
    assert kept.differences
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@pytest.mark.parametrize(
from tests.proofs.planted import standing
    "edits",
from tests.proofs.planted import standing
    [
from tests.proofs.planted import standing
        [{"clearance_m": 0.5}, {"clearance_m": 0.5}, {"clearance_m": 0.5}, {"clearance_m": 0.35}],
from tests.proofs.planted import standing
        [{"target": "dock"}, {"target": "dock"}, {"target": "dock"}, {"target": "tool_stand"}],
from tests.proofs.planted import standing
        [{"clearance_m": 0.5}, {"clearance_m": 0.5}, {"clearance_m": 0.5}, None, None, None, None],
from tests.proofs.planted import standing
        [{"clearance_m": 0.5}, {"clearance_m": 0.5}, None],
from tests.proofs.planted import standing
    ],
from tests.proofs.planted import standing
)
from tests.proofs.planted import standing
def test_edits_that_go_apart_or_are_no_habit_suggest_nothing(
from tests.proofs.planted import standing
    tmp_path: Path, edits: list[dict[str, Any] | None]
from tests.proofs.planted import standing
) -> None:
from tests.proofs.planted import standing
    async def now_so_now_so(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared", CARRYING)
from tests.proofs.planted import standing
        for edit in edits:
from tests.proofs.planted import standing
            asked = {"target": "bench_a_stand", "clearance_m": 0.4}
from tests.proofs.planted import standing
            await floor.answered("approve", "transport_object", **asked, edit=edit)
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    about = {about for _, about in found(lived(tmp_path / "data", now_so_now_so))}
from tests.proofs.planted import standing
    assert [one for one in about if "(clearance_m)" in one or "(target)" in one] == []
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
# -- permissions under supervision ------------------------------------------------------------------------------------
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@cache
from tests.proofs.planted import standing
def watched() -> PolicySet:
from tests.proofs.planted import standing
    """Return the shipped policy, but that its planner looks around under supervision only."""
from tests.proofs.planted import standing
    file = "organization.yaml"
from tests.proofs.planted import standing
    text = shipped().files[file]
from tests.proofs.planted import standing
    was, now = "[navigation, perception, manipulation, tool_operation]", "[navigation, manipulation, tool_operation]"
from tests.proofs.planted import standing
    assert f"{{permissions: {was}}}" in text
from tests.proofs.planted import standing
    made = text.replace(f"{{permissions: {was}}}", f"{{permissions: {now}, supervised: [perception]}}")
from tests.proofs.planted import standing
    return load_files({**shipped().files, file: made})
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
async def looked(floor: Floor, decision: str, *profiles: str) -> None:
from tests.proofs.planted import standing
    for profile in profiles:
from tests.proofs.planted import standing
        await floor.under(profile)
from tests.proofs.planted import standing
        for _ in range(4):
from tests.proofs.planted import standing
            await floor.answered(decision, "inspect_area", area="bench_a_top")
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_permission_whose_every_use_was_granted_may_be_held_without_supervision(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def both(floor: Floor) -> None:
from tests.proofs.planted import standing
        await looked(floor, "approve", "human-shared", "real-restricted")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    habits = lived(tmp_path / "both", both, watched())
from tests.proofs.planted import standing
    one = found(habits, watched())["always-granted", "perception of planner"]
from tests.proofs.planted import standing
    assert (one.counts["granted"], len(one.events)) == (8, 8)
from tests.proofs.planted import standing
    changed = load_files({**watched().files, **one.files})
from tests.proofs.planted import standing
    assert changed.agents["planner"].permissions == shipped().agents["planner"].permissions
from tests.proofs.planted import standing
    assert changed.agents["planner"].supervised == frozenset()
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def one_alone(floor: Floor) -> None:
from tests.proofs.planted import standing
        await looked(floor, "approve", "human-shared")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    assert found(lived(tmp_path / "one", one_alone, watched()), watched()) == {}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_permission_whose_every_use_was_denied_may_be_taken_away(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def never(floor: Floor) -> None:
from tests.proofs.planted import standing
        await looked(floor, "deny", "human-shared")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    one = found(lived(tmp_path / "never", never, watched()), watched())["never-granted", "perception of planner"]
from tests.proofs.planted import standing
    changed = load_files({**watched().files, **one.files}).agents["planner"]
from tests.proofs.planted import standing
    assert "perception" not in changed.permissions | changed.supervised
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def seldom(floor: Floor) -> None:
from tests.proofs.planted import standing
        await looked(floor, "deny", "human-shared")
from tests.proofs.planted import standing
        await floor.answered("approve", "inspect_area", area="bench_a_top")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    assert found(lived(tmp_path / "seldom", seldom, watched()), watched()) == {}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_refusal_after_which_a_person_took_the_cell_may_be_a_question(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    async def by_hand(floor: Floor) -> None:
from tests.proofs.planted import standing
        await floor.under("human-shared", AT_SHELF)
from tests.proofs.planted import standing
        for _ in range(3):
from tests.proofs.planted import standing
            made = await floor.ask("grasp_object", object_id="solvent_1")
from tests.proofs.planted import standing
            assert made["status"] == "denied"
from tests.proofs.planted import standing
            await floor.driven_by_hand()
from tests.proofs.planted import standing
        await floor.driven_by_hand()
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    one = found(lived(tmp_path / "data", by_hand))["taken-over", "organization/hazardous"]
from tests.proofs.planted import standing
    assert one.counts == {"taken_over": 3, "refused": 3}
from tests.proofs.planted import standing
    assert load_files({**shipped().files, **one.files}).rules["organization/hazardous"].then == "escalate"
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
# -- what is counted, and the command ---------------------------------------------------------------------------------
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_another_version_and_an_earlier_time_count_for_nothing(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    lived(tmp_path / "data", hurried)
from tests.proofs.planted import standing
    (one,) = found(read_habits(tmp_path / "data", shipped())).values()
from tests.proofs.planted import standing
    other = load_files({**shipped().files, **one.files})
from tests.proofs.planted import standing
    habits = read_habits(tmp_path / "data", other)
from tests.proofs.planted import standing
    assert (habits.decisions.count, habits.left_out) == (0, 6)
from tests.proofs.planted import standing
    assert suggest(other, habits, Least(decisions=1, answers=1, silent=1, overrides=1)) == []
from tests.proofs.planted import standing
    assert read_habits(tmp_path / "data", shipped(), since=4e9).decisions.count == 0
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_directory_without_a_log_is_said(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    with pytest.raises(RecordDamaged, match="no such log"):
from tests.proofs.planted import standing
        read_habits(tmp_path, shipped())
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_rule_between_brackets_is_left_alone(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    patching = Patching(shipped())
from tests.proofs.planted import standing
    with pytest.raises(PolicyErrors, match="brackets"):
from tests.proofs.planted import standing
        patching.drop_rule("authority/none")
from tests.proofs.planted import standing
    with pytest.raises(PolicyErrors, match="one line"):
from tests.proofs.planted import standing
        patching.set("organization.yaml", ("rules", 0), "x")
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
LISTS = {
from tests.proofs.planted import standing
    "on one line": ("a: {b: [x, y]}  # why\n", ["x"], "a: {b: [x]}  # why\n"),
from tests.proofs.planted import standing
    "over several lines": ("a:\n  b: [x,\n    y]  # why\nc: 1\n", ["y", "z"], "a:\n  b: [y, z]  # why\nc: 1\n"),
from tests.proofs.planted import standing
    "line by line, one less": ("a:\n  b:\n    - x  # one\n    - y\n    # end\n  c: 1\n", ["x"],
from tests.proofs.planted import standing
                               "a:\n  b:\n    - x  # one\n    # end\n  c: 1\n"),
from tests.proofs.planted import standing
    "line by line, one more": ("a:\n  b:\n  - x\n  # end\n  c: 1\n", ["w", "x"],
from tests.proofs.planted import standing
                               "a:\n  b:\n  - x\n  - w\n  # end\n  c: 1\n"),
from tests.proofs.planted import standing
    "line by line, another": ("a:\n  b:\n    - x\n    - y", ["x", "z"], "a:\n  b:\n    - x\n    - z\n"),
from tests.proofs.planted import standing
    "line by line, none left": ("a:\n  b:  # none\n    - x\n    - y\nc: 1\n", [], "a:\n  b: []  # none\nc: 1\n"),
from tests.proofs.planted import standing
    "not there, between brackets": ("a: {c: 1}\n", ["x"], "a: {b: [x], c: 1}\n"),
from tests.proofs.planted import standing
    "not there, and nothing else": ("a: {}\n", ["x"], "a: {b: [x]}\n"),
from tests.proofs.planted import standing
    "not there, line by line": ("# d\na:\n  c: 1\n", ["x"], "# d\na:\n  b: [x]\n  c: 1\n"),
from tests.proofs.planted import standing
}  # fmt: skip
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@pytest.mark.parametrize(("before", "names", "after"), LISTS.values(), ids=LISTS)
from tests.proofs.planted import standing
def test_a_list_of_names_is_changed_however_it_is_written(before: str, names: list[str], after: str) -> None:
from tests.proofs.planted import standing
    patching = Patching(replace(shipped(), files={"o.yaml": before}))
from tests.proofs.planted import standing
    patching.hold("o.yaml", ("a", "b"), names)
from tests.proofs.planted import standing
    assert patching.changed == {"o.yaml": after}
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
@pytest.mark.parametrize("text", ["c: 1\n", "a:\n  b:\n    - x: 1\n", "a:\n  b:\n    - - x\n"])
from tests.proofs.planted import standing
def test_what_is_no_list_of_names_is_left_alone(text: str) -> None:
from tests.proofs.planted import standing
    with pytest.raises(PolicyErrors, match=r"a\.b: cannot be changed here: it "):
from tests.proofs.planted import standing
        Patching(replace(shipped(), files={"o.yaml": text})).hold("o.yaml", ("a", "b"), ["x"])
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_permission_is_taken_away_where_each_has_a_line(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    file, text = "organization.yaml", watched().files["organization.yaml"]
from tests.proofs.planted import standing
    was = "{permissions: [navigation, manipulation, tool_operation], supervised: [perception]}"
from tests.proofs.planted import standing
    assert was in text
from tests.proofs.planted import standing
    listed = "\n    permissions: [navigation, manipulation, tool_operation]\n    supervised:\n      - perception"
from tests.proofs.planted import standing
    policy = load_files({**watched().files, file: text.replace(f" {was}", listed)})
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    async def never(floor: Floor) -> None:
from tests.proofs.planted import standing
        await looked(floor, "deny", "human-shared")
from tests.proofs.planted import standing

from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", never, policy), policy).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about, one.unwritten) == ("never-granted", "perception of planner", "")
from tests.proofs.planted import standing
    assert load_files({**policy.files, **one.files}).agents["planner"].supervised == frozenset()
from tests.proofs.planted import standing
    assert "-      - perception\n" in one.patch
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_a_change_that_cannot_be_written_is_suggested_without_a_patch(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    file, text = "organization.yaml", shipped().files["organization.yaml"]
from tests.proofs.planted import standing
    head, _, _ = text.partition("\nrules:\n")
from tests.proofs.planted import standing
    rules = orjson.dumps(yaml.safe_load(text)["rules"]).decode()
from tests.proofs.planted import standing
    policy = load_files({**shipped().files, file: f"{head}\nrules: {rules}\n"})
from tests.proofs.planted import standing
    (one,) = found(lived(tmp_path / "data", unsure, policy), policy).values()
from tests.proofs.planted import standing
    assert (one.kind, one.about, one.files, one.patch) == ("always-granted", "organization/low-confidence", {}, "")
from tests.proofs.planted import standing
    place = (
from tests.proofs.planted import standing
        f"organization.yaml:{head.count(chr(10)) + 2}: rules: cannot be changed here: it is written between brackets"
from tests.proofs.planted import standing
    )
from tests.proofs.planted import standing
    assert one.unwritten == place
from tests.proofs.planted import standing
    said = vetted(one).document()
from tests.proofs.planted import standing
    assert (said["sound"], said["comparison"], said["unwritten"]) == (False, None, place)
from tests.proofs.planted import standing
    (tmp_path / "policies").mkdir()
from tests.proofs.planted import standing
    for name, content in {**policy.files, "properties.yaml": "order: []\n"}.items():
from tests.proofs.planted import standing
        file = tmp_path / "policies" / name
from tests.proofs.planted import standing
        file.parent.mkdir(exist_ok=True)
from tests.proofs.planted import standing
        file.write_text(content)
from tests.proofs.planted import standing
    command = ["policy", "suggest", "--data", str(tmp_path / "data"), "--policies", str(tmp_path / "policies")]
from tests.proofs.planted import standing
    told = CliRunner().invoke(app, [*command, "--least-answers", "4"])
from tests.proofs.planted import standing
    assert told.exit_code == 0
from tests.proofs.planted import standing
    assert f"no patch, to be changed by hand: {place}" in told.stdout
from tests.proofs.planted import standing

from tests.proofs.planted import standing

from tests.proofs.planted import standing
def test_the_command_prints_patches_that_apply(tmp_path: Path) -> None:
from tests.proofs.planted import standing
    lived(tmp_path / "data", unsure)
from tests.proofs.planted import standing
    before = {path: path.read_bytes() for path in POLICIES.rglob("*.yaml")}
from tests.proofs.planted import standing
    command = ["policy", "suggest", "--data", str(tmp_path / "data"), "--policies", str(POLICIES)]
from tests.proofs.planted import standing
    told = CliRunner().invoke(app, command)
from tests.proofs.planted import standing
    assert told.exit_code == 0
from tests.proofs.planted import standing
    assert "0 suggestions from 4 decisions" in told.stdout
from tests.proofs.planted import standing
    told = CliRunner().invoke(app, [*command, "--least-answers", "4", "--json"])
from tests.proofs.planted import standing
    assert told.exit_code == 0
from tests.proofs.planted import standing
    document = orjson.loads(told.stdout)
from tests.proofs.planted import standing
    (one,) = document["suggestions"]
from tests.proofs.planted import standing
    assert (document["decisions"], document["least"]["answers"]) == (4, 4)
from tests.proofs.planted import standing
    assert not one["sound"]
from tests.proofs.planted import standing
    assert any("unsure-passes-a-human" in line for line in one["refuted"])
from tests.proofs.planted import standing
    told = CliRunner().invoke(app, [*command, "--least-answers", "4"])
from tests.proofs.planted import standing
    assert "would be refused, for what is not true any more" in told.stdout
from tests.proofs.planted import standing
    assert one["patch"] in told.stdout
from tests.proofs.planted import standing
    shutil.copytree(POLICIES, tmp_path / "policies")
from tests.proofs.planted import standing
    subprocess.run(["git", "apply", "-"], input=one["patch"].encode(), cwd=tmp_path / "policies", check=True)
from tests.proofs.planted import standing
    assert "organization/low-confidence" not in load(tmp_path / "policies").rules
from tests.proofs.planted import standing
    assert {path: path.read_bytes() for path in POLICIES.rglob("*.yaml")} == before
from tests.proofs.planted import standing
    told = CliRunner().invoke(app, ["policy", "suggest", "--data", str(tmp_path), "--policies", str(POLICIES)])
from tests.proofs.planted import standing
    assert told.exit_code == 2
from tests.proofs.planted import standing
