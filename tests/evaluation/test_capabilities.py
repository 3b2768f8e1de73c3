"""Whether a task is done, and whether the world is back as it was, on worlds made by hand."""

from __future__ import annotations

from math import nan, pi
from types import SimpleNamespace
from typing import Any, cast

import pytest

from app.evaluation.capabilities import (
    ARRIVED_M,
    BACK_M,
    STANDS_M,
    STOOD_M,
    STOOD_RAD,
    TOOL_BACK,
    judge_of,
    restored_of,
    truly_unmet,
    undoable_of,
)
from app.evaluation.draws import Drawn
from app.evaluation.model import CAPABILITIES, Kind
from app.evaluation.stage import Start
from app.sim.faults import Scenario
from app.sim.truth import Truth
from app.sim.workcell import Workcell
from tests.governance.policy_world import shipped

SITE = shipped().site
MUG_Z = SITE.surfaces["bench_a"].z_m + SITE.objects["mug_1"].size_m[2]
ON_BENCH = (SITE.surfaces["bench_a"].x_m, SITE.surfaces["bench_a"].y_m, MUG_Z)
DOCK = SITE.targets["dock"]
BEGAN: dict[str, Any] = {
    "base": (0.0, 0.0, 0.0),
    "held": None,
    "objects": {"mug_1": ON_BENCH},
    "upright": {"mug_1": True},
    "secure": False,
    "tools": {"lever": 0.0, "press": 0.0},
    "switches": {"lever": "between", "press": "released"},
}


def truth(**differs: Any) -> Truth:
    blank = dict.fromkeys(Truth._fields, nan)
    return Truth(**cast("Any", {**blank, **BEGAN, **differs}))


def world(*, inspected: tuple[str, ...] = (), tool: str = "", **differs: Any) -> Workcell:
    return cast(
        "Workcell",
        SimpleNamespace(
            site=SITE,
            truth=lambda: truth(**differs),
            facts=lambda: SimpleNamespace(inspected=inspected),
            tool_state=lambda _name: tool,
        ),
    )


def drawn(capability: str, holding: str = "", **params: Any) -> Drawn:
    return Drawn(
        seed=1,
        number=1,
        kind=Kind.CLEAN,
        capability=capability,
        profile="sim-relaxed",
        params=params,
        start=Start(holding=holding),
        scenario=Scenario(),
    )


@pytest.mark.parametrize(("off", "there"), [(0.9 * ARRIVED_M, True), (1.1 * ARRIVED_M, False)])
def test_arrived_is_near_the_goal_named_or_given(off: float, there: bool) -> None:
    at = world(base=(DOCK.x_m + off, DOCK.y_m, 0.0))
    assert judge_of(drawn("navigate_to", target="dock"))(at) is there
    assert judge_of(drawn("navigate_to", x_m=DOCK.x_m, y_m=DOCK.y_m, yaw_rad=0.0))(at) is there


@pytest.mark.parametrize(("held", "done"), [("mug_1", True), (None, False), ("glass_1", False)])
def test_transported_is_arrived_with_what_was_held(held: str | None, done: bool) -> None:
    trial = drawn("transport_object", "mug_1", target="dock")
    assert judge_of(trial)(world(base=(DOCK.x_m, DOCK.y_m, 0.0), held=held)) is done
    assert not judge_of(trial)(world(held=held))


@pytest.mark.parametrize(("held", "done"), [("mug_1", True), (None, False), ("glass_1", False)])
def test_grasped_is_holding_the_object(held: str | None, done: bool) -> None:
    assert judge_of(drawn("grasp_object", object_id="mug_1"))(world(held=held)) is done


@pytest.mark.parametrize(
    ("differs", "done"),
    [
        ({}, True),
        ({"held": "mug_1"}, False),
        ({"upright": {"mug_1": False}}, False),
        ({"objects": {"mug_1": (ON_BENCH[0], ON_BENCH[1], MUG_Z + 1.1 * STANDS_M)}}, False),
        ({"objects": {"mug_1": (ON_BENCH[0] + 5.0, ON_BENCH[1], MUG_Z)}}, False),
        ({"objects": {"mug_1": (ON_BENCH[0], ON_BENCH[1], 0.05)}}, False),
    ],
)
def test_placed_is_standing_on_the_surface_out_of_the_hand(differs: dict[str, Any], done: bool) -> None:
    assert judge_of(drawn("place_object", "mug_1", surface="bench_a"))(world(**differs)) is done


def test_operated_is_the_state_that_the_action_ends_in() -> None:
    tool = SITE.tools["lever"]
    trial = drawn("operate_tool", tool="lever", action="pull_down")
    assert judge_of(trial)(world(tool=tool.actions["pull_down"]))
    assert not judge_of(trial)(world(tool="somewhere"))


def test_inspected_is_all_of_the_area_seen() -> None:
    trial = drawn("inspect_area", area="bench_a_top")
    assert judge_of(trial)(world(inspected=("bench_a_top",)))
    assert not judge_of(trial)(world())


def test_every_capability_has_a_judge() -> None:
    for capability in CAPABILITIES:
        assert callable(judge_of(drawn(capability)))


