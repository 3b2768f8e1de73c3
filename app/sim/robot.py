"""The robot: a UR5e by its published DH parameters on a holonomic base, with a parallel gripper.

`add_robot` writes it into a model spec; the workcell uses it twice, once in the whole world and once alone as the
robot's own model of itself (inverse kinematics, Jacobian, expected torques). `load_robot` takes another robot's MJCF
instead and says which parts it lacks.

Contact bits: environment 1, robot 2, objects 4; the robot does not collide with itself.
"""

from __future__ import annotations

import warnings
from math import cos, pi, sin
from pathlib import Path
from typing import NamedTuple

import mujoco

ENVIRONMENT, ROBOT, OBJECT = 1, 2, 4

# UR5e, published DH parameters (a, d in metres, alpha in radians), link masses, torque and speed limits.
DH_A_M = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
DH_D_M = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
DH_ALPHA_RAD = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
LINK_MASS_KG = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
TORQUE_LIMIT_NM = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
JOINT_SPEED_LIMIT_RADPS = pi

ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
BASE_JOINTS = ("base_x", "base_y", "base_yaw")
FINGER_JOINTS = ("finger_left", "finger_right")
GRIP_ACTUATOR = "grip"
GRIPPER = "gripper"
TCP_SITE = "tcp"
WRIST_SITE = "wrist_ft"
PAD_GEOMS = ("pad_left", "pad_right")

ARM_KP = (6000.0, 6000.0, 4000.0, 1000.0, 800.0, 500.0)
ARM_KV = (400.0, 400.0, 250.0, 60.0, 45.0, 25.0)
ARM_ARMATURE = (0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
BASE_KV = (4000.0, 4000.0, 800.0)
BASE_FORCE = (600.0, 600.0, 200.0)

ARM_MOUNT_M = (0.12, 0.0, 0.70)
FLANGE_TO_TCP_M = 0.165
FINGER_STROKE_M = 0.055
GRIPPER_MASS_KG = 0.9
FINGER_MASS_KG = 0.12
BASE_MASS_KG = 140.0
BASE_RADIUS_M = 0.42  # circle around the footprint
PAD_FRICTION = (0.9, 0.02, 0.0005)
# As stiff as MuJoCo lets a brake be: friction yields to a steady load, by default some millimetres a second.
_BRAKES, _BRAKING = (0.9999, 0.9999, 0.001, 0.5, 2.0), (0.004, 1.0)

# Joint angles with the tool pointing down in front of the base: over the working height, and drawn in for driving.
READY_RAD = (-0.3580, -1.8890, 1.7650, -1.4470, -1.5708, 1.2128)
HOME_RAD = (-0.4600, -2.1190, 2.0180, -1.4698, -1.5708, 1.1108)


class _Link(NamedTuple):
    """One capsule of an arm link in its own frame: ends and radius."""

    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    radius_m: float


_LINKS: tuple[tuple[_Link, ...], ...] = (
    (_Link((0, 0, 0.0), (0, 0, 0.15), 0.062),),
    (_Link((0, 0, 0.13), (-0.425, 0, 0.13), 0.055),),
    (_Link((0, 0, 0.01), (-0.3922, 0, 0.01), 0.045),),
    (_Link((0, 0, 0.0), (0, 0, 0.10), 0.043),),
    (_Link((0, 0, 0.0), (0, 0, 0.08), 0.043),),
    (_Link((0, 0, 0.02), (0, 0, 0.07), 0.038),),
)
_SHELL = (0.80, 0.83, 0.86, 1.0)
_DARK = (0.20, 0.22, 0.25, 1.0)


def add_robot(spec: mujoco.MjSpec, *, mobile: bool = True, fingers: bool = True) -> None:
    """Write the robot into `spec`.

    Args:
        spec: model spec to add to.
        mobile: with the base's three joints; otherwise the base stands at the origin.
        fingers: with moving fingers and their motor; otherwise they are fixed half open.
    """
    base = _add_base(spec, mobile=mobile)
    wrist = _add_arm(spec, base)
    _add_gripper(spec, wrist, fingers=fingers)


def robot_model(*, mobile: bool, mjcf: Path | None = None) -> mujoco.MjModel:
    """Compile the robot alone: the model it has of itself (gravity counted, no contacts).

    Args:
        mobile: with the base's three joints; otherwise the base stands at the origin.
        mjcf: another robot's model.

    Raises:
        ValueError: the other robot's model cannot be used.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    if mjcf is None:
        add_robot(spec, mobile=mobile, fingers=False)
    else:
        other = load_robot(mjcf)
        _keep_joints(other, {*ARM_JOINTS, *BASE_JOINTS} if mobile else set(ARM_JOINTS))
        put_robot(spec, other)
    for body in spec.bodies:
        body.gravcomp = 0.0
    return compiled(spec)


def load_robot(path: Path) -> mujoco.MjSpec:
    """Read another robot's MJCF and check that it has what the workcell drives and senses.

    It has to be arranged like the project's own (a mobile base, a six-axis arm with the axes of a UR, a parallel
    gripper), under the same names; lengths, masses, limits and servo gains are its own, and so is its model of itself.
    Whatever can be touched gets the workcell's contact bits.

    Raises:
        ValueError: the file cannot be read, lacks parts, has them in another order, or has no servos on them; the
            message names the parts.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"robot model `{path}` cannot be read: {error}") from error
    _check_parts(path.name, spec)
    _check_order(path.name, spec)
    _check_servos(path.name, spec)
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = ROBOT, ENVIRONMENT | OBJECT
    return spec


