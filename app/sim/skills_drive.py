"""Skills of the base: driving with empty hands, driving with an object, backing off, standing anew."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, hypot, sin
from typing import TYPE_CHECKING

from app.cell.substrate import SubstrateError
from app.sim.body import Body, Moves, SkillFailed
from app.sim.localisation import to_world, wrapped
from app.sim.navigation import FloorMap, plan_way
from app.sim.skills_arm import TRAVEL_SPEED_MPS, number

if TYPE_CHECKING:
    from app.governance.model import Json, Point, Vec3

RECOVERY_BASE_SPEED_MPS, RECOVERY_TCP_SPEED_MPS = 0.20, 0.12
RETREAT_M, REDOCK_WITHIN_M = 0.30, 0.6
AT_TOOL_M = 0.1  # a handle's swing is 2 cm of it
_LOOKS = 20  # along the way back


def navigate_to(body: Body, params: Mapping[str, Json]) -> Moves:
    """Drive to a named target or a pose, with the arm drawn in."""
    goal = _goal(body, params)
    return _go(body, goal, _plan(body, goal, params), number(params, "speed_mps", 0.3))


def transport_object(body: Body, params: Mapping[str, Json]) -> Moves:
    """Drive to a named target while holding an object."""
    if body.senses.hand is None or not body.holding:
        raise SubstrateError("object_lost", "the gripper holds nothing to transport")
    goal = _goal(body, params)
    body.carrying = True
    return _go(body, goal, _plan(body, goal, params), number(params, "speed_mps", 0.3))


def safe_retreat(body: Body, params: Mapping[str, Json]) -> Moves:
    """Draw the arm in and back straight off; the speed is the base's, and the arm is no faster either.

    What is held is taken along, and a tool's handle let go of: it stands fast, and would hold the arm.
    """
    distance = number(params, "distance_m", RETREAT_M)
    x, y, yaw = body.senses.believed_pose()
    floor = FloorMap(body.senses.site, body.senses.perception.crates, 0.0, (x, y))
    shares = [k * distance / _LOOKS for k in range(1, _LOOKS + 1)]
    free = [floor.free(x - share * cos(yaw), y - share * sin(yaw)) for share in shares]
    if not free[-1] or False in free[free.index(True) :]:  # it may begin beside a bench, but not come up to anything
        raise SubstrateError("no_path", f"no room for {distance:.2f} m behind the base")
    goal = (x - distance * cos(yaw), y - distance * sin(yaw), yaw)
    grips_tool = _grips_tool(body)
    body.carrying = body.holding and not grips_tool
    speed = number(params, "speed_mps", RECOVERY_BASE_SPEED_MPS)
    moves = _go(body, goal, [(x, y), goal[:2]], speed, min(speed, RECOVERY_TCP_SPEED_MPS))
    return _off_the_tool(body, moves) if grips_tool else moves


def _grips_tool(body: Body) -> bool:
    senses = body.senses
    if senses.hand is not None or not body.holding:
        return False
    x, y = to_world(senses.believed_pose(), body.pose.x_m, body.pose.y_m)
    return any(hypot(tool.x_m - x, tool.y_m - y) < AT_TOOL_M for tool in senses.site.tools.values())


def _off_the_tool(body: Body, then: Moves) -> Moves:
    body.enter("retract", 0.0)
    yield from body.open()
    body.senses.tare()
    yield from then


def reposition_base(body: Body, params: Mapping[str, Json]) -> Moves:
    """Stand anew: by the given shift relative to the base, or exactly on the stand that is near.

    Where none is near, the base stays: the arm is drawn in, and the position settles before what failed is tried anew.
    The way is straight and as near to a bench as the stand is, so there is no clearance to keep.
    """
    pose = body.senses.believed_pose()
    dx, dy = number(params, "dx_m", 0.0), number(params, "dy_m", 0.0)
    goal = (*to_world(pose, dx, dy), pose[2])
    if dx == 0.0 and dy == 0.0:
        goal = _nearest_stand(body, pose)
    body.carrying = body.holding
    return _go(body, goal, [pose[:2], goal[:2]], number(params, "speed_mps", 0.1), RECOVERY_TCP_SPEED_MPS)


def _nearest_stand(body: Body, pose: Vec3) -> Vec3:
    stands = [(t.x_m, t.y_m, t.yaw_rad) for t in body.senses.site.targets.values()]
    best = min(stands, key=lambda s: hypot(s[0] - pose[0], s[1] - pose[1]))
    near = hypot(best[0] - pose[0], best[1] - pose[1]) < REDOCK_WITHIN_M and abs(wrapped(best[2] - pose[2])) < 0.5
    return best if near else pose


def _goal(body: Body, params: Mapping[str, Json]) -> Vec3:
    name = params.get("target")
    if name is not None:
        target = body.senses.site.targets[str(name)]
        return target.x_m, target.y_m, target.yaw_rad
    x, y, yaw = body.senses.believed_pose()
    return number(params, "x_m", x), number(params, "y_m", y), number(params, "yaw_rad", yaw)


def _plan(body: Body, goal: Vec3, params: Mapping[str, Json]) -> list[Point]:
    senses = body.senses
    corridor = params.get("corridor")
    return plan_way(
        senses.site,
        senses.believed_pose(),
        goal,
        clearance_m=number(params, "clearance_m", 0.1),
        corridor=None if corridor is None else str(corridor),
        crates=senses.perception.crates,
    )


def _go(body: Body, goal: Vec3, way: list[Point], limit_mps: float, tcp_mps: float = TRAVEL_SPEED_MPS) -> Moves:
    body.way = tuple((float(x), float(y)) for x, y in way)
    body.enter("retract", 0.0)
    yield from body.retract(body.speed(tcp_mps))
    body.enter("drive", 0.1)
    yield from body.drive(way, goal[2], body.speed(limit_mps))
    body.enter("settle", 0.97)
    yield from body.wait(0.3 if not body.careful else 0.8)
    if body.carrying and not body.holding:
        raise SkillFailed("object_lost", "the object was lost on the way")
