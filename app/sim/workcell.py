"""The simulated workcell: the MuJoCo substrate behind the same protocol a real robot would have.

One tick: command → drives and physics (5 × 2 ms) → people and faults take their turn → sensors → localisation and
perception → `Observation`. Everything random hangs on the seed, so a run is the same for the same seed and the same
commands. `snapshot` carries physics, drives, sensors, delay lines, generators, localisation, memory, people and
faults; it does not carry a skill in flight (a generator cannot be copied): bind anew after `restore`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from math import hypot, isfinite
from typing import TYPE_CHECKING

import numpy as np

from app.cell.substrate import SubstrateError
from app.governance.model import CONTROL_PERIOD_S, Command, Frames, ObjectFact, Observation, SensorStamps, WorldFacts
from app.governance.recovery import RETRACE
from app.sim import robot
from app.sim.display import copy_poses, describe, moving_bodies
from app.sim.faults import FaultClock, Scenario, Victim
from app.sim.hand import MARK_MAX, WIDER_M, Mark
from app.sim.kinematics import ArmSolver, Residual, SelfModel, speed_of
from app.sim.localisation import Localiser, to_base
from app.sim.occasions import Occasions
from app.sim.people import People
from app.sim.perception import Perception, pictured
from app.sim.plant import PAD_LOADED_N, Plant
from app.sim.sensors import AS_MEASURED, Quality, Sensors
from app.sim.skills import RECOVERIES, SKILLS, Run, start
from app.sim.skills_arm import within_reach
from app.sim.skills_jog import CAPABILITY as TAKEOVER
from app.sim.skills_jog import Jog
from app.sim.truth import Glance, Truth, glance_of, truth_of

if TYPE_CHECKING:
    from pathlib import Path

    from app.governance.model import Json, Point, Site, Vec3
    from app.governance.permit import Grant
    from app.sim.faults import Fault
    from app.sim.hand import Hand
    from app.sim.people import Walk
    from app.sim.perception import Glimpse
    from app.sim.plant import Tick

_WARM_UP_TICKS = 40
_NO_HABITS: AbstractSet[str] = frozenset()
_MARK_TICKS, _MARK_RAD = 5, 0.004
_DOZE_TICKS = 5
_AT_REST_TICKS = 100  # without anything commanded to move
_FRESH_S, _VISIBLE_S, _RETRACTED_RAD, _READY_RAD, _READY_RADPS = 0.5, 1.0, 0.08, 0.05, 0.05
_LEVER_STATE_RAD, _BUTTON_PRESSED_M, _BUTTON_LATCH_S = 0.33, 0.012, 60.0
_TALL_TOOL_M = 0.1


@dataclass(slots=True)
class State:
    """Everything of a workcell that changes and is not in the plant; plain data, copied whole by `snapshot`."""

    sensors: Sensors
    localiser: Localiser
    perception: Perception
    residual: Residual
    people: People
    clock: FaultClock
    occasions: Occasions
    held: Command
    tick: int = 0
    still_ticks: int = 0
    hand: Hand | None = None
    trail: list[Mark] = field(default_factory=list[Mark])
    went_back: bool = False  # along the trail, since its last mark
    invocation: str = ""
    pressed_s: dict[str, float] = field(default_factory=dict[str, float])
    observation: Observation | None = None
    framed_s: tuple[float, ...] = ()
    frames: Frames | None = None
    habits: set[str] = field(default_factory=set[str])


class Workcell:
    """A simulated cell; implements `Substrate` and, for its skills, `Senses`."""

    def __init__(
        self,
        site: Site,
        *,
        cell_id: str = "workcell-1",
        seed: int = 0,
        faults: Sequence[Fault] = (),
        people: Sequence[Walk] = (),
        robot_mjcf: Path | None = None,
        quality: Quality = AS_MEASURED,
        room_for: int = 0,
    ) -> None:
        """Build the cell with the robot parked at the site's start.

        Args:
            site: names and geometry.
            cell_id: identity that authorizations are bound to.
            seed: everything random hangs on it.
            faults: what goes wrong, and when.
            people: who walks where, and when.
            robot_mjcf: another robot's model instead of the project's own.
            quality: how good the sensors are.
            room_for: how many people the world keeps figures for, at least.
        """
        self.id, self.period_s, self.site, self.seed = cell_id, CONTROL_PERIOD_S, site, seed
        self.plant = Plant(site, people=max(len(people), room_for), robot_mjcf=robot_mjcf)
        self.solver = ArmSolver(robot_mjcf)
        self._self_model = SelfModel(robot_mjcf)
        start_at = site.targets[site.start]
        at = (start_at.x_m, start_at.y_m, start_at.yaw_rad)
        self._walls = _tall(site)
        self._shown = moving_bodies(self.plant.model)
        self._grant: Grant | None = None
        self._run: Run | Jog | None = None
        self._recovers = False
        held = Command(robot.HOME_RAD, (0.0,) * 6, (0.0, 0.0, 0.0), 0.0)  # type: ignore[arg-type]  # six of them
        self._state = State(
            sensors=Sensors(seed, at, self.plant.gripper_kg, quality),
            localiser=Localiser(at),
            perception=Perception(seed, site, quality.noise),
            residual=Residual(),
            people=People(people),
            clock=FaultClock(tuple(faults)),
            occasions=Occasions(),
            held=held,
        )
        for _ in range(_WARM_UP_TICKS):
            self.step(held)

    # -- Substrate -------------------------------------------------------------------------------------------

    def bind(self, grant: Grant, capability: str, params: Mapping[str, Json], *, careful: bool = False) -> Run | Jog:
        """Unlock the actuators for a grant and prepare a skill (see `Substrate.bind`)."""
        permit = grant.authorization
        if permit.cell != self.id:
            raise SubstrateError("wrong_cell", f"the grant is for `{permit.cell}`, this is `{self.id}`")
        if not grant.covers(capability, params):
            raise SubstrateError("not_covered", f"the grant does not cover `{capability}` with {dict(params)}")
        if capability not in SKILLS and capability != TAKEOVER:
            raise SubstrateError("unknown_capability", f"`{capability}`: valid are {', '.join(sorted(SKILLS))}")
        if not self.plant.drives.powered:
            raise SubstrateError("power_off", "power is off: reset first")
        if self._grant is not None and self._grant.authorization.id != permit.id:
            raise SubstrateError("busy", "another grant is bound")
        state = self._state
        if permit.invocation != state.invocation and capability not in RECOVERIES:
            state.invocation, state.trail, state.went_back = permit.invocation, [self._mark(driving=False)], False
            state.pressed_s.pop(str(params.get("tool")), None)  # what its switch remembers another session did
        self._mark_return()
        self._recovers = capability in RECOVERIES
        try:
            run = start(capability, params, self, self.observe(), state.held, careful=careful)
        except KeyError as error:
            raise SubstrateError("unknown_name", f"{error} is no name of this site") from error
        state.occasions.begin(capability)
        self._grant, self._run = grant, run
        return run

    def unbind(self) -> None:
        """Lock the actuators."""
        self._grant = self._run = None

    def hold(self) -> Command:
        """Return the command that keeps everything where it is, with the present grip."""
        return self._state.held

    def step(self, command: Command) -> Observation:
        """Apply a command for one control period and return what the sensors saw.

        Without a bound grant it holds instead.
        """
        state, plant = self._state, self.plant
        if self._grant is None or not plant.drives.powered or not _finite(command):
            command = state.held
        state.tick += 1
        now = state.tick * CONTROL_PERIOD_S
        if self._run is not None:
            state.occasions.note(self._run.capability, self._run.report().phase, now)
        state.people.move(now, state.occasions, plant)
        state.clock.advance(now, state.occasions, Victim(plant, state.sensors, state.perception, state.habits))
        if state.tick % _DOZE_TICKS == 0:
            plant.doze()
        still = _still(command)
        state.still_ticks = state.still_ticks + 1 if command == still else 0
        plant.let_rest(state.still_ticks >= _AT_REST_TICKS)
        physical = plant.step(command)
        state.held = still
        state.observation = self._sense(physical, now)
        self._remember(command)
        return state.observation

    def observe(self) -> Observation:
        """Return the newest observation."""
        observation = self._state.observation
        if observation is None:
            raise SubstrateError("not_started", "nothing has been observed yet")
        return observation

    def stop(self, category: int) -> None:
        """Stop by IEC 60204-1 category: 0 and 1 take power away (brakes), 2 keeps it."""
        if category not in (0, 1, 2):
            raise ValueError(f"stop category `{category}`: valid are 0, 1, 2")
        self._state.held = self._state.held._replace(joint_speed_radps=(0.0,) * 6, base_velocity=(0.0, 0.0, 0.0))  # type: ignore[arg-type]
        if category < 2:  # category 2 keeps power
            self.plant.cut_power()
            self._state.held = self._state.held._replace(grip_force_n=max(self.plant.drives.grip_force_n, 0.0))

    @property
    def powered(self) -> bool:
        """Return whether the drives have power."""
        return self.plant.drives.powered

    def reset(self) -> None:
        """Give power back with everything held where it is now."""
        self.plant.give_power()
        self._state.held = self._state.held._replace(joint_rad=self.plant.drives.joint_rad)

    def facts(self) -> WorldFacts:
        """Return what the sensors say about the world."""
        state, seen = self._state, self.observe()
        joints = np.array(seen.joint_rad)
        still = float(np.abs(seen.joint_speed_radps).max()) < _READY_RADPS
        in_place = float(np.abs(joints - state.held.joint_rad).max()) < _READY_RAD
        x, y, _ = pose = state.localiser.pose
        tracks = [hypot(track.x_m - x, track.y_m - y) for track in seen.people]
        return WorldFacts(
            stamp_s=seen.time_s,
            arm_ready=still and (in_place or not self.plant.drives.powered),  # power comes back holding what is there
            arm_retracted=float(np.abs(joints - robot.HOME_RAD).max()) < _RETRACTED_RAD,
            gripper_empty=not seen.pads_loaded,
            holding=state.hand.name if state.hand and seen.pads_loaded else None,
            base=pose,
            objects={name: self._fact(name, seen.time_s, pose) for name in state.perception.memory},
            tools={name: self.tool_state(name) for name in self.site.tools},
            inspected=dict(state.perception.inspected),
            people_count=len(tracks),
            people_nearest_m=min(tracks, default=99.0),
            sensors_fresh=seen.time_s - min(seen.stamps_s) < _FRESH_S,
        )

    def scene(self) -> Mapping[str, Json]:
        """Return the static scene for displays."""
        return describe(self.plant.model, self.site)

    def poses(self) -> Callable[[], bytes]:
        """Copy the body poses for displays; what is returned packs them."""
        return copy_poses(self.plant.data, self._shown)

    def way(self) -> tuple[Point, ...]:
        """Return the way the base is planned to go, for displays."""
        return () if self._run is None else self._run.way

    def snapshot(self) -> object:
        """Return everything but a skill in flight."""
        return self.plant.snapshot(), copy.deepcopy(self._state), self._grant

    def restore(self, state: object) -> None:
        """Bring back a snapshot; a skill that was in flight has to be bound anew."""
        physics, own, self._grant = state  # type: ignore[misc]  # opaque outside this class
        self.plant.restore(physics)
        self._state, self._run, self._recovers = copy.deepcopy(own), None, False

    def begin(self, seed: int, scenario: Scenario) -> None:
        """Begin another run from the present state: randomness, faults and people anew, the world as it is.

        Args:
            seed: everything random hangs on it from now on.
            scenario: faults and people; the times of its triggers count from the cell's own start.

        Raises:
            ValueError: more people than the world was built with.
        """
        if len(scenario.people) > self.plant.people:
            raise ValueError(f"`{len(scenario.people)}` people in a world built for {self.plant.people}")
        state = self._state
        self.seed = seed
        state.sensors.reseed(seed)
        state.perception.reseed(seed)
        state.people, state.clock, state.occasions = People(scenario.people), FaultClock(scenario.faults), Occasions()
        state.habits.clear()

    # -- Senses: what skills may ask -------------------------------------------------------------------------

    @property
    def perception(self) -> Perception:
        """The robot's cameras and memory of the world."""
        return self._state.perception

    @property
    def hand(self) -> Hand | None:
        """What the robot believes to hold."""
        return self._state.hand

    @hand.setter
    def hand(self, value: Hand | None) -> None:
        self._state.hand = value

    @property
    def trail(self) -> list[Mark]:
        """The recorded safe path of the present invocation."""
        return self._state.trail

    @property
    def habits(self) -> AbstractSet[str]:
        """The bad habits that faults have given the skills: those of tasks, which recovery does not share."""
        return _NO_HABITS if self._recovers else self._state.habits

    def believed_pose(self) -> Vec3:
        """Return where the robot believes its base is."""
        state = self._state
        if "dead_reckoning" in self.habits:
            x, y, yaw = self.observe().odometry
            return x, y, yaw
        return state.localiser.pose

    def glimpse(self, name: str) -> Glimpse | None:
        """Return an object as the cameras see it now."""
        return self._state.perception.glimpse(self.plant, name)

    def sweep(self, area: str, surface_z_m: float) -> float:
        """Look at an area and return the share of it seen so far."""
        state = self._state
        return state.perception.sweep(area, state.tick, state.localiser.pose, self.observe().tcp_m, surface_z_m)

    def tool_state(self, name: str) -> str:
        """Return a tool's state as its own switch says."""
        position = self.plant.tool_angle(name)
        if self.site.tools[name].kind == "lever":
            return "up" if position > _LEVER_STATE_RAD else "down" if position < -_LEVER_STATE_RAD else "between"
        pressed = self._state.pressed_s.get(name)
        recent = pressed is not None and self._state.tick * CONTROL_PERIOD_S - pressed < _BUTTON_LATCH_S
        return "pressed" if recent else "released"

    def tare(self) -> None:
        """Take what the wrist carries now as the load, and what the arm bears now as unexplained no more."""
        state = self._state
        state.sensors.tare(self.plant.read())
        state.residual.zero()

    def zero_slip(self) -> None:
        """Take the present grip as the one without slip."""
        self._state.sensors.zero_slip()

    # -- evaluation ------------------------------------------------------------------------------------------

    def truth(self) -> Truth:
        """Return what truly is (evaluation and tests; no skill and no watcher sees it)."""
        state = self._state
        switches = {name: self.tool_state(name) for name in self.site.tools}
        time_s = state.tick * CONTROL_PERIOD_S
        return truth_of(self.plant, self._self_model, self.site, state.people.present, switches, time_s)

    def glance(self) -> Glance:
        """Return what truly is as far as limits speak of it, without the cost of the whole truth."""
        return glance_of(self.plant, self._self_model, self._state.hand, self._state.people.present)

    # -- inside ----------------------------------------------------------------------------------------------

    def _sense(self, physical: Tick, now: float) -> Observation:
        state, sensors = self._state, self._state.sensors
        reading = sensors.read(
            state.tick, physical, self.plant.between_pads() if max(physical.pad_force_n) > 0.1 else None
        )
        fix = sensors.fix(state.tick, physical.base_pose)
        people = sensors.people(state.tick, state.people.present.items(), physical.base_pose[:2], self._walls)
        arm, odometry, gripper = reading.arm[1], tuple(reading.odometry[1]), reading.gripper[1]
        joint, speed, velocity = tuple(arm[0:6]), tuple(arm[6:12]), [*odometry[3:6], *arm[6:12]]
        expected = self._self_model.update(joint, velocity, state.residual.accelerations(velocity))
        tcp, jacobian = self._self_model.tcp()
        state.localiser.update(now, odometry[0:3], fix)
        if pictured(state.tick):
            state.perception.look(self.plant, state.tick, state.localiser.pose)
        stamps_s = SensorStamps(
            reading.arm[0],
            reading.wrist[0],
            reading.gripper[0],
            reading.odometry[0],
            sensors.fix_stamp_s,
            sensors.people_stamp_s,
            state.perception.stamp_s,
        )
        if sensors.noisy and stamps_s[4:] != state.framed_s:
            state.framed_s = stamps_s[4:]
            state.frames = Frames(sensors.fix_frame, sensors.people_frame, state.perception.frame)
        return Observation(
            tick=state.tick,
            time_s=now,
            joint_rad=joint,
            joint_speed_radps=speed,
            joint_torque_nm=tuple(arm[12:18]),
            residual_nm=state.residual.update(expected, arm[12:18]),
            tcp_m=tuple(tcp),
            tcp_speed_mps=speed_of(jacobian, speed),
            jacobian=(*jacobian[0], *jacobian[1], *jacobian[2]),
            contact_force_n=reading.wrist[1][0],
            peak_force_n=reading.wrist[1][1],
            grip_width_m=gripper[0],
            grip_force_n=0.5 * (gripper[1] + gripper[2]),
            slip_m=gripper[3],
            pads_loaded=gripper[1] > PAD_LOADED_N and gripper[2] > PAD_LOADED_N,
            odometry=odometry[0:3],
            base_velocity=odometry[3:6],
            fix=fix,
            people=people,
            stamps_s=stamps_s,
            frames=state.frames,
            sightings=state.perception.sightings,
        )

    def _remember(self, command: Command) -> None:
        """Latch tools, and extend the safe path while a primary skill moves, or a recovery does."""
        state = self._state
        for name, tool in self.site.tools.items():
            if tool.kind == "button" and self.plant.tool_angle(name) > _BUTTON_PRESSED_M:
                state.pressed_s[name] = state.tick * CONTROL_PERIOD_S
        if self._run is None or state.tick % _MARK_TICKS or len(state.trail) >= MARK_MAX:
            return
        driving, capability = command.base_velocity != (0.0, 0.0, 0.0), self._run.capability
        state.went_back = state.went_back or capability == RETRACE
        if capability in RECOVERIES:
            if capability != RETRACE and state.trail and (driving or not state.trail[-1].recovering):
                state.trail.append(self._mark(driving=driving)._replace(recovering=True))
            return
        mark, last = self._mark(driving=driving), state.trail[-1]
        moved = float(np.abs(mark.joints - last.joints).max()) > _MARK_RAD
        moved = moved or abs(mark.width_m - last.width_m) > WIDER_M
        if moved or mark.driving or mark.driving != last.driving or mark.holding != last.holding:
            state.trail.append(mark)

    def _mark_return(self) -> None:
        """Have the safe path go on from where a way back along it was left."""
        if self._state.went_back:
            self._state.trail.append(self._mark(driving=False)._replace(leaps=True))
            self._state.went_back = False

    def _mark(self, *, driving: bool) -> Mark:
        state = self._state
        seen = self.observe()
        joints, width_m = np.array(state.held.joint_rad), seen.grip_width_m
        return Mark(joints, state.localiser.pose, driving, seen.pads_loaded, width_m=width_m)

    def _fact(self, name: str, now: float, pose: Vec3) -> ObjectFact:
        seen = self._state.perception.memory[name]
        reachable = within_reach(*to_base(pose, seen.x_m, seen.y_m))
        return ObjectFact(
            visible=now - seen.stamp_s < _VISIBLE_S,
            reachable=reachable,
            x_m=seen.x_m,
            y_m=seen.y_m,
            z_m=seen.z_m,
            stamp_s=seen.stamp_s,
            upright=seen.upright,
        )