def put_robot(spec: mujoco.MjSpec, other: mujoco.MjSpec) -> None:
    """Put a loaded robot into an empty spec; its own units of angle stay in force for it."""
    spec.attach(other, frame=spec.worldbody.add_frame(), prefix="")


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec that a robot was put into: names without a prefix matter to models that are saved, not here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Attaching a spec with an empty prefix")
        return spec.compile()


def _keep_joints(spec: mujoco.MjSpec, names: set[str]) -> None:
    """Leave only these joints, and nothing that acts on or listens to others."""
    for part in (*spec.keys, *spec.sensors, *spec.actuators, *spec.equalities, *spec.tendons):
        spec.delete(part)
    for joint in [joint for joint in spec.joints if joint.name not in names]:
        spec.delete(joint)


def _check_parts(model: str, spec: mujoco.MjSpec) -> None:
    wanted = {
        "body": ({GRIPPER}, {body.name for body in spec.bodies}),
        "joint": (set(BASE_JOINTS + ARM_JOINTS + FINGER_JOINTS), {joint.name for joint in spec.joints}),
        "actuator": ({*BASE_JOINTS, *ARM_JOINTS, GRIP_ACTUATOR}, {actuator.name for actuator in spec.actuators}),
        "site": ({TCP_SITE, WRIST_SITE, *(f"{pad}_touch" for pad in PAD_GEOMS)}, {site.name for site in spec.sites}),
        "geom": (set(PAD_GEOMS), {geom.name for geom in spec.geoms}),
    }
    missing = [f"{kind} `{name}`" for kind, (need, have) in wanted.items() for name in sorted(need - have)]
    if missing:
        raise ValueError(f"robot model `{model}` lacks {', '.join(missing)}")


def _check_order(model: str, spec: mujoco.MjSpec) -> None:
    found, wanted = [joint.name for joint in spec.joints], [*BASE_JOINTS, *ARM_JOINTS]
    if found[: len(wanted)] != wanted:
        raise ValueError(
            f"robot model `{model}` has its joints in the order {', '.join(f'`{name}`' for name in found)}; "
            f"valid: {', '.join(f'`{name}`' for name in wanted)} first, then the fingers"
        )


def _check_servos(model: str, spec: mujoco.MjSpec) -> None:
    """The drives' brakes and faults work on gains: positions for the arm, velocities for the base."""
    servos = {actuator.name: actuator for actuator in spec.actuators}
    for names, kind, place in ((ARM_JOINTS, "position", 1), (BASE_JOINTS, "velocity", 2)):
        for name in names:
            gain, bias = float(servos[name].gainprm[0]), float(servos[name].biasprm[place])
            if not (gain > 0.0 and bias == -gain):
                raise ValueError(f"robot model `{model}` drives `{name}` by something else; valid: a {kind} servo")


def _add_base(spec: mujoco.MjSpec, *, mobile: bool) -> mujoco.MjsBody:
    base = spec.worldbody.add_body(name="base", gravcomp=1.0)
    if mobile:
        kinds = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
        axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        for name, kind, axis, kv, force in zip(BASE_JOINTS, kinds, axes, BASE_KV, BASE_FORCE, strict=True):
            base.add_joint(name=name, type=kind, axis=axis, solimp_friction=_BRAKES, solref_friction=_BRAKING)
            _add_velocity_servo(spec, name, kv, force)
    _add_shape(base, "chassis", mujoco.mjtGeom.mjGEOM_BOX, (0.33, 0.25, 0.20), (0, 0, 0.26), BASE_MASS_KG * 0.8, _DARK)
    _add_shape(
        base, "column", mujoco.mjtGeom.mjGEOM_BOX, (0.14, 0.14, 0.12), (0.08, 0, 0.58), BASE_MASS_KG * 0.2, _SHELL
    )
    return base


