from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

from app.governance.bundle import load
from app.governance.conditions import TESTS, unmet
from app.governance.model import ObjectFact, WorldFacts

SITE = load(Path(__file__).parents[2] / "policies").site
STAND = SITE.targets["bench_a_stand"]
BENCH = SITE.surfaces["bench_b"]


def seen(x_m: float, y_m: float, z_m: float, **more: object) -> ObjectFact:
    return ObjectFact(
        **{"visible": True, "reachable": True, "x_m": x_m, "y_m": y_m, "z_m": z_m, "stamp_s": 1.0, **more}
    )


def facts(**more: object) -> WorldFacts:
    calm: dict[str, object] = {
        "stamp_s": 1.0, "arm_ready": True, "arm_retracted": True, "gripper_empty": True, "holding": None,
        "base": (STAND.x_m, STAND.y_m, STAND.yaw_rad), "objects": {"mug_1": seen(1.45, 5.25, 0.8)},
        "tools": {"lever": "down"}, "inspected": {"bench_a_top": 0.5},
    }  # fmt: skip
    return WorldFacts(**{**calm, **more})


HOLDING = {"gripper_empty": False, "holding": "mug_1"}
AWAY = {"base": (STAND.x_m + 2.0, STAND.y_m, STAND.yaw_rad)}
ON_B = {"mug_1": seen(BENCH.x_m, BENCH.y_m, BENCH.z_m + 0.05)}


@pytest.mark.parametrize(
    ("condition", "params", "good", "bad"),
    [
        ("sensors_fresh", {}, {}, {"sensors_fresh": False}),
        ("arm_ready", {}, {}, {"arm_ready": False}),
        ("arm_retracted", {}, {}, {"arm_retracted": False}),
        ("gripper_empty", {}, {}, HOLDING),
        ("gripper_empty", {}, {}, {"gripper_empty": False}),
        ("carrying", {}, HOLDING, {}),
        ("carrying", {}, HOLDING, {"gripper_empty": False, "holding": "stone_7"}),
        ("object_visible", {"object_id": "mug_1"}, {}, {"objects": {}}),
        ("object_visible", {"object_id": "mug_1"}, {}, {"objects": {"mug_1": seen(1, 5, 1, visible=False)}}),
        ("object_reachable", {"object_id": "mug_1"}, {}, {"objects": {"mug_1": seen(1, 5, 1, reachable=False)}}),
        ("surface_reachable", {"surface": "bench_a"}, {}, AWAY),
        ("tool_reachable", {"tool": "lever"}, {"base": (3.4, 1.4, -1.57)}, {}),
        ("area_in_view", {"area": "bench_a_top"}, {}, AWAY),
        ("object_secured", {"object_id": "mug_1"}, HOLDING, {}),
        ("object_secured", {"object_id": "mug_1"}, HOLDING, {"gripper_empty": False, "holding": "glass_1"}),
        ("object_placed", {"surface": "bench_b", "object_id": "mug_1"}, {"objects": ON_B}, {"objects": {}}),
        (
            "object_placed",
            {"surface": "bench_b", "object_id": "mug_1"},
            {"objects": ON_B},
            {"objects": ON_B, **HOLDING},
        ),
        ("at_target", {"target": "bench_a_stand"}, {}, AWAY),
        ("at_target", {"x_m": STAND.x_m, "y_m": STAND.y_m, "yaw_rad": STAND.yaw_rad + math.tau}, {}, AWAY),
        ("area_inspected", {"area": "bench_a_top"}, {}, {"inspected": {}}),
        ("tool_actuated", {"tool": "lever", "action": "pull_down"}, {}, {"tools": {"lever": "up"}}),
    ],
)
def test_a_condition_holds_in_one_world_and_not_in_the_other(condition, params, good, bad):
    assert unmet((condition,), params, facts(**good), SITE) == ()
    (missing,) = unmet((condition,), params, facts(**bad), SITE)
    assert missing.condition == condition
    assert missing.message
    assert missing.remedy


def test_the_table_above_leaves_no_condition_out():
    here = test_a_condition_holds_in_one_world_and_not_in_the_other.pytestmark[0].args[1]
    assert {row[0] for row in here} == set(TESTS)


