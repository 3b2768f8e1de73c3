"""What a rollback brought back, judged by sensors."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.cell.restored import not_restored
from app.governance.model import ObjectFact, WorldFacts

MUG = ObjectFact(visible=True, reachable=True, x_m=1.0, y_m=5.0, z_m=0.8, stamp_s=1.0)
BEGAN = WorldFacts(
    stamp_s=1.0,
    arm_ready=True,
    arm_retracted=True,
    gripper_empty=True,
    holding=None,
    base=(1.0, 4.2, 1.57),
    objects={"mug_1": MUG},
)
MUG_1 = {"object_id": "mug_1"}


@pytest.mark.parametrize(
    ("now", "restored"),
    [
        (MUG, True),
        (replace(MUG, x_m=1.09, z_m=0.84), True),
        (replace(MUG, x_m=1.11), False),
        (replace(MUG, z_m=0.05), False),  # it has fallen beside the bench's edge
        (replace(MUG, z_m=0.86), False),  # it stands on something
        (replace(MUG, upright=False), False),
        (replace(MUG, visible=False), False),
        (replace(MUG, x_m=float("nan")), False),
        (replace(MUG, z_m=float("nan")), False),
        (None, False),
    ],
)
def test_what_was_handled_is_back_as_it_was(now: ObjectFact | None, *, restored: bool) -> None:
    ended = replace(BEGAN, objects={} if now is None else {"mug_1": now})
    assert not_restored(BEGAN, ended, MUG_1) == (() if restored else ("object_pose",))


def test_what_lay_may_lie_again() -> None:
    lying = replace(BEGAN, objects={"mug_1": replace(MUG, upright=False)})
    assert not_restored(lying, lying, MUG_1) == ()


def test_what_was_carried_in_is_back_in_the_hand_and_nowhere_else() -> None:
    carrying = replace(BEGAN, gripper_empty=False, holding="mug_1")
    assert not_restored(carrying, replace(carrying, objects={"mug_1": replace(MUG, z_m=1.2)}), MUG_1) == ()
    assert not_restored(carrying, BEGAN, MUG_1) == ("holding",)


@pytest.mark.parametrize(("says", "restored"), [("up", True), ("between", False), ("down", False), (None, False)])
def test_a_tool_that_was_worked_says_what_it_said(says: str | None, *, restored: bool) -> None:
    began = replace(BEGAN, tools={"lever": "up", "press": "released"})
    ended = replace(BEGAN, tools={"press": "pressed"} if says is None else {"lever": says, "press": "pressed"})
    assert not_restored(began, ended, {"tool": "lever"}) == (() if restored else ("tool_state",))
    assert not_restored(began, ended, MUG_1) == ()
