"""The workshop as a MuJoCo model, built from the `Site`.

Furniture, tools, loose objects, people, crates that may block a way.

Everything is made of primitive shapes written here; no assets. People are figures without physical collision, moved
by the workcell: what counts is the distance to them. Crates are parked under the floor until a fault needs one.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import TYPE_CHECKING

import mujoco

from app.sim import robot

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from app.governance.model import Site, SiteObject, Surface, Tool

PHYSICS_STEP_S = 0.002
SUBSTEPS = 5
CRATES = ("crate_1",)
CRATE_HALF_M = (0.25, 0.25, 0.4)
LEVER_LENGTH_M = 0.20
LEVER_SWING_RAD = 0.45  # up at +, down at -
BUTTON_TRAVEL_M = 0.02
UNDER_FLOOR_M = -3.0
TOP_THICKNESS_M = 0.02
_FOOT_M = 0.004
_FELT_M = 0.02
_BENCH_FRICTION = (0.5, 0.005, 0.0001)
_WOOD = (0.62, 0.48, 0.34, 1.0)
_STEEL = (0.55, 0.58, 0.62, 1.0)
_COLOURS = {
    "mug": (0.16, 0.45, 0.70, 1.0),
    "glass": (0.65, 0.85, 0.90, 0.55),
    "driver": (0.90, 0.55, 0.10, 1.0),
    "box": (0.70, 0.60, 0.45, 1.0),
    "bottle": (0.80, 0.20, 0.20, 1.0),
}
_SKIN, _CLOTH, _TROUSERS = (0.80, 0.62, 0.50, 1.0), (0.85, 0.70, 0.20, 1.0), (0.25, 0.28, 0.38, 1.0)
PERSON_PARTS = ("torso", "leg_left", "leg_right")
HIP_M = 0.90


def build_world(site: Site, *, people: int = 0, robot_mjcf: Path | None = None) -> mujoco.MjModel:
    """Compile the workshop.

    Args:
        site: names and geometry.
        people: how many figures to keep ready.
        robot_mjcf: another robot's model; the project's own mobile UR5e by default.

    Raises:
        ValueError: the other robot's model cannot be used.
    """
    spec = mujoco.MjSpec()
    _configure(spec)
    if robot_mjcf is None:
        robot.add_robot(spec)
    else:
        robot.put_robot(spec, robot.load_robot(robot_mjcf))
    _add_sensors(spec)
    _add_room(spec, site)
    for surface in site.surfaces.values():
        _add_surface(spec, surface)
    for tool in site.tools.values():
        _add_tool(spec, tool, _facing(site, tool))
    for thing in site.objects.values():
        _add_object(spec, thing, site.surfaces[thing.surface])
    for index in range(people):
        _add_person(spec, index)
    _add_crates(spec, CRATES)
    return robot.compiled(spec)


def _configure(spec: mujoco.MjSpec) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = PHYSICS_STEP_S
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    option.iterations = 50
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # bodies of few shapes: testing the pairs is cheaper
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # of what the plant lets doze
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.headlight.ambient = (0.35, 0.35, 0.35)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    for kind, name in (
        (mujoco.mjtSensor.mjSENS_FORCE, "wrist_force"),
        (mujoco.mjtSensor.mjSENS_ACCELEROMETER, "wrist_acceleration"),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=robot.WRIST_SITE)
    for pad in robot.PAD_GEOMS:
        spec.add_sensor(
            name=pad, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"{pad}_touch"
        )
    for crate in CRATES:  # for the truth alone: the robot has no such sensor
        spec.add_sensor(name=crate, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=crate)


def _fixed(
    spec: mujoco.MjSpec,
    name: str,
    half: tuple[float, float, float],
    at: tuple[float, float, float],
    yaw_rad: float,
    rgba: tuple[float, ...],
) -> None:
    # A body of its own: the broad phase then tells the pieces apart.
    body = spec.worldbody.add_body(name=f"{name}_body", pos=at, quat=(cos(yaw_rad / 2), 0, 0, sin(yaw_rad / 2)))
    _add_block(body, name, half, (0.0, 0.0, 0.0), rgba)


def _add_block(
    body: mujoco.MjsBody,
    name: str,
    half: tuple[float, float, float],
    at: tuple[float, float, float],
    rgba: tuple[float, ...],
) -> None:
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=half,
        pos=at,
        rgba=rgba,
        contype=robot.ENVIRONMENT,
        conaffinity=0,
        friction=_BENCH_FRICTION,
        condim=3,
    )


def _add_room(spec: mujoco.MjSpec, site: Site) -> None:
    x0, y0, x1, y1 = site.bounds_m
    spec.worldbody.add_light(
        pos=((x0 + x1) / 2, (y0 + y1) / 2, 5.0), dir=(0, 0, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=((x1 - x0) / 2, (y1 - y0) / 2, 0.1),
        pos=((x0 + x1) / 2, (y0 + y1) / 2, 0),
        rgba=(0.78, 0.79, 0.80, 1),
        contype=robot.ENVIRONMENT,
        conaffinity=0,
        friction=_BENCH_FRICTION,
        condim=3,
    )


def _add_surface(spec: mujoco.MjSpec, surface: Surface) -> None:
    half = (surface.half_x_m, surface.half_y_m, TOP_THICKNESS_M)
    _fixed(spec, surface.name, half, (surface.x_m, surface.y_m, surface.z_m - TOP_THICKNESS_M), surface.yaw_rad, _WOOD)
    leg = (surface.z_m - 2 * TOP_THICKNESS_M) / 2
    turn = (cos(surface.yaw_rad / 2), 0, 0, sin(surface.yaw_rad / 2))
    # The legs share one body apart from the top: what stands on the top is nowhere near it, and the broad phase has
    # one entry instead of four.
    legs = spec.worldbody.add_body(name=f"{surface.name}_legs", pos=(surface.x_m, surface.y_m, leg), quat=turn)
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        at = (sx * (surface.half_x_m - 0.04), sy * (surface.half_y_m - 0.04), 0.0)
        _add_block(legs, f"{surface.name}_leg_{k}", (0.03, 0.03, leg), at, _STEEL)


def _facing(site: Site, tool: Tool) -> float:
    """Return the direction in which someone looks who stands at the tool's target."""
    return site.targets[tool.target].yaw_rad


