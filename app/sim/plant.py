"""The physics below the sensors.

Actuators with their servos and brakes, five substeps per control tick, and what truly happened.

Nothing above this file touches `MjData`. Truth leaves it through `Tick` (what the sensors are made from) and the
`true_*` queries (evaluation, perception); skills see neither.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from math import atan2, cos, hypot, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from app.sim import robot
from app.sim.world import (
    CRATE_HALF_M,
    CRATES,
    HIP_M,
    LEVER_SWING_RAD,
    PERSON_PARTS,
    PHYSICS_STEP_S,
    SUBSTEPS,
    UNDER_FLOOR_M,
    build_world,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from app.governance.model import Command, Site, Vec3, Vec6

    Floats = NDArray[np.float64]

PAD_LOADED_N = 1.0
_BRAKE_ARM_NM, _BRAKE_BASE_N = 400.0, 3000.0
_REST_ITERATIONS = 2
_BASE_HOLD_PER_S, _BASE_HOLD_MAX, _STANDING_MPS = 5.0, 0.05, 0.01
_FINGERS_STAND_MPS = 0.005  # the softest grip closes ten times as fast
_SCALING_LEAK_S = 1.5
_WAKE_M, _RESTING_MPS = (
    0.25,
    1e-3,
)  # around the tool; checked every few ticks, between which the tool moves some centimetres
_AVERAGE = np.full(SUBSTEPS, 1.0 / SUBSTEPS)
_LYING = 0.7
_BETWEEN_PADS_M = (0.05, 0.06, 0.14)  # half sizes of the room between the pads, tool frame
_PADS_REACH_M = hypot(*_BETWEEN_PADS_M)
# Model fields that faults and brakes edit; a snapshot carries them beside the integration state.
_EDITED = (
    "dof_frictionloss",
    "actuator_gainprm",
    "actuator_biasprm",
    "jnt_actfrcrange",
    "body_gravcomp",
    "geom_friction",
    "geom_priority",
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_invweight0",
    "actuator_acc0",
    "geom_contype",
    "geom_conaffinity",
    "body_contype",
    "body_conaffinity",
    "tree_sleep_policy",
)


@dataclass(slots=True)
class Drives:
    """What the low-level drives remember between ticks, and the faults in them and in what they carry."""

    joint_rad: Vec6
    grip_force_n: float = 0.0
    powered: bool = True
    base_hold: tuple[float, ...] | None = None
    scaling_offset_rad: Floats = field(default_factory=lambda: np.zeros(6))
    grip_gain: float = 1.0
    speed_gain: float = 1.0
    strength: float = 1.0
    beside_m: dict[str, float] = field(default_factory=dict)


class Tick(NamedTuple):
    """What physically happened in one control tick; noise-free.

    `wrist` has one row per substep: force (3) and acceleration (3) in the wrist frame, then what each pad bears;
    `pad_force_n` is the mean of each pad; `base_velocity` is in the base frame. The joints' arrays are windows on the
    present: copy what has to last.
    """

    joint_rad: Floats
    joint_speed: Floats
    joint_torque: Floats
    wrist: list[list[float]]
    pad_force_n: tuple[float, float]
    width_m: float
    base_pose: Vec3
    base_velocity: Vec3


class Plant:
    """The simulated world and the robot's drives."""

    def __init__(self, site: Site, *, people: int, robot_mjcf: Path | None = None) -> None:
        """Build the world with the robot at the site's start, arm drawn in and gripper open."""
        self.model = build_world(site, people=people, robot_mjcf=robot_mjcf)
        self.data = mujoco.MjData(self.model)
        self.people = people
        self.objects = tuple(site.objects)
        self._look_up(site)
        start = site.targets[site.start]
        self.drives = Drives(joint_rad=robot.HOME_RAD)
        self._qpos[self._base_q] = (start.x_m, start.y_m, start.yaw_rad)
        self._qpos[self._arm_q] = robot.HOME_RAD
        self._qpos[self._finger_q] = robot.FINGER_STROKE_M
        for tool in site.tools.values():
            if tool.kind == "lever":
                self._qpos[self._tool_q[tool.name]] = LEVER_SWING_RAD
        self._force = np.zeros((2 * SUBSTEPS, self.model.nsensordata))  # this tick's rows after the last one's
        self._torque = np.zeros((SUBSTEPS, 6))
        self._rows = tuple(zip(self._force[SUBSTEPS:], self._torque, strict=True))
        self._asleep: set[str] = set()
        mujoco.mj_forward(self.model, self.data)

    def _look_up(self, site: Site) -> None:
        model = self.model
        # Views once, not per tick: every access to a field of `MjData` makes a new array object.
        data = self.data
        self._qpos, self._qvel, self._ctrl, self._sensed = data.qpos, data.qvel, data.ctrl, data.sensordata
        self._base_q = _run_of([model.joint(n).qposadr[0] for n in robot.BASE_JOINTS])
        self._arm_q = _run_of([model.joint(n).qposadr[0] for n in robot.ARM_JOINTS])
        self._finger_q = _run_of([model.joint(n).qposadr[0] for n in robot.FINGER_JOINTS])
        self._base_v = _run_of([model.joint(n).dofadr[0] for n in robot.BASE_JOINTS])
        self._arm_v = _run_of([model.joint(n).dofadr[0] for n in robot.ARM_JOINTS])
        self._arm_j = _run_of([model.joint(n).id for n in robot.ARM_JOINTS])
        self._arm_u = _run_of([model.actuator(n).id for n in robot.ARM_JOINTS])
        self._base_u = _run_of([model.actuator(n).id for n in robot.BASE_JOINTS])
        self._base_at, self._base_speed = self._qpos[self._base_q], self._qvel[self._base_v]
        self._arm_at, self._arm_speed = self._qpos[self._arm_q], self._qvel[self._arm_v]
        self._arm_pushed, self._fingers_at = data.qfrc_actuator[self._arm_v], self._qpos[self._finger_q]
        self._fingers_speed = self._qvel[_run_of([model.joint(n).dofadr[0] for n in robot.FINGER_JOINTS])]
        self._arm_ctrl, self._base_ctrl = self._ctrl[self._arm_u], self._ctrl[self._base_u]
        damping, stiffness = model.actuator_biasprm[self._arm_u, 2], model.actuator_gainprm[self._arm_u, 0]
        self._feed_forward_s = tuple((-damping / stiffness).tolist())
        self._grip_u = int(model.actuator(robot.GRIP_ACTUATOR).id)
        self._object_body = {n: int(model.body(n).id) for n in site.objects}
        self._object_q = {n: int(model.joint(n).qposadr[0]) for n in site.objects}
        self._object_v = {n: int(model.joint(n).dofadr[0]) for n in site.objects}
        self._object_geom = {n: int(model.geom(n).id) for n in site.objects}
        self._pads = tuple(int(model.geom(n).id) for n in robot.PAD_GEOMS)
        self._tool_q = {n: int(model.joint(n).qposadr[0]) for n in site.tools}
        tcp = int(model.site(robot.TCP_SITE).id)
        self._tcp_at, self._tcp_turn = data.site_xpos[tcp], data.site_xmat[tcp]
        self._object_at = {n: data.xpos[body] for n, body in self._object_body.items()}
        self._object_turn = {n: data.xmat[body] for n, body in self._object_body.items()}
        self._crates_felt = _run_of([int(model.sensor(name).adr[0]) for name in CRATES])
        self._gripper_kg = float(model.body_subtreemass[model.body(robot.GRIPPER).id])
        # Nothing falls asleep by itself: what dozes is decided here, and in the same way after a restore.
        model.tree_sleep_policy[:] = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
        self._powered = {name: getattr(model, name).copy() for name in _EDITED}

    # -- moving ----------------------------------------------------------------------------------------------

    def step(self, command: Command) -> Tick:
        """Apply a command for one control period."""
        drives = self.drives
        if drives.powered:
            self._drive_arm(command)
            self._drive_base(command)
        self._drive_grip(command.grip_force_n)
        if drives.beside_m:
            self._weigh_beside()
        self._force[:SUBSTEPS] = self._force[SUBSTEPS:]
        model, data, sensed, pushed, mj_step = self.model, self.data, self._sensed, self._arm_pushed, mujoco.mj_step
        for force, torque in self._rows:
            mj_step(model, data)
            force[:] = sensed
            torque[:] = pushed
        # Poses of now, not of the last substep's beginning: the same that a restored state has.
        mujoco.mj_kinematics(model, data)
        return self.read()

    def _drive_arm(self, command: Command) -> None:
        drives, wanted = self.drives, command.joint_rad
        # What is ahead leaks away when it is over, too.
        if drives.speed_gain != 1.0 or any(drives.scaling_offset_rad.tolist()):
            leak = _SCALING_LEAK_S if max(map(abs, command.joint_speed_radps)) > 1e-3 else 0.3
            drives.scaling_offset_rad *= 1.0 - PHYSICS_STEP_S * SUBSTEPS / leak
            drives.scaling_offset_rad += (drives.speed_gain - 1.0) * np.subtract(wanted, drives.joint_rad)
        drives.joint_rad, gain = wanted, drives.speed_gain
        self._arm_ctrl[:] = [
            q + offset + lead * (v * gain)
            for q, offset, lead, v in zip(
                wanted, drives.scaling_offset_rad.tolist(), self._feed_forward_s, command.joint_speed_radps, strict=True
            )
        ]

    def _drive_base(self, command: Command) -> None:
        drives = self.drives
        vx, vy, wz = command.base_velocity
        if vx == 0.0 and vy == 0.0 and wz == 0.0:
            self._base_ctrl[:] = self._stand_still()
            return
        drives.base_hold = None
        yaw, gain = float(self._base_at[2]), drives.speed_gain
        c, s = cos(yaw), sin(yaw)
        self._base_ctrl[:] = (gain * (c * vx - s * vy), gain * (s * vx + c * vy), gain * wz)

    def _stand_still(self) -> tuple[float, ...]:
        """Standing still is a position loop of the wheel drives: a push does not move the base away for good."""
        drives, at = self.drives, self._base_at.tolist()
        if drives.base_hold is None and max(map(abs, self._base_speed.tolist())) < _STANDING_MPS:
            drives.base_hold = tuple(at)
        if drives.base_hold is None:
            return (0.0, 0.0, 0.0)
        return tuple(
            max(-_BASE_HOLD_MAX, min(_BASE_HOLD_MAX, _BASE_HOLD_PER_S * (a - b)))
            for a, b in zip(drives.base_hold, at, strict=True)
        )

    def _drive_grip(self, force_n: float) -> None:
        self.drives.grip_force_n = force_n
        self._ctrl[self._grip_u] = force_n * (self.drives.grip_gain if force_n > 0 else 1.0)

    def read(self) -> Tick:
        """Return what the last tick physically was."""
        _, _, yaw = pose = self.read_base()
        vx, vy, wz = self._base_speed.tolist()
        c, s = cos(yaw), sin(yaw)
        left, right = self._fingers_at.tolist()
        wrist = self._force[SUBSTEPS:].tolist()
        return Tick(
            joint_rad=self._arm_at,
            joint_speed=self._arm_speed,
            joint_torque=_AVERAGE.dot(self._torque),
            wrist=wrist,
            pad_force_n=(sum([row[6] for row in wrist]) / SUBSTEPS, sum([row[7] for row in wrist]) / SUBSTEPS),
            width_m=left + right,
            base_pose=pose,
            base_velocity=(c * vx + s * vy, c * vy - s * vx, wz),
        )

    def let_rest(self, at_rest: bool) -> None:
        """Keep what rests in the gripper where it is, or solve contacts without that.

        MuJoCo's friction gives way by some millimetres a minute under a weight that a real grip bears for good.
        """
        self.model.opt.noslip_iterations = _REST_ITERATIONS if at_rest else 0

    def cut_power(self) -> None:
        """Take power from arm and base: the brakes fall in. The gripper locks itself and keeps its grip, if it has one.

        Fingers that are on their way, with nothing between them, stay where they are.
        """
        if not self.drives.powered:
            return
        self.drives.powered = False
        pads_n = self._force[-1, 6:8].tolist()
        if min(pads_n) < PAD_LOADED_N and max(map(abs, self._fingers_speed.tolist())) > _FINGERS_STAND_MPS:
            self.drives.grip_force_n = 0.0
        model = self.model
        for actuators in (self._arm_u, self._base_u):
            model.actuator_gainprm[actuators, 0] = 0.0
            model.actuator_biasprm[actuators, 0:3] = 0.0
        model.dof_frictionloss[self._arm_v] = _BRAKE_ARM_NM
        model.dof_frictionloss[self._base_v] = _BRAKE_BASE_N

    def give_power(self) -> None:
        """Release the brakes with the servos holding where everything stands now."""
        if self.drives.powered:
            return
        model, drives = self.model, self.drives
        for name in ("actuator_gainprm", "actuator_biasprm"):
            for actuators in (self._arm_u, self._base_u):
                getattr(model, name)[actuators] = self._powered[name][actuators]
        drives.powered, drives.base_hold = True, self.read_base()
        self.weaken(drives.strength)
        model.dof_frictionloss[self._arm_v] = 0.0
        model.dof_frictionloss[self._base_v] = 0.0
        drives.joint_rad = tuple(self._arm_at.tolist())
        drives.scaling_offset_rad = np.zeros(6)
        self._arm_ctrl[:] = drives.joint_rad
        self._base_ctrl[:] = 0.0

    # -- changing the world (faults, people) -----------------------------------------------------------------

    def weaken(self, strength: float) -> None:
        """Let the arm's servos have only this share of their stiffness and torque (actuator fade)."""
        self.drives.strength = strength
        if not self.drives.powered:
            return  # servos without power have none to lose or win back; `give_power` gives them this share
        model = self.model
        model.actuator_gainprm[self._arm_u, 0] = self._powered["actuator_gainprm"][self._arm_u, 0] * strength
        model.actuator_biasprm[self._arm_u, 1:3] = self._powered["actuator_biasprm"][self._arm_u, 1:3] * strength
        # Gravity is borne by the same motors: one that has faded enough lets the arm sink.
        model.jnt_actfrcrange[self._arm_j] = self._powered["jnt_actfrcrange"][self._arm_j] * strength

    def set_pad_friction(self, friction: float) -> None:
        """Set the sliding friction between pads and whatever they hold."""
        self.model.geom_friction[list(self._pads), 0] = friction

    def make_slippery(self, name: str, friction: float) -> None:
        """Give one object a surface that slides in the pads."""
        geom = self._object_geom[name]
        self.model.geom_priority[geom] = 2
        self.model.geom_friction[geom, 0] = friction

    def scale_mass(self, name: str, factor: float) -> None:
        """Change an object's mass."""
        body = self._object_body[name]
        self.model.body_mass[body] *= factor
        self.model.body_inertia[body] *= factor
        # The solver's softness follows inverse weights worked out at compile time; stale ones let a heavy thing creep.
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def shift_mass(self, name: str, offset_m: float) -> None:
        """Have an object's weight pull so far along its own x beside its middle; its inertia stays where it was.

        MuJoCo compiles what moves freely around its own centre in a simpler form, in which that centre cannot move
        afterwards. The torque of a weight beside it can be put on any body; what is left out, the same for the object's
        acceleration, is a tenth of it for a load that is carried.
        """
        self.drives.beside_m[name] = offset_m
        self._weigh_beside()
        if offset_m == 0.0:
            del self.drives.beside_m[name]

    def _weigh_beside(self) -> None:
        model, data = self.model, self.data
        for name, offset_m in self.drives.beside_m.items():
            body = self._object_body[name]
            weight_n = model.opt.gravity * (model.body_mass[body] * (1.0 - model.body_gravcomp[body]))
            data.xfrc_applied[body, 3:] = np.cross(data.xmat[body].reshape(3, 3)[:, 0] * offset_m, weight_n)

    def place_object(self, name: str, x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0) -> None:
        """Put an object somewhere before a run starts, or take it away (under the floor it is hung up, not falling)."""
        self._set_asleep(name, asleep=z_m < 0)  # the floor would throw out what is put under it
        q, v = self._object_q[name], self._object_v[name]
        self._qpos[q : q + 7] = (x_m, y_m, z_m, cos(yaw_rad / 2), 0.0, 0.0, sin(yaw_rad / 2))
        self._qvel[v : v + 6] = 0.0
        mujoco.mj_kinematics(self.model, self.data)  # or what dozes would be decided by where it was

    def place_crate(self, name: str, x_m: float, y_m: float, z_m: float = CRATE_HALF_M[2]) -> None:
        """Put a crate on the floor, or hang it up with its middle at `z_m`."""
        self.data.mocap_pos[self.model.body(name).mocapid[0]] = (x_m, y_m, z_m)

    def remove_crate(self, name: str) -> None:
        """Take a crate away."""
        self.data.mocap_pos[self.model.body(name).mocapid[0]] = (0.0, 0.0, UNDER_FLOOR_M)

    def place_person(
        self, index: int, x_m: float, y_m: float, heading_rad: float, swing_rad: float, *, present: bool
    ) -> None:
        """Move a figure; one that is not present waits under the floor."""
        half, z = heading_rad / 2, HIP_M if present else UNDER_FLOOR_M
        turn = np.array((cos(half), 0.0, 0.0, sin(half)))
        for part, swing in zip(PERSON_PARTS, (0.0, swing_rad, -swing_rad), strict=True):
            mocap = self.model.body(f"person_{index}_{part}").mocapid[0]
            self.data.mocap_pos[mocap] = (x_m, y_m, z)
            c, s = cos(swing / 2), sin(swing / 2)
            self.data.mocap_quat[mocap] = (turn[0] * c, -turn[3] * s, turn[0] * s, turn[3] * c)

    # -- truth -----------------------------------------------------------------------------------------------

    def true_object(self, name: str) -> tuple[Vec3, float, float]:
        """Return an object's true position, its yaw, and how upright it stands (1 upright, 0 lying)."""
        x, y, z = self._object_at[name].tolist()
        turn = self._object_turn[name].tolist()
        # Lying down, what is left of a heading is the direction of the long axis.
        column = 0 if abs(turn[8]) > _LYING else 2
        return (x, y, z), atan2(turn[3 + column], turn[column]), abs(turn[8])

    def read_base(self) -> Vec3:
        """Return the true pose of the base: x_m, y_m, yaw_rad."""
        x, y, yaw = self._base_at.tolist()
        return x, y, yaw

    def between_pads(self) -> tuple[str, Vec3] | None:
        """Return the object between the pads, with its position in the tool frame: the nearest, where several are.

        By geometry alone. What is held passes over what stands below it.
        """
        x, y, z = self.true_tcp()
        turn = self._tcp_turn.tolist()
        nearest, between = _PADS_REACH_M**2, None
        for name, at in self._object_at.items():
            ox, oy, oz = at.tolist()
            dx, dy, dz = ox - x, oy - y, oz - z
            far = dx * dx + dy * dy + dz * dz
            if far > nearest:
                continue
            along, across, deep = (turn[k] * dx + turn[3 + k] * dy + turn[6 + k] * dz for k in range(3))
            if abs(along) < _BETWEEN_PADS_M[0] and abs(across) < _BETWEEN_PADS_M[1] and abs(deep) < _BETWEEN_PADS_M[2]:
                nearest, between = far, (name, (along, across, deep))
        return between

    def true_tcp(self) -> Vec3:
        """Return the true position of the tool centre point, world frame."""
        x, y, z = self._tcp_at.tolist()
        return x, y, z

    def true_held(self) -> str | None:
        """Return the object that both pads touch, if one."""
        touching: dict[int, set[int]] = {}
        for contact in self.data.contact[: self.data.ncon]:
            first, second = int(contact.geom[0]), int(contact.geom[1])
            pad, other = (first, second) if first in self._pads else (second, first)
            if pad in self._pads:
                touching.setdefault(other, set()).add(pad)
        for name, geom in self._object_geom.items():
            if len(touching.get(geom, ())) == len(self._pads):
                return name
        return None

    def true_grip_n(self, name: str) -> float:
        """Return the most that the pads can bear of an object by friction (N), at the force they press it with."""
        geom, most, wrench = self._object_geom[name], 0.0, np.zeros(6)
        for k, contact in enumerate(self.data.contact[: self.data.ncon]):
            pair = {int(contact.geom[0]), int(contact.geom[1])}
            if geom in pair and not pair.isdisjoint(self._pads):
                mujoco.mj_contactForce(self.model, self.data, k, wrench)
                most += float(contact.friction[0] * wrench[0])
        return most

    def weight_n(self, name: str) -> float:
        """Return what an object weighs (N)."""
        return float(self.model.body_mass[self._object_body[name]] * np.linalg.norm(self.model.opt.gravity))

    def true_contact_n(self, held: str | None) -> tuple[float, float]:
        """Return the exact force between gripper (with what it holds) and the rest.

        Mean over 20 ms, highest substep.
        """
        mass = self._gripper_kg + (float(self.model.body_mass[self._object_body[held]]) if held else 0.0)
        x, y, z, peak = beyond_wrist(self._force.tolist(), mass)
        return hypot(x, y, z), peak

    def true_push_n(self) -> tuple[float, float]:
        """Return the exact force between the robot, any part of it, and crates in its way.

        Mean over 20 ms, highest substep; the sum of what is normal to the surfaces.
        """
        felt = self._force[:, self._crates_felt]
        if not any(map(any, felt.tolist())):  # nearly always, in every tick of an evaluation
            return 0.0, 0.0
        pushed = felt.sum(axis=1)
        return float(pushed.mean()), float(pushed[SUBSTEPS:].max())

    def tool_angle(self, name: str) -> float:
        """Return a tool's joint: lever angle in radians, or button travel in metres."""
        return float(self._qpos[self._tool_q[name]])

    def crates(self) -> list[tuple[float, float]]:
        """Return where crates stand on the floor."""
        spots = (self.data.mocap_pos[self.model.body(name).mocapid[0]] for name in CRATES)
        return [(float(at[0]), float(at[1])) for at in spots if 0 < at[2] <= CRATE_HALF_M[2]]

    @property
    def gripper_kg(self) -> float:
        """Mass of everything beyond the wrist sensor, without a load."""
        return self._gripper_kg

    def doze(self) -> None:
        """Spare the solver objects that lie still away from the gripper.

        Without contacts and weight they do not move, so that MuJoCo may let them sleep; that changes no bit of
        anything else, whether they sleep already or not yet.
        """
        x, y, _ = self.true_tcp()
        for name, at in self._object_at.items():
            ax, ay, az = at.tolist()
            far = az < 0 or hypot(ax - x, ay - y) > _WAKE_M
            if far == (name in self._asleep):
                continue
            v = self._object_v[name]
            if not far or np.abs(self._qvel[v : v + 6]).max() < _RESTING_MPS:
                self._set_asleep(name, asleep=far)

    def _set_asleep(self, name: str, *, asleep: bool) -> None:
        body, v = self._object_body[name], self._object_v[name]
        geoms = np.flatnonzero(self.model.geom_bodyid == body)
        # The body's own bits are those of its geoms, worked out at compile time; the broad phase reads them first.
        for kind, where in (("geom", geoms), ("body", body)):
            for bits in (f"{kind}_contype", f"{kind}_conaffinity"):
                getattr(self.model, bits)[where] = 0 if asleep else self._powered[bits][where]
        self.model.body_gravcomp[body] = 1.0 if asleep else 0.0
        policy = mujoco.mjtSleepPolicy
        tree = int(self.model.body_treeid[body])
        self.model.tree_sleep_policy[tree] = policy.mjSLEEP_ALLOWED if asleep else policy.mjSLEEP_NEVER
        self._qvel[v : v + 6] = 0.0
        (self._asleep.add if asleep else self._asleep.discard)(name)

    # -- keeping and bringing back ---------------------------------------------------------------------------

    def snapshot(self) -> object:
        """Return the integration state, the edited model fields and the drives; `restore` brings it back bitwise."""
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, state, kind)
        edits = {name: getattr(self.model, name).copy() for name in _EDITED}
        return state, edits, copy.deepcopy((self.drives, self._force, self._torque, self._asleep))

    def restore(self, state: object) -> None:
        """Bring back what `snapshot` returned."""
        physics, edits, own = copy.deepcopy(state)  # type: ignore[misc]  # opaque outside this class
        # Awake all first: nobody sleeps through being put elsewhere. MuJoCo itself has to do it, which keeps lists.
        self.model.tree_sleep_policy[:] = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
        mujoco.mj_kinematics(self.model, self.data)
        for name, values in edits.items():
            getattr(self.model, name)[:] = values
        self.drives, self._force[:], self._torque[:], self._asleep = own
        mujoco.mj_setState(self.model, self.data, physics, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_setState(
            self.model, self.data, physics, mujoco.mjtState.mjSTATE_INTEGRATION
        )  # forward touched the warm start


def beyond_wrist(substeps: Sequence[Sequence[float]], mass_kg: float) -> tuple[float, float, float, float]:
    """Return what acts on the wrist beyond a mass that hangs on it.

    Args:
        substeps: rows of force (3) and acceleration (3), as in `Tick.wrist`.
        mass_kg: everything that hangs on the wrist.

    Returns:
        The mean force (x, y, z) and the highest magnitude in any row, newtons.
    """
    sx = sy = sz = peak = 0.0
    for fx, fy, fz, ax, ay, az, *_ in substeps:
        x, y, z = fx - mass_kg * ax, fy - mass_kg * ay, fz - mass_kg * az
        sx, sy, sz, peak = sx + x, sy + y, sz + z, max(peak, x * x + y * y + z * z)
    count = len(substeps)
    return sx / count, sy / count, sz / count, sqrt(peak)


def _run_of(indices: list[int]) -> slice:
    """Return consecutive indices as a slice, which makes views instead of copies.

    Raises:
        ValueError: they are not consecutive.
    """
    first = int(indices[0])
    if [int(i) for i in indices] != list(range(first, first + len(indices))):
        raise ValueError(
            "the robot's joints and actuators must stand in order, base, arm and fingers each together; "
            f"found `{indices}`"
        )
    return slice(first, first + len(indices))
