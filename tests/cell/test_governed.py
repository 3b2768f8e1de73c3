"""The runner as the link speaks to it, on the fake cell under the shipped policy."""

from __future__ import annotations

import asyncio
import base64
import functools
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from app.cell.governed import GovernedCell
from app.cell.journal import Journal
from app.cell.loop import NewPolicy, Outbox, Welcomed
from app.cell.moment import Sight
from app.cell.sighting import Sightings, things
from app.governance import bundle
from app.governance.model import Json
from app.governance.permit import mint
from app.governance.policy import PolicySet
from app.protocol import Ack, Human, Launch, Scene, Sighting, decode_up
from app.sim.faults import Fault
from app.sim.occasions import Trigger
from app.sim.workcell import Workcell
from tests.cell.rig import KEY, NOW_S, PERMIT, FakeCell
from tests.cell.workshop import policy


@functools.cache
def changed(name: str, before: str, after: str) -> PolicySet:
    files = policy().files
    assert before in files[name]
    return bundle.load_files({**files, name: files[name].replace(before, after, 1)})


def moved() -> PolicySet:
    return changed("site.yaml", "dock: {x_m: 0.8, y_m: 0.8", "dock: {x_m: 2.2, y_m: 0.8")


class Governed:
    """A governed fake cell that was welcomed."""

    def __init__(self, folder: Path) -> None:
        self.substrate = FakeCell()
        self.outbox = Outbox()
        self.journal = Journal(folder / "journal", boot="boot-1")
        self.cell = GovernedCell(
            self.substrate,  # type: ignore[arg-type]
            policy(),
            kernel_key=base64.b64encode(KEY.public_key().public_bytes_raw()).decode(),
            journal=self.journal,
            outbox=self.outbox,
            wall=lambda: NOW_S + 1.0,
        )
        self.cell.obey(Welcomed(profile="human-shared"))

    def drive(self, policies: PolicySet | None = None, **changes: object) -> None:
        permit = replace(
            PERMIT,
            capability="navigate_to",
            params={"target": "dock", "speed_mps": 0.3, "clearance_m": 0.3},
            policy_digest=(policies or policy()).digest,
            recoveries=(),
        )
        made = mint(replace(permit, **changes), KEY)  # type: ignore[arg-type]
        self.cell.obey(
            Launch(body=base64.b64encode(made.body).decode(), signature=base64.b64encode(made.signature).decode())
        )

    def refusals(self) -> list[object]:
        return [event.body["refused"] for event in self.outbox.events if event.body.get("refused")]


class Bench:
    """A governed workcell whose robot stands where it can reach, driven session after session."""

    def __init__(self, folder: Path, *faults: Fault) -> None:
        self.workcell = Workcell(policy().site, seed=3, faults=faults)
        self.outbox = Outbox()
        self.cell = GovernedCell(
            self.workcell,
            policy(),
            kernel_key=base64.b64encode(KEY.public_key().public_bytes_raw()).decode(),
            journal=Journal(folder / "journal", boot="boot-1"),
            outbox=self.outbox,
            wall=lambda: NOW_S + 1.0,
        )
        self.cell.obey(Welcomed(profile="human-shared"))
        self.sessions = 0

    def launch(self, capability: str, **params: Json) -> None:
        self.sessions += 1
        filled = policy().validate_params(capability, params)
        assert isinstance(filled, dict), filled
        permit = replace(
            PERMIT,
            id=f"auth-{self.sessions}",
            invocation=f"inv-{self.sessions}",
            cell=self.workcell.id,
            capability=capability,
            params=filled,
            policy_digest=policy().digest,
            recoveries=(),
        )
        made = mint(permit, KEY)
        self.cell.obey(
            Launch(body=base64.b64encode(made.body).decode(), signature=base64.b64encode(made.signature).decode())
        )
        assert self.cell.state(overruns=0).invocation == permit.invocation, self.outbox.events[-1]

    def said(self, kind: str) -> list[dict[str, object]]:
        return [event.body for event in self.outbox.events if event.kind == kind and event.invocation == self.running]

    def alarms(self) -> list[object]:
        return [body["rule"] for body in self.said("alert") if body["signal"] != "COMPLETION"]

    @property
    def running(self) -> str:
        return f"inv-{self.sessions}"

    def until(self, kind: str, ticks: int = 4000) -> dict[str, object]:
        """Tick until something of that kind was said of the newest session."""
        for _ in range(ticks):
            if found := self.said(kind):
                return found[-1]
            self.cell.tick()
        raise AssertionError(f"no {kind} within {ticks} ticks: {self.outbox.events[-1]}")


