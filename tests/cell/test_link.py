"""The cell's end of the link, against a server made of a real socket and the protocol alone."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue

import pytest
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from app import protocol, workcell
from app.cell.journal import Entry, Journal
from app.cell.latch import Latch
from app.cell.link import MOST_AHEAD, Identity, Link
from app.cell.loop import Lease, NewPolicy, Order, Outbox, TickLoop, Welcomed
from app.cell.pin import KeyPin, LinkRefused
from app.config import CellSettings
from app.governance import bundle
from app.governance.policy import PolicySet
from app.protocol import (
    LEASE_MS,
    Ack,
    Beat,
    Down,
    Ended,
    Estop,
    Hello,
    Human,
    Launch,
    Policy,
    Reset,
    SetProfile,
    State,
    Unrecorded,
    Up,
    UpEvent,
    Welcome,
)
from tests.cell.test_loop import Recorder, event

POLICIES = Path(__file__).parents[2] / "policies"
FILES = bundle.read_files(POLICIES)
DIGEST = bundle.load(POLICIES).digest
KEY = "a2V5"
WITHIN_S = 15.0
PATIENT_MS = 60_000  # the lease where no lapse is meant: all parts share one process here, and the machine is busy


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@dataclass
class Script:
    """A server that a test plays by hand: what came in, and the socket to answer on."""

    key: str = KEY
    acknowledged: int = 0
    greet: bool = True
    beats: bool = True
    answers: bool = True
    welcome_after_s: float = 0.0
    beat: int = 0  # the newest of the cell's that was heard
    heard: list[Up] = field(default_factory=list)
    frames: list[bytes] = field(default_factory=list)
    sockets: list[ServerConnection] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)

    async def converse(self, socket: ServerConnection) -> None:
        self.paths.append(socket.request.path if socket.request else "")
        beating = asyncio.create_task(self._beat(socket))
        try:
            async for frame in socket:
                if isinstance(frame, bytes):
                    self.frames.append(frame)
                    continue
                message = protocol.decode_up(frame)
                if isinstance(message, Beat):
                    self.beat = message.n if self.answers else 0
                    continue
                self.heard.append(message)
                if isinstance(message, Hello) and self.greet:
                    await asyncio.sleep(self.welcome_after_s)
                    await self._welcome(socket, message)
        except ConnectionClosed:
            pass
        finally:
            beating.cancel()

    async def _welcome(self, socket: ServerConnection, hello: Hello) -> None:
        await self.say(
            Welcome(kernel_key=self.key, policy_digest=DIGEST, profile="human-shared", acknowledged=self.acknowledged),
            socket,
        )
        if hello.policy_digest != DIGEST:
            await self.say(Policy(digest=DIGEST, files=FILES), socket)
        self.sockets.append(socket)

    async def _beat(self, socket: ServerConnection) -> None:
        while True:
            await asyncio.sleep(protocol.BEAT_MS / 1000)
            if self.beats and self.sockets and self.sockets[-1] is socket:
                await self.say(Beat(n=self.beat), socket)

    async def say(self, message: Down, socket: ServerConnection | None = None) -> None:
        await (socket or self.sockets[-1]).send(protocol.encode(message))

    def of(self, kind: type) -> list[Up]:
        return [message for message in self.heard if isinstance(message, kind)]


@dataclass
class Shelf:
    """What the journal's file holds."""

    id: str = "jrn_1"
    first_seq: int = 1
    events: list[UpEvent] = field(default_factory=list)

    def recall(self, after: int, before: int) -> list[Entry]:
        return [
            Entry(one.seq, one.at_s, one.tick, one.kind, one.invocation, one.actor, dict(one.body))
            for one in self.events
            if after < one.seq < before
        ]


@dataclass
class Rig:
    """A link under test with all its parts."""

    script: Script
    link: Link
    runner: Recorder
    inbox: SimpleQueue[Order]
    outbox: Outbox
    stop: asyncio.Event
    said: list[str]
    built: list[tuple[PolicySet, str, int]]
    shelf: Shelf

    def orders(self, kind: type) -> list[Order]:
        return [order for order in self.runner.orders if isinstance(order, kind)]


async def until(condition: Callable[[], object], what: str = "") -> None:
    try:
        async with asyncio.timeout(WITHIN_S):
            while not condition():
                await asyncio.sleep(0.01)
    except TimeoutError:
        pytest.fail(f"not within {WITHIN_S} s: {what}")