@pytest.mark.parametrize(
    ("differs", "back"),
    [
        ({}, True),
        ({"base": (0.9 * STOOD_M, 0.0, 0.0)}, True),
        ({"base": (1.1 * STOOD_M, 0.0, 0.0)}, False),
        ({"base": (0.0, 0.0, 0.9 * STOOD_RAD)}, True),
        ({"base": (0.0, 0.0, -1.1 * STOOD_RAD)}, False),
        ({"base": (0.0, 0.0, 2.0 * pi)}, True),
        ({"held": "mug_1"}, False),
        ({"upright": {"mug_1": False}}, False),
        ({"objects": {"mug_1": (ON_BENCH[0] + 0.9 * BACK_M, ON_BENCH[1], MUG_Z)}}, True),
        ({"objects": {"mug_1": (ON_BENCH[0] + 1.1 * BACK_M, ON_BENCH[1], MUG_Z)}}, False),
    ],
)
def test_restored_is_the_base_the_hand_and_the_object_as_they_were(differs: dict[str, Any], back: bool) -> None:
    trial = drawn("grasp_object", object_id="mug_1")
    assert restored_of(trial, truth())(world(**differs)) is back


def test_what_was_held_is_held_again() -> None:
    restored = restored_of(drawn("transport_object", "mug_1", target="dock"), truth(held="mug_1"))
    assert restored(world(held="mug_1"))
    assert not restored(world())


@pytest.mark.parametrize(
    ("differs", "capable"),
    [
        ({}, True),
        ({"base": (9.0, 9.0, 0.0)}, True),  # far off, and yet there is a way back
        ({"upright": {"mug_1": False}}, False),  # nothing on the way back sets it up
        ({"held": "mug_1"}, True),
        ({"held": "mug_1", "objects": {"mug_1": (ON_BENCH[0] + 0.4, ON_BENCH[1], MUG_Z)}}, True),
        ({"objects": {"mug_1": (ON_BENCH[0] + 0.9 * BACK_M, ON_BENCH[1], MUG_Z)}}, True),
        ({"objects": {"mug_1": (ON_BENCH[0] + 1.1 * BACK_M, ON_BENCH[1], MUG_Z)}}, False),  # moved by somebody
        ({"objects": {"mug_1": (ON_BENCH[0], ON_BENCH[1], 0.05)}}, False),  # on the floor
        ({"objects": {"mug_1": (ON_BENCH[0], ON_BENCH[1], -2.0)}}, False),  # taken away
        ({"objects": {"mug_1": (-1.0, -1.0, MUG_Z)}}, False),  # and so far that it is outside
    ],
)
def test_there_is_something_to_go_back_to_where_the_object_is_in_the_hand_or_where_it_stood(
    differs: dict[str, Any], capable: bool
) -> None:
    trial = drawn("grasp_object", object_id="mug_1")
    assert undoable_of(trial, truth())(world(**differs)) is capable


def test_what_slipped_out_of_a_hand_that_held_it_at_the_start_cannot_be_gone_back_to() -> None:
    undoable = undoable_of(drawn("place_object", "mug_1", surface="bench_a"), truth(held="mug_1"))
    assert undoable(world(held="mug_1", secure=True))
    assert not undoable(world(held="mug_1"))  # the pads touch it still, and it slides out
    assert not undoable(world())
    assert undoable_of(drawn("navigate_to", target="dock"), truth())(world())


@pytest.mark.parametrize("tool", ["lever", "press"])
@pytest.mark.parametrize(
    ("share", "switched", "as_it_was"), [(0.9, False, True), (-1.1, False, False), (0.0, True, False)]
)
def test_a_tool_that_was_operated_is_neither_restored_nor_to_be_restored_by_going_back(
    tool: str, share: float, switched: bool, as_it_was: bool
) -> None:
    trial = drawn("operate_tool", tool=tool, action=next(iter(SITE.tools[tool].actions)))
    tools = {**BEGAN["tools"], tool: share * TOOL_BACK[SITE.tools[tool].kind]}
    now = world(tools=tools, switches={**BEGAN["switches"], **({tool: "elsewhere"} if switched else {})})
    assert restored_of(trial, truth())(now) is as_it_was
    assert undoable_of(trial, truth())(now) is as_it_was


@pytest.mark.parametrize(
    ("unmet", "differs"),
    [
        ("holding", {"held": "mug_1"}),
        ("gripper_empty", {"held": "mug_1"}),
        ("base_pose", {"base": (1.1 * STOOD_M, 0.0, 0.0)}),
        ("base_pose", {"base": (0.0, 0.0, 1.1 * STOOD_RAD)}),
        ("object_pose", {"objects": {"mug_1": (ON_BENCH[0] + 1.1 * BACK_M, *ON_BENCH[1:])}}),
        ("object_pose", {"upright": {"mug_1": False}}),
    ],
)
def test_what_a_cell_finds_unmet_is_held_against_the_exact_state(unmet: str, differs: dict[str, Any]) -> None:
    params = {"object_id": "mug_1"}
    assert truly_unmet(unmet, params, truth(), truth(**differs))
    assert not truly_unmet(unmet, params, truth(), truth())


def test_what_only_sensors_tell_of_and_a_grip_that_is_there_are_not_truly_unmet() -> None:
    assert truly_unmet("object_secured", {}, truth(), truth())
    assert not truly_unmet("object_secured", {}, truth(), truth(held="mug_1"))
    assert not truly_unmet("arm_retracted", {}, truth(), truth())
