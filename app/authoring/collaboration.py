"""What ISO/TS 15066:2016 has of distance, force and speed between people and robots, as numbers to reckon with."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

TRANSIENT: Final = 2.0  # a short contact may have twice the force of a lasting one (Table A.2)


class Distances(NamedTuple):
    """What the protective separation distance is made of, in s, m and m/s (5.5.4)."""

    human_speed_mps: float
    reaction_s: float
    stopping_s: float
    intrusion_m: float
    position_uncertainty_m: float
    robot_uncertainty_m: float

    def separation_m(self, robot_mps: float) -> float:
        """Return S_p = v_h (T_r + T_s) + v_r T_r + v_r T_s / 2 + C + Z_d + Z_r in m, at a speed of the robot in m/s."""
        human_m = self.human_speed_mps * (self.reaction_s + self.stopping_s)
        robot_m = robot_mps * (self.reaction_s + self.stopping_s / 2)
        return human_m + robot_m + self.intrusion_m + self.position_uncertainty_m + self.robot_uncertainty_m


class Region(NamedTuple):
    """A part of the body.

    Attributes:
        force_n: what it bears in a lasting contact, in N (Table A.2).
        spring_npm: its spring constant, in N/m (Annex A).
        mass_kg: its effective mass, in kg (Annex A).
    """

    force_n: float
    spring_npm: float
    mass_kg: float


# Skull, forehead, face and larynx are left out: contact there is to be prevented, not limited (5.5.5).
REGIONS: Final[Mapping[str, Region]] = {
    "back-and-shoulders": Region(210, 35_000, 40),
    "chest": Region(140, 25_000, 40),
    "abdomen": Region(110, 10_000, 40),
    "pelvis": Region(180, 25_000, 40),
    "upper-arm-and-elbow": Region(150, 30_000, 3),
    "forearm-and-wrist": Region(160, 40_000, 2),
    "hand-and-fingers": Region(140, 75_000, 0.6),
    "thigh-and-knee": Region(220, 50_000, 75),
    "lower-leg": Region(130, 60_000, 75),
}


def lasting_force_n(regions: Iterable[str]) -> float:
    """Return the most that a lasting contact may have, in N: the least of the regions that may be touched."""
    return min(REGIONS[name].force_n for name in regions)


def contact_speed_mps(regions: Iterable[str], *, moving_kg: float, load_kg: float) -> float:
    """Return the speed in m/s at which a free contact reaches its transient force in one of the regions (Annex A).

    v = F / sqrt(mu k), with 1/mu = 1/m_H + 1/m_R and m_R = M/2 + m_L.

    Args:
        regions: the parts of the body that may be touched.
        moving_kg: M, the mass of the robot's moving parts.
        load_kg: m_L, the mass of tool and load.
    """
    robot_kg = moving_kg / 2 + load_kg

    def speed(region: Region) -> float:
        reduced_kg = 1 / (1 / region.mass_kg + 1 / robot_kg)
        return TRANSIENT * region.force_n / math.sqrt(reduced_kg * region.spring_npm)

    return min(speed(REGIONS[name]) for name in regions)