def make_workcell(
    site: Site,
    *,
    cell_id: str,
    seed: int = 0,
    scenario: Scenario | None = None,
    robot_mjcf: Path | None = None,
    quality: Quality = AS_MEASURED,
    people: int = 0,
) -> Workcell:
    """Build a simulated cell as the `cell` process wires it.

    Args:
        site: names and geometry.
        cell_id: identity that authorizations are bound to.
        seed: everything random hangs on it.
        scenario: faults and people to add (`Scenario.read` makes one from plain data).
        robot_mjcf: another robot's model.
        quality: how good the sensors are; `Quality(noise=0.0)` for noise-free ones.
        people: room for at least so many people, for scenarios that begin later (`Workcell.begin`).

    Raises:
        ValueError: the other robot lacks parts that the workcell drives or senses.
    """
    extra = scenario or Scenario()
    return Workcell(
        site,
        cell_id=cell_id,
        seed=seed,
        faults=extra.faults,
        people=extra.people,
        robot_mjcf=robot_mjcf,
        quality=quality,
        room_for=people,
    )


def _still(command: Command) -> Command:
    return Command(command.joint_rad, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), max(command.grip_force_n, 0.0))


def _finite(command: Command) -> bool:
    return isfinite(
        sum(command.joint_rad) + sum(command.joint_speed_radps) + sum(command.base_velocity) + command.grip_force_n
    )


def _tall(site: Site) -> list[tuple[Point, ...]]:
    """Return outlines that people cannot be seen through: the tool station's posts; benches are lower than the mast."""
    half = _TALL_TOOL_M
    return [
        (
            (t.x_m - half, t.y_m - half),
            (t.x_m + half, t.y_m - half),
            (t.x_m + half, t.y_m + half),
            (t.x_m - half, t.y_m + half),
        )
        for t in site.tools.values()
    ]
