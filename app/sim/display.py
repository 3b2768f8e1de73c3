"""The workcell for displays: the static scene once, body poses often."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from app.governance.model import Json, Site

_SHAPES = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
_HIDDEN_GROUP = 4
_PERSON = "person_"


def describe(model: mujoco.MjModel, site: Site) -> Mapping[str, Json]:
    """Return bounds, zones, and every visible shape with its body, pose within it, size and colour.

    `loose` are those of the bodies that are neither the robot's nor a person's, and may be anywhere.

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
        "loose": [*_loose(model)],
    }


def moving_bodies(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the numbers of the bodies that can move, in the order of the scene's `bodies`."""
    return np.array([*_moving(model).values()], dtype=np.intp)


def copy_poses(data: mujoco.MjData, bodies: NDArray[np.intp]) -> Callable[[], bytes]:
    """Copy the poses of bodies as they are now, and return what packs them: float32 x, y, z, qw, qx, qy, qz each."""
    positions, turns = data.xpos[bodies], data.xquat[bodies]
    return lambda: np.hstack((positions, turns)).astype("<f4").tobytes()


def _fixed(model: mujoco.MjModel) -> Json:
    """Return the poses of bodies that never move."""
    moving = _moving(model)
    names = [model.body(k).name for k in range(1, model.nbody)]
    return {
        name: [float(v) for v in (*model.body(name).pos, *model.body(name).quat)]
        for name in names
        if name not in moving
    }


def _loose(model: mujoco.MjModel) -> list[str]:
    free = {int(model.jnt_bodyid[k]) for k in range(model.njnt) if model.jnt_type[k] == mujoco.mjtJoint.mjJNT_FREE}
    return [
        name
        for name, k in _moving(model).items()
        if (k in free or model.body_mocapid[k] >= 0) and not name.startswith(_PERSON)
    ]


def _moving(model: mujoco.MjModel) -> dict[str, int]:
    return {
        model.body(k).name: k for k in range(1, model.nbody) if model.body_weldid[k] != 0 or model.body_mocapid[k] >= 0
    }