class Socket:
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Sighting] = []

    async def send(self, message: str | bytes) -> None:
        sighting = decode_up(message)
        assert isinstance(sighting, Sighting)
        self.sent.append(sighting)


@pytest.fixture
def governed(tmp_path: Path) -> Governed:
    return Governed(tmp_path)


def test_the_gauges_of_a_session_end_with_it_and_those_of_sensors_go_on(governed: Governed) -> None:
    governed.drive()
    for _ in range(50):
        governed.cell.tick()
    running = governed.cell.state(overruns=0)
    assert running.invocation == "inv-1"
    assert running.gauges["elapsed_s"] > 0.3
    assert running.gauges["base_speed_mps"] > 0.1
    governed.cell.obey(Human(invocation="inv-1", op="stop", actor="operator"))
    for _ in range(300):
        governed.cell.tick()
    assert governed.cell.state(overruns=0).invocation is None
    governed.substrate.lie = lambda seen: seen._replace(contact_force_n=17.0, base_velocity=(0.0, 0.0, 0.0))
    governed.cell.tick()
    over = governed.cell.state(overruns=3)
    assert set(over.gauges) == {"tcp_speed_mps", "base_speed_mps", "grip_force_n", "contact_force_n", "late_ticks"}
    assert (over.gauges["contact_force_n"], over.gauges["base_speed_mps"]) == (17.0, 0.0)


def test_launches_nothing_under_a_policy_of_another_site_and_says_what_to_do(governed: Governed) -> None:
    governed.cell.obey(NewPolicy(policies=moved()))
    governed.drive(moved())
    assert governed.refusals() == ["another_site"]
    state = governed.cell.state(overruns=0)
    assert (state.invocation, state.policy_digest) == (None, moved().digest)
    assert "restart the cell" in state.elsewhere
    governed.cell.obey(NewPolicy(policies=policy()))
    assert governed.cell.state(overruns=0).elsewhere == ""
    governed.drive(id="auth-2")
    assert governed.cell.state(overruns=0).invocation == "inv-1"


def test_launches_as_ever_under_a_policy_that_leaves_the_site_alone(governed: Governed) -> None:
    blunter = changed("profiles/human-shared.yaml", "sensitivity: 0.9", "sensitivity: 0.8")
    governed.cell.obey(NewPolicy(policies=blunter))
    governed.drive(blunter)
    state = governed.cell.state(overruns=0)
    assert (governed.refusals(), state.invocation, state.elsewhere) == ([], "inv-1", "")


@pytest.mark.parametrize(("x_m", "outcome"), [(0.8, "succeeded"), (2.2, None)])
def test_a_session_has_done_what_its_own_policy_says_whatever_has_come_meanwhile(
    governed: Governed, x_m: float, outcome: str | None
) -> None:
    governed.substrate.script.base_mps = 0.0
    governed.substrate.x_m, governed.substrate.y_m = x_m, 0.8
    governed.drive()
    governed.cell.obey(NewPolicy(policies=moved()))
    assert governed.cell.state(overruns=0).elsewhere == "", "it moves, as long as the session goes on"
    for _ in range(150):
        governed.cell.tick()
    ended = [event.body["outcome"] for event in governed.outbox.events if event.kind == "outcome"]
    assert ended == ([] if outcome is None else [outcome])