def _add_tool(spec: mujoco.MjSpec, tool: Tool, facing_rad: float) -> None:
    c, s = cos(facing_rad), sin(facing_rad)
    match tool.kind:
        case "lever":
            back = LEVER_LENGTH_M
            at = (tool.x_m + c * back, tool.y_m + s * back, tool.z_m)
            _fixed(
                spec,
                f"{tool.name}_post",
                (0.03, 0.06, tool.z_m / 2 + 0.03),
                (at[0] + c * 0.06, at[1] + s * 0.06, tool.z_m / 2 + 0.03),
                facing_rad,
                _STEEL,
            )
            _add_lever(spec, tool.name, at, facing_rad)
        case "button":
            # The cap's rest height is the tool's z; the post ends below its travel.
            top = tool.z_m - BUTTON_TRAVEL_M - 0.03
            _fixed(spec, f"{tool.name}_post", (0.06, 0.06, top / 2), (tool.x_m, tool.y_m, top / 2), facing_rad, _STEEL)
            _add_button(spec, tool)
        case _:
            raise ValueError(f"tool `{tool.name}` is a `{tool.kind}`: valid kinds are `lever` and `button`")


def _add_lever(spec: mujoco.MjSpec, name: str, at: tuple[float, float, float], facing_rad: float) -> None:
    body = spec.worldbody.add_body(
        name=name, pos=at, quat=(cos((facing_rad + pi) / 2), 0, 0, sin((facing_rad + pi) / 2)), gravcomp=1.0
    )
    # The body's x points at whoever operates it; raising the handle is a turn about -y.
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=(0, -1, 0),
        range=(-LEVER_SWING_RAD, LEVER_SWING_RAD),
        limited=True,
        frictionloss=0.6,
        damping=0.3,
        armature=0.01,
        ref=0.0,
    )
    # A little play sideways, as every lever has: a stiff arm with a stiff handle would fight over millimetres.
    body.add_joint(
        name=f"{name}_play",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=(0, 0, 1),
        range=(-0.15, 0.15),
        limited=True,
        stiffness=4.0,
        damping=0.3,
        armature=0.01,
    )
    body.add_geom(
        name=f"{name}_bar",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(0, 0, 0, LEVER_LENGTH_M + 0.03, 0, 0),
        size=(0.012, 0, 0),
        mass=0.4,
        contype=robot.OBJECT,
        conaffinity=0,
        condim=4,
        rgba=(0.85, 0.25, 0.15, 1),
    )


