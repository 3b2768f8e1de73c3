"""What the cameras see of loose objects: a wide one on the mast, and one at the wrist that is exact from close by.

The perception takes the truth from the plant and gives away only what a camera could have seen, with noise; the robot
keeps what it saw in `memory`. Poses are measured relative to the base and placed in the world by the robot's own
localisation. Pictures come at 30 Hz and say where objects are; of every third one the robot takes the poses it works
by.
"""

from __future__ import annotations

from math import atan2, hypot
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from app.governance.model import CONTROL_PERIOD_S, Sighting
from app.sim.localisation import to_base, to_world, wrapped
from app.sim.sensors import Noise

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from app.governance.model import Area, Point, Site, Vec3
    from app.sim.plant import Plant

    Floats = NDArray[np.float64]

POSES_PERIOD_TICKS, PICTURES = 10, (0, 4, 7)  # of 30 Hz: the ticks of a period in which one has come
MAST_RANGE_M, MAST_HALF_ANGLE_RAD, MAST_SIGMA_M = 1.6, 1.25, 0.008
WRIST_SPREAD, WRIST_RANGE_M, WRIST_SIGMA_M, WRIST_BIAS_M = 1.0, 0.7, 0.0015, 0.0006
UPRIGHT = 0.9
MIN_HEIGHT_M = 0.2  # what fell to the floor is out of every camera's sight
_CRATE_RANGE_M = 1.8
_AREA_GRID_M = 0.1
_FROZEN = frozenset({"stuck", "delayed"})
_BLEND, _BLEND_S, _BLEND_M = 0.3, 0.5, 0.05


class Glimpse(NamedTuple):
    """An object as one camera frame shows it, relative to the base."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    upright: bool
    sigma_m: float


class Seen(NamedTuple):
    """An object as remembered: world frame, and when it was last seen (cell time)."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    upright: bool
    stamp_s: float


def pictured(tick: int) -> bool:
    """Say whether a new picture has come in this tick."""
    return tick % POSES_PERIOD_TICKS in PICTURES


