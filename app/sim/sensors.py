"""The robot's own sensors: arm, wrist, gripper, odometry, absolute fix, and the people tracker.

Seeded, delayed, and breakable.

Noise comes from blocks drawn in advance, one row per tick, so that a tick costs no call into the generator and a run
is the same for the same seed. Nothing here holds a reference to the simulator: a deep copy of `Sensors` is its whole
state.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import cos, dist, hypot, inf, sin
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from app.governance.model import CONTROL_PERIOD_S, Fix, PersonTrack
from app.sim.plant import PAD_LOADED_N, beyond_wrist

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from app.governance.model import Point, Vec3
    from app.sim.plant import Tick

    Floats = NDArray[np.float64]

FIX_PERIOD_TICKS, FIX_DELAY_TICKS, FIX_SIGMA_M, FIX_SIGMA_RAD = 5, 5, 0.02, 0.005
PEOPLE_PERIOD_TICKS, PEOPLE_DELAY_TICKS, PEOPLE_SIGMA_M, PEOPLE_DROPOUT = 5, 6, 0.05, 0.03
PEOPLE_RANGE_M, PEOPLE_KEEP_S = 8.0, 1.0
ENCODER_SIGMA_RAD, DRIVE_SIGMA_RADPS, TORQUE_SIGMA_NM = 2e-5, 2e-3, 0.15
WRIST_SIGMA_N, PAD_SIGMA_N, WIDTH_SIGMA_M, SLIP_SIGMA_M = 0.6, 0.15, 1e-4, 1e-4
SENSORS = ("arm", "wrist", "gripper", "odometry", "fix", "people", "objects")
_COLUMNS, _ROWS = 64, 512
_BASE_SIGMA, _WHEELS_STILL = 0.002, 1e-3
_BODY_SIGMA = np.repeat(
    (
        *(ENCODER_SIGMA_RAD, DRIVE_SIGMA_RADPS, TORQUE_SIGMA_NM, WRIST_SIGMA_N, PAD_SIGMA_N),
        *(WIDTH_SIGMA_M, SLIP_SIGMA_M, _BASE_SIGMA),
    ),
    (6, 6, 6, 3, 2, 1, 1, 3),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """How good a cell's sensors are.

    Attributes:
        noise: what every σ, bias and scale error of the sensors is multiplied with; 0 is noise-free. Broken sensors
            (`SensorFault`) stay as broken as they were declared.
        dropout: how often the tracker misses a person in a frame.
        fix_delay_ticks: how late an absolute fix arrives.
        people_delay_ticks: how late a frame of the people tracker arrives.
    """

    noise: float = 1.0
    dropout: float = PEOPLE_DROPOUT
    fix_delay_ticks: int = FIX_DELAY_TICKS
    people_delay_ticks: int = PEOPLE_DELAY_TICKS

    def __post_init__(self) -> None:
        """Refuse what no sensor can have."""
        if not 0.0 <= self.noise < inf:
            raise ValueError(f"sensor noise `{self.noise}`: valid is 0 (none) or more, 1 is as measured")
        if not 0.0 <= self.dropout <= 1.0:
            raise ValueError(f"tracker dropout `{self.dropout}`: valid is 0 to 1")
        for name in ("fix_delay_ticks", "people_delay_ticks"):
            if getattr(self, name) < 0:
                raise ValueError(f"`{name}` `{getattr(self, name)}`: valid is 0 or more")


AS_MEASURED = Quality()


class Noise:
    """Standard normal numbers in rows, drawn a block at a time."""

    def __init__(self, seed: Sequence[int]) -> None:
        """Start the generator from a seed sequence."""
        self._rng = np.random.default_rng(seed)
        self._block = np.empty((0, _COLUMNS))
        self._next = 0

    def row(self) -> Floats:
        """Return the next row of 64 numbers."""
        if self._next >= len(self._block):
            self._block = self._rng.standard_normal((_ROWS, _COLUMNS))
            self._next = 0
        self._next += 1
        return self._block[self._next - 1]


@dataclass(slots=True)
class SensorFault:
    """How one sensor is broken.

    `stuck` (old value, new stamp), `stale` (nothing new), `noisy`, `offset` or `delayed`, by `size`: in the unit of
    the sensor, of a delay in seconds.
    """

    kind: str
    size: float = 0.0
    kept: tuple[float, Floats] | None = None
    line: deque[tuple[float, Floats]] = field(default_factory=deque[tuple[float, "Floats"]])

    def distort(self, stamp_s: float, value: Floats, noise: Floats) -> tuple[float, Floats]:
        """Return what the broken sensor says instead."""
        if self.kept is None:
            self.kept = (stamp_s, value.copy())
        match self.kind:
            case "stuck":
                return stamp_s, self.kept[1]
            case "stale":
                return self.kept
            case "noisy":
                return stamp_s, value + self.size * noise[: len(value)]
            case "offset":
                return stamp_s, value + self.size
            case "delayed":
                self.line.append((stamp_s, value.copy()))
                # By age, not by count: not every sensor has a sample in each tick.
                while len(self.line) > 1 and self.line[1][0] <= stamp_s - self.size + CONTROL_PERIOD_S / 2.0:
                    self.line.popleft()
                return self.line[0]
            case _:
                raise ValueError(f"sensor fault `{self.kind}`: valid are stuck, stale, noisy, offset, delayed")


class Reading(NamedTuple):
    """All body sensors in one tick: (stamp, values) each, as delivered."""

    arm: tuple[float, list[float]]  # 6 angles, 6 speeds, 6 torques
    wrist: tuple[float, list[float]]  # mean, peak
    gripper: tuple[float, list[float]]  # width, left pad, right pad, slip
    odometry: tuple[float, list[float]]  # x, y, yaw, vx, vy, wz


class Sensors:
    """Seeded sensors of one workcell."""

    def __init__(self, seed: int, start: Vec3, gripper_kg: float, quality: Quality = AS_MEASURED) -> None:
        """Start with odometry at `start` (the robot knows where it was parked) and the wrist tared to the bare gripper.

        Args:
            seed: what the noise hangs on.
            start: where the robot was parked.
            gripper_kg: what hangs on the wrist without a load.
            quality: how good the sensors are.
        """
        self._quality = quality
        self._dropped_beyond = NormalDist().inv_cdf(1.0 - quality.dropout / 2.0) if quality.dropout > 0.0 else inf
        self._body_sigma = quality.noise * _BODY_SIGMA
        self._fix_sigma = quality.noise * np.array((FIX_SIGMA_M, FIX_SIGMA_M, FIX_SIGMA_RAD))
        self._people_sigma_m = quality.noise * PEOPLE_SIGMA_M
        self.odometry = start
        self.reseed(seed)
        self.odometry_bias: Point = (0.0, 0.0)  # m/s, world frame; a fault sets it
        self.faults: dict[str, SensorFault] = {}
        self.load_kg = 0.0
        self._gripper_kg = gripper_kg
        self._grip: tuple[str, Vec3] | None = None
        self._slip_m = 0.0
        self._fixes: deque[tuple[int, Fix]] = deque()
        self._sightings: deque[tuple[int, float, float, tuple[PersonTrack, ...]]] = deque()
        self._tracks: dict[int, PersonTrack] = {}
        self.fix_stamp_s = self.people_stamp_s = 0.0
        self.fix_frame = self.people_frame = 0.0  # what the newest samples add up to (`Frames`)

    def reseed(self, seed: int) -> None:
        """Draw noise and traits anew from another seed; what was measured so far stays."""
        self._noise = Noise((seed, 1))
        traits = self._quality.noise * np.random.default_rng((seed, 2)).standard_normal(4)
        self.odometry_scale = 1.0 + 0.005 * float(traits[0])
        self.odometry_turn_radpm = 0.01 * float(traits[1])

    # -- body ------------------------------------------------------------------------------------------------

    def read(self, tick: int, physical: Tick, nearest: tuple[str, Vec3] | None) -> Reading:
        """Return what the body sensors say.

        Args:
            tick: control tick, which is the time in hundredths of a second.
            physical: what happened.
            nearest: the object between the pads and its position in the tool frame, as far as there is one.
        """
        now = tick * CONTROL_PERIOD_S
        n = self._noise.row()
        noise = self._body_sigma * n[: len(self._body_sigma)]
        arm = np.concatenate((physical.joint_rad, physical.joint_speed, physical.joint_torque))
        arm += noise[0:18]
        nx, ny, nz, n_left, n_right, n_width, n_slip, *n_base = noise[18:].tolist()
        fx, fy, fz, peak = beyond_wrist(physical.wrist, self._gripper_kg + self.load_kg)
        left, right = physical.pad_force_n
        left, right = max(left + n_left, 0.0), max(right + n_right, 0.0)
        slip = self._measure_slip(left, right, nearest) + abs(n_slip)
        velocity = physical.base_velocity
        if max(map(abs, velocity)) > _WHEELS_STILL:
            velocity = velocity[0] + n_base[0], velocity[1] + n_base[1], velocity[2] + n_base[2]
        reading = Reading(
            (now, arm.tolist()),
            (now, [hypot(fx + nx, fy + ny, fz + nz), peak]),
            (now, [physical.width_m + n_width, left, right, slip]),
            (now, [*self._dead_reckon(velocity), *velocity]),
        )
        if not self.faults:
            return reading
        return Reading(*(self._deliver(name, *said, n[32:]) for name, said in reading._asdict().items()))

    def _deliver(self, name: str, stamp_s: float, values: list[float], noise: Floats) -> tuple[float, list[float]]:
        fault = self.faults.get(name)
        if fault is None:
            return stamp_s, values
        stamp_s, broken = fault.distort(stamp_s, np.array(values), noise)
        return stamp_s, broken.tolist()

    def _measure_slip(self, left_n: float, right_n: float, nearest: tuple[str, Vec3] | None) -> float:
        """Watch how far the thing between the pads moves against them since the grip closed.

        Keeps the last value once it is gone.
        """
        if min(left_n, right_n) < PAD_LOADED_N or nearest is None:
            if max(left_n, right_n) < PAD_LOADED_N and self._slip_m == 0.0:
                self._grip = None
            return self._slip_m
        name, at = nearest
        if self._grip is None or self._grip[0] != name:
            self._grip = nearest
        self._slip_m = dist(at, self._grip[1])
        return self._slip_m

    def tare(self, physical: Tick) -> None:
        """Take what hangs on the wrist now as the load (standing still); nothing between the pads means no load."""
        force, acceleration = np.split(np.array(physical.wrist).mean(axis=0)[:6], 2)
        carried = float(force @ acceleration) / float(acceleration @ acceleration) - self._gripper_kg
        self.load_kg = max(carried, 0.0) if min(physical.pad_force_n) > PAD_LOADED_N else 0.0

    def zero_slip(self) -> None:
        """Take the present grip as the one without slip (after the grip has closed or opened)."""
        self._grip, self._slip_m = None, 0.0

    def _dead_reckon(self, velocity: Vec3) -> Vec3:
        (x, y, yaw), scale, dt = self.odometry, self.odometry_scale, CONTROL_PERIOD_S
        vx, vy, wz = velocity[0] * scale, velocity[1] * scale, velocity[2] * scale
        middle = yaw + 0.5 * wz * dt
        c, s = cos(middle), sin(middle)
        self.odometry = (
            x + (c * vx - s * vy + self.odometry_bias[0]) * dt,
            y + (s * vx + c * vy + self.odometry_bias[1]) * dt,
            yaw + (wz + self.odometry_turn_radpm * hypot(vx, vy)) * dt,
        )
        return self.odometry

    # -- absolute fix ----------------------------------------------------------------------------------------

    def fix(self, tick: int, pose: Vec3) -> Fix | None:
        """Take a fix every 50 ms and return the one that arrives in this tick, if one does."""
        if tick % FIX_PERIOD_TICKS == 0:
            n = self._noise.row()
            seen = [true + noise for true, noise in zip(pose, (self._fix_sigma * n[:3]).tolist(), strict=True)]
            stamp, (x, y, yaw) = self._deliver("fix", tick * CONTROL_PERIOD_S, seen, n[3:])
            self._fixes.append((tick + self._quality.fix_delay_ticks, Fix(stamp, x, y, yaw)))
        if self._fixes and self._fixes[0][0] <= tick:
            fix = self._fixes.popleft()[1]
            if fix.stamp_s > self.fix_stamp_s:
                self.fix_stamp_s, self.fix_frame = fix.stamp_s, fix.x_m + fix.y_m + fix.yaw_rad
                return fix
        return None

    @property
    def noisy(self) -> bool:
        """Say whether samples carry noise, so that no two are alike."""
        return self._quality.noise > 0.0

    # -- people ----------------------------------------------------------------------------------------------

    def people(
        self, tick: int, present: Iterable[tuple[int, Point]], eye: Point, walls: Sequence[tuple[Point, ...]]
    ) -> tuple[PersonTrack, ...]:
        """Track people from the robot's mast: 20 Hz, 60 ms late, with dropout, and not through furniture.

        A person who drops out keeps the last sighting, with its old stamp, for a second.
        """
        now = tick * CONTROL_PERIOD_S
        if tick % PEOPLE_PERIOD_TICKS == 0:
            self._sight(tick, now, present, eye, walls)
        if self._sightings and self._sightings[0][0] <= tick:
            _, stamp, frame, seen = self._sightings.popleft()
            if stamp > self.people_stamp_s:
                self.people_stamp_s, self.people_frame = stamp, frame
            self._tracks.update({track.person: track for track in seen})
        if not self._tracks:
            return ()
        self._tracks = {k: track for k, track in self._tracks.items() if now - track.stamp_s < PEOPLE_KEEP_S}
        return tuple(self._tracks.values())

    def _sight(
        self,
        tick: int,
        now: float,
        present: Iterable[tuple[int, Point]],
        eye: Point,
        walls: Sequence[tuple[Point, ...]],
    ) -> None:
        n = self._noise.row()
        ids: list[int] = []
        spots: list[float] = []
        for person, (x, y) in present:
            k = 4 * (person % 8)
            dropped = abs(n[k + 2]) > self._dropped_beyond
            if (
                dropped
                or hypot(x - eye[0], y - eye[1]) > PEOPLE_RANGE_M
                or any(_crosses(eye, (x, y), wall) for wall in walls)
            ):
                continue
            ids.append(person)
            spots += (x + self._people_sigma_m * float(n[k]), y + self._people_sigma_m * float(n[k + 1]))
        # The last number is what the noise of the whole picture adds up to.
        stamp, (*spots, frame) = self._deliver("people", now, [*spots, float(n[3])], n[32:])
        # A broken tracker may repeat a sighting of fewer or more people than are in view now.
        tracks = tuple(
            PersonTrack(person, stamp, x, y) for person, x, y in zip(ids, spots[0::2], spots[1::2], strict=False)
        )
        self._sightings.append((tick + self._quality.people_delay_ticks, stamp, frame, tracks))


def _crosses(start: Point, end: Point, wall: tuple[Point, ...]) -> bool:
    """Tell whether a line of sight crosses the outline of something higher than the mast."""
    return any(_meet(start, end, wall[i - 1], wall[i]) for i in range(len(wall)))


def _meet(a: Point, b: Point, c: Point, d: Point) -> bool:
    def side(p: Point, q: Point, r: Point) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0
