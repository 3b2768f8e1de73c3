"""The values that watching works with: the numbers of one tick, the state between ticks, and a plan's constants."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.estimation import LOOSE_SCATTER_M, BaseEstimate, PersonEstimate
from app.governance.keepout import Keepout
from app.governance.model import Intervention, SensorStamps
from app.governance.policy_model import WALKING_MPS

if TYPE_CHECKING:
    from app.governance.model import Observation, WatchPlan, WatchRule

FAR_M: Final = 99.0


class Signals(NamedTuple):
    """All signals of one tick, SI units; the names up to `grip_force_n` are what watch rules use.

    `separation_m` is the distance between a person and the robot (hull of the base, or TCP), and
    `protective_separation_m` what it has to be: of the person for whom the difference is least, which is
    `separation_margin_m`. `sensor_margin_ms` is the largest excess of an age over its limit. `separation_ahead_m` is
    what a rule with a fixed distance, and a response that holds, is judged by: how far away the nearest person is, or
    less where somebody comes on so fast, or may, that less than `LEFT_M` would be left once the robot stands.
    """

    contact_force_n: float = 0.0
    residual_nm: float = 0.0
    tcp_speed_mps: float = 0.0
    base_speed_mps: float = 0.0
    zone_margin_m: float = FAR_M
    separation_m: float = FAR_M
    stall_s: float = 0.0
    elapsed_s: float = 0.0
    retries: float = 0.0
    slip_m: float = 0.0
    grip_lost: float = 0.0
    tracking_error_rad: float = 0.0
    base_tracking_error_mps: float = 0.0
    sensor_age_ms: float = 0.0
    implausible: float = 0.0
    postcondition: float = 0.0
    grip_force_n: float = 0.0
    protective_separation_m: float = 0.0
    separation_margin_m: float = FAR_M
    sensor_margin_ms: float = -1.0
    base_x_m: float = 0.0
    base_y_m: float = 0.0
    base_yaw_rad: float = 0.0
    separation_ahead_m: float = FAR_M


SIGNAL_NAMES: Final = Signals._fields[:17]
"""The names a watch rule may use."""


SHOWN: Final = frozenset(
    {
        "contact_force_n", "residual_nm", "tcp_speed_mps", "base_speed_mps", "zone_margin_m", "separation_m", "slip_m",
        "protective_separation_m", "base_x_m", "base_y_m", "base_yaw_rad",
    }
)  # fmt: skip
"""The signals that telemetry has a channel for: measured whether a rule watches them or not."""


class Senses(NamedTuple):
    """What measuring remembers from tick to tick: estimates, timers of the attempt, and the tick before.

    `sound` says whether that tick's readings of where base, hand and people are were all finite; until
    `doubted_until_s` a leap of a reading is held against its sensor. `scatter_m2` is by how much a coordinate of the
    loose object that scatters most changes from picture to picture, squared.
    """

    base: BaseEstimate = BaseEstimate()
    people: tuple[PersonEstimate, ...] = ()
    before: Observation | None = None
    sound: bool = False
    elapsed_ticks: int = 0
    stall_ticks: int = 0
    progress: float = -1.0
    held_ticks: int = 0
    lost_ticks: int = 0
    slip_from_m: float | None = None
    stuck_ticks: int = 0
    stuck_base_ticks: int = 0
    frozen: int = 0
    stuck_grip_ticks: int = 0
    closing: bool | None = None
    closings: int = 0
    reached: float = 0.0
    restarts: int = 0
    scatter_m2: float = LOOSE_SCATTER_M[1] ** 2
    doubted_until_s: float = 0.0


class WatchState(NamedTuple):
    """Everything watching remembers: what measuring does, the last signals, and how long which rule has been violated.

    `remembered` are the values of `Senses`, `measured` those of `Signals`: plain tuples are made and taken apart in a
    third of the time, and in most ticks nobody asks for a name. `lasting` holds (row, ticks) of the rules violated now,
    or that have spoken and are not over yet (less than 0: for how long they have been clear), `sums` the cumulative
    sums of the CUSUM rules in order.
    """

    remembered: tuple[object, ...] = tuple(Senses())
    measured: tuple[float, ...] = tuple(Signals())
    lasting: tuple[tuple[int, int], ...] = ()
    sums: tuple[float, ...] = ()

    @property
    def senses(self) -> Senses:
        """Return what measuring remembers, by name."""
        return Senses(*self.remembered)  # type: ignore[arg-type]

    @property
    def signals(self) -> Signals:
        """Return the last signals, by name."""
        return Signals._make(self.measured)


def holds_off(rule: WatchRule) -> bool:
    """Say whether a rule holds the robot while somebody is nearer than a distance that it names."""
    fixed = rule.signal == "separation_m" and rule.threshold is not None and not rule.above
    return fixed and rule.response.enter is not Intervention.CONTINUE


class Constants(NamedTuple):
    """What detectors take from a plan, worked out once. `age_limits_s` goes with `SensorStamps`, ∞ where none is set.

    The protective separation S_p = v_h (T_r + T_s) + v_r T_r + v_r T_s / 2 + C + Z_d + Z_r is split into what is fixed
    (`fixed_gap_m`), what v_r multiplies (`gap_per_speed_s`), and what is to be added where somebody comes faster than
    v_h (`human_speed_mps`), per speed (`gap_per_human_speed_s`). `held_off_m` is the distance that a rule names which
    holds the robot while somebody is nearer; 0 without one. Where a profile declares no S_p, that is the distance kept.
    """

    period_s: float
    keepouts: tuple[Keepout, ...]
    base_deceleration_mps2: float
    base_radius_m: float
    age_limits_s: tuple[float, ...]
    fixed_gap_m: float
    gap_per_speed_s: float
    gap_per_human_speed_s: float
    human_speed_mps: float
    held_off_m: float

    @classmethod
    def of(cls, plan: WatchPlan, period_s: float) -> Constants:
        """Work a plan's constants out.

        Raises:
            ValueError: `stale_after_ms` names a sensor that does not exist, or a constant is not usable.
        """
        known = SensorStamps._fields
        for sensor in plan.stale_after_ms:
            if sensor not in known:
                raise ValueError(f"unknown sensor `{sensor}`; valid: {', '.join(f'`{name}`' for name in known)}")
        if not plan.base_deceleration_mps2 > 0.0:
            raise ValueError(f"base deceleration `{plan.base_deceleration_mps2}` m/s²; valid: more than 0")
        gap = plan.separation
        held_off_m = max((rule.threshold or 0.0 for rule in plan.rules if holds_off(rule)), default=0.0)
        return cls(
            period_s=period_s,
            keepouts=tuple(Keepout.of(zone) for zone in plan.zones),
            base_deceleration_mps2=plan.base_deceleration_mps2,
            base_radius_m=plan.base_radius_m,
            age_limits_s=tuple(plan.stale_after_ms.get(name, math.inf) / 1000.0 for name in known),
            fixed_gap_m=held_off_m if gap is None else (
                gap.human_speed_mps * (gap.reaction_s + gap.stopping_s)
                + gap.intrusion_m + gap.position_uncertainty_m + gap.robot_uncertainty_m
            ),
            gap_per_speed_s=0.0 if gap is None else gap.reaction_s + gap.stopping_s / 2.0,
            gap_per_human_speed_s=0.0 if gap is None else gap.reaction_s + gap.stopping_s,
            human_speed_mps=WALKING_MPS if gap is None else gap.human_speed_mps,
            held_off_m=held_off_m,
        )  # fmt: skip

    def stale(self, seen: Observation) -> tuple[str, ...]:
        """Name the sensors whose newest sample is too old; for the record, not for the loop."""
        samples = zip(SensorStamps._fields, seen.stamps_s, self.age_limits_s, strict=True)
        return tuple(name for name, stamp_s, limit_s in samples if not seen.time_s <= stamp_s + limit_s)
