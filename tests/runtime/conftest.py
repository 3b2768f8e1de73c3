"""A runtime on a real record and the shipped policy, and a cell played by hand over the real protocol."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app import clock
from app.audit.examination import examine_file
from app.audit.store import AuditStore
from app.governance.bundle import load
from app.governance.model import Role
from app.governance.policy import PolicySet
from app.protocol import Down, Estop, Hello, Reset, State, UpEvent, decode_down, encode
from app.runtime.assembly import Runtime
from app.runtime.examining import Examine
from app.runtime.invocation import Principal, ProposalRequest
from app.runtime.link import Attachment
from tests.examining import examine_here
from tests.lasting import let_states_last

PATIENCE_S = 20.0
CELL = "workcell-1"
AGENT = Principal(name="planner", role=Role.AGENT)
STRANGER = Principal(name="stranger", role=Role.AGENT)
OPERATOR = Principal(name="olivia", role=Role.OPERATOR)
OPERATOR_2 = Principal(name="oskar", role=Role.OPERATOR)
ENGINEER = Principal(name="erin", role=Role.ENGINEER)
AUDITOR = Principal(name="ada", role=Role.AUDITOR)
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))

AT_BENCH = {
    "stamp_s": 1.0,
    "arm_ready": True,
    "arm_retracted": True,
    "gripper_empty": True,
    "holding": None,
    "base": [1.6, 4.6, 1.5708],
    "objects": {
        name: {"visible": True, "reachable": True, "x_m": 1.5, "y_m": 5.25, "z_m": 0.8, "stamp_s": 1.0}
        for name in ("mug_1", "glass_1", "driver_1")
    },
    "tools": {"lever": "up", "press": "raised"},
    "inspected": {},
    "people_count": 0,
    "people_nearest_m": 99.0,
    "sensors_fresh": True,
}
AT_TOOLS = {**AT_BENCH, "base": [3.4, 1.4, -1.5708], "objects": {}}


def navigate(**changes: Any) -> ProposalRequest:
    return ProposalRequest(capability="navigate_to", params={"target": "dock"}, **changes)


def grasp(**changes: Any) -> ProposalRequest:
    return ProposalRequest(capability="grasp_object", params={"object_id": "mug_1"}, **changes)


def press(**changes: Any) -> ProposalRequest:
    return ProposalRequest(capability="operate_tool", params={"tool": "press", "action": "press"}, **changes)


async def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition, with a deadline."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0.002)


@dataclass
class Clock:
    """A wall clock that moves when told to."""

    offset_s: float = 0.0

    def __call__(self) -> float:
        return clock.wall_s() + self.offset_s


@dataclass
class HandCell:
    """A cell played by hand: what the server sent is in `heard`."""

    runtime: Runtime
    id: str = CELL
    boot: str = "boot-1"
    journal: str = "jrn-1"
    heard: list[Down] = field(default_factory=list)
    closed: tuple[int, str] | None = None
    attachment: Attachment | None = None
    seq: int = 0
    facts: dict[str, Any] = field(default_factory=lambda: dict(AT_BENCH))
    invocation: str | None = None
    status: str | None = None
    latched: bool = False
    reset: str = ""
    obeys: bool = True  # a stop and a reset, and says so
    tripped: int = 0  # the tick at which it latched a stop by itself

    async def send(self, frame: str) -> None:
        if self.closed:
            raise ConnectionError("the link is closed")
        message = decode_down(frame)
        self.heard.append(message)
        if self.obeys and isinstance(message, Estop | Reset):
            self.latched = isinstance(message, Estop) or (self.latched and message.seen < self.tripped)
            if isinstance(message, Reset):
                self.reset = message.id
            await self.state()

    async def close(self, code: int, reason: str) -> None:
        self.closed = (code, reason)

    def trip(self, tick: int) -> None:
        """Latch a stop by itself."""
        self.latched, self.tripped = True, tick

    async def dial(self, *, waits: bool = True, **changes: Any) -> HandCell:
        """Dial in, and wait until that is recorded, unless it is not to."""
        hello = {
            "cell": self.id,
            "boot": self.boot,
            "robot": "ur5e",
            "policy_digest": None,
            "profile": None,
            "invocation": self.invocation,
            "latched": self.latched,
            "journal": self.journal,
            "last_seq": self.seq,
            **changes,
        }
        self.attachment = await self.runtime.fleet.attach(self.id, self)
        await self.attachment.receive(encode(Hello(**hello)))
        if waits and (arrival := self.attachment._arrival) is not None:
            await asyncio.wait({arrival})
        return self

    async def hang_up(self) -> None:
        assert self.attachment is not None
        self.closed = (1006, "gone")
        await self.attachment.detach()

    async def state(self, **changes: Any) -> None:
        assert self.attachment is not None
        state = {
            "at_s": self.runtime.register.now_s(),
            "tick": max(1, self.tripped),
            "invocation": self.invocation,
            "status": self.status,
            "latched": self.latched,
            "reset": self.reset,
            "holding": False,
            "policy_digest": self.runtime.kernel.policy.digest,
            "profile": "human-shared",
            "facts": self.facts,
            "gauges": {},
            **changes,
        }
        await self.attachment.receive(encode(State(**state)))

    def event(self, kind: str, invocation: str | None = None, **body: Any) -> UpEvent:
        self.seq += 1
        actor = body.pop("actor", "cell")
        return UpEvent(seq=self.seq, at_s=1.0, tick=7, kind=kind, invocation=invocation, actor=actor, body=body)

    async def report(self, kind: str, invocation: str | None = None, **body: Any) -> UpEvent:
        """Report something, and wait until it is acknowledged."""
        event = self.event(kind, invocation, **body)
        await self.say(event)
        await self.acknowledged(event.seq)
        return event

    async def say(self, event: UpEvent) -> None:
        assert self.attachment is not None
        await self.attachment.receive(encode(event))

    async def acknowledged(self, seq: int) -> None:
        await until(lambda: any(message.type == "ack" and message.seq >= seq for message in self.heard))

    def all(self, kind: str) -> list[Any]:
        return [message for message in self.heard if message.type == kind]

    def ops(self) -> list[str]:
        return [message.op for message in self.all("human")]

    def told(self) -> list[str]:
        """What `ops` says, with what was said again while nobody said that it was heard told once.

        A session that is to hold is told every 0.2 s until it says that it holds, and a busy machine takes longer.
        """
        return [op for op, _ in groupby(self.ops())]

    async def expect(self, kind: str, count: int = 1) -> Any:
        await until(lambda: len(self.all(kind)) >= count)
        return self.all(kind)[-1]

    async def launched(self, invocation: str) -> None:
        """Say that the session began."""
        self.invocation, self.status = invocation, "running"
        await self.report("launch", invocation)
        await self.report("status", invocation, status="running")
        await self.state()

    async def ended(self, invocation: str, outcome: str) -> None:
        """Say that the session is over."""
        await self.report("outcome", invocation, outcome=outcome, code="done")
        self.invocation = self.status = None
        await self.state()


@dataclass
class House:
    """A data directory that servers come and go on."""

    folder: Path
    policy: PolicySet
    wall_s: Clock = field(default_factory=Clock)
    profile: str = "human-shared"
    absent_s: float = 30.0
    examine: Examine = examine_here
    promises: str | None = None
    sound: bool = True  # whether what is left says nothing else than the log
    withdrawn: set[str] = field(default_factory=set[str])  # whose tokens are gone

    @asynccontextmanager
    async def open(self) -> AsyncIterator[Runtime]:
        store = AuditStore.open(self.folder)
        runtime = Runtime(
            store,
            self.policy,
            KEY,
            default_profile=self.profile,
            examine=self.examine,
            promises=self.promises,
            absent_s=self.absent_s,
            wall_s=self.wall_s,
            may_give=lambda name: name not in self.withdrawn,
            may_vouch=lambda name: name not in self.withdrawn,
        )
        try:
            async with runtime.running():
                yield runtime
        finally:
            await store.close()
        found = examine_file(self.folder)
        assert found.ok is self.sound, found  # whatever was tested


@asynccontextmanager
async def stating(cell: HandCell, **changes: Any) -> AsyncGenerator[None]:
    """Have the cell say its state again and again, as a real one does."""

    async def state() -> None:
        while True:
            await cell.state(**changes)
            await asyncio.sleep(0.02)

    saying = asyncio.create_task(state())
    try:
        yield
    finally:
        saying.cancel()


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="session")
def policy() -> PolicySet:
    return load(Path(__file__).resolve().parents[2] / "policies")


@pytest.fixture
def lasting(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Let a state count for longer than a test takes; what is about one that lapses undoes it, or ages the state."""
    let_states_last(monkeypatch)
    return monkeypatch


@pytest.fixture(scope="session")
def new_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory on its first day, which a test copies: to make each anew took longer than most of the tests."""
    folder = tmp_path_factory.mktemp("new") / "data"

    async def make() -> None:
        await AuditStore.open(folder).close()

    asyncio.run(make())
    return folder


@pytest.fixture
def house(tmp_path: Path, policy: PolicySet, new_log: Path, lasting: pytest.MonkeyPatch) -> House:
    return House(shutil.copytree(new_log, tmp_path / "data"), policy)


@pytest.fixture
async def runtime(house: House, anyio_backend: str) -> AsyncIterator[Runtime]:
    async with house.open() as runtime:
        yield runtime


@pytest.fixture
async def cell(runtime: Runtime) -> HandCell:
    """A cell that is attached and fresh."""
    cell = await HandCell(runtime).dial()
    await cell.state()
    return cell
