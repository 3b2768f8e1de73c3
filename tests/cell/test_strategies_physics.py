"""Each recovery strategy is reached by a physical fault it is for, and does in the workcell what its name says."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import dist
from pathlib import Path
from typing import Any

import pytest

from app.governance.model import WatchPlan, Zone
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from tests.cell.workshop import Workshop

pytestmark = pytest.mark.physics

GRASP = {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25}
DRIVE = {"target": "dock", "speed_mps": 0.3, "clearance_m": 0.3}
AWAY = {"x_m": 1.6, "y_m": 3.0, "yaw_rad": 1.5708, "speed_mps": 0.3, "clearance_m": 0.1}
ELBOW = {"x_m": 1.6, "y_m": 4.5, "z_m": 1.72}
EDGE_M = 2.6


def fault(kind: str, at: Trigger, for_s: float | None = None, **sizes: Any) -> Fault:
    return Fault(kind=kind, at=at, sizes=sizes, for_s=for_s)


def driving(after_s: float) -> Trigger:
    return Trigger(capability="navigate_to", phase="drive", after_s=after_s)


def grasping(phase: str, after_s: float = 0.0) -> Trigger:
    return Trigger(capability="grasp_object", phase=phase, after_s=after_s)


def above_the_elbow() -> Fault:
    return fault("blocked", grasping("approach"), **ELBOW)


def test_retry_gives_a_drive_that_hung_a_second_attempt(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.hang(runs=1)
    shop.launch("navigate_to", **DRIVE)
    assert shop.finish()["outcome"] == "recovered"
    assert (shop.rules(), shop.strategies()) == (["stall"], ["RETRY"])
    dock = shop.policy.site.targets["dock"]
    assert dist(shop.cell.truth().base[:2], (dock.x_m, dock.y_m)) < 0.05


def test_a_new_attempt_puts_down_first_what_the_one_before_left_in_the_hand(tmp_path: Path) -> None:
    shop = Workshop(tmp_path, faults=(fault("habit", grasping("verify"), 6.0, habit="hung"),))
    shop.launch("grasp_object", object_id="glass_1", force_n=20.0, speed_mps=0.15)
    heights_m: list[float] = []
    while shop.runner.invocation is not None:
        shop.runner.tick()
        heights_m.append(shop.cell.plant.true_object("glass_1")[0][2])
    assert shop.last("outcome")["outcome"] == "recovered"
    assert (shop.rules(), shop.strategies()) == (["stall"], ["RETRY"])
    fastest_mps = max(before - after for before, after in pairwise(heights_m)) / shop.cell.period_s
    assert fastest_mps < 0.2  # what falls is faster after two centimetres
    assert shop.cell.truth().held == "glass_1"


def test_a_recovery_capability_stands_anew_after_something_unseen_held_the_base(tmp_path: Path) -> None:
    crate = fault("blocked", driving(0.5), 4.0, x_m=1.6, y_m=3.7, z_m=0.45)
    shop = Workshop(tmp_path, faults=(crate,))
    shop.launch("navigate_to", **AWAY)
    assert shop.finish()["outcome"] == "recovered"
    assert shop.strategies() == ["RECOVERY_CAPABILITY", "RETRY"]
    assert shop.of("recovery")[0]["capability"] == "reposition_base"
    assert dist(shop.cell.truth().base[:2], (AWAY["x_m"], AWAY["y_m"])) < 0.05


def test_safer_mode_goes_on_at_half_speed_after_drives_ran_away(tmp_path: Path) -> None:
    shop = Workshop(tmp_path, faults=(fault("speed_scaling", driving(1.0), 0.3, gain=1.6),))
    shop.launch("navigate_to", **DRIVE)
    while not shop.strategies():
        shop.runner.tick()
    for _ in range(60):
        shop.runner.tick()
    fastest = 0.0
    while shop.runner.invocation is not None:
        shop.runner.tick()
        fastest = max(fastest, shop.cell.truth().base_speed_mps)
    assert shop.last("outcome")["outcome"] == "recovered"
    assert shop.strategies() == ["SAFER_MODE"]
    assert 0.1 < fastest < 0.16


def test_rollback_brings_the_base_back_from_a_zone(tmp_path: Path) -> None:
    def across_the_way(plan: WatchPlan) -> WatchPlan:
        corners = ((-1.0, 0.0), (9.0, 0.0), (9.0, EDGE_M), (-1.0, EDGE_M))
        return replace(plan, zones=(Zone(name="new", kind="forbidden", polygon=corners),))

    shop = Workshop(tmp_path)
    shop.edit = across_the_way
    start, southernmost = shop.cell.truth().base, 9.0
    shop.launch("navigate_to", **DRIVE)
    while shop.runner.invocation is not None:
        shop.runner.tick()
        southernmost = min(southernmost, shop.cell.truth().base[1])
    assert shop.last("outcome")["outcome"] == "rolled_back"
    assert (shop.rules(), shop.strategies()) == (["zone"], ["ROLLBACK"])
    assert dist(shop.cell.truth().base, start) < 0.1
    assert southernmost - 0.45 > EDGE_M - 0.02  # it turned back before the hull was in


def test_rollback_puts_an_object_back_where_it_was_taken(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    was = shop.cell.truth().objects["mug_1"]
    shop.launch("grasp_object", **{**GRASP, "speed_mps": 0.033})  # slow enough to run out of time with the mug in hand
    held: list[bool] = []
    while shop.runner.invocation is not None:
        shop.runner.tick()
        held.append(shop.cell.truth().held == "mug_1")
    assert any(held)
    assert shop.last("outcome")["outcome"] == "rolled_back"
    assert (shop.rules(), shop.strategies()) == (["timeout"], ["ROLLBACK"])
    truth = shop.cell.truth()
    assert truth.held is None
    assert dist(truth.objects["mug_1"], was) < 0.02
    assert truth.upright["mug_1"]


def test_rollback_of_what_fell_over_when_it_was_put_back_has_failed(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **{**GRASP, "speed_mps": 0.033})
    while shop.cell.truth().held is None:
        shop.runner.tick()
    while shop.cell.truth().held is not None:
        shop.runner.tick()
    plant = shop.cell.plant
    plant.data.body("mug_1").xfrc_applied[3] = 0.2  # a knock: N m about its foot
    while plant.true_object("mug_1")[2] > 0.6:
        shop.runner.tick()
    plant.data.body("mug_1").xfrc_applied[3] = 0.0
    while shop.runner.status not in (None, "escalated"):
        shop.runner.tick()
    assert shop.last("recovery")["failure"] == "rollback_failed"
    assert shop.last("recovery")["unmet"] == ["object_pose"]
    assert not shop.cell.truth().upright["mug_1"]


def at_the_tools(folder: Path) -> Workshop:
    shop = Workshop(folder, profile="real-restricted")
    shop.launch("navigate_to", target="tool_stand", speed_mps=0.6, clearance_m=0.3)
    assert shop.finish()["outcome"] == "succeeded", shop.story()
    return shop


def rolled_back(shop: Workshop, number: int, action: str, tool: str, phase: str, after_ticks: int = 30) -> Any:
    """Work a tool, have that rolled back midway, and return how it ended: None where a human is asked."""
    shop.launch("operate_tool", number, tool=tool, action=action, force_n=40.0, speed_mps=0.15)
    while shop.runner.session is not None and shop.runner.session.run.skill.report().phase != phase:
        shop.runner.tick()
    for _ in range(after_ticks):
        shop.runner.tick()
    assert shop.runner.human(f"inv-{number}", "rollback", "operator") is None
    while shop.runner.status not in (None, "escalated"):
        shop.runner.tick()
    return shop.last("outcome")["outcome"] if shop.runner.status is None else None


@pytest.mark.parametrize(("phase", "after_ticks", "says"), [("operate", 160, "between"), ("release", 30, "down")])
def test_rollback_that_leaves_a_lever_elsewhere_has_failed(
    phase: str, after_ticks: int, says: str, tmp_path: Path
) -> None:
    shop = at_the_tools(tmp_path)
    assert rolled_back(shop, 2, "pull_down", "lever", phase, after_ticks) is None
    assert shop.cell.tool_state("lever") == says
    assert shop.last("recovery")["failure"] == "rollback_failed"
    assert "tool_state" in shop.last("recovery")["unmet"]  # type: ignore[operator]  # a list of names


def test_rollback_before_a_button_was_touched_is_one_whatever_the_session_before_did_to_it(tmp_path: Path) -> None:
    shop = at_the_tools(tmp_path)
    shop.launch("operate_tool", 2, tool="press", action="press", force_n=40.0, speed_mps=0.15)
    assert shop.finish()["outcome"] == "succeeded", shop.story()
    assert shop.cell.tool_state("press") == "pressed"
    assert rolled_back(shop, 3, "press", "press", "approach") == "rolled_back", shop.story()


def test_rollback_ends_where_the_session_began_whatever_recoveries_drove_in_between(tmp_path: Path) -> None:
    crate = fault("blocked", grasping("approach"), 6.0, **ELBOW)
    shop = Workshop(tmp_path, profile="test-audit", faults=(crate,))
    start, was = shop.cell.truth().base, shop.cell.truth().objects["mug_1"]
    shop.launch("grasp_object", **GRASP)
    while shop.strategies() != ["RECOVERY_CAPABILITY", "SAFER_MODE"]:  # it has backed off
        shop.runner.tick()
    assert shop.runner.human("inv-1", "rollback", "operator") is None
    while shop.runner.invocation is not None and "elsewhere" not in [told["reason"] for told in shop.of("recovery")]:
        shop.runner.tick()
    assert shop.of("recovery")[-1]["unmet"] == ["base_pose"]
    assert dist(shop.cell.truth().base[:2], start[:2]) > 0.15
    hardest_n = 0.0
    while shop.runner.invocation is not None:
        shop.runner.tick()
        hardest_n = max(hardest_n, shop.cell.truth().contact_force_n)
    assert shop.last("outcome")["outcome"] == "rolled_back"
    assert dist(shop.cell.truth().base, start) < 0.05
    assert dist(shop.cell.truth().objects["mug_1"], was) < 0.05
    assert hardest_n < 5.0  # only the base goes back: the hand does not go again where it met something


def test_terminate_ends_where_the_table_says_so(tmp_path: Path) -> None:
    stuck = fault("sensor", grasping("approach", 0.5), sensor="arm", fault="stuck")
    shop = Workshop(tmp_path, profile="sim-relaxed", faults=(stuck,))
    shop.launch("grasp_object", **GRASP)
    ended = shop.finish()
    assert (ended["outcome"], ended["code"]) == ("terminated", "sensor_fault")
    assert [(told["strategy"], told["reason"]) for told in shop.of("recovery")] == [("TERMINATE", "table")]


def test_ask_human_holds_in_contact_until_somebody_decides(tmp_path: Path) -> None:
    shop = Workshop(tmp_path, faults=(above_the_elbow(),))
    shop.launch("grasp_object", **GRASP)
    shop.until("escalated")
    assert (shop.rules(), shop.strategies()) == (["external-torque"], ["ASK_HUMAN"])
    for _ in range(200):
        shop.runner.tick()
    assert shop.cell.truth().tcp_speed_mps < 0.005
    assert shop.runner.human("inv-1", "resolve_terminate", "operator") is None
    assert shop.finish()["outcome"] == "terminated"


def test_where_nobody_can_be_asked_what_is_not_covered_ends_at_rest(tmp_path: Path) -> None:
    shop = Workshop(tmp_path, profile="sim-relaxed", faults=(above_the_elbow(),))
    shop.launch("grasp_object", covered=False, **GRASP)
    assert shop.finish()["outcome"] == "terminated"
    assert [(told["strategy"], told["reason"]) for told in shop.of("recovery")] == [("TERMINATE", "nobody_to_ask")]
    assert not shop.of("escalation")
    for _ in range(100):
        shop.runner.tick()
    assert shop.cell.truth().tcp_speed_mps < 0.005
