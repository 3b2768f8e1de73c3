"""The workcell as a substrate: locked without a permit, the same for a seed, exact to restore, stopped when stopped."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from app.cell.substrate import SubstrateError
from app.governance.model import Command, Observation, Site, SkillState
from app.sim.faults import Scenario
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.sensors import Quality
from app.sim.trial import grant_for, run_skill
from app.sim.workcell import Workcell, make_workcell

pytestmark = pytest.mark.physics

DRIVE = {"x_m": 1.6, "y_m": 4.2, "yaw_rad": 1.57, "speed_mps": 0.3, "clearance_m": 0.1}
GO = (0.3, 0.0, 0.0)


def cell_of(site: Site, seed: int = 0) -> Workcell:
    return make_workcell(site, cell_id="cell", seed=seed)


def pushing(cell: Workcell) -> Command:
    return cell.hold()._replace(base_velocity=GO)


def test_nothing_moves_without_a_bound_permit(site: Site):
    cell = cell_of(site)
    before = cell.truth().base
    for _ in range(50):
        cell.step(pushing(cell))
    assert cell.truth().base == pytest.approx(before, abs=0.002)


def test_an_unbound_cell_is_locked_again(site: Site):
    cell = cell_of(site)
    cell.bind(grant_for("cell", "navigate_to", DRIVE), "navigate_to", DRIVE)
    for _ in range(30):
        cell.step(pushing(cell))
    assert cell.truth().base_speed_mps > 0.1
    cell.unbind()
    for _ in range(100):
        cell.step(pushing(cell))
    assert cell.truth().base_speed_mps < 0.01


def test_a_permit_for_another_cell_binds_nothing(site: Site):
    cell = cell_of(site)
    with pytest.raises(SubstrateError, match="cell"):
        cell.bind(grant_for("elsewhere", "navigate_to", DRIVE), "navigate_to", DRIVE)


def test_a_permit_binds_only_what_it_covers(site: Site):
    cell = cell_of(site)
    grant = grant_for("cell", "navigate_to", DRIVE)
    with pytest.raises(SubstrateError):
        cell.bind(grant, "grasp_object", {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.2})
    with pytest.raises(SubstrateError):
        cell.bind(grant, "navigate_to", {**DRIVE, "speed_mps": 1.5})


def test_the_same_seed_gives_the_same_world_and_another_does_not(site: Site):
    def walk(seed: int) -> tuple[object, ...]:
        cell = cell_of(site, seed)
        run_skill(cell, "navigate_to", DRIVE, limit_s=2.0)
        return (cell.truth().base, cell.observe())

    assert walk(3) == walk(3)
    assert walk(3) != walk(4)


def test_a_restored_snapshot_goes_on_bit_for_bit(site: Site):
    cell = cell_of(site)
    run_skill(cell, "navigate_to", DRIVE, limit_s=1.0)
    state = cell.snapshot()

    def play() -> list[object]:
        return [(cell.step(cell.hold()), cell.truth()) for _ in range(60)]

    first = play()
    cell.restore(state)
    assert play() == first


def test_a_snapshot_goes_on_bit_for_bit_after_what_was_awake_in_it_fell_asleep(site: Site):
    def asleep() -> int:
        return int((cell.plant.data.tree_asleep >= 0).sum())

    def play() -> list[object]:
        return [(cell.step(cell.hold()), cell.truth()) for _ in range(60)]

    cell = cell_of(site)
    run_skill(cell, "grasp_object", {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25}, limit_s=4.0)
    state, before = cell.snapshot(), asleep()
    first = play()
    run_skill(cell, "safe_retreat", {})
    assert asleep() > before
    cell.restore(state)
    assert play() == first


def test_a_snapshot_goes_on_bit_for_bit_in_another_cell_where_nothing_sleeps_yet(site: Site):
    cell, other = cell_of(site), cell_of(site)
    run_skill(cell, "navigate_to", DRIVE, limit_s=3.0)
    assert (cell.plant.data.tree_asleep >= 0).any()
    other.restore(cell.snapshot())
    assert not (other.plant.data.tree_asleep >= 0).any()
    for _ in range(60):
        assert cell.step(pushing(cell)) == other.step(pushing(other))
        assert cell.truth() == other.truth()
    assert (other.plant.data.tree_asleep >= 0).any()


def test_an_emergency_stop_ends_motion_and_a_reset_starts_none(site: Site):
    cell = cell_of(site)
    cell.bind(grant_for("cell", "navigate_to", DRIVE), "navigate_to", DRIVE)
    for _ in range(40):
        cell.step(pushing(cell))
    cell.stop(0)
    for _ in range(50):
        cell.step(pushing(cell))
    stood = cell.truth().base
    assert cell.truth().base_speed_mps < 0.01
    cell.unbind()
    cell.reset()
    for _ in range(50):
        cell.step(pushing(cell))
    assert cell.truth().base == pytest.approx(stood, abs=0.003)


def test_a_skill_keeps_still_at_rate_zero_and_then_goes_on_to_the_same_place(site: Site):
    cell = cell_of(site)
    moving: list[float] = []

    def hold_a_while(seen, report) -> float:
        moving.append(cell.truth().base_speed_mps)
        return 0.0 if 60 <= len(moving) < 160 else 1.0

    ran = run_skill(cell, "navigate_to", DRIVE, each=hold_a_while)
    assert ran.state is SkillState.SUCCEEDED
    assert max(moving[110:160]) < 0.02
    assert cell.truth().base[1] == pytest.approx(DRIVE["y_m"], abs=0.05)


def test_facts_come_from_sensors_and_say_what_is_held(site: Site):
    cell = cell_of(site)
    before = cell.facts()
    assert before.gripper_empty
    assert before.objects["mug_1"].visible
    assert before.objects["mug_1"].reachable
    assert not ("box_1" in before.objects and before.objects["box_1"].reachable)
    truth = cell.truth().objects["mug_1"]
    assert before.objects["mug_1"].x_m == pytest.approx(truth[0], abs=0.03)
    assert (before.objects["mug_1"].x_m, before.objects["mug_1"].y_m) != truth[:2]
    assert run_skill(cell, "grasp_object", {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25}).done
    after = cell.facts()
    assert (after.holding, after.gripper_empty) == ("mug_1", False)


def test_the_scene_and_the_poses_name_the_same_bodies(site: Site):
    cell = cell_of(site)
    bodies = cell.scene()["bodies"]
    assert {"mug_1", "glass_1", "box_1"} <= set(bodies)
    pack = cell.poses()
    poses = np.frombuffer(pack(), "<f4").reshape(len(bodies), 7)
    x, y, _ = cell.truth().objects["mug_1"]
    assert poses[bodies.index("mug_1"), :2] == pytest.approx((x, y), abs=1e-3)
    assert np.linalg.norm(poses[:, 3:], axis=1) == pytest.approx(1.0, abs=1e-5)
    run_skill(cell, "navigate_to", {"target": "dock", "speed_mps": 0.6})
    assert pack() == poses.tobytes()  # a copy of its own moment


def test_what_may_be_anywhere_is_loose_and_neither_the_robot_nor_a_person_is(site: Site):
    cell = Workcell(site, people=[Walk(points=((1.0, 1.0), (2.0, 1.0)))])
    scene = cell.scene()
    assert any(name.startswith("person_") for name in scene["bodies"])
    assert {"crate_1", *site.objects} == set(scene["loose"])


def test_a_drive_shows_the_way_it_is_planned_to_go(site: Site):
    cell = cell_of(site)
    assert cell.way() == ()
    dock = site.targets["dock"]
    params = {"target": "dock", "speed_mps": 0.6}
    cell.bind(grant_for(cell.id, "navigate_to", params), "navigate_to", params).act(cell.observe(), 1.0)
    assert cell.way()[-1] == pytest.approx((dock.x_m, dock.y_m))
    cell.unbind()
    assert cell.way() == ()


def test_a_robot_model_without_the_needed_joints_is_refused(site: Site, tmp_path):
    model = tmp_path / "robot.xml"
    model.write_text("<mujoco><worldbody><body name='box'><geom size='0.1'/></body></worldbody></mujoco>")
    with pytest.raises(ValueError, match="joint"):
        make_workcell(site, cell_id="cell", robot_mjcf=model)


def test_truth_is_a_value_of_its_own(site: Site):
    truth = cell_of(site).truth()
    assert truth.held is None
    assert truth.people_m == 99.0
    assert dataclasses.is_dataclass(truth) or truth._fields


def test_noise_free_sensors_say_what_is_true(site: Site):
    cell = make_workcell(site, cell_id="cell", seed=3, quality=Quality(noise=0.0))
    for _ in range(20):
        seen = cell.step(cell.hold())
    assert run_skill(cell, "navigate_to", {"x_m": 1.6, "y_m": 3.8, "yaw_rad": 1.57, "speed_mps": 0.3}).done
    seen, truth = cell.observe(), cell.truth()
    assert seen.odometry == pytest.approx(truth.base, abs=1e-3)
    assert seen.tcp_speed_mps == pytest.approx(truth.tcp_speed_mps, abs=1e-9)
    fixes = [fix for _ in range(10) if (fix := cell.step(cell.hold()).fix)]
    assert [(fix.x_m, fix.y_m) for fix in fixes] == [pytest.approx(truth.base[:2], abs=1e-4)] * 2


def test_noise_scales_what_the_sensors_say_and_nothing_else(site: Site):
    def spread(noise: float) -> float:
        cell = make_workcell(site, cell_id="cell", seed=3, quality=Quality(noise=noise))
        speeds = [cell.step(cell.hold()).joint_speed_radps[0] for _ in range(200)]
        return float(np.std(speeds))

    assert spread(0.0) < 1e-6
    assert spread(3.0) == pytest.approx(3.0 * spread(1.0), rel=0.01)


def test_a_noise_free_tracker_still_misses_people_and_is_late_as_configured(site: Site):
    walk = Walk(points=((3.0, 3.6), (1.6, 3.6)), speed_mps=1.2, start=Trigger(time_s=0.0), leaves=False)

    def lag(quality: Quality) -> list[float]:
        cell = make_workcell(site, cell_id="cell", scenario=Scenario(people=(walk,)), quality=quality)
        return [seen.time_s - seen.people[0].stamp_s for _ in range(200) if (seen := cell.step(cell.hold())).people]

    assert max(lag(Quality(noise=0.0, dropout=0.0, people_delay_ticks=2))) == pytest.approx(0.06)
    assert max(lag(Quality(noise=0.0, dropout=0.0, people_delay_ticks=20))) == pytest.approx(0.24)
    assert max(lag(Quality(noise=0.0, dropout=0.5, people_delay_ticks=2))) > 0.1
    assert lag(Quality(noise=0.0, dropout=1.0)) == []


@pytest.mark.parametrize("wrong", [{"noise": -1.0}, {"noise": float("nan")}, {"dropout": 1.5}, {"fix_delay_ticks": -1}])
def test_sensors_that_cannot_be_are_refused(wrong: dict[str, float]):
    with pytest.raises(ValueError, match=f"{next(iter(wrong.values()))}"):
        Quality(**wrong)


def test_a_run_that_begins_anew_depends_on_its_own_seed_alone(site: Site):
    cell = make_workcell(site, cell_id="again", seed=1, people=1)
    ready = cell.snapshot()

    def run(seed: int) -> tuple[Observation, ...]:
        cell.restore(ready)
        cell.begin(seed, Scenario(people=(Walk(points=((1.0, 1.0), (1.0, 3.0))),)))
        return tuple(cell.step(cell.hold()) for _ in range(20))

    first, other, again = run(5), run(6), run(5)
    assert repr(first) == repr(again)
    assert repr(first) != repr(other)


def test_a_run_cannot_begin_with_more_people_than_there_are_figures(site: Site):
    cell = make_workcell(site, cell_id="again", seed=1)
    with pytest.raises(ValueError, match="`1` people in a world built for 0"):
        cell.begin(1, Scenario(people=(Walk(points=((1.0, 1.0),)),)))


def test_what_is_held_is_felt_and_not_what_it_passes_over(site: Site):
    cell = make_workcell(site, cell_id="over", seed=3)
    assert run_skill(cell, "grasp_object", {"object_id": "driver_1", "force_n": 40.0, "speed_mps": 0.25}).done
    x, y, z = cell.truth().objects["driver_1"]
    cell.plant.place_object("glass_1", x, y, z - 0.1)
    seen = cell.step(cell.hold())
    assert seen.slip_m < 0.01