@asynccontextmanager
async def rig(
    folder: Path,
    script: Script | None = None,
    *,
    server_key: str | None = None,
    last_seq: int = 0,
    ready: threading.Event | None = None,
    lease_ms: int = PATIENT_MS,
    aged_ms: int = PATIENT_MS,
    latched: bool = False,
) -> AsyncIterator[Rig]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("app.cell.loop.LEASE_MS", lease_ms)
        patch.setattr("app.cell.link.AGED_MS", aged_ms)
        async with _rigged(folder, script or Script(), server_key, last_seq, ready, latched) as cell:
            yield cell


@asynccontextmanager
async def _rigged(
    folder: Path, script: Script, server_key: str | None, last_seq: int, ready: threading.Event | None, latched: bool
) -> AsyncIterator[Rig]:
    server: Server = await serve(script.converse, "127.0.0.1", 0)
    port = next(iter(server.sockets)).getsockname()[1]
    runner = Recorder(period_s=0.01)
    inbox: SimpleQueue[Order] = SimpleQueue()
    outbox, lease, stop = Outbox(last_seq), Lease(), asyncio.Event()
    said: list[str] = []
    shelf = Shelf()
    built: list[tuple[PolicySet, str, int]] = []

    def build(policies: PolicySet, kernel_key: str, acknowledged: int) -> TickLoop:
        built.append((policies, kernel_key, acknowledged))
        if ready is not None:
            assert ready.wait(WITHIN_S)
        return TickLoop(runner, inbox, outbox, lease, pace=1.0)

    link = Link(
        Identity(cell="workcell-1", boot="boot_1", journal=shelf, robot="recorder", latched=latched, token="secret"),
        lambda: f"http://127.0.0.1:{port}",
        KeyPin(path=folder / "kernel.pub", fixed=server_key),
        build,
        inbox,
        outbox,
        lease,
        said.append,
    )
    running = asyncio.create_task(link.run(stop))
    try:
        yield Rig(script, link, runner, inbox, outbox, stop, said, built, shelf)
    finally:
        stop.set()
        await running
        server.close()
        await server.wait_closed()


@pytest.mark.anyio
async def test_says_hello_is_welcomed_and_builds_its_world_from_the_policy(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State), "a state from the loop")
        hello = cell.script.of(Hello)[0]
        assert isinstance(hello, Hello)
        assert (hello.cell, hello.boot, hello.policy_digest, hello.last_seq) == ("workcell-1", "boot_1", None, 0)
        assert cell.script.paths == ["/v1/cells/workcell-1/link"]
        assert [(policies.digest, key) for policies, key, _ in cell.built] == [(DIGEST, KEY)]
        await until(lambda: cell.orders(Welcomed), "the welcome reaches the runner")
        assert cell.runner.holds == []


@pytest.mark.anyio
async def test_says_that_an_earlier_run_left_it_latched_before_its_loop_can_and_then_what_the_loop_says(
    tmp_path: Path,
) -> None:
    ready = threading.Event()
    async with rig(tmp_path, ready=ready, latched=True) as cell:
        await until(lambda: cell.built, "the building begins")
        ready.set()
        await until(lambda: cell.script.of(State), "a state from the loop")
        await cell.script.sockets[-1].close()
        await until(lambda: len(cell.script.of(Hello)) > 1, "another hello")
        said = [one.latched for one in cell.script.of(Hello) if isinstance(one, Hello)]
        assert said == [True, False], "by then it may have been reset"


@pytest.mark.parametrize("left", ["in the journal", "beside it"])
@pytest.mark.anyio
async def test_a_cell_that_is_started_latched_says_so_at_once(tmp_path: Path, left: str) -> None:
    journal = Journal(tmp_path / "journal", boot="boot_1")
    if left == "in the journal":
        journal.mark({"latched": True})
    else:
        Latch(tmp_path / "latch").keep()
    journal.close()
    script = Script(greet=False)
    async with await serve(script.converse, "127.0.0.1", 0) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        settings = CellSettings(id="workcell-1", token="secret", data=tmp_path, server=f"http://127.0.0.1:{port}")
        running = asyncio.create_task(workcell._run(settings, None, None))
        await until(lambda: script.of(Hello), "the hello")
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    (hello,) = script.of(Hello)
    assert isinstance(hello, Hello)
    assert hello.latched


