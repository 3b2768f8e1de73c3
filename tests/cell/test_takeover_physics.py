"""A human at the controls of the simulated workcell, under the shipped policy; the test plays kernel and console."""

from __future__ import annotations

from itertools import groupby, pairwise
from math import cos, dist, hypot, sin
from pathlib import Path

import pytest

from app.governance.model import Authorization, Json, Mode, Vec3, Wish
from app.governance.permit import mint
from app.protocol import CHANNELS, HAND, ROW
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from app.sim.people import Walk
from tests.cell.rig import KEY, NOW_S
from tests.cell.workshop import Workshop

pytestmark = pytest.mark.physics

DRIVE = {"target": "dock", "speed_mps": 0.3, "clearance_m": 0.3}
GRASP = {"object_id": "mug_1", "force_n": 40.0, "speed_mps": 0.25}
LIMITS: dict[str, Json] = {"tcp_speed_mps": 0.25, "base_speed_mps": 0.3, "grip_force_n": 20.0}
STOPS_WITHIN = 16  # ticks: 100 ms until a command expires, 50 ms down to nothing, and the tick it is heard in


class Console:
    """A hand on the keys: every command is said anew each 50 ms, as a console does."""

    def __init__(self, shop: Workshop, invocation: str = "inv-1", lease: str = "lease") -> None:
        self.shop, self.invocation, self.lease, self.number = shop, invocation, lease, 0
        self.fastest_base, self.fastest_tool = 0.0, 0.0

    def say(self, wish: Wish) -> str | None:
        self.number += 1
        return self.shop.runner.jog(self.invocation, self.lease, self.number, wish, "operator")

    def hold(self, wish: Wish, ticks: int) -> str | None:
        """Hold a key for so long; return the last refusal."""
        why = None
        for tick in range(ticks):
            if tick % 5 == 0:
                why = self.say(wish)
            self.tick()
        return why

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.shop.runner.tick()
            truth = self.shop.cell.glance()
            self.fastest_base = max(self.fastest_base, truth.base_speed_mps)
            self.fastest_tool = max(self.fastest_tool, truth.tcp_speed_mps)

    def release(self) -> None:
        self.say(Wish())

    def press(self, wish: Wish, ticks: int) -> str | None:
        self.release()
        return self.hold(wish, ticks)


def permit(shop: Workshop, capability: str, number: int, invocation: int = 1, **params: Json) -> Authorization:
    return Authorization(
        id=f"auth-{number}",
        invocation=f"inv-{invocation}",
        cell=shop.cell.id,
        capability=capability,
        version="1.0.0",
        params=params,
        mode=Mode.NORMAL,
        profile=shop.profile,
        policy_digest=shop.policy.digest,
        issued_at_s=NOW_S,
        expires_at_s=NOW_S + 30.0,
    )


def take_over(shop: Workshop, number: int = 2) -> Console:
    """Take the controls of the running session, and wait until they are in hand."""
    assert shop.runner.launch(mint(permit(shop, "takeover", number, **LIMITS), KEY)) is None, shop.story()
    console = Console(shop)
    for _ in range(200):
        if console.press(Wish(), 1) is None and console.say(Wish(grip="open")) is None:
            break
        shop.runner.tick()
    console.release()
    return console


def idle(folder: Path, **options: object) -> tuple[Workshop, Console]:
    shop = Workshop(folder, **options)  # type: ignore[arg-type]
    shop.launch("takeover", **LIMITS)
    console = Console(shop)
    console.release()
    return shop, console


def over(shop: Workshop, console: Console, thing: str) -> None:
    """Lead the tool over a thing."""
    for _ in range(400):
        truth = shop.cell.truth()
        x, y, z = truth.objects[thing]
        left, ahead, up = truth.tcp_m[0] - x, y - truth.tcp_m[1], z + 0.15 - truth.tcp_m[2]
        if max(map(abs, (left, ahead, up))) < 0.004:  # the base looks along y
            return
        console.hold(Wish(tool=(2.0 * ahead, 2.0 * left, 2.0 * up)), 5)
    raise AssertionError(shop.story())