def test_another_object_on_the_surface_proves_no_placing():
    others = {"glass_1": seen(BENCH.x_m, BENCH.y_m, BENCH.z_m + 0.06), "mug_1": seen(5.2, 4.6, 0.05)}
    assert unmet(("object_placed",), {"surface": "bench_b", "object_id": "mug_1"}, facts(objects=others), SITE)
    assert unmet(("object_placed",), {"surface": "bench_b"}, facts(objects=others), SITE)


@pytest.mark.parametrize("off", [(0.8, 0.0, 0.05), (0.0, 0.5, 0.05), (0.0, 0.0, 0.5), (0.0, 0.0, -0.1)])
def test_an_object_beside_above_or_below_a_surface_is_not_on_it(off):
    beside = {"mug_1": seen(BENCH.x_m + off[0], BENCH.y_m + off[1], BENCH.z_m + off[2])}
    assert unmet(("object_placed",), {"surface": "bench_b", "object_id": "mug_1"}, facts(objects=beside), SITE)


def test_an_object_that_lies_on_its_side_was_not_placed():
    asked, at = {"surface": "bench_b", "object_id": "mug_1"}, (BENCH.x_m, BENCH.y_m, BENCH.z_m + 0.035)
    assert unmet(("object_placed",), asked, facts(objects={"mug_1": seen(*at)}), SITE) == ()
    (lies,) = unmet(("object_placed",), asked, facts(objects={"mug_1": seen(*at, upright=False)}), SITE)
    assert lies.message == "`mug_1` lies on its side"


@pytest.mark.parametrize(("off_m", "placed"), [(0.0, True), (0.08, True), (0.12, False), (0.9, False)])
def test_an_object_was_placed_where_that_was_asked_for(off_m: float, placed: bool):
    stands = {"mug_1": seen(BENCH.x_m - 0.45 + off_m, BENCH.y_m, BENCH.z_m + 0.05)}
    asked = {"surface": "bench_b", "object_id": "mug_1", "x_m": BENCH.x_m - 0.45, "y_m": BENCH.y_m}
    assert (unmet(("object_placed",), asked, facts(objects=stands), SITE) == ()) is placed


@pytest.mark.parametrize("condition", sorted(TESTS))
def test_nothing_is_met_without_facts(condition):
    assert unmet((condition,), {}, None, SITE)


@pytest.mark.parametrize("base", [(math.nan, 4.6, 1.57), (1.6, math.nan, 1.57), (STAND.x_m, STAND.y_m, math.nan)])
def test_a_base_that_is_nowhere_is_at_no_target(base):
    assert unmet(("at_target",), {"target": "bench_a_stand"}, facts(base=base), SITE)


def test_names_that_mean_nothing_are_unmet():
    assert unmet(("object_happy",), {}, facts(), SITE)[0].message == "there is no condition `object_happy`"
    for condition, params in (
        ("surface_reachable", {"surface": "moon"}), ("at_target", {"target": "moon"}),
        ("tool_actuated", {"tool": "moon"}),
        ("area_in_view", {"area": 3}), ("object_placed", {"surface": "moon"}),
    ):  # fmt: skip
        assert unmet((condition,), params, facts(), SITE)


def test_every_unmet_condition_is_named_at_once():
    world = dataclasses.replace(facts(), arm_ready=False, sensors_fresh=False)
    assert [one.condition for one in unmet(("sensors_fresh", "arm_ready"), {}, world, SITE)] == [
        "sensors_fresh",
        "arm_ready",
    ]


@pytest.mark.parametrize(
    ("condition", "params"),
    [("area_in_view", {"area": "bench_a_top"}), ("surface_reachable", {"surface": "bench_a"})],
)
@pytest.mark.parametrize(
    ("away_m", "turned_rad", "met"),
    [(0.2, 0.2, True), (0.2, -0.2, True), (0.2, 2 * math.pi, True), (0.3, 0.0, False), (0.0, 0.3, False),
     (0.0, math.pi, False)],
)  # fmt: skip
def test_a_base_works_from_where_its_skill_would_start(condition, params, away_m, turned_rad, met):
    there = facts(base=(STAND.x_m - away_m, STAND.y_m, STAND.yaw_rad + turned_rad))
    assert (unmet((condition,), params, there, SITE) == ()) == met
