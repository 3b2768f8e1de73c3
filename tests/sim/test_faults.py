"""Each fault has its physical effect, compared with the same seed without it; and none is told to anybody."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from app.governance.model import Json, Observation, Site, SkillReport, SkillState
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.sensors import SensorFault
from app.sim.skills import Run
from app.sim.trial import Ran, grant_for, run_skill
from app.sim.workcell import Workcell
from app.sim.world import UNDER_FLOOR_M

pytestmark = pytest.mark.physics

GRASP = {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25}
DRIVE = {"x_m": 1.6, "y_m": 3.6, "yaw_rad": 1.57, "speed_mps": 0.4, "clearance_m": 0.1}
AT_ONCE = Trigger(time_s=0.0)


def cell_with(site: Site, *faults: Fault, people: Sequence[Walk] = ()) -> Workcell:
    return Workcell(site, seed=5, faults=faults, people=people)


def fault(kind: str, at: Trigger = AT_ONCE, **sizes: object) -> Fault:
    return Fault(kind=kind, at=at, sizes=sizes)


def bound(cell: Workcell, capability: str, params: Mapping[str, Json]) -> Run:
    cell.unbind()
    return cell.bind(grant_for(cell.id, capability, params), capability, params)


def drive(cell: Workcell, limit_s: float = 4.0) -> Ran:
    return run_skill(cell, "navigate_to", DRIVE, limit_s=limit_s)


def test_a_grip_that_loses_its_force_drops_the_object(site: Site):
    lifting = Trigger(capability="grasp_object", phase="lift", after_s=0.5)
    weak = cell_with(site, fault("grip_gain", lifting, gain=0.01))
    run_skill(weak, "grasp_object", GRASP)
    assert weak.truth().held is None


def test_speed_scaling_moves_the_base_faster_than_it_was_told(site: Site):
    told = drive(cell_with(site)).base_speed_mps
    assert told < 0.42
    assert drive(cell_with(site, fault("speed_scaling", gain=1.5))).base_speed_mps > 1.15 * told


def test_drives_that_run_as_told_again_bring_the_arm_back_to_where_it_is_told_to_be(site: Site):
    begins = Trigger(capability="grasp_object", phase="approach", after_s=0.8)
    cell = cell_with(site, Fault(kind="speed_scaling", at=begins, sizes={"gain": 1.5}, for_s=0.6))
    run_skill(cell, "grasp_object", {**GRASP, "speed_mps": 0.5})
    for _ in range(300):
        cell.step(cell.hold())
    assert cell.observe().joint_rad == pytest.approx(cell.hold().joint_rad, abs=0.003)


def test_a_missing_object_is_not_found(site: Site):
    ran = run_skill(cell_with(site, fault("missing", object="mug_1")), "grasp_object", GRASP)
    assert ran.failure in {"object_not_found", "grasp_failed", "perception_mismatch"}


def test_a_missing_object_stays_away(site: Site):
    cell = cell_with(site, fault("missing", object="mug_1"))
    for _ in range(200):
        cell.step(cell.hold())
    assert cell.truth().objects["mug_1"][2] == pytest.approx(UNDER_FLOOR_M, abs=0.01)


def test_a_slippery_object_slips_out(site: Site):
    cell = cell_with(site, fault("slippery", object="mug_1", friction=0.01))
    ran = run_skill(cell, "grasp_object", {**GRASP, "force_n": 10.0})
    assert cell.truth().held is None
    assert not ran.done


def test_what_the_pads_touch_is_secure_as_long_as_their_friction_bears_it(site: Site):
    cell = cell_with(site)
    assert run_skill(cell, "grasp_object", GRASP).done
    assert (cell.truth().held, cell.truth().secure) == ("mug_1", True)
    cell.plant.make_slippery("mug_1", 0.03)  # 2 x 0.03 x 40 N is less than the mug weighs
    cell.step(cell.hold())
    assert (cell.truth().held, cell.truth().secure) == ("mug_1", False)
    for _ in range(100):
        cell.step(cell.hold())
    assert cell.truth().held is None


def test_a_crate_that_hangs_in_the_way_is_no_obstacle_on_the_floor_and_holds_what_meets_it(site: Site):
    cell = cell_with(site, fault("blocked", x_m=1.6, y_m=3.7, z_m=0.45))
    ran = drive(cell, limit_s=20.0)
    assert (ran.failure, ran.detail) == ("blocked", "the base does not follow: something holds it")
    assert cell.truth().base[1] > 4.2


def test_what_hangs_in_the_arms_way_is_felt_by_the_truth_where_the_wrist_feels_nothing(site: Site):
    over = fault("blocked", Trigger(capability="grasp_object", phase="approach"), x_m=1.6, y_m=5.35, z_m=1.6)
    cell = cell_with(site, over)
    felt, pressed = 0.0, 0.0
    skill = bound(cell, "grasp_object", GRASP)
    for _ in range(150):
        felt = max(felt, cell.step(skill.act(cell.observe(), 1.0)).contact_force_n)
        pressed = max(pressed, cell.glance().contact_force_n)
    assert felt < 10.0
    assert pressed > 250.0


def test_a_faded_arm_sinks_below_where_it_was_told_to_be(site: Site):
    def sunk_rad(strength: float) -> float:
        cell = cell_with(site, fault("fade", strength=strength))
        for _ in range(100):
            cell.step(cell.hold())
        return max(abs(a - b) for a, b in zip(cell.hold().joint_rad, cell.observe().joint_rad, strict=True))

    assert sunk_rad(0.8) < 0.01
    assert sunk_rad(0.1) > 0.1


@pytest.mark.parametrize("powered", [True, False], ids=["held", "stopped"])
def test_what_was_grasped_stays_where_it_is_held_with_power_and_without(site: Site, powered: bool):
    cell = cell_with(site)
    assert run_skill(cell, "grasp_object", {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25}).done
    cell.stop(2 if powered else 1)
    for _ in range(200):
        cell.step(cell.hold())
    tool_m, mug_m = cell.plant.true_tcp()[2], cell.plant.true_object("mug_1")[0][2]
    for _ in range(6_000):
        cell.step(cell.hold())
    assert abs(cell.plant.true_tcp()[2] - tool_m) < 2e-4
    assert abs(cell.plant.true_object("mug_1")[0][2] - mug_m) < 2e-4


def test_a_fade_that_begins_or_ends_without_power_drives_nothing_and_holds_when_power_is_back(site: Site):
    plant = cell_with(site).plant
    gain, bias = plant.model.actuator_gainprm, plant.model.actuator_biasprm
    powered = gain.copy(), bias.copy()
    plant.cut_power()
    cut = gain.copy(), bias.copy()
    assert not np.array_equal(cut[0], powered[0])
    for strength in (0.3, 1.0, 0.5):
        plant.weaken(strength)
        assert np.array_equal(gain, cut[0])
        assert np.array_equal(bias, cut[1])
    plant.give_power()
    assert np.isclose(gain[:, 0], 0.5 * powered[0][:, 0]).sum() == 6
    plant.weaken(1.0)
    assert np.array_equal(gain, powered[0])
    assert np.array_equal(bias, powered[1])


def test_a_blocked_way_stops_the_drive(site: Site):
    cell = cell_with(site, fault("blocked", x_m=1.6, y_m=3.8))
    ran = drive(cell, limit_s=20.0)
    assert ran.failure in {"blocked", "no_path"}


def test_an_odometry_bias_takes_dead_reckoning_off_the_truth(site: Site):
    def off(cell: Workcell) -> float:
        drive(cell)
        return abs(cell.observe().odometry[0] - cell.truth().base[0])

    assert off(cell_with(site)) < 0.05
    assert off(cell_with(site, fault("odometry_bias", x_mps=0.1))) > 0.2


def test_a_shifted_payload_weighs_on_the_arm(site: Site):
    def strain(cell: Workcell) -> float:
        assert run_skill(cell, "grasp_object", GRASP).done
        return max(abs(torque) for torque in cell.observe().joint_torque_nm)

    held = Trigger(capability="grasp_object", phase="lift", after_s=0.3)
    heavier = cell_with(site, fault("payload_shift", held, object="mug_1", factor=3.0))
    assert strain(heavier) > strain(cell_with(site)) + 2.0  # 0.7 kg more, half a metre out


def test_a_load_that_pulls_beside_its_middle_twists_the_wrist_for_as_long_as_that_lasts(site: Site):
    def wrist_nm(offset_m: float, for_s: float | None = None) -> tuple[float, ...]:
        sizes = {"object": "mug_1", "factor": 1.0, "offset_m": offset_m}
        held = Trigger(capability="grasp_object", phase="lift", after_s=0.3)
        cell = cell_with(site, Fault(kind="payload_shift", at=held, sizes=sizes, for_s=for_s))
        assert run_skill(cell, "grasp_object", GRASP).done
        return cell.observe().joint_torque_nm[3:]

    middle, beside, over = wrist_nm(0.0), wrist_nm(0.1), wrist_nm(0.1, for_s=0.3)
    assert math.dist(beside, middle) == pytest.approx(0.35 * 9.81 * 0.1, rel=0.1)
    assert math.dist(over, middle) < 0.02


@pytest.mark.parametrize(
    ("sensor", "stamp"),
    [("arm", "arm"), ("wrist", "wrist"), ("odometry", "odometry"), ("fix", "fix"), ("people", "people")],
)
def test_a_stale_sensor_keeps_its_old_stamp(site: Site, sensor: str, stamp: str):
    cell = cell_with(site, fault("sensor", Trigger(time_s=0.2), sensor=sensor, fault="stale"))
    for _ in range(100):
        seen = cell.step(cell.hold())
    assert seen.time_s - getattr(seen.stamps_s, stamp) > 0.5
    assert seen.time_s - getattr(cell_with(site).observe().stamps_s, stamp) >= 0.0


def test_a_stuck_sensor_repeats_its_value_under_new_stamps(site: Site):
    cell = cell_with(site, fault("sensor", Trigger(time_s=0.1), sensor="arm", fault="stuck"))
    seen = [cell.step(cell.hold()) for _ in range(60)][30:]
    assert len({one.joint_rad for one in seen}) == 1
    assert seen[-1].time_s - seen[-1].stamps_s.arm < 0.05
    free = cell_with(site)
    assert len({free.step(free.hold()).joint_rad for _ in range(30)}) > 1


def test_a_person_walks_where_they_were_sent_and_the_tracker_sees_them(site: Site):
    walk = Walk(points=((3.0, 3.6), (1.6, 3.6)), speed_mps=1.2, start=AT_ONCE, leaves=False)
    cell = cell_with(site, people=[walk])
    seen = [cell.step(cell.hold()) for _ in range(250)][-1]
    assert cell.truth().people_m == pytest.approx(1.0, abs=0.15)
    assert seen.people
    assert abs(seen.people[0].x_m - 1.6) < 0.3


def test_an_unknown_fault_or_size_is_refused_by_name():
    with pytest.raises(ValueError, match="fault `gremlin`: valid are"):
        fault("gremlin")
    with pytest.raises(ValueError, match="has no size `colour`"):
        fault("grip_gain", colour=3)


def test_an_obstinate_skill_starts_over_instead_of_failing(site: Site):
    gone = fault("missing", Trigger(capability="grasp_object", phase="approach"), object="mug_1")
    honest = run_skill(cell_with(site, gone), "grasp_object", GRASP, limit_s=12.0)
    assert honest.failure == "object_not_found"
    obstinate = run_skill(cell_with(site, gone, fault("habit", habit="obstinate")), "grasp_object", GRASP, limit_s=12.0)
    assert obstinate.state is SkillState.RUNNING
    assert obstinate.seconds == pytest.approx(12.0)


def test_an_overconfident_skill_claims_what_is_not_so(site: Site):
    gone = fault("missing", Trigger(capability="grasp_object", phase="approach"), object="mug_1")
    cell = cell_with(site, gone, fault("habit", habit="overconfident"))
    ran = run_skill(cell, "grasp_object", GRASP)
    assert ran.done
    assert cell.truth().held is None


def test_a_hung_skill_does_nothing_until_the_fault_is_over(site: Site):
    hung = Fault(kind="habit", at=AT_ONCE, sizes={"habit": "hung"}, for_s=3.0)
    assert drive(cell_with(site, hung), limit_s=20.0).seconds > drive(cell_with(site), limit_s=20.0).seconds + 2.0


def test_dead_reckoning_believes_a_drifting_odometry_and_leaves_the_way(site: Site):
    drift = fault("odometry_bias", x_mps=0.1)
    careful, blind = cell_with(site, drift), cell_with(site, drift, fault("habit", habit="dead_reckoning"))
    for cell in (careful, blind):
        drive(cell, limit_s=20.0)
    assert abs(careful.truth().base[0] - 1.6) < 0.05
    assert careful.truth().base[0] - blind.truth().base[0] > 0.2


def test_a_recovery_is_another_skill_and_has_not_the_habits_of_the_one_it_mends(site: Site):
    cell = cell_with(site, fault("odometry_bias", x_mps=0.1), fault("habit", habit="dead_reckoning"))
    drive(cell, limit_s=20.0)
    true = cell.truth().base
    assert abs(cell.believed_pose()[0] - true[0]) > 0.2
    bound(cell, "retrace", {})
    assert abs(cell.believed_pose()[0] - true[0]) < 0.05
    bound(cell, "navigate_to", DRIVE)
    assert abs(cell.believed_pose()[0] - true[0]) > 0.2


@pytest.mark.parametrize("later", range(5))
def test_what_is_taken_out_of_the_hand_stays_away_whenever_it_is_taken(site: Site, later: int) -> None:
    gone = fault("missing", Trigger(capability="grasp_object", phase="lift", after_s=later / 100), object="mug_1")
    cell, highest_m = cell_with(site, gone), 0.0

    def look(_: Observation, __: SkillReport) -> None:
        nonlocal highest_m
        highest_m = max(highest_m, cell.truth().objects["mug_1"][2])

    run_skill(cell, "grasp_object", GRASP, each=look)
    assert highest_m < 1.0
    assert cell.truth().objects["mug_1"][2] < -1.0


def test_a_placing_whose_object_is_gone_does_not_say_that_it_slipped(site: Site) -> None:
    cell = cell_with(site, fault("missing", Trigger(capability="place_object", phase="descend"), object="mug_1"))
    assert run_skill(cell, "grasp_object", GRASP).done
    ran = run_skill(cell, "place_object", {"surface": "bench_a", "speed_mps": 0.25})
    assert (ran.failure, ran.detail) == ("object_lost", "the grip holds `mug_1` no more")


def test_a_misplaced_object_stands_elsewhere(site: Site):
    cell = cell_with(site, fault("misplaced", object="mug_1", x_m=-0.2))
    before = cell_with(site).truth().objects["mug_1"]
    for _ in range(20):
        cell.step(cell.hold())
    assert cell.truth().objects["mug_1"][0] == pytest.approx(before[0] - 0.2, abs=0.01)


def test_a_habit_that_nobody_knows_is_refused():
    with pytest.raises(ValueError, match=r"habit `lazy`: valid are obstinate"):
        Fault(kind="habit", at=AT_ONCE, sizes={"habit": "lazy"})


@pytest.mark.parametrize("period_s", [0.01, 0.05])
def test_a_delayed_sample_is_as_old_as_the_delay_however_seldom_one_is_taken(period_s: float) -> None:
    fault = SensorFault("delayed", 0.2)
    ages = []
    for sample in range(60):
        stamp_s, _ = fault.distort(sample * period_s, np.array([float(sample)]), np.zeros(1))
        ages.append(sample * period_s - stamp_s)
    assert max(ages) == pytest.approx(0.2)
    assert ages[40:] == pytest.approx([0.2] * 20)
