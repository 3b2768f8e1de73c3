"""What the watcher measures in one tick: every signal that a watch rule can name, from sensors alone.

`measure` takes the state of the tick before and what came in since, and returns the next state with its `Signals`. It
is flat on purpose: about twenty numbers from named tuples, no objects on the way, no branch that a quiet tick does not
need. What a number means, when it is too much and what follows is policy's business (`watcher`, `intervention`).

NaN never passes as well: every sensor field goes into one sum, and a sum that is not finite makes `implausible`.
"""

from __future__ import annotations

import math
from math import cos, hypot, sin, sqrt
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.estimation import BaseEstimate, PersonEstimate, now, offset, track_base, track_people
from app.governance.model import SensorStamps

if TYPE_CHECKING:
    from app.governance.model import Command, Observation, SkillReport, Vec6, WatchPlan, Zone

FAR_M: Final = 99.0
NEAR_ZONE_M: Final = 1.5
EDGE_M: Final = 0.03
REACTION_S: Final = 0.05  # from a violation to less speed: two ticks, the filter's lag and the drives'
STUCK_TICKS: Final = 20
HELD_TICKS: Final = 10
LOST_TICKS: Final = 3
FIST_M: Final = 0.008
PROGRESS_STEP: Final = 1e-4
CREEP_MPS: Final = 0.01
FIX_JUMP_M: Final = 0.3

LARGEST_JOINT_RAD: Final = 2 * math.pi + 0.1
LARGEST_JOINT_SPEED_RADPS: Final = 10.0
LARGEST_TORQUE_NM: Final = 1000.0
LARGEST_FORCE_N: Final = 20_000.0
LARGEST_WIDTH_M: Final = 0.5
LONGEST_REACH_M: Final = 3.0
LARGEST_BASE_SPEED_MPS: Final = 10.0