def _add_button(spec: mujoco.MjSpec, tool: Tool) -> None:
    body = spec.worldbody.add_body(name=tool.name, pos=(tool.x_m, tool.y_m, tool.z_m - 0.015), gravcomp=1.0)
    body.add_joint(
        name=tool.name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=(0, 0, -1),
        range=(0.0, BUTTON_TRAVEL_M),
        limited=True,
        stiffness=500.0,
        springref=-0.006,
        damping=8.0,
        armature=0.02,
    )
    body.add_geom(
        name=f"{tool.name}_cap",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=(0.045, 0.015, 0),
        mass=0.1,
        contype=robot.OBJECT,
        conaffinity=0,
        condim=4,
        rgba=(0.80, 0.15, 0.15, 1),
    )


def _add_object(spec: mujoco.MjSpec, thing: SiteObject, surface: Surface) -> None:
    body = spec.worldbody.add_body(name=thing.name, pos=(thing.x_m, thing.y_m, surface.z_m + thing.size_m[2] + 0.0005))
    body.add_freejoint(name=thing.name)
    cylinder = thing.shape == "cylinder"
    size = (thing.size_m[0], thing.size_m[2], 0.0) if cylinder else thing.size_m
    body.add_geom(
        name=thing.name,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER if cylinder else mujoco.mjtGeom.mjGEOM_BOX,
        size=size,
        mass=thing.mass_kg,
        condim=4,
        contype=robot.OBJECT,
        conaffinity=robot.OBJECT,
        friction=_BENCH_FRICTION,
        rgba=_COLOURS.get(thing.kind, _STEEL),
    )
    # It stands, and when tipped lies, on small spheres in its corners: exact contacts at a third of the cost of shape
    # against shape.
    rx, ry, rz = (thing.size_m[0] * 0.7071, thing.size_m[1] * 0.7071, thing.size_m[2]) if cylinder else thing.size_m
    for k in range(8):
        sx, sy, sz = (1 if k & bit else -1 for bit in (1, 2, 4))
        at = (sx * (rx - _FOOT_M), sy * (ry - _FOOT_M), sz * (rz - _FOOT_M))
        body.add_geom(
            name=f"{thing.name}_foot_{k}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(_FOOT_M, 0, 0),
            pos=at,
            mass=0,
            condim=3,
            contype=0,
            conaffinity=robot.ENVIRONMENT,
            friction=_BENCH_FRICTION,
            group=4,
        )


def _add_person(spec: mujoco.MjSpec, index: int) -> None:
    shapes = {
        "torso": (
            (mujoco.mjtGeom.mjGEOM_CAPSULE, (0, 0, 0.06, 0, 0, 0.46), 0.17, _CLOTH),
            (mujoco.mjtGeom.mjGEOM_CAPSULE, (0, 0.23, 0.45, 0.05, 0.26, -0.05), 0.05, _CLOTH),
            (mujoco.mjtGeom.mjGEOM_CAPSULE, (0, -0.23, 0.45, 0.05, -0.26, -0.05), 0.05, _CLOTH),
            (mujoco.mjtGeom.mjGEOM_CAPSULE, (0, 0, 0.70, 0, 0, 0.76), 0.10, _SKIN),
        ),
        "leg_left": ((mujoco.mjtGeom.mjGEOM_CAPSULE, (0, 0.09, 0, 0, 0.09, -0.82), 0.07, _TROUSERS),),
        "leg_right": ((mujoco.mjtGeom.mjGEOM_CAPSULE, (0, -0.09, 0, 0, -0.09, -0.82), 0.07, _TROUSERS),),
    }
    for part in PERSON_PARTS:
        body = spec.worldbody.add_body(name=f"person_{index}_{part}", pos=(0, 0, UNDER_FLOOR_M), mocap=True)
        for kind, ends, radius, rgba in shapes[part]:
            body.add_geom(type=kind, fromto=ends, size=(radius, 0, 0), contype=0, conaffinity=0, rgba=rgba)


def _add_crates(spec: mujoco.MjSpec, names: Iterable[str]) -> None:
    for name in names:
        body = spec.worldbody.add_body(name=name, pos=(0, 0, UNDER_FLOOR_M), mocap=True)
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=CRATE_HALF_M,
            contype=robot.ENVIRONMENT,
            conaffinity=0,
            friction=_BENCH_FRICTION,
            rgba=_WOOD,
        )
        around = tuple(half + _FELT_M for half in CRATE_HALF_M)
        body.add_site(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=around, group=4)
