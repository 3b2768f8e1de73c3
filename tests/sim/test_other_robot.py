"""Another robot's MJCF: a longer upper arm, a shorter forearm, in degrees, with classes and servos of its own."""

from __future__ import annotations

from math import dist
from pathlib import Path

import pytest

from app.config import ConfigError
from app.governance.model import Site
from app.sim.robot import load_robot
from app.sim.trial import run_skill
from app.sim.workcell import Workcell, make_workcell
from app.workcell import robot_model

pytestmark = pytest.mark.physics

OTHER = """
<mujoco model="other">
  <default>
    <default class="arm">
      <joint range="-360 360" armature="0.08" actuatorgravcomp="true" actuatorfrcrange="-170 170"/>
      <geom type="capsule"/>
    </default>
    <default class="wrist">
      <joint range="-360 360" armature="0.04" actuatorgravcomp="true" actuatorfrcrange="-30 30"/>
      <geom type="capsule" size="0.04"/>
    </default>
    <default class="finger">
      <joint type="slide" range="0 0.055" damping="80" armature="0.05"/>
      <geom type="box"/>
      <site type="box" size="0.013 0.007 0.016"/>
    </default>
    <default class="pad">
      <geom type="box" size="0.011 0.005 0.014" mass="0.04" condim="4" priority="1" friction="0.9 0.02 0.0005"
            solimp="0.95 0.99 0.001"/>
    </default>
  </default>
  <worldbody>
    <body name="base" gravcomp="1">
      <joint name="base_x" type="slide" axis="1 0 0"/>
      <joint name="base_y" type="slide" axis="0 1 0"/>
      <joint name="base_yaw" type="hinge" axis="0 0 1"/>
      <geom type="cylinder" size="0.3 0.2" pos="0 0 0.26" mass="120"/>
      <geom type="box" size="0.14 0.14 0.12" pos="0.08 0 0.58" mass="25"/>
      <body name="shoulder" pos="0.12 0 0.7" euler="0 0 180" gravcomp="1">
        <joint name="shoulder_pan" class="arm"/>
        <geom class="arm" size="0.06" fromto="0 0 0 0 0 0.15" mass="4"/>
        <body name="upper_arm" pos="0 0 0.1625" euler="90 0 0" gravcomp="1">
          <joint name="shoulder_lift" class="arm"/>
          <geom class="arm" size="0.055" fromto="0 0 0.13 -0.45 0 0.13" mass="8.5"/>
          <body name="forearm" pos="-0.45 0 0" gravcomp="1">
            <joint name="elbow" class="arm" range="-180 180"/>
            <geom class="arm" size="0.045" fromto="0 0 0.01 -0.36 0 0.01" mass="2.6"/>
            <body name="wrist_one" pos="-0.36 0 0.1333" gravcomp="1">
              <joint name="wrist_1" class="wrist" pos="0 0 -0.1333"/>
              <geom class="wrist" fromto="0 0 -0.12 0 0 -0.03" mass="1.4"/>
              <body name="wrist_two" euler="90 0 0" gravcomp="1">
                <joint name="wrist_2" class="wrist"/>
                <geom class="wrist" fromto="0 0 0 0 0 0.08" mass="1.3"/>
                <body name="wrist_three" pos="0 0 0.0997" euler="-90 0 0" gravcomp="1">
                  <joint name="wrist_3" class="wrist"/>
                  <geom class="wrist" fromto="0 0 0.02 0 0 0.07" mass="0.4"/>
                  <body name="gripper" pos="0 0 0.0996" gravcomp="1">
                    <geom type="box" size="0.035 0.07 0.035" pos="0 0 0.035" mass="0.7"/>
                    <site name="wrist_ft" pos="0 0 0.06"/>
                    <site name="tcp" pos="0 0 0.165"/>
                    <body name="left" gravcomp="1">
                      <joint name="finger_left" class="finger" axis="0 1 0"/>
                      <geom class="finger" size="0.01 0.006 0.05" pos="0 0.016 0.115" mass="0.09"/>
                      <geom name="pad_left" class="pad" pos="0 0.005 0.165"/>
                      <site name="pad_left_touch" class="finger" pos="0 0.005 0.165"/>
                    </body>
                    <body name="right" gravcomp="1">
                      <joint name="finger_right" class="finger" axis="0 -1 0"/>
                      <geom class="finger" size="0.01 0.006 0.05" pos="0 -0.016 0.115" mass="0.09"/>
                      <geom name="pad_right" class="pad" pos="0 -0.005 0.165"/>
                      <site name="pad_right_touch" class="finger" pos="0 -0.005 0.165"/>
                    </body>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="grip"><joint joint="finger_left" coef="1"/><joint joint="finger_right" coef="1"/></fixed>
  </tendon>
  <equality><joint joint1="finger_left" joint2="finger_right"/></equality>
  <actuator>
    <velocity name="base_x" joint="base_x" kv="4500" forcerange="-700 700"/>
    <velocity name="base_y" joint="base_y" kv="4500" forcerange="-700 700"/>
    <velocity name="base_yaw" joint="base_yaw" kv="900" forcerange="-250 250"/>
    <position name="shoulder_pan" joint="shoulder_pan" kp="7000" kv="450"/>
    <position name="shoulder_lift" joint="shoulder_lift" kp="7000" kv="450"/>
    <position name="elbow" joint="elbow" kp="4500" kv="280"/>
    <position name="wrist_1" joint="wrist_1" kp="1100" kv="65"/>
    <position name="wrist_2" joint="wrist_2" kp="900" kv="50"/>
    <position name="wrist_3" joint="wrist_3" kp="550" kv="28"/>
    <motor name="grip" tendon="grip" gear="-1"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def other(tmp_path: Path) -> Path:
    return written(tmp_path, OTHER)


def written(folder: Path, text: str) -> Path:
    path = folder / "other.xml"
    path.write_text(text)
    return path


def cell_with(site: Site, mjcf: Path) -> Workcell:
    return make_workcell(site, cell_id="cell", seed=1, robot_mjcf=mjcf)


def test_the_other_robot_knows_its_own_reach(site: Site, other: Path) -> None:
    cell, own = cell_with(site, other), make_workcell(site, cell_id="cell", seed=1)
    seen, truth = cell.observe(), cell.truth()
    x, y, _ = truth.base
    assert (x + -seen.tcp_m[1], y + seen.tcp_m[0], seen.tcp_m[2]) == pytest.approx(truth.tcp_m, abs=2e-3)
    assert dist(seen.tcp_m, own.observe().tcp_m) > 0.02
    assert max(map(abs, seen.residual_nm)) < 3.0


def test_the_other_robot_drives_grasps_and_lifts(site: Site, other: Path) -> None:
    cell = cell_with(site, other)
    away = {"x_m": 1.6, "y_m": 3.8, "yaw_rad": 1.5708, "speed_mps": 0.3, "clearance_m": 0.1}
    assert run_skill(cell, "navigate_to", away).done
    assert run_skill(cell, "navigate_to", {"target": "bench_a_stand", "speed_mps": 0.3, "clearance_m": 0.1}).done
    ran = run_skill(cell, "grasp_object", {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25})
    assert ran.done, ran
    assert cell.truth().held == "mug_1"
    assert ran.tcp_speed_mps < 0.25 * 1.05


@pytest.mark.parametrize(
    ("part", "instead", "said"),
    [
        ('joint name="wrist_3"', 'joint name="wrist_4"', "lacks joint `wrist_3`"),
        ('site name="pad_left_touch"', 'site name="palm_touch"', "lacks site `pad_left_touch`"),
        ('body name="gripper"', 'body name="hand"', "lacks body `gripper`"),
        ('geom name="pad_right"', 'geom name="thumb"', "lacks geom `pad_right`"),
        ('velocity name="base_x"', 'velocity name="wheels"', "lacks actuator `base_x`"),
        ('<position name="elbow" joint="elbow" kp="4500" kv="280"/>', '<motor name="elbow" joint="elbow"/>',
         "drives `elbow` by something else; valid: a position servo"),
        ('<velocity name="base_y" joint="base_y" kv="4500" forcerange="-700 700"/>',
         '<position name="base_y" joint="base_y" kp="100"/>', "drives `base_y` by something else; valid: a velocity"),
        ('<joint name="base_x" type="slide" axis="1 0 0"/>\n      <joint name="base_y" type="slide" axis="0 1 0"/>',
         '<joint name="base_y" type="slide" axis="0 1 0"/>\n      <joint name="base_x" type="slide" axis="1 0 0"/>',
         "joints in the order `base_y`, `base_x`"),
        ("</worldbody>", "</word>", "cannot be read"),
    ],
    ids=["joint", "site", "body", "geom", "actuator", "arm servo", "base servo", "order", "xml"],
)  # fmt: skip
def test_a_model_that_cannot_be_driven_is_refused_by_name(tmp_path: Path, part: str, instead: str, said: str) -> None:
    assert part in OTHER
    path = written(tmp_path, OTHER.replace(part, instead))
    with pytest.raises(ValueError, match=said):
        load_robot(path)
    with pytest.raises(ConfigError, match=said):
        robot_model(str(path))