class Signals(NamedTuple):
    """All signals of one tick, SI units; the names up to `postcondition` are what watch rules use.

    `separation_m` is the distance between the nearest person and the robot (hull of the base, or TCP), and
    `protective_separation_m` what it has to be. `separation_margin_m` is the smallest difference of the two over all
    people, `sensor_margin_ms` the largest excess of an age over its limit.
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
    protective_separation_m: float = 0.0
    separation_margin_m: float = FAR_M
    sensor_margin_ms: float = -1.0
    base_x_m: float = 0.0
    base_y_m: float = 0.0
    base_yaw_rad: float = 0.0


SIGNAL_NAMES: Final = Signals._fields[:16]
"""The names a watch rule may use."""


class Senses(NamedTuple):
    """What measuring remembers from tick to tick: estimates, timers of the attempt, and the tick before."""

    base: BaseEstimate = BaseEstimate()
    people: tuple[PersonEstimate, ...] = ()
    before: Observation | None = None
    elapsed_ticks: int = 0
    stall_ticks: int = 0
    progress: float = -1.0
    held_ticks: int = 0
    lost_ticks: int = 0
    slip_from_m: float | None = None
    stuck_ticks: int = 0
    stuck_base_ticks: int = 0


class Measure:
    """The constants of one plan, worked out once, and the measuring itself. Holds no state of its own."""

    __slots__ = ("_ages", "_base_radius_m", "_deceleration", "_fixed_m", "_per_speed_s", "_period_s", "_zones")

    def __init__(self, plan: WatchPlan, period_s: float) -> None:
        """Work the plan's constants out.

        Raises:
            ValueError: `stale_after_ms` names a sensor that does not exist, or a constant is not usable.
        """
        known = SensorStamps._fields
        for sensor in plan.stale_after_ms:
            if sensor not in known:
                raise ValueError(f"unknown sensor `{sensor}`; valid: {', '.join(f'`{name}`' for name in known)}")
        if not plan.base_deceleration_mps2 > 0.0:
            raise ValueError(f"base deceleration `{plan.base_deceleration_mps2}` m/s²; valid: more than 0")
        self._ages = tuple((known.index(name), limit / 1000.0) for name, limit in plan.stale_after_ms.items())
        self._zones = tuple(_Keepout.of(zone) for zone in plan.zones)
        self._deceleration = plan.base_deceleration_mps2
        self._base_radius_m = plan.base_radius_m
        self._period_s = period_s
        gap = plan.separation
        # S_p = v_h (T_r + T_s) + v_r T_r + v_r T_s / 2 + C + Z_d + Z_r, split into what is fixed and what v_r
        # multiplies.
        self._fixed_m = 0.0 if gap is None else (
            gap.human_speed_mps * (gap.reaction_s + gap.stopping_s)
            + gap.intrusion_m + gap.position_uncertainty_m + gap.robot_uncertainty_m
        )  # fmt: skip
        self._per_speed_s = 0.0 if gap is None else gap.reaction_s + gap.stopping_s / 2.0

    def __call__(
        self,
        senses: Senses,
        seen: Observation,
        report: SkillReport,
        command: Command,
        rate: float,
        retries: int,
        unmet: int,
    ) -> tuple[Senses, Signals]:
        """Measure one tick.

        Args:
            senses: What the tick before left.
            seen: What the sensors say now.
            report: What the skill says of itself.
            command: What the actuators were told, after the clamp.
            rate: How fast the skill was let run; at 0 neither timeout nor stall goes on.
            retries: Recoveries of kind retry so far, counted by governance.
            unmet: How many postconditions were found unmet when the skill said it was done.
        """
        before = senses.before or seen
        period_s = self._period_s
        placed = _placing(seen)
        sound = placed - placed == 0.0
        base, people = senses.base, senses.people
        vx, vy, _ = seen.base_velocity
        cx, cy, _ = command.base_velocity
        speed = sqrt(vx * vx + vy * vy)
        x = y = yaw = margin_m = gap_m = gap_margin_m = math.nan
        needed_m = self._fixed_m
        if sound:  # otherwise the estimates stay as they were, and every signal that needs them is unknown
            base = track_base(base, seen.time_s, seen.odometry, seen.fix)
            people = track_people(people, seen.people, seen.time_s) if seen.people or people else ()
            odo_x, odo_y, odo_yaw = seen.odometry
            off_x, off_y = offset(base, seen.time_s)
            x, y, yaw = odo_x + off_x, odo_y + off_y, odo_yaw + base.yaw_rad
            c, s = cos(yaw), sin(yaw)
            wx, wy = c * vx - s * vy, s * vx + c * vy
            margin_m = self._zone_margin(x, y, wx, wy, base) if self._zones else FAR_M
            gap_m = gap_margin_m = FAR_M
            if people:
                gap_m, needed_m, gap_margin_m = self._separation(people, seen, x, y, c, s, wx, wy)
        age_ms, age_margin_ms = self._staleness(seen)

        elapsed, stall, progress = senses.elapsed_ticks, senses.stall_ticks, senses.progress
        if rate > 0.0:
            elapsed += 1
            # What visibly moves is not stalled, however coarsely it tells its progress; the timeout is for that.
            stall += speed < CREEP_MPS and seen.tcp_speed_mps < CREEP_MPS
        if abs(report.progress - progress) > PROGRESS_STEP:
            stall, progress = 0, report.progress

        held, lost, slip_from_m, slip_m = _grip(senses, seen, command.grip_force_n > 0.0)
        stuck, stuck_base = _stuck(senses, seen, before, command)
        odd = (
            stuck >= STUCK_TICKS
            or stuck_base >= STUCK_TICKS
            or (base.miss_m > FIX_JUMP_M and base.fix_s != senses.base.fix_s)
            or (seen.time_s <= before.time_s and seen is not before)
            or _implausible(seen, placed)
        )
        signals = Signals._make(
            (
                0.5 * (seen.contact_force_n + before.contact_force_n),
                _largest(seen.residual_nm),
                seen.tcp_speed_mps,
                speed,
                margin_m,
                gap_m,
                stall * period_s,
                elapsed * period_s,
                float(retries),
                slip_m,
                1.0 if lost >= LOST_TICKS else 0.0,
                _farthest(command.joint_rad, seen.joint_rad),
                sqrt((cx - vx) ** 2 + (cy - vy) ** 2),
                age_ms,
                1.0 if odd else 0.0,
                float(unmet),
                needed_m,
                gap_margin_m,
                age_margin_ms,
                x,
                y,
                yaw,
            ),
        )
        after = Senses._make((base, people, seen, elapsed, stall, progress, held, lost, slip_from_m, stuck, stuck_base))
        return after, signals

    def _zone_margin(self, x: float, y: float, wx: float, wy: float, base: BaseEstimate) -> float:
        """Return the least clearance between the hull and a zone on the way to standstill, if braking began now."""
        speed, vx, vy = hypot(wx, wy), wx, wy
        if speed > 0.01:
            wx, wy = wx + base.drift_x_mps, wy + base.drift_y_mps
            speed = hypot(wx, wy)
        reach_s = REACTION_S + speed / (2.0 * self._deceleration)
        ahead = speed * reach_s
        least = FAR_M
        for zone in self._zones:
            x0, y0, x1, y1, _ = zone
            dx = x0 - x if x < x0 else x - x1 if x > x1 else 0.0
            dy = y0 - y if y < y0 else y - y1 if y > y1 else 0.0
            # Far off the distance to the bounding box stands in: it is never more than the true one.
            margin = sqrt(dx * dx + dy * dy) - ahead
            if not margin > NEAR_ZONE_M:
                margin = zone.clearance(x, y, wx * reach_s, wy * reach_s)
            if not margin >= least:
                least = margin
        margin = least - self._base_radius_m
        if -EDGE_M < margin < 0.0 and self._leaves(x, y, vx * reach_s, vy * reach_s):
            return 0.0
        return margin

    def _leaves(self, x: float, y: float, ahead_x: float, ahead_y: float) -> bool:
        """Say whether the base stands, or nears no zone: who was stopped at the edge has to be able to back out.

        There it stands within the noise of its own estimate, which alone would be a violation again and again.
        """
        return all(zone.clearance(x, y, ahead_x, ahead_y) >= zone.clearance(x, y, 0.0, 0.0) for zone in self._zones)

    def _separation(
        self,
        people: tuple[PersonEstimate, ...],
        seen: Observation,
        x: float,
        y: float,
        c: float,
        s: float,
        wx: float,
        wy: float,
    ) -> tuple[float, float, float]:
        """Return distance, protective separation and margin of the person with the least margin."""
        tx, ty, _ = seen.tcp_m
        hand_x, hand_y = x + c * tx - s * ty, y + s * tx + c * ty
        jx, jy = _tcp_velocity(seen.jacobian, seen.joint_speed_radps)
        hand_wx, hand_wy = wx + c * jx - s * jy, wy + s * jx + c * jy
        worst = (FAR_M, self._fixed_m, math.inf)
        for person in people:
            px, py = now(person, seen.time_s)
            to_x, to_y = px - x, py - y
            reach_x, reach_y = px - hand_x, py - hand_y
            far, near = hypot(to_x, to_y), hypot(reach_x, reach_y)
            # Directed: only speed towards the person shortens the time they have.
            closing = max(
                0.0,
                (wx * to_x + wy * to_y) / (far or 1.0),
                (hand_wx * reach_x + hand_wy * reach_y) / (near or 1.0),
            )
            gap_m = min(far - self._base_radius_m, near)
            needed_m = self._fixed_m + closing * self._per_speed_s
            if gap_m - needed_m < worst[2]:
                worst = (gap_m, needed_m, gap_m - needed_m)
        return worst

    def _staleness(self, seen: Observation) -> tuple[float, float]:
        """Return the age that exceeds its limit most (or comes nearest to), and by how much, in ms."""
        time_s, stamps = seen.time_s, seen.stamps_s
        age_s, worst_s = 0.0, -1e6
        for place, limit_s in self._ages:
            over_s = time_s - stamps[place] - limit_s
            if over_s > worst_s:
                age_s, worst_s = over_s + limit_s, over_s
        return age_s * 1000.0, worst_s * 1000.0

    def stale_sensors(self, seen: Observation) -> tuple[str, ...]:
        """Name the sensors whose newest sample is too old; for the record, not for the loop."""
        stamps, names = seen.stamps_s, SensorStamps._fields
        return tuple(names[place] for place, limit_s in self._ages if not seen.time_s - stamps[place] <= limit_s)


class _Keepout(NamedTuple):
    """A zone with its bounding box and its edges (x0, y0, x1, y1)."""

    x0: float
    y0: float
    x1: float
    y1: float
    edges: tuple[tuple[float, float, float, float], ...]

    @classmethod
    def of(cls, zone: Zone) -> _Keepout:
        corners = zone.polygon
        xs, ys = [x for x, _ in corners], [y for _, y in corners]
        around = zip(corners, (*corners[1:], corners[0]), strict=True)
        return cls(min(xs), min(ys), max(xs), max(ys), tuple((*a, *b) for a, b in around))

    def clearance(self, x: float, y: float, ahead_x: float, ahead_y: float) -> float:
        """Return the distance from the way ahead to the zone; negative inside."""
        here, there = self._signed(x, y), self._signed(x + ahead_x, y + ahead_y)
        least = min(here, there)
        if least <= 0.0:
            return least
        for x0, y0, _, _ in self.edges:  # a corner may reach into the way between its ends
            least = min(least, _to_segment(x0, y0, x, y, x + ahead_x, y + ahead_y))
        return least

    def _signed(self, x: float, y: float) -> float:
        inside, least = False, math.inf
        for x0, y0, x1, y1 in self.edges:
            least = min(least, _to_segment(x, y, x0, y0, x1, y1))
            if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
                inside = not inside
        return -least if inside else least


def _to_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> float:
    ex, ey = x1 - x0, y1 - y0
    length = ex * ex + ey * ey
    along = ((x - x0) * ex + (y - y0) * ey) / length if length > 0.0 else 0.0
    along = 0.0 if along < 0.0 else min(along, 1.0)
    return hypot(x - x0 - along * ex, y - y0 - along * ey)


def _tcp_velocity(jacobian: tuple[float, ...], speeds: Vec6) -> tuple[float, float]:
    a, b, c, d, e, f = speeds
    j0, j1, j2, j3, j4, j5, k0, k1, k2, k3, k4, k5, *_ = jacobian
    return (
        j0 * a + j1 * b + j2 * c + j3 * d + j4 * e + j5 * f,
        k0 * a + k1 * b + k2 * c + k3 * d + k4 * e + k5 * f,
    )


def _largest(values: Vec6) -> float:
    high, low = max(values), min(values)
    return high if high > -low else -low


def _within(values: Vec6, limit: float) -> bool:
    a, b, c, d, e, f = values
    low = -limit
    return (
        low <= a <= limit
        and low <= b <= limit
        and low <= c <= limit
        and low <= d <= limit
        and low <= e <= limit
        and low <= f <= limit
    )


def _farthest(told: Vec6, seen: Vec6) -> float:
    a, b, c, d, e, f = told
    u, v, w, x, y, z = seen
    return max(abs(a - u), abs(b - v), abs(c - w), abs(d - x), abs(e - y), abs(f - z))


def _grip(senses: Senses, seen: Observation, closing: bool) -> tuple[int, int, float, float]:
    """Return ticks held, ticks lost, where slip counts from, and the slip since then."""
    if not closing:
        return 0, 0, seen.slip_m, 0.0
    held, lost = senses.held_ticks, senses.lost_ticks
    if seen.pads_loaded and seen.grip_width_m > FIST_M:  # a closed fist that presses a button holds nothing
        held, lost = held + 1, 0
    elif held >= HELD_TICKS:
        lost += 1
    else:
        held = 0
    from_m = senses.slip_from_m
    if from_m is None or seen.slip_m < from_m:  # the sensor starts from zero when the grip closes anew
        from_m = seen.slip_m
    return held, lost, from_m, seen.slip_m - from_m


def _stuck(senses: Senses, seen: Observation, before: Observation, command: Command) -> tuple[int, int]:
    """Count ticks of commanded movement in which a signal repeated bit by bit: arm and wrist, and drives."""
    arm, drives = senses.stuck_ticks, senses.stuck_base_ticks
    if any(command.joint_speed_radps):
        arm = arm + 1 if _arm_unchanged(seen, before) else 0
    if any(command.base_velocity):
        drives = drives + 1 if seen is not before and seen.base_velocity == before.base_velocity else 0
    return arm, drives


def _arm_unchanged(seen: Observation, before: Observation) -> bool:
    """Say whether a signal that never repeats bit by bit while the arm moves has just done so."""
    return (
        seen.contact_force_n == before.contact_force_n
        or seen.joint_torque_nm == before.joint_torque_nm
        or seen.joint_rad == before.joint_rad
        or seen.joint_speed_radps == before.joint_speed_radps
    ) and seen is not before


def _placing(seen: Observation) -> float:
    """Return a sum that is finite only if every reading is that says where base, hand and people are."""
    total = sum(seen.odometry) + sum(seen.base_velocity) + sum(seen.tcp_m) + sum(seen.jacobian) + seen.time_s
    total += sum(seen.joint_speed_radps)
    if seen.fix is not None:
        total += sum(seen.fix)
    for track in seen.people:
        total += sum(track)
    return total


def _implausible(seen: Observation, placed: float) -> bool:
    """Say whether a reading is not finite or cannot be: one sum finds every NaN and infinity, whatever its field."""
    total = (
        placed
        + sum(seen.joint_rad)
        + sum(seen.joint_torque_nm)
        + sum(seen.residual_nm)
        + sum(seen.stamps_s)
        + (seen.tcp_speed_mps + seen.contact_force_n + seen.peak_force_n)
        + (seen.grip_width_m + seen.grip_force_n + seen.slip_m)
    )
    if total - total != 0.0:
        return True
    return not (
        _within(seen.joint_rad, LARGEST_JOINT_RAD)
        and _within(seen.joint_speed_radps, LARGEST_JOINT_SPEED_RADPS)
        and _within(seen.joint_torque_nm, LARGEST_TORQUE_NM)
        and 0.0 <= seen.contact_force_n <= LARGEST_FORCE_N
        and -0.05 <= seen.grip_width_m <= LARGEST_WIDTH_M
        and abs(seen.tcp_m[0]) + abs(seen.tcp_m[1]) <= LONGEST_REACH_M
        and abs(seen.base_velocity[0]) + abs(seen.base_velocity[1]) <= LARGEST_BASE_SPEED_MPS
        and max(seen.stamps_s) <= seen.time_s + 0.1
    )
