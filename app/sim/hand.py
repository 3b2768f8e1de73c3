"""What the robot remembers of its own doing: what it holds and from where, and the way it came.

And which surface is where.
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from app.governance.model import Site, Surface, Vec3


MARK_MAX = 20_000
"""How many points of the recorded safe path are kept: one that is as long as that leads no further, and not back."""

WIDER_M = 0.01
"""How much wider open a hand has to have been for that to be another way of holding it."""


class Hand(NamedTuple):
    """What the robot believes to hold.

    How far the tool was above the support, and from where it took the object (world frame).
    """

    name: str
    above_support_m: float
    x_m: float
    y_m: float
    yaw_rad: float
    support_z_m: float


class Mark(NamedTuple):
    """One point of the recorded safe path.

    Commanded joints, believed base pose, whether the base drove, whether the pads held something, whether it was a
    recovery that went there, and how wide the hand was open. Of recoveries the path holds that they began, and where
    they drove: they draw the arm in, and undo by that what it did. Going back is not recorded: the path `leaps` to
    where it was interrupted.
    """

    joints: NDArray[np.float64]
    base: Vec3
    driving: bool
    holding: bool
    recovering: bool = False
    leaps: bool = False
    width_m: float = 0.0


def on_surface(surface: Surface, x_m: float, y_m: float, *, margin_m: float = 0.0) -> bool:
    """Tell whether a point of the world lies on a surface, `margin_m` away from its edges."""
    dx, dy, c, s = x_m - surface.x_m, y_m - surface.y_m, cos(surface.yaw_rad), sin(surface.yaw_rad)
    return abs(c * dx + s * dy) <= surface.half_x_m - margin_m and abs(-s * dx + c * dy) <= surface.half_y_m - margin_m


def support(site: Site, x_m: float, y_m: float) -> Surface | None:
    """Return the surface under a point of the world."""
    return next((surface for surface in site.surfaces.values() if on_surface(surface, x_m, y_m)), None)
