"""What truly is in a workcell: for evaluation and tests alone. No skill and no watcher sees it."""

from __future__ import annotations

from math import cos, dist, hypot, sin
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from app.sim.navigation import distance_to
from app.sim.plant import PAD_LOADED_N

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.model import Point, Site, Vec3
    from app.sim.hand import Hand
    from app.sim.kinematics import SelfModel
    from app.sim.plant import Plant

NOBODY_M: Final = 99.0
UPRIGHT: Final = 0.9  # cosine of the lean


class Truth(NamedTuple):
    """What truly is; for evaluation and tests alone.

    `secure` is whether the friction of the pads can bear what they hold: what cannot be borne slides out, however long
    the pads still touch it. `tools` are joints (rad, m), `switches` the states that the tools themselves tell.
    """

    time_s: float
    base: Vec3
    base_speed_mps: float
    tcp_m: Vec3
    tcp_speed_mps: float
    contact_force_n: float
    peak_force_n: float
    held: str | None
    secure: bool
    grip_force_n: float
    people_m: float
    people: tuple[Point, ...]
    zones: tuple[str, ...]
    objects: Mapping[str, Vec3]
    upright: Mapping[str, bool]
    tools: Mapping[str, float]
    switches: Mapping[str, str]


class Glance(NamedTuple):
    """What truly is in one tick, as far as limits speak of it: the part of `Truth` that is cheap.

    `base_velocity` is in the world frame (m/s), `tcp_m` too; `load_m` is where the object that the robot believes to
    hold is, relative to the tool centre, or None.
    """

    tcp_speed_mps: float
    base_speed_mps: float
    contact_force_n: float
    peak_force_n: float
    grip_force_n: float
    base: Vec3
    base_velocity: Point
    tcp_m: Vec3
    load_m: float | None
    people: tuple[Point, ...]


def truth_of(  # the world has that many sides
    plant: Plant,
    self_model: SelfModel,
    site: Site,
    people: Mapping[int, Point],
    switches: Mapping[str, str],
    time_s: float,
) -> Truth:
    """Return everything that truly is.

    Args:
        plant: the physics.
        self_model: the robot's kinematics, for the speed of its tool.
        site: names and zones.
        people: who is present, and where.
        switches: the state of every tool.
        time_s: cell time.
    """
    tick, held, base = plant.read(), plant.true_held(), plant.read_base()
    contact, peak = _contact(plant, held)
    at = (np.array([base[0]]), np.array([base[1]]))
    objects = {name: plant.true_object(name) for name in plant.objects}
    return Truth(
        time_s=time_s,
        base=base,
        base_speed_mps=hypot(*tick.base_velocity[:2]),
        tcp_m=plant.true_tcp(),
        tcp_speed_mps=self_model.tcp_speed(tick.joint_rad, tick.joint_speed),
        contact_force_n=contact,
        peak_force_n=peak,
        held=held,
        secure=held is not None and plant.true_grip_n(held) >= plant.weight_n(held),
        grip_force_n=0.5 * sum(tick.pad_force_n),
        people_m=min((hypot(x - base[0], y - base[1]) for x, y in people.values()), default=NOBODY_M),
        people=tuple(people.values()),
        zones=tuple(name for name, zone in site.zones.items() if float(distance_to(zone.polygon, *at)[0]) == 0.0),
        objects={name: found[0] for name, found in objects.items()},
        upright={name: found[2] > UPRIGHT for name, found in objects.items()},
        tools={name: plant.tool_angle(name) for name in site.tools},
        switches=switches,
    )


def glance_of(plant: Plant, self_model: SelfModel, hand: Hand | None, people: Mapping[int, Point]) -> Glance:
    """Return what truly is as far as limits speak of it.

    Args:
        plant: the physics.
        self_model: the robot's kinematics, for the speed of its tool.
        hand: what the robot believes to hold.
        people: who is present, and where.
    """
    tick = plant.read()
    held = hand.name if hand and min(tick.pad_force_n) > PAD_LOADED_N else None
    tcp, base = plant.true_tcp(), tick.base_pose
    vx, vy, _ = tick.base_velocity
    c, s = cos(base[2]), sin(base[2])
    return Glance(
        self_model.tcp_speed(tick.joint_rad, tick.joint_speed),
        hypot(vx, vy),
        *_contact(plant, held),
        0.5 * sum(tick.pad_force_n),
        base,
        (c * vx - s * vy, s * vx + c * vy),
        tcp,
        None if hand is None else dist(plant.true_object(hand.name)[0], tcp),
        tuple(people.values()),
    )


def _contact(plant: Plant, held: str | None) -> tuple[float, float]:
    """Return the force of an unwanted contact, mean over 20 ms and highest: of the hand, or of the arm and a crate."""
    (hand, hand_peak), (arm, arm_peak) = plant.true_contact_n(held), plant.true_push_n()
    return max(hand, arm), max(hand_peak, arm_peak)