def _add_arm(spec: mujoco.MjSpec, base: mujoco.MjsBody) -> mujoco.MjsBody:
    # Turned by half a circle, because with the published signs the arm at zero points along -x.
    parent, position, quat = base, ARM_MOUNT_M, (0.0, 0.0, 0.0, 1.0)
    for i, name in enumerate(ARM_JOINTS):
        body = parent.add_body(name=f"{name}_link", pos=position, quat=quat, gravcomp=1.0)
        limit = pi if name == "elbow" else 2 * pi
        body.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=(0, 0, 1),
            range=(-limit, limit),
            limited=True,
            armature=ARM_ARMATURE[i],
            actgravcomp=True,
            actfrcrange=(-TORQUE_LIMIT_NM[i], TORQUE_LIMIT_NM[i]),
            actfrclimited=True,
            solimp_friction=_BRAKES,
            solref_friction=_BRAKING,
        )
        for k, link in enumerate(_LINKS[i]):
            body.add_geom(
                name=f"{name}_shell_{k}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=(*link.start_m, *link.end_m),
                size=(link.radius_m, 0, 0),
                mass=LINK_MASS_KG[i] / len(_LINKS[i]),
                contype=ROBOT,
                conaffinity=ENVIRONMENT | OBJECT,
                rgba=_SHELL if i % 2 else _DARK,
            )
        _add_position_servo(spec, name, ARM_KP[i], ARM_KV[i])
        parent, position = body, (DH_A_M[i], 0.0, DH_D_M[i])
        quat = (cos(DH_ALPHA_RAD[i] / 2), sin(DH_ALPHA_RAD[i] / 2), 0.0, 0.0)
    return parent


def _add_gripper(spec: mujoco.MjSpec, wrist: mujoco.MjsBody, *, fingers: bool) -> None:
    palm = wrist.add_body(name=GRIPPER, pos=(0, 0, DH_D_M[5]), gravcomp=1.0)
    _add_shape(
        palm,
        "palm",
        mujoco.mjtGeom.mjGEOM_BOX,
        (0.035, 0.07, 0.035),
        (0, 0, 0.035),
        GRIPPER_MASS_KG - 2 * FINGER_MASS_KG,
        _DARK,
    )
    palm.add_site(name=WRIST_SITE, pos=(0, 0, 0.06))
    palm.add_site(name=TCP_SITE, pos=(0, 0, FLANGE_TO_TCP_M))
    for name, pad, side in zip(FINGER_JOINTS, PAD_GEOMS, (1.0, -1.0), strict=True):
        finger = palm.add_body(name=name, pos=(0, 0 if fingers else side * FINGER_STROKE_M / 2, 0), gravcomp=1.0)
        if fingers:
            finger.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=(0, side, 0),
                range=(0.0, FINGER_STROKE_M),
                limited=True,
                damping=80.0,
                armature=0.05,
            )
        _add_shape(
            finger,
            f"{name}_rod",
            mujoco.mjtGeom.mjGEOM_BOX,
            (0.010, 0.006, 0.05),
            (0, side * 0.016, 0.115),
            FINGER_MASS_KG * 0.7,
            _SHELL,
        )
        finger.add_geom(
            name=pad,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.011, 0.005, 0.014),
            pos=(0, side * 0.005, FLANGE_TO_TCP_M),
            mass=FINGER_MASS_KG * 0.3,
            contype=ROBOT,
            conaffinity=ENVIRONMENT | OBJECT,
            condim=4,
            priority=1,
            friction=PAD_FRICTION,
            solimp=(0.95, 0.99, 0.001, 0.5, 2),
            solref=(0.02, 1.0),
            rgba=(0.1, 0.1, 0.1, 1),
        )
        finger.add_site(
            name=f"{pad}_touch",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.013, 0.007, 0.016),
            pos=(0, side * 0.005, FLANGE_TO_TCP_M),
            rgba=(0, 0, 0, 0),
        )
    if fingers:
        _couple_fingers(spec)


def _couple_fingers(spec: mujoco.MjSpec) -> None:
    left, right = FINGER_JOINTS
    equality = spec.add_equality(name="fingers", type=mujoco.mjtEq.mjEQ_JOINT, name1=left, name2=right)
    equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
    equality.data[:5] = (0, 1, 0, 0, 0)
    tendon = spec.add_tendon(name=GRIP_ACTUATOR)
    tendon.wrap_joint(left, 1.0)
    tendon.wrap_joint(right, 1.0)
    motor = spec.add_actuator(name=GRIP_ACTUATOR, target=GRIP_ACTUATOR, trntype=mujoco.mjtTrn.mjTRN_TENDON)
    motor.gear[0] = -1.0  # positive closes, newtons per pad


def _add_shape(
    body: mujoco.MjsBody,
    name: str,
    kind: mujoco.mjtGeom,
    size: tuple[float, ...],
    pos: tuple[float, ...],
    mass_kg: float,
    rgba: tuple[float, ...],
) -> None:
    body.add_geom(
        name=name,
        type=kind,
        size=size,
        pos=pos,
        mass=mass_kg,
        contype=ROBOT,
        conaffinity=ENVIRONMENT | OBJECT,
        rgba=rgba,
    )


def _add_position_servo(spec: mujoco.MjSpec, joint: str, kp: float, kv: float) -> None:
    servo = spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, biastype=mujoco.mjtBias.mjBIAS_AFFINE
    )
    servo.gainprm[0] = kp
    servo.biasprm[1], servo.biasprm[2] = -kp, -kv


def _add_velocity_servo(spec: mujoco.MjSpec, joint: str, kv: float, force: float) -> None:
    servo = spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, biastype=mujoco.mjtBias.mjBIAS_AFFINE
    )
    servo.gainprm[0] = kv
    servo.biasprm[2] = -kv
    servo.forcelimited = True
    servo.forcerange = (-force, force)