def test_the_journal_is_made_smaller_once_nothing_moves(governed: Governed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.cell.journal.COMPACT_BYTES", 0)
    compacted: list[str] = []
    monkeypatch.setattr(governed.journal, "compact", lambda: compacted.append(governed.cell.state(0).status or "over"))
    governed.drive()
    for _ in range(50):
        governed.cell.tick()
        governed.cell.obey(Ack(seq=governed.journal.last_seq))
    assert compacted == []
    governed.cell.obey(Human(invocation="inv-1", op="stop", actor="operator"))
    for _ in range(100):
        governed.cell.tick()
        governed.cell.obey(Ack(seq=governed.journal.last_seq))
    assert set(compacted) == {"over"}
    assert governed.journal.unacknowledged() == ()


def test_sees_people_as_the_tracker_does_while_a_session_runs(governed: Governed) -> None:
    assert governed.cell.sight() is None
    governed.substrate.people = lambda _: ((1.0, 2.0), (float("nan"), 3.0))
    governed.drive()
    governed.cell.tick()
    sight = governed.cell.sight()
    assert sight is not None
    assert (sight.invocation, sight.people) == ("inv-1", governed.substrate.observe().people)
    governed.outbox.sights.append(sight)
    socket = Socket()
    asyncio.run(Sightings(governed.outbox).show(socket))
    (sighting,) = socket.sent
    assert (sighting.people, sighting.time_s) == ([(0, 1.0, 2.0)], sight.time_s)


def test_the_things_of_a_session_are_the_sites_and_whatever_else_is_loose() -> None:
    scene = Scene(scene={"loose": ["mug_1", "crate_1"]}, bodies=["base", "mug_1", "crate_1"], gauges=[])
    found = things(scene, policy().site)
    assert {"mug_1", "lever", "crate_1"} < set(found)
    assert len(found) == len(set(found))
    assert "base" not in found


def test_sends_a_thing_when_it_has_moved_and_all_things_on_another_link(governed: Governed) -> None:
    governed.outbox.scene = Scene(scene={}, bodies=["base", "mug_1", "glass_1"], gauges=[])
    assert {"mug_1", "glass_1", "lever"} < set(governed.outbox.things)
    assert "base" not in governed.outbox.things

    def sight(time_s: float, mug_m: float) -> Sight:
        packed = struct.pack("<21f", *range(7), mug_m, *range(1, 7), *range(7))
        return Sight("inv-1", time_s, (), lambda: packed)

    socket, sightings = Socket(), Sightings(governed.outbox)
    governed.outbox.sights.extend((sight(1.0, 0.5), sight(1.2, 0.5004), sight(1.4, 0.75)))
    asyncio.run(sightings.show(socket))
    assert [set(one.bodies) for one in socket.sent] == [{"mug_1", "glass_1"}, set(), {"mug_1"}]
    assert socket.sent[-1].bodies["mug_1"] == (0.75, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    governed.outbox.sights.append(sight(1.6, 0.75))
    again = Socket()
    asyncio.run(Sightings(governed.outbox).show(again))
    assert set(again.sent[0].bodies) == {"mug_1", "glass_1"}


@pytest.mark.physics
@pytest.mark.parametrize(
    ("capability", "phase", "params"),
    [
        ("transport_object", "drive", {"target": "dock", "speed_mps": 0.15, "clearance_m": 0.3}),
        ("place_object", "approach", {"surface": "bench_a", "speed_mps": 0.15}),
        ("takeover", "jog", {"grip_force_n": 60.0}),
    ],
)
def test_what_is_fragile_is_held_no_more_firmly_by_whatever_comes_after_its_grasp(
    tmp_path: Path, capability: str, phase: str, params: dict[str, Json]
) -> None:
    squeezing = Fault(
        kind="grip_gain", at=Trigger(capability=capability, phase=phase, after_s=0.2), sizes={"gain": 2.5}
    )
    bench = Bench(tmp_path, squeezing)
    bench.launch("grasp_object", object_id="glass_1", force_n=20.0, speed_mps=0.15)
    assert bench.until("outcome")["outcome"] == "succeeded"
    assert bench.alarms() == []
    bench.launch(capability, **params)
    assert bench.until("alert", ticks=400)["rule"] == "grip-force"
    for _ in range(200):
        bench.cell.tick()
    assert bench.workcell.truth().grip_force_n < 22.0


@pytest.mark.physics
@pytest.mark.parametrize("misses", ["now", "before"])
def test_pads_that_miss_what_they_hold_for_a_tick_let_nobody_grip_it_firmer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, misses: str
) -> None:
    bench = Bench(tmp_path)
    bench.launch("grasp_object", object_id="glass_1", force_n=20.0, speed_mps=0.15)
    assert bench.until("outcome")["outcome"] == "succeeded"
    seen = bench.workcell.observe()
    assert seen.pads_loaded
    with monkeypatch.context() as missing:
        missing.setattr(bench.workcell, "observe", lambda: seen._replace(pads_loaded=False))
        bench.launch("takeover", grip_force_n=60.0)
    if misses == "before":
        bench.cell.obey(Human(invocation=bench.running, op="end_takeover", actor="operator"))
        bench.until("outcome")
        bench.launch("takeover", grip_force_n=60.0)
    session = bench.cell._runner.session
    assert session is not None
    assert session.run.bounds.grip_force_n == 20.0


@pytest.mark.physics
def test_what_is_held_may_be_held_as_firmly_as_it_was_taken_and_the_next_thing_as_firmly_as_policy_says(
    tmp_path: Path,
) -> None:
    bench = Bench(tmp_path)
    for thing, force_n in (("glass_1", 20.0), ("mug_1", 55.0)):
        for capability, params in (
            ("grasp_object", {"object_id": thing, "force_n": force_n, "speed_mps": 0.15}),
            ("place_object", {"surface": "bench_a", "speed_mps": 0.15}),
        ):
            bench.launch(capability, **params)
            assert bench.until("outcome")["outcome"] == "succeeded"
            assert bench.alarms() == []
