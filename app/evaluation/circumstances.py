"""What a campaign of protocol `physical` may be run in besides the reported circumstances.

Other sensor noise, other fault sizes, other ways of walking: whoever doubts the tables turns these, and sees whether
they hold. They travel with every job as text, so that a row stays a plain function of its job.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import cos, inf, pi, sin
from typing import TYPE_CHECKING, Final

from app.evaluation.draws import MOVING
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.sensors import Quality

if TYPE_CHECKING:
    from numpy.random import Generator

    from app.evaluation.draws import Drawn
    from app.governance.policy import PolicySet

USUAL, OTHER = "usual", "other"
WALKS: Final = (USUAL, OTHER)
NOMINAL: Final = (
    "The boundary band, and the sizes of faults near their limit, are in units of the noise as measured, whatever the "
    "noise is"
)
"""What whoever changes the noise of the sensors has to know; for the report."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Circumstances:
    """In what trials are run.

    Attributes:
        noise: What every error of every sensor is multiplied with; 1 is as measured. The boundary band, and what is
            drawn in units of sigma, keep the sigma of 1.
        dropout: How often the tracker misses a person in a frame.
        fault_size: What the part of a fault's size that goes beyond the limit is multiplied with, and the drift of
            odometry, and what friction is divided by; 1 is as reported.
        walks: `usual`: up to the robot and past it. `other`: across behind it, round in a curve, or stopping short.
    """

    noise: float = 1.0
    dropout: float = Quality().dropout
    fault_size: float = 1.0
    walks: str = USUAL

    def __post_init__(self) -> None:
        """Refuse what nothing can be run in."""
        _ = self.quality
        if not 0.0 < self.fault_size < inf:
            raise ValueError(f"fault size `{self.fault_size}`: valid is above 0, 1 is as reported")
        if self.walks not in WALKS:
            raise ValueError(f"walks `{self.walks}`: valid are {', '.join(WALKS)}")

    @property
    def quality(self) -> Quality:
        """Return how good the sensors are.

        Raises:
            ValueError: no sensor can be so.
        """
        return Quality(noise=self.noise, dropout=self.dropout)

    @property
    def text(self) -> str:
        """Return what differs from what is reported, as `name=value` with commas between; empty: nothing does."""
        named = ((one.name, getattr(self, one.name), one.default) for one in fields(self))
        return ",".join(f"{name}={value}" for name, value, usual in named if value != usual)

    @classmethod
    def read(cls, text: str) -> Circumstances:
        """Read what `text` gives."""
        found: dict[str, str] = dict(part.split("=", 1) for part in text.split(",") if part)  # type: ignore[misc]
        numbers = {name: float(value) for name, value in found.items() if name != "walks"}
        return cls(**numbers, walks=found.get("walks", USUAL))  # type: ignore[arg-type]


AS_REPORTED: Final = Circumstances()


def other_way(policy: PolicySet, drawn: Drawn, rng: Generator) -> tuple[Walk, float]:
    """Draw how somebody comes who crosses behind the robot, comes round in a curve, or stops short and then goes on.

    Returns:
        The walk, and its speed, m/s.
    """
    stand = policy.site.targets[drawn.start.stand]
    back = stand.yaw_rad + pi + float(rng.uniform(-0.6, 0.6))

    def at(away: float, aside: float) -> tuple[float, float]:
        return (
            stand.x_m + away * cos(back) - aside * sin(back),
            stand.y_m + away * sin(back) + aside * cos(back),
        )

    side = 1.0 if rng.uniform() < 0.5 else -1.0
    near = float(rng.uniform(0.3, 0.6))
    way, stay = {
        0: ((at(near, 3.0 * side), at(near, 0.0), at(near, -3.0 * side)), ()),
        1: ((at(3.5, 1.5 * side), at(2.0, 1.8 * side), at(0.9, 1.0 * side), at(near, 0.0)), ((3, 1.0),)),
        2: ((at(4.0, 0.0), at(1.9, 0.2 * side), at(near, 0.0), at(4.0, 0.0)), ((1, 1.0), (2, 0.5))),
    }[int(rng.integers(3))]
    pace = float(rng.uniform(0.4, 2.0))
    at_phase = Trigger(
        capability=drawn.capability, phase=MOVING[drawn.capability], after_s=float(rng.uniform(0.0, 1.0))
    )
    return Walk(points=way, speed_mps=pace, start=at_phase, stay_s=stay), pace
