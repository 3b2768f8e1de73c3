"""The workcell for displays: the static scene once, body poses often."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.model import Json, Site

_SHAPES = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
_HIDDEN_GROUP = 4


def describe(model: mujoco.MjModel, site: Site) -> Mapping[str, Json]:
    """Return bounds, zones, and every visible shape with its body, pose within it, size and colour.

    Shapes: `plane`, `sphere`, `capsule`, `cylinder` (radius, half length along z), `box` (half sizes). Poses are x,
    y, z, qw, qx, qy, qz.
    """
    shapes: list[Json] = []
    for k in range(model.ngeom):
        if int(model.geom_group[k]) == _HIDDEN_GROUP:
            continue
        shapes.append(
            {
                "body": model.body(int(model.geom_bodyid[k])).name,
                "shape": _SHAPES[mujoco.mjtGeom(int(model.geom_type[k]))],
                "size": [float(v) for v in model.geom_size[k]],
                "pose": [float(v) for v in (*model.geom_pos[k], *model.geom_quat[k])],
                "rgba": [round(float(v), 3) for v in model.geom_rgba[k]],
            }
        )
    zones: list[Json] = [
        {"name": z.name, "kind": z.kind, "polygon": [list(p) for p in z.polygon]} for z in site.zones.values()
    ]
    return {
        "bounds_m": list(site.bounds_m),
        "zones": zones,
        "shapes": shapes,
        "fixed": _fixed(model),
        "bodies": [*_moving(model)],
    }


def body_poses(model: mujoco.MjModel, data: mujoco.MjData) -> Mapping[str, tuple[float, ...]]:
    """Return the pose (x, y, z, qw, qx, qy, qz) of every body that can move, by name."""
    return {name: (*data.xpos[k].tolist(), *data.xquat[k].tolist()) for name, k in _moving(model).items()}


def _fixed(model: mujoco.MjModel) -> Json:
    """Return the poses of bodies that never move."""
    moving = _moving(model)
    names = [model.body(k).name for k in range(1, model.nbody)]
    return {
        name: [float(v) for v in (*model.body(name).pos, *model.body(name).quat)]
        for name in names
        if name not in moving
    }


def _moving(model: mujoco.MjModel) -> dict[str, int]:
    return {
        model.body(k).name: k for k in range(1, model.nbody) if model.body_weldid[k] != 0 or model.body_mocapid[k] >= 0
    }