class Perception:
    """Seeded cameras; holds only its own noise and the robot's memory of the world."""

    def __init__(self, seed: int, site: Site, noise: float = 1.0) -> None:
        """Start knowing nothing but the site's names; `noise` scales the cameras' own errors (0: none)."""
        self._noise_scale = noise
        self.reseed(seed)
        self._unseen: dict[str, list[Point]] = {name: _grid(area) for name, area in site.areas.items()}
        self._points = {name: len(points) for name, points in self._unseen.items()}
        self.fault: tuple[str, float] | None = None  # of the cameras: kind and size
        self._frozen: dict[str, Glimpse] = {}
        self.memory: dict[str, Seen] = {}
        self.inspected: dict[str, float] = {}
        self.crates: list[Point] = []
        self.stamp_s = 0.0
        self.sightings: tuple[Sighting, ...] = ()  # of the newest picture
        self.frame = 0.0  # what the noise of the newest pictures adds up to (`Frames`)

    def reseed(self, seed: int) -> None:
        """Draw noise and bias anew from another seed; what is remembered stays."""
        self._noise, self._grain = Noise((seed, 3)), np.random.default_rng((seed, 5))
        self._extra = np.random.default_rng((seed, 6))  # for pictures that no pose is taken from
        bias = self._noise_scale * WRIST_BIAS_M * np.random.default_rng((seed, 4)).standard_normal(3)
        self._bias: list[float] = bias.tolist()

    def look(self, plant: Plant, tick: int, pose: Vec3) -> None:
        """Look around: say where every object in view of either camera is, and remember them, and crates in the way.

        Between two pictures that poses are taken from nothing is remembered: that one is for whoever watches.
        """
        if self.fault is not None and self.fault[0] == "stale":
            return
        self.stamp_s = tick * CONTROL_PERIOD_S
        if self.fault is None or self.fault[0] not in _FROZEN:
            self.frame = float(self._grain.standard_normal())
        if tick % POSES_PERIOD_TICKS:
            glimpses = {name: self._between(plant, name) for name in plant.objects}
        else:
            glimpses = {name: self.glimpse(plant, name) for name in plant.objects}
            self._remember(plant, glimpses, pose)
        self.sightings = tuple(
            [
                Sighting(name, *to_world(pose, glimpse.x_m, glimpse.y_m))
                for name, glimpse in glimpses.items()
                if glimpse is not None
            ]
        )

    def _remember(self, plant: Plant, glimpses: Mapping[str, Glimpse | None], pose: Vec3) -> None:
        for name, glimpse in glimpses.items():
            if glimpse is not None:
                x, y = to_world(pose, glimpse.x_m, glimpse.y_m)
                now = Seen(x, y, glimpse.z_m, wrapped(glimpse.yaw_rad + pose[2]), glimpse.upright, self.stamp_s)
                self.memory[name] = _blended(self.memory.get(name), now)
        for x, y in plant.crates():
            if hypot(x - pose[0], y - pose[1]) < _CRATE_RANGE_M and (x, y) not in self.crates:
                self.crates.append((x, y))

    def glimpse(self, plant: Plant, name: str) -> Glimpse | None:
        """Return the object relative to the base as the better camera sees it now, or None out of view."""
        return self._shown(name, self._shoot(plant, name, self._noise.row), self._noise.row)

    def _between(self, plant: Plant, name: str) -> Glimpse | None:
        """Return the object as a picture shows it that no pose is taken from."""

        def draw() -> Floats:
            return self._extra.standard_normal(4)

        return self._shown(name, self._shoot(plant, name, draw), draw)

    def _shown(self, name: str, fresh: Glimpse | None, draw: Callable[[], Floats]) -> Glimpse | None:
        """Return what the cameras, broken as they may be, make of what they would show."""
        if fresh is None:
            return None
        if self.fault is None:
            self._frozen[name] = fresh
            return fresh
        kind, size = self.fault
        if kind == "stale":
            return None
        match kind:
            case "offset":
                return fresh._replace(x_m=fresh.x_m + size, y_m=fresh.y_m + size)
            case "noisy":
                n = draw()
                return fresh._replace(x_m=fresh.x_m + size * float(n[0]), y_m=fresh.y_m + size * float(n[1]))
            case _:  # stuck or delayed: the picture from before
                return self._frozen.get(name, fresh)

    def _shoot(self, plant: Plant, name: str, draw: Callable[[], Floats]) -> Glimpse | None:
        true, yaw, upright = plant.true_object(name)
        if true[2] < MIN_HEIGHT_M:
            return None
        base = plant.read_base()
        x, y = to_base(base, true[0], true[1])
        sigma = self._sigma(plant, x, y, true)
        if sigma is None:
            return None
        bx, by, bz = self._bias
        nx, ny, nz, turn = (self._noise_scale * draw()[:4]).tolist()
        return Glimpse(
            x + bx + sigma * nx,
            y + by + sigma * ny,
            true[2] + bz + sigma * nz,
            wrapped(yaw - base[2]) + 3 * sigma * turn,
            upright > UPRIGHT,
            sigma,
        )

    def _sigma(self, plant: Plant, x: float, y: float, true: Vec3) -> float | None:
        tcp = plant.true_tcp()
        above = tcp[2] - true[2]
        aside = hypot(true[0] - tcp[0], true[1] - tcp[1])
        if -0.05 < above < WRIST_RANGE_M and aside < max(0.12, WRIST_SPREAD * above):
            return WRIST_SIGMA_M * max(1.0, above / 0.3)
        if hypot(x, y) < MAST_RANGE_M and abs(atan2(y, x)) < MAST_HALF_ANGLE_RAD:
            return MAST_SIGMA_M
        return None

    def sweep(self, area: str, tick: int, pose: Vec3, tcp_m: Vec3, surface_z_m: float) -> float:
        """Take off what the cameras see of an area and return the share seen so far.

        All of it seen makes it inspected.
        """
        left: list[Point] = []
        for point in self._unseen[area]:
            x, y = to_base(pose, *point)
            below_wrist = hypot(x - tcp_m[0], y - tcp_m[1]) < WRIST_SPREAD * (tcp_m[2] - surface_z_m)
            from_mast = hypot(x, y) < MAST_RANGE_M and abs(atan2(y, x)) < MAST_HALF_ANGLE_RAD
            if not (below_wrist or from_mast):
                left.append(point)
        self._unseen[area] = left
        if not left:
            self.inspected[area] = tick * CONTROL_PERIOD_S
        return 1.0 - len(left) / self._points[area]

    def forget_area(self, area: Area) -> None:
        """Start an inspection afresh."""
        self._unseen[area.name] = _grid(area)
        self.inspected.pop(area.name, None)


def _blended(before: Seen | None, now: Seen) -> Seen:
    """Average what stays where it was; take at once what moved, turned over, or was long out of sight."""
    if before is None or now.stamp_s - before.stamp_s > _BLEND_S or now.upright != before.upright:
        return now
    if max(abs(now.x_m - before.x_m), abs(now.y_m - before.y_m), abs(now.z_m - before.z_m)) > _BLEND_M:
        return now
    x, y, z = (a + _BLEND * (b - a) for a, b in zip(before[:3], now[:3], strict=True))
    return Seen(
        x, y, z, wrapped(before.yaw_rad + _BLEND * wrapped(now.yaw_rad - before.yaw_rad)), now.upright, now.stamp_s
    )


def _grid(area: Area) -> list[Point]:
    xs, ys = [p[0] for p in area.polygon], [p[1] for p in area.polygon]
    return [
        (float(x), float(y))
        for x in np.arange(min(xs), max(xs) + 1e-6, _AREA_GRID_M)
        for y in np.arange(min(ys), max(ys) + 1e-6, _AREA_GRID_M)
    ]
