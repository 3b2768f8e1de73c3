"""Operating the tool station: swinging the lever by its handle, pressing the button.

The tool's own switch says whether it worked.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from math import cos, sin
from typing import TYPE_CHECKING

from app.cell.substrate import SubstrateError
from app.sim.body import CONTACT_NEAR_M, SOFT_CLOSE_N, Body, Moves, SkillFailed
from app.sim.kinematics import ToolPose
from app.sim.skills_arm import HOVER_M, contact_speed, number, within_reach
from app.sim.world import LEVER_LENGTH_M, LEVER_SWING_RAD

if TYPE_CHECKING:
    from app.governance.model import Command, Json, Tool

_CLEAR_M = 0.22  # above the tool's place: clear of a raised lever
# A handle that is gripped harder cannot turn in the fingers: the hand goes on a circle of its own then, against the
# lever's, and strains the arm. `force_n` is what the tool may be worked with, not what it has to be held with.
HANDLE_GRIP_N = 60.0
_FELT_EVERY_RAD = 0.1
# Of a lever that was let go of on its way its switch says only that it is at neither end.
_MAY_STAND_RAD = {
    "up": (LEVER_SWING_RAD,),
    "between": tuple(
        LEVER_SWING_RAD - k * _FELT_EVERY_RAD for k in range(1, round(2 * LEVER_SWING_RAD / _FELT_EVERY_RAD) + 1)
    ),
    "down": (-LEVER_SWING_RAD,),
}


def operate_tool(body: Body, params: Mapping[str, Json]) -> Moves:
    """Work a lever or press a button, and check its switch."""
    site = body.senses.site
    tool = site.tools[str(params["tool"])]
    action = str(params["action"])
    if action not in tool.actions:
        raise SubstrateError(
            "tool_failed", f"`{tool.name}` has no action `{action}`: valid are {', '.join(sorted(tool.actions))}"
        )
    if not within_reach(*body.relative(tool.x_m, tool.y_m)):
        raise SubstrateError("unreachable", f"`{tool.name}` is out of reach: drive to `{tool.target}` first")
    force, limit = number(params, "force_n", 30.0) * 0.98, number(params, "speed_mps", 0.15)
    work = {"lever": _swing_lever, "button": _press_button}[tool.kind]
    return work(body, tool, tool.actions[action], force, limit)


def _swing_lever(body: Body, tool: Tool, wanted: str, force_n: float, limit_mps: float) -> Moves:
    speed, slow = body.speed(limit_mps), contact_speed(body, limit_mps)
    may_stand = _MAY_STAND_RAD[body.senses.tool_state(tool.name)]
    begin, end = may_stand[0], LEVER_SWING_RAD if wanted == "up" else -LEVER_SWING_RAD
    body.enter("approach", 0.0)
    yield from body.open()
    x, y = body.relative(tool.x_m, tool.y_m)
    first = _handle(x, y, tool.z_m, begin)
    yield from body.approach(first._replace(z_m=tool.z_m + _CLEAR_M), speed)
    yield from body.line(first._replace(z_m=first.z_m + CONTACT_NEAR_M), speed)
    body.enter("descend", 0.3)
    if len(may_stand) > 1:
        begin = yield from _feel_for(body, {angle: _handle(x, y, tool.z_m, angle) for angle in may_stand}, slow)
    grips = [_handle(x, y, tool.z_m, begin + (end - begin) * k / 12) for k in range(13)]
    yield from body.line(grips[0], slow, until=body.touched)
    body.enter("close", 0.4)
    yield from body.close(min(force_n, HANDLE_GRIP_N))
    body.enter("operate", 0.5)
    if abs(end - begin) > 0.1:
        for grip in grips[1:]:
            yield from body.line(grip, slow)
    body.enter("release", 0.8)
    yield from body.open()
    here = body.pose
    yield from body.line(here._replace(z_m=here.z_m + 0.04), slow)
    yield from body.line(here._replace(z_m=tool.z_m + _CLEAR_M), speed)
    yield from _check_tool(body, tool, wanted)


def _feel_for(body: Body, places: Mapping[float, ToolPose], slow_mps: float) -> Generator[Command, None, float]:
    """Close softly wherever a handle may stand, from above downwards; returns the middle of where it was felt."""
    felt: list[float] = []
    for angle, place in places.items():
        yield from body.line(place, slow_mps, until=body.touched)
        try:
            yield from body.close(SOFT_CLOSE_N)
            felt.append(angle)
        except SkillFailed:
            if felt:
                break
        yield from body.open()
    if not felt:
        raise SkillFailed("tool_failed", "the handle is at neither end, and nowhere in between")
    yield from body.open()
    return sum(felt) / len(felt)


def _handle(x_m: float, y_m: float, pivot_z_m: float, angle_rad: float) -> ToolPose:
    """Return where to grip the lever's handle at an angle; the pivot lies a lever's length behind the tool's place."""
    return ToolPose(
        x_m + LEVER_LENGTH_M * (1.0 - cos(angle_rad)), y_m, pivot_z_m + LEVER_LENGTH_M * sin(angle_rad), 0.0
    )


def _press_button(body: Body, tool: Tool, wanted: str, force_n: float, limit_mps: float) -> Moves:
    speed, slow = body.speed(limit_mps), min(body.speed(limit_mps), 0.03)
    body.enter("approach", 0.0)
    x, y = body.relative(tool.x_m, tool.y_m)
    above = ToolPose(x, y, tool.z_m + HOVER_M, 0.0)
    yield from body.open()
    yield from body.approach(above._replace(z_m=tool.z_m + _CLEAR_M), speed)
    body.grip_n = SOFT_CLOSE_N
    yield from body.wait(1.0)
    yield from body.line(above._replace(z_m=tool.z_m + CONTACT_NEAR_M), speed)
    body.enter("operate", 0.4)
    yield from body.line(
        above._replace(z_m=tool.z_m - 0.008),
        slow,
        until=lambda: body.touched(force_n) or body.senses.tool_state(tool.name) == wanted,
    )
    body.enter("retreat", 0.8)
    yield from body.line(above, slow)
    yield from body.line(above._replace(z_m=tool.z_m + _CLEAR_M), speed)
    yield from _check_tool(body, tool, wanted)


def _check_tool(body: Body, tool: Tool, wanted: str) -> Moves:
    body.enter("verify", 0.95)
    yield from body.wait(0.2)
    state = body.senses.tool_state(tool.name)
    if state != wanted:
        raise SkillFailed("tool_failed", f"`{tool.name}` is `{state}` and not `{wanted}`")