def refused(shop: Workshop) -> str:
    jogged = shop.runner.view().jogged
    assert jogged is not None
    return jogged[1]


def test_a_hand_moves_the_base_and_stays_below_the_limit(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    x, y, _ = shop.cell.truth().base
    assert console.hold(Wish(base=(-1.0, 0.0, 0.0)), 200) is None, shop.story()
    there = shop.cell.truth().base
    assert 0.3 < hypot(there[0] - x, there[1] - y) < 0.6
    assert 0.2 < console.fastest_base <= 0.3 * 1.05
    assert shop.rules() == []


def test_a_hand_moves_the_tool_straight_and_stays_below_the_limit(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    before = shop.cell.observe().tcp_m
    assert console.hold(Wish(tool=(0.0, 0.0, 5.0)), 60) is None
    after = shop.cell.observe().tcp_m
    assert after[2] - before[2] > 0.06, (before, after)
    assert hypot(after[0] - before[0], after[1] - before[1]) < 0.01
    assert 0.15 < console.fastest_tool <= 0.25 * 1.05
    assert shop.rules() == []


def test_a_hand_that_is_slow_moves_the_tool_as_slowly(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    before = shop.cell.truth().tcp_m
    assert console.hold(Wish(tool=(0.0, 0.0, 0.01)), 100) is None
    assert shop.cell.truth().tcp_m[2] - before[2] == pytest.approx(0.0085, abs=0.001)  # the rate ramps up first


def test_a_hand_that_has_met_something_leads_the_tool_off_it_and_not_onto_it_again(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    console.hold(Wish(tool=(0.25, 0.0, 0.0)), 60)
    console.press(Wish(tool=(0.0, 0.0, -0.25)), 400)  # onto what lies on the bench
    assert refused(shop) == "grip-force"
    console.release()
    console.tick(60)
    met_m, pressing_n = shop.cell.truth().tcp_m[2], []
    for _ in range(8):
        assert console.press(Wish(tool=(0.0, 0.0, 0.1)), 5) is None
        pressing_n.append(shop.cell.truth().contact_force_n)
    assert max(pressing_n) < 5.0
    assert shop.cell.truth().tcp_m[2] > met_m + 0.005


@pytest.mark.parametrize("aside", [0.0, 0.25])
@pytest.mark.parametrize(("profile", "most_n", "out"), [("human-shared", 100.0, 60), ("real-restricted", 150.0, 25)])
def test_a_hand_that_comes_down_on_a_bench_at_full_speed_presses_no_harder_than_it_may(
    tmp_path: Path, profile: str, most_n: float, out: int, aside: float
) -> None:
    shop, console = idle(tmp_path, profile=profile)
    console.hold(Wish(tool=(1.0, 0.0, 0.0)), out)
    console.release()
    down, pressing_n = Wish(tool=(aside, aside, -2.0)), [0.0]
    for tick in range(400):
        if tick % 5 == 0:
            console.say(down)
        console.tick()
        pressing_n.append(shop.cell.glance().contact_force_n)
    assert refused(shop) in ("grip-force", "contact-force"), shop.story()
    assert 10.0 < max(pressing_n) < most_n, max(pressing_n)


@pytest.mark.parametrize(("profile", "most_n"), [("human-shared", 100.0), ("real-restricted", 150.0)])
@pytest.mark.parametrize("height_m", [0.68, 0.74])
def test_a_hand_that_the_base_takes_against_a_bench_presses_no_harder_than_it_may(
    tmp_path: Path, profile: str, most_n: float, height_m: float
) -> None:
    shop, console = idle(tmp_path, profile=profile)
    console.hold(Wish(base=(-0.3, 0.0, 0.0)), 150)
    console.press(Wish(tool=(0.25, 0.0, 0.0)), 100)
    while shop.cell.observe().tcp_m[2] > height_m:
        console.hold(Wish(tool=(0.0, 0.0, -0.1)), 5)
    pressing_n = [0.0]
    console.release()
    for tick in range(700):
        if tick % 5 == 0:
            console.say(Wish(base=(1.0, 0.0, 0.0)))
        console.tick()
        pressing_n.append(shop.cell.glance().contact_force_n)
    assert 10.0 < max(pressing_n) < most_n, max(pressing_n)


@pytest.mark.parametrize(("profile", "most_n"), [("human-shared", 100.0), ("real-restricted", 150.0)])
@pytest.mark.parametrize("thing", ["mug_1", "glass_1", "driver_1"])
def test_a_hand_that_comes_down_on_a_thing_at_full_speed_presses_no_harder_than_it_may(
    tmp_path: Path, profile: str, most_n: float, thing: str
) -> None:
    shop, console = idle(tmp_path, profile=profile)
    console.press(Wish(grip="close"), 100)
    over(shop, console, thing)
    pressing_n = [0.0]
    console.release()
    for tick in range(400):
        if tick % 5 == 0:
            console.say(Wish(tool=(0.0, 0.0, -2.0)))
        console.tick()
        pressing_n.append(shop.cell.glance().contact_force_n)
    assert 10.0 < max(pressing_n) < most_n, max(pressing_n)


@pytest.mark.parametrize("ahead", [Wish(base=(1.0, 0.0, 0.0)), Wish(base=(1.0, 0.5, 0.0))])
def test_a_base_comes_as_near_to_a_bench_as_a_planned_way_does_and_can_be_led_along_it(
    tmp_path: Path, ahead: Wish
) -> None:
    shop, console = idle(tmp_path, profile="real-restricted")
    console.hold(Wish(base=(-0.5, 0.0, 0.0)), 150)
    x, _, _ = shop.cell.truth().base
    bench = shop.policy.site.surfaces["bench_a"]
    console.release()
    nearest_m = 9.0
    for tick in range(400):
        if tick % 5 == 0:
            console.say(ahead)
        console.tick()
        nearest_m = min(nearest_m, bench.y_m - bench.half_y_m - shop.cell.truth().base[1])
    assert 0.42 < nearest_m < 0.46
    assert refused(shop) == ("blocked" if ahead.base[1] == 0.0 else "")
    assert (abs(shop.cell.truth().base[0] - x) > 0.3) is (ahead.base[1] != 0.0)
    assert shop.rules() == []


@pytest.mark.parametrize("wish", [Wish(base=(-1.0, 0.0, 0.0)), Wish(tool=(0.0, 0.0, 1.0)), Wish(base=(0.0, 0.0, 1.0))])
def test_a_command_that_is_not_said_again_expires_and_everything_stands(tmp_path: Path, wish: Wish) -> None:
    shop, console = idle(tmp_path)
    console.hold(wish, 80)
    console.say(wish)
    console.tick(STOPS_WITHIN)
    held = shop.runner.session
    assert held is not None
    assert held.run.previous.base_velocity == (0.0, 0.0, 0.0)
    assert held.run.previous.joint_speed_radps == (0.0,) * 6
    console.tick(10)
    assert shop.cell.truth().base_speed_mps < 0.02
    assert shop.cell.truth().tcp_speed_mps < 0.02


@pytest.mark.parametrize(("gap", "why"), [(20, None), (40, "release_first")], ids=["a stutter", "a silence"])
def test_what_a_link_held_back_starts_nothing_once_everything_stands(tmp_path: Path, gap: int, why: str | None) -> None:
    """A key is held all the while; the link falls silent for so many ticks, and goes on with what it held back."""
    shop, console = idle(tmp_path)
    ahead = Wish(base=(-0.3, 0.0, 0.0))
    assert console.hold(ahead, 80) is None
    console.tick(gap)
    assert console.hold(ahead, 40) == why
    assert (shop.cell.truth().base_speed_mps > 0.1) is (why is None)
    assert console.press(ahead, 40) is None
    assert shop.cell.truth().base_speed_mps > 0.1


def test_a_hand_that_wanted_nothing_may_be_silent_for_long(tmp_path: Path) -> None:
    _, console = idle(tmp_path)
    console.release()
    console.tick(100)
    assert console.hold(Wish(base=(-0.3, 0.0, 0.0)), 20) is None


def test_letting_go_counts_at_once(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    console.hold(Wish(base=(-1.0, 0.0, 0.0), tool=(0.0, 0.0, 1.0)), 100)
    console.release()
    console.tick(6)
    held = shop.runner.session
    assert held is not None
    assert held.run.previous.base_velocity == (0.0, 0.0, 0.0)
    assert held.run.previous.joint_speed_radps == (0.0,) * 6


def test_a_hand_grasps_what_is_there_and_the_robot_knows_it(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **GRASP)
    while shop.runner.session is not None and shop.runner.session.run.skill.report().phase != "descend":
        shop.runner.tick()
    console = take_over(shop)
    for _ in range(400):
        if shop.cell.observe().tcp_m[2] < shop.cell.facts().objects["mug_1"].z_m:
            break
        console.hold(Wish(tool=(0.0, 0.0, -0.05)), 5)
    console.press(Wish(grip="close"), 150)
    assert shop.cell.observe().pads_loaded, shop.story()
    assert shop.cell.facts().holding == "mug_1"
    console.press(Wish(tool=(0.0, 0.0, 0.1)), 100)
    assert shop.cell.truth().held == "mug_1"
    assert shop.cell.observe().grip_force_n < 20.0 * 1.05
    console.press(Wish(grip="open"), 150)
    assert shop.cell.facts().holding is None


def test_what_stood_between_the_fingers_does_so_again_when_a_shut_hand_goes_back(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **{**GRASP, "object_id": "glass_1"})
    while shop.runner.session is not None and shop.runner.session.run.skill.report().phase != "close":
        shop.runner.tick()
    console = take_over(shop)
    console.hold(Wish(tool=(0.0, 0.0, 0.25)), 100)  # off the glass
    console.press(Wish(grip="close"), 150)
    assert shop.cell.observe().grip_width_m < 0.01
    assert shop.runner.human("inv-1", "rollback", "operator") is None
    hardest_n = 0.0
    while shop.runner.invocation is not None and shop.runner.status != "escalated":
        shop.runner.tick()
        hardest_n = max(hardest_n, shop.cell.glance().contact_force_n)
    assert shop.last("outcome")["outcome"] == "rolled_back"
    assert hardest_n < 5.0
    assert shop.cell.truth().upright["glass_1"]


def test_a_hand_keeps_what_its_pads_miss_for_a_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **GRASP)
    while shop.runner.session is not None:
        shop.runner.tick()
    shop.launch("takeover", 2, **LIMITS)
    console = Console(shop, "inv-2")
    console.release()
    console.tick(20)
    step = shop.cell.step
    with monkeypatch.context() as missing:
        missing.setattr(shop.cell, "step", lambda command: step(command)._replace(pads_loaded=False))
        console.tick()
    console.tick(100)
    assert (shop.cell.truth().held, shop.cell.facts().holding) == ("mug_1", "mug_1")
    assert shop.cell.observe().grip_force_n > 15.0


def test_a_thing_gripped_anew_in_another_place_has_not_slipped(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **GRASP)
    while shop.runner.session is not None:
        shop.runner.tick()
    assert shop.cell.facts().holding == "mug_1"
    shop.launch("takeover", 2, **LIMITS)
    console = Console(shop, "inv-2")
    console.release()
    for _ in range(400):
        if shop.cell.observe().contact_force_n > 12.0:
            break
        console.hold(Wish(tool=(0.0, 0.0, -0.05)), 5)
    console.press(Wish(grip="open"), 150)
    assert shop.cell.facts().holding is None
    assert shop.cell.observe().slip_m < 0.002
    low = shop.cell.observe().tcp_m[2]
    for _ in range(400):
        if shop.cell.observe().tcp_m[2] > low + 0.035:
            break
        console.hold(Wish(tool=(0.0, 0.0, 0.05)), 5)
    console.press(Wish(grip="close"), 200)
    assert shop.cell.facts().holding == "mug_1"
    assert shop.cell.observe().slip_m < 0.005


def test_a_zone_stops_the_hand_and_lets_it_lead_out(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    zone = shop.policy.site.zones["press_area"]
    cx = sum(x for x, _ in zone.polygon) / len(zone.polygon)
    cy = sum(y for _, y in zone.polygon) / len(zone.polygon)
    for _ in range(900):
        x, y, yaw = shop.cell.truth().base
        dx, dy = cx - x, cy - y
        wish = Wish(base=(dx * cos(yaw) + dy * sin(yaw), -dx * sin(yaw) + dy * cos(yaw), 0.0))
        console.hold(wish, 5)
        if refused(shop):
            break
    assert refused(shop) == "zone", (refused(shop), shop.story())
    console.hold(wish, 50)
    assert shop.runner.status == "paused"
    assert shop.cell.truth().base_speed_mps < 0.02
    assert shop.last("intervention")["rule"] == "zone"
    away = Wish(base=(-wish.base[0], -wish.base[1], 0.0))
    assert console.press(away, 60) is None, shop.story()
    assert shop.runner.status == "running"
    assert shop.strategies() == []


def test_somebody_too_near_stops_the_hand_and_a_key_still_held_does_not_start_it_again(tmp_path: Path) -> None:
    walk = Walk(points=((1.6, 1.0), (1.6, 3.2), (1.6, 1.0)), start=Trigger(time_s=1.0), stay_s=((1, 0.5),))
    shop, console = idle(tmp_path, people=(walk,))
    away = Wish(base=(-0.3, 0.0, 0.0))
    for _ in range(200):
        console.hold(away, 5)
        if refused(shop):
            break
    assert refused(shop) == "separation", shop.story()
    console.hold(away, 40)
    assert shop.cell.truth().base_speed_mps < 0.02
    for _ in range(300):
        console.hold(away, 5)
        if shop.runner.status == "running":
            break
    assert shop.runner.status == "running", shop.story()
    stood = shop.cell.truth().base
    assert console.hold(away, 30) == "release_first"
    assert shop.cell.truth().base[:2] == pytest.approx(stood[:2], abs=0.01)
    assert console.press(away, 30) is None


def test_a_key_pressed_in_a_pause_and_kept_drives_nowhere_when_it_ends(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    away = Wish(base=(-0.3, 0.0, 0.0))
    assert shop.runner.human("inv-1", "pause", "operator") is None
    assert console.press(away, 20) == "paused"
    stood = shop.cell.truth().base
    assert shop.runner.human("inv-1", "resume", "operator") is None
    assert console.hold(away, 60) == "release_first"
    assert shop.cell.truth().base[:2] == pytest.approx(stood[:2], abs=0.01)
    assert console.press(away, 30) is None
    assert shop.cell.truth().base_speed_mps > 0.1


@pytest.mark.parametrize("stilled", [False, True], ids=["renewed", "pre-empted"])
def test_a_key_held_by_whoever_gets_a_lease_starts_nothing_until_it_is_let_go(tmp_path: Path, stilled: bool) -> None:
    shop, console = idle(tmp_path)
    ahead = Wish(base=(-0.2, 0.0, 0.0))
    assert console.press(ahead, 60) is None
    if stilled:  # as the server does where one lease takes the place of another
        assert shop.runner.jog("inv-1", "", 0, Wish(), "server") is None
    other = Console(shop, lease="another")
    assert other.hold(ahead, 60) == "release_first"
    assert shop.cell.truth().base_speed_mps < 0.02
    assert other.press(ahead, 30) is None
    assert shop.cell.truth().base_speed_mps > 0.1


@pytest.mark.parametrize(("speed_mps", "why"), [(0.1, "blocked"), (0.2, "blocked"), (0.3, "base-tracking")])
def test_a_base_that_has_met_something_stops_pushing_and_says_so(tmp_path: Path, speed_mps: float, why: str) -> None:
    unseen = {"x_m": 1.6, "y_m": 3.6, "z_m": 0.45}  # it hangs, and no camera looks for it there
    shop, console = idle(tmp_path, faults=(Fault(kind="blocked", at=Trigger(time_s=0.5), sizes=unseen),))
    ahead = Wish(base=(-speed_mps, 0.0, 0.0))
    for _ in range(200):
        console.hold(ahead, 5)
        if refused(shop):
            break
    assert refused(shop) == why, shop.story()
    console.hold(ahead, 60)
    assert refused(shop) == why
    assert why in {body["refused"] for body in shop.of("human") if body["op"] == "jog"}, shop.story()
    held = shop.runner.session
    assert held is not None
    assert held.run.previous.base_velocity == (0.0, 0.0, 0.0)
    stood = shop.cell.truth().base
    assert console.press(Wish(base=(0.1, 0.0, 0.0)), 100) is None
    assert refused(shop) == ""
    assert dist(shop.cell.truth().base[:2], stood[:2]) > 0.05


@pytest.mark.parametrize(
    "wish", [(-0.04, 0.0, 0.0), (0.0, -0.1, 0.0), (-0.3, 0.0, 0.0), (0.0, 0.0, 0.2), (-0.1, 0.1, 0.3)]
)
def test_a_base_that_gets_on_is_not_taken_for_one_that_has_met_something(
    tmp_path: Path, wish: tuple[float, float, float]
) -> None:
    shop, console = idle(tmp_path)
    for _ in range(60):
        console.hold(Wish(base=wish), 5)
        assert refused(shop) == ""


def test_a_tool_out_of_reach_stays_and_says_so(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    for _ in range(400):
        console.hold(Wish(tool=(0.0, 0.0, 0.2)), 5)
        if refused(shop):
            break
    assert refused(shop) == "unreachable"
    stays = shop.cell.hold().joint_rad
    console.hold(Wish(tool=(0.0, 0.0, 0.2)), 40)
    assert refused(shop) == "unreachable"
    assert shop.cell.hold().joint_rad == stays
    assert shop.cell.truth().tcp_speed_mps < 0.02
    assert console.press(Wish(tool=(0.0, 0.0, -0.2)), 30) is None
    assert refused(shop) == ""


def test_a_session_is_taken_over_driven_and_bound_anew_from_where_the_robot_is(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("navigate_to", **DRIVE)
    for _ in range(400):
        shop.runner.tick()
    console = take_over(shop)
    before = shop.cell.truth().base
    assert console.press(Wish(base=(0.0, 0.2, 0.0)), 150) is None
    there = shop.cell.truth().base
    assert hypot(there[0] - before[0], there[1] - before[1]) > 0.15
    assert shop.runner.status == "running"
    anew = permit(shop, "navigate_to", 3, **shop._filled("navigate_to", DRIVE))
    assert shop.runner.launch(mint(anew, KEY)) is None, shop.story()
    assert shop.runner.jog("inv-1", "lease", 999, Wish(base=(0.1, 0.0, 0.0)), "operator") == "returning"
    assert shop.finish()["outcome"] == "recovered"
    x, y, _ = shop.cell.truth().base
    assert hypot(x - 0.8, y - 0.8) < 0.05
    reasons = [body["reason"] for body in shop.of("status")]
    assert reasons == ["launched", "handed_back", "handed_back", "verified"], reasons


def test_what_cannot_be_bound_anew_stays_in_the_human_hand(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **GRASP)
    for _ in range(100):
        shop.runner.tick()
    console = take_over(shop)
    for _ in range(40):
        console.hold(Wish(base=(-0.3, 0.0, 0.0)), 5)
    console.release()
    anew = permit(shop, "grasp_object", 3, **shop._filled("grasp_object", GRASP))
    assert shop.runner.launch(mint(anew, KEY)) is None
    for _ in range(100):
        shop.runner.tick()
    assert shop.last("launch")["refused"] == "unreachable", shop.story()
    assert shop.last("launch")["permit"] == "auth-3"
    assert shop.runner.status == "running"
    assert console.press(Wish(base=(0.3, 0.0, 0.0)), 30) is None


def test_a_contact_that_is_over_keeps_nobody_from_handing_back(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("grasp_object", **GRASP)
    for _ in range(100):
        shop.runner.tick()
    console = take_over(shop)
    console.hold(Wish(tool=(0.25, 0.0, 0.0)), 100)
    console.press(Wish(tool=(0.0, 0.0, -0.25)), 500)
    stopped_by = refused(shop)
    assert stopped_by in {"grip-force", "contact-force", "external-torque"}
    console.release()
    console.tick(200)
    told = len(shop.of("intervention"))
    anew = permit(shop, "grasp_object", 3, **shop._filled("grasp_object", GRASP))
    assert shop.runner.launch(mint(anew, KEY)) is None
    for _ in range(100):
        shop.runner.tick()
    assert "refused" not in shop.last("launch"), shop.story()
    assert len(shop.of("intervention")) == told
    assert shop.finish()["outcome"] == "recovered"


def test_a_rollback_goes_back_the_way_the_hand_went_too(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("navigate_to", **DRIVE)
    began = shop.cell.truth().base
    for _ in range(500):
        shop.runner.tick()
    console = take_over(shop)
    assert console.press(Wish(base=(0.0, 0.2, 0.0)), 150) is None
    assert console.press(Wish(base=(0.0, -0.2, 0.0)), 100) is None
    assert shop.runner.human("inv-1", "rollback", "operator") is None
    session, velocities = shop.runner.session, list[Vec3]()
    assert session is not None
    while shop.runner.invocation is not None:
        shop.runner.tick()
        velocities.append(session.run.previous.base_velocity)
    assert shop.last("outcome")["outcome"] == "rolled_back", shop.story()
    assert max(dist(a[:2], b[:2]) for a, b in pairwise(velocities)) < 0.06  # where the way turns back, the base stands
    assert shop.cell.truth().base[:2] == pytest.approx(began[:2], abs=0.1)


@pytest.mark.parametrize(("phase", "ticks"), [("close", 30), ("lift", 40)])
def test_a_rollback_puts_back_where_it_was_what_a_hand_has_driven_off_with(
    tmp_path: Path, phase: str, ticks: int
) -> None:
    shop = Workshop(tmp_path)
    began = shop.cell.truth()
    shop.launch("grasp_object", **GRASP)
    while ticks:
        shop.runner.tick()
        assert shop.runner.session is not None, shop.story()
        ticks -= shop.runner.session.run.skill.report().phase == phase
    console = take_over(shop)
    assert console.press(Wish(base=(-1.0, 0.0, 0.0)), 100) is None
    console.release()
    console.tick(20)
    assert dist(shop.cell.truth().objects["mug_1"][:2], began.objects["mug_1"][:2]) > 0.15
    assert shop.runner.human("inv-1", "rollback", "operator") is None
    assert shop.finish()["outcome"] == "rolled_back", shop.story()
    ended = shop.cell.truth()
    assert ended.objects["mug_1"] == pytest.approx(began.objects["mug_1"], abs=0.03)
    assert ended.base[:2] == pytest.approx(began.base[:2], abs=0.03)
    assert shop.strategies() == ["ROLLBACK"]


def test_a_rollback_that_a_hand_interrupts_is_carried_on_from_there(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    began = shop.cell.truth().base
    assert console.press(Wish(base=(-0.3, 0.0, 0.0)), 300) is None
    console.release()
    console.tick(20)
    assert dist(shop.cell.truth().base[:2], began[:2]) > 0.7
    assert shop.runner.human("inv-1", "rollback", "operator") is None
    while dist(shop.cell.truth().base[:2], began[:2]) > 0.4:
        shop.runner.tick()
    console = take_over(shop)
    assert console.press(Wish(base=(0.0, 0.1, 0.0)), 60) is None
    console.release()
    console.tick(20)
    assert shop.runner.human("inv-1", "rollback", "operator") is None
    farthest_m = 0.0
    while shop.runner.invocation is not None:
        shop.runner.tick()
        farthest_m = max(farthest_m, dist(shop.cell.truth().base[:2], began[:2]))
    assert shop.last("outcome")["outcome"] == "rolled_back", shop.story()
    assert farthest_m < 0.5
    assert shop.cell.truth().base[:2] == pytest.approx(began[:2], abs=0.03)


def test_whoever_lets_go_without_a_word_leaves_a_session_that_waits(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("navigate_to", **DRIVE)
    for _ in range(300):
        shop.runner.tick()
    console = take_over(shop)
    console.hold(Wish(base=(0.2, 0.0, 0.0)), 50)
    assert shop.runner.human("inv-1", "let_go", "server") is None
    assert shop.runner.status == "escalated"
    console.tick(60)
    assert shop.cell.truth().base_speed_mps < 0.02
    assert console.press(Wish(base=(0.2, 0.0, 0.0)), 10) == "not_taken_over"
    assert shop.runner.human("inv-1", "resolve_continue", "operator") == "needs_authorization"
    anew = permit(shop, "navigate_to", 3, **shop._filled("navigate_to", DRIVE))
    assert shop.runner.launch(mint(anew, KEY)) is None
    assert shop.finish()["outcome"] == "recovered"


def test_the_end_says_what_the_agent_faces_now(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.launch("navigate_to", **DRIVE)
    for _ in range(300):
        shop.runner.tick()
    take_over(shop)
    assert shop.runner.human("inv-1", "end_takeover", "operator") is None
    ended = shop.finish()
    assert ended["outcome"] == "taken_over"
    facts = ended["facts"]
    assert isinstance(facts, dict)
    assert facts["gripper_empty"] is True
    assert facts["base"][:2] == pytest.approx(shop.cell.truth().base[:2], abs=0.05)


def test_a_link_that_is_lost_ends_the_driving(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    console.hold(Wish(base=(-0.2, 0.0, 0.0)), 50)
    shop.runner.hold("link")
    assert console.say(Wish(base=(-0.2, 0.0, 0.0))) == "holding"
    assert shop.finish()["outcome"] == "taken_over"
    assert shop.last("outcome")["code"] == "link"


def test_the_command_stream_is_told_where_it_changes_and_not_at_every_command(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    console.hold(Wish(base=(-0.1, 0.0, 0.0)), 200)
    console.release()
    console.tick(40)
    told = [body for body in shop.of("human") if body["op"] == "jog"]
    assert [body["base"] for body in told] == [[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]


def test_telemetry_holds_the_whole_command_stream_what_counted_and_what_did_not(tmp_path: Path) -> None:
    shop, console = idle(tmp_path)
    slow, fast = Wish(base=(-0.05, 0.0, 0.0)), Wish(base=(-0.1, 0.0, 0.0))
    up = Wish(tool=(0.0, 0.0, 0.02), grip="open")
    console.hold(slow, 20)
    console.hold(fast, 3)  # the same way: no event tells of it, nor of a tap that is as short
    console.hold(up, 2)
    console.release()
    console.tick(3)
    console.lease = "another"
    assert console.hold(fast, 5) == "release_first"
    console.tick(40)
    rows = [dict(zip(CHANNELS, row, strict=True)) for row in ROW.iter_unpack(shop.telemetry)]
    asked = [tuple(row[name] for name in HAND) for row in rows if any(row[name] for name in HAND)]
    runs = [(run, len(list(ticks))) for run, ticks in groupby(asked)]
    counted = [(*wish.base, *wish.tool, 1.0 if wish.grip else 0.0, 1.0) for wish in (slow, fast, up)]
    refused_until_it_expired = ((*fast.base, *fast.tool, 0.0, 0.0), 9)
    expected = [*zip(counted, (20, 3, 2), strict=True), refused_until_it_expired]
    assert [ticks for _, ticks in runs] == [ticks for _, ticks in expected]
    for (was, _), (wanted, _) in zip(runs, expected, strict=True):
        assert was == pytest.approx(wanted)