@pytest.mark.anyio
async def test_a_link_lost_while_the_world_is_built_leaves_one_world_that_runs(tmp_path: Path) -> None:
    ready = threading.Event()
    async with rig(tmp_path, ready=ready) as cell:
        await until(lambda: cell.built, "the building begins")
        await cell.script.sockets[-1].close()
        await until(lambda: cell.said[-1].startswith("link down"))
        ready.set()
        await until(lambda: len(cell.script.sockets) > 1, "the second welcome")
        await until(lambda: cell.script.of(State), "a state from the loop")
        await cell.script.say(Policy(digest=DIGEST, files=FILES))
        await until(lambda: cell.orders(NewPolicy), "a later policy reaches the one loop there is")
        assert len(cell.built) == 1


@pytest.mark.anyio
async def test_says_which_journal_it_numbers_in_and_how_far_before_its_world_is_built(tmp_path: Path) -> None:
    async with rig(tmp_path, last_seq=41) as cell:
        await until(lambda: cell.script.of(Hello))
        hello = cell.script.of(Hello)[0]
        assert isinstance(hello, Hello)
        assert (hello.journal, hello.last_seq) == ("jrn_1", 41)


@pytest.mark.anyio
async def test_passes_orders_to_the_runner_as_they_came(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        launch = Launch(body="e30=", signature="c2ln")
        stop = Human(invocation="inv_1", op="stop", actor="operator")
        for message in (launch, stop, Estop(actor="planner")):
            await cell.script.say(message)
        await until(lambda: cell.orders(Launch) and cell.orders(Human) and cell.orders(Estop))
        assert launch in cell.runner.orders
        assert stop in cell.runner.orders


@pytest.mark.anyio
async def test_a_launch_does_not_overtake_the_policy_it_needs(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        await cell.script.say(Policy(digest=DIGEST, files=FILES))
        await cell.script.say(Launch(body="e30=", signature="c2ln"))
        await until(lambda: cell.orders(Launch))
        kinds = [type(order) for order in cell.runner.orders if isinstance(order, NewPolicy | Launch)]
        assert kinds == [NewPolicy, Launch]


def human(op: str) -> Human:
    return Human.model_validate({"invocation": "inv_1", "op": op, "actor": "operator"})


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("waiting", "restraint"),
    [
        (Launch(body="e30=", signature="c2ln"), human("stop")),
        (Launch(body="e30=", signature="c2ln"), human("let_go")),
        (Reset(id="r1", actor="operator", seen=1), Estop(actor="planner")),
        (human("resume"), human("pause")),
    ],
)
async def test_a_restraint_overtakes_what_waits_and_has_the_last_word_all_the_same(
    tmp_path: Path, waiting: Launch | Reset | Human, restraint: Human | Estop
) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        for message in (Policy(digest=DIGEST, files=FILES), waiting, restraint):
            await cell.script.say(message)
        await cell.script.say(SetProfile(profile="last"))
        await until(lambda: cell.orders(SetProfile))
        said = [order for order in cell.runner.orders if order in (waiting, restraint)]
        assert said[-2:] == [waiting, restraint]
        assert said.count(waiting) == 1
        first, built = cell.runner.orders.index(restraint), cell.runner.orders.index(cell.orders(NewPolicy)[0])
        assert first < built, "it does not wait for a policy to compile"


@pytest.mark.anyio
async def test_sends_reports_in_order_and_again_after_a_reconnect(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        for seq in (1, 2, 3):
            cell.outbox.event(event(seq))
        await until(lambda: len(cell.script.of(UpEvent)) >= 3)
        await cell.script.say(Ack(seq=1))
        await until(lambda: len(cell.outbox.events) == 2, "the first is forgotten")
        cell.script.acknowledged = 1
        sent = len(cell.script.of(UpEvent))  # more than three where the link was lost on the way, as on a busy machine
        await cell.script.sockets[-1].close()
        await until(lambda: len(cell.script.of(UpEvent)) >= sent + 2)
        reports = [one.seq for one in cell.script.of(UpEvent) if isinstance(one, UpEvent)]
        assert (reports[:3], reports[sent : sent + 2]) == ([1, 2, 3], [2, 3])
        newest = cell.script.of(Hello)[-1]
        assert isinstance(newest, Hello)
        assert (newest.policy_digest, newest.last_seq) == (DIGEST, 3)


@pytest.mark.anyio
async def test_sends_no_more_reports_ahead_than_a_server_lets_wait_and_says_what_else_there_is(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        for seq in range(1, MOST_AHEAD + 101):
            cell.outbox.event(event(seq))
        await until(lambda: len(cell.script.of(UpEvent)) >= MOST_AHEAD)
        cell.outbox.batch(b"RTM1")  # goes behind whatever was sent
        await until(lambda: cell.script.frames)
        assert len(cell.script.of(UpEvent)) == MOST_AHEAD
        await cell.script.say(Ack(seq=60))
        await until(lambda: len(cell.script.of(UpEvent)) >= MOST_AHEAD + 60)
        await cell.script.say(Ack(seq=MOST_AHEAD))
        await until(lambda: len(cell.script.of(UpEvent)) >= MOST_AHEAD + 100)
        reports = [one.seq for one in cell.script.of(UpEvent) if isinstance(one, UpEvent)]
        assert reports == list(range(1, MOST_AHEAD + 101))


async def reported(cell: Rig, count: int) -> None:
    """Report so many events, and have all of them acknowledged."""
    await until(lambda: cell.script.of(State))
    for seq in range(1, count + 1):
        cell.outbox.event(event(seq))
        cell.shelf.events.append(event(seq))
    await until(lambda: len(cell.script.of(UpEvent)) >= count)
    await cell.script.say(Ack(seq=count))
    await until(lambda: not cell.outbox.events)


@pytest.mark.anyio
async def test_a_server_that_was_put_back_gets_again_what_the_journal_still_holds(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await reported(cell, 4)
        cell.script.heard.clear()
        cell.script.acknowledged = 1
        await cell.script.sockets[-1].close()
        await until(lambda: len(cell.script.of(UpEvent)) >= 3)
        cell.outbox.event(event(5))
        await until(lambda: len(cell.script.of(UpEvent)) >= 4)
        assert [one.seq for one in cell.script.of(UpEvent) if isinstance(one, UpEvent)] == [2, 3, 4, 5]
        assert cell.orders(Ack)[-1] == Ack(seq=1), "the journal owes them again, too"


@pytest.mark.anyio
async def test_a_server_that_lacks_what_the_journal_has_not_kept_is_told_so_and_gets_nothing_it_would_refuse(
    tmp_path: Path,
) -> None:
    async with rig(tmp_path) as cell:
        await reported(cell, 4)
        cell.shelf.first_seq = 4
        cell.script.heard.clear()
        cell.script.acknowledged = 1
        await cell.script.sockets[-1].close()
        await until(lambda: cell.script.of(Hello))
        cell.outbox.event(event(5))
        await until(lambda: len(cell.script.of(State)) >= 5)
        (hello,) = cell.script.of(Hello)
        assert isinstance(hello, Hello)
        assert (hello.first_seq, hello.last_seq) == (4, 4)
        assert not cell.script.of(UpEvent)
        assert "whose log lacks the reports `2` to `3`, which the journal has not kept: nothing is" in cell.said[-1]
        cell.script.acknowledged = 3  # the newer record is back
        await cell.script.sockets[-1].close()
        cell.shelf.events = [event(4), event(5)]
        await until(lambda: len(cell.script.of(UpEvent)) >= 2)
        assert [one.seq for one in cell.script.of(UpEvent) if isinstance(one, UpEvent)] == [4, 5]


@pytest.mark.anyio
async def test_what_a_compaction_took_since_the_hello_is_said_in_the_next_one(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await reported(cell, 4)
        cell.shelf.events = []  # while the hello still says that all is there
        cell.script.acknowledged = 1
        await cell.script.sockets[-1].close()
        await until(lambda: "link down: the journal was compacted just now" in cell.said)
        cell.shelf.first_seq = 5
        await until(lambda: "lacks the reports `2` to `4`" in cell.said[-1])


@pytest.mark.anyio
async def test_holds_and_dials_again_when_the_server_falls_silent(tmp_path: Path) -> None:
    async with rig(tmp_path, lease_ms=LEASE_MS) as cell:
        await until(lambda: cell.orders(Welcomed))
        cell.script.beats = False
        await until(lambda: cell.runner.holds == ["link"], "the hold")
        cell.script.beats = True
        await until(lambda: len(cell.orders(Welcomed)) > 1, "the second welcome")


@pytest.mark.anyio
async def test_gives_a_line_up_that_brings_words_steadily_and_late(tmp_path: Path) -> None:
    async with rig(tmp_path, lease_ms=LEASE_MS, aged_ms=600) as cell:
        await until(lambda: cell.orders(Welcomed))
        cell.script.answers, cell.script.beat = False, 0  # as if what the server says was said before
        await until(lambda: cell.runner.holds == ["link"], "the hold")
        # Where nothing was heard for a lease before that, it is the next link that is found to be slow.
        await until(lambda: any("the line is slow" in word for word in cell.said), "the reason")
        cell.script.answers = True
        await until(lambda: len(cell.orders(Welcomed)) > 1, "the second welcome")


@pytest.mark.anyio
async def test_a_welcome_that_was_long_on_its_way_is_none(tmp_path: Path) -> None:
    script = Script(welcome_after_s=0.4)
    async with rig(tmp_path, script, aged_ms=300) as cell:
        await until(lambda: len(script.of(Hello)) > 1, "another dial")
        assert not cell.orders(Welcomed)
        assert not cell.built
        script.welcome_after_s = 0.0
        await until(lambda: cell.orders(Welcomed), "the welcome")


@pytest.mark.anyio
async def test_dials_again_after_a_lapse_that_only_the_loop_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.cell.link.MIND_S", 1.0)  # the link looks seldom: a frame comes before it does
    async with rig(tmp_path, lease_ms=LEASE_MS) as cell:
        await until(lambda: cell.orders(Welcomed))
        cell.script.beats = False
        await until(lambda: cell.runner.holds == ["link"], "the hold")
        cell.script.beats = True
        await cell.script.say(Beat())
        await until(lambda: len(cell.orders(Welcomed)) > 1, "the second welcome")


@pytest.mark.anyio
async def test_says_up_and_to_people_that_its_journal_cannot_be_written(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        cell.runner.unrecorded = Unrecorded(
            why="no room", ended=[Ended(invocation="inv-1", outcome="stopped", code="x")]
        )
        await until(lambda: any(isinstance(one, State) and one.fault is not None for one in cell.script.heard))
        await until(lambda: "nothing moves: no room" in cell.said)
        cell.runner.unrecorded = None
        await until(lambda: "the journal can be written again" in cell.said)
        newest = lambda: [one for one in cell.script.heard if isinstance(one, State)][-1]  # noqa: E731
        await until(lambda: newest().fault is None, "the server hears it as well")
        assert [word for word in cell.said if "linked" not in word] == [
            "nothing moves: no room",
            "the journal can be written again",
        ]


@pytest.mark.anyio
async def test_sends_telemetry_as_binary_frames(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        row = protocol.ROW.pack(*range(len(protocol.CHANNELS)))
        cell.outbox.batch(protocol.pack_batch("inv_1", row))
        await until(lambda: cell.script.frames)
        assert protocol.unpack_batch(cell.script.frames[0])[0] == "inv_1"


@pytest.mark.anyio
async def test_refuses_a_policy_that_is_not_its_digest(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        await cell.script.say(Policy(digest="sha256:00", files=FILES))
        await until(lambda: any("make the digest" in word for word in cell.said))
        assert cell.orders(NewPolicy) == []


@pytest.mark.anyio
async def test_refuses_another_kernel_key_than_the_first(tmp_path: Path) -> None:
    (tmp_path / "kernel.pub").write_text("b3RoZXI=\n")
    async with rig(tmp_path) as cell:
        await until(lambda: any("pinned" in word for word in cell.said))
        assert cell.built == []
        assert cell.script.of(State) == []


@pytest.mark.anyio
async def test_refuses_another_kernel_key_than_the_flag_names(tmp_path: Path) -> None:
    async with rig(tmp_path, server_key="b3RoZXI=") as cell:
        await until(lambda: any("pinned by `--server-key`" in word for word in cell.said))
        assert cell.built == []


@pytest.mark.anyio
async def test_hands_up_the_last_reports_before_it_leaves(tmp_path: Path) -> None:
    async with rig(tmp_path) as cell:
        await until(lambda: cell.script.of(State))
        cell.outbox.event(event(1))
        cell.stop.set()
        await until(lambda: cell.script.of(UpEvent))
        await until(lambda: cell.runner.holds == ["shutdown"])


def test_keeps_the_first_key_it_trusts(tmp_path: Path) -> None:
    pin = KeyPin(path=tmp_path / "kernel.pub")
    pin.check(KEY)
    pin.check(KEY)
    assert (tmp_path / "kernel.pub").stat().st_mode & 0o777 == 0o600
    with pytest.raises(LinkRefused, match=r"pinned in `.*kernel\.pub`"):
        pin.check("b3RoZXI=")


def test_refuses_the_server_when_the_key_cannot_be_kept(tmp_path: Path) -> None:
    with pytest.raises(LinkRefused, match="cannot pin"):
        KeyPin(path=tmp_path / "missing" / "kernel.pub").check(KEY)
