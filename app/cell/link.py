"""The cell's end of the link: dials the server, and goes on dialling for ever.

How one connection goes:

1. Dial `WS /v1/cells/{id}/link` with the cell's token and say `Hello`.
2. The first answer is `Welcome`. Its kernel key must be the pinned one: given by flag, or trusted on first use and kept
   in the cell's data directory. Another key ends the connection; the cell holds.
3. A `Policy` counts by its digest, computed here again from the files. Only then is there a world to build (the site is
   part of the policy), and the control loop starts.
4. From `Welcome` on the lease runs: every frame renews it. When it lapses the loop holds, the link closes and dials
   again, and nothing launches until the next `Welcome`; a frame that comes too late mends nothing. The link closes as
   well when frames come, but none by which the server has heard this cell lately: on a line that holds words back for
   seconds a stop would come as late, and nobody would know.
5. Events go up in order from the first that the server has not acknowledged, on every connection again, and never many
   (`MOST_AHEAD`) before it acknowledges: what else there is to say does not wait behind all of them. A server that has
   fewer than before was put back to an older copy of its record: it gets again what the journal's file still holds,
   and where that is not all of it, nothing, since it would refuse the gap.

Nothing here decides: orders go to the runner as they came, authorizations with their signature.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NoReturn, Protocol

import orjson
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus, WebSocketException

from app import protocol
from app.cell.display import Drawing
from app.cell.journal import JournalUnavailable
from app.cell.loop import STOPPING_S, NewPolicy, Shutdown, Welcomed
from app.cell.pin import LinkRefused
from app.cell.sighting import Sightings
from app.clock import monotonic_s
from app.governance import bundle
from app.governance.errors import GovernanceError
from app.protocol import (
    AGED_MS,
    Ack,
    Beat,
    Estop,
    Hello,
    Human,
    Jog,
    Launch,
    Policy,
    ProtocolError,
    Reset,
    SetProfile,
    UpEvent,
    Watch,
    Welcome,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from websockets.asyncio.client import ClientConnection

    from app.cell.journal import Entry
    from app.cell.loop import Inbox, Lease, Outbox, TickLoop
    from app.cell.pin import KeyPin
    from app.governance.policy import PolicySet
    from app.protocol import Down

FIRST_RETRY_S: Final = 0.05
LAST_RETRY_S: Final = 2.0
STABLE_S: Final = 1.0
PATIENCE_S: Final = 5.0  # for the handshake and the welcome
FAREWELL_S: Final = 0.5  # for the last events to be acknowledged
MIND_S: Final = 0.05
MOST_AHEAD: Final = 1024  # reports behind the last that was acknowledged: a server lets no more than 4,096 wait
MAX_FRAME_BYTES: Final = 16 * 1024 * 1024
MAX_WHY: Final = 300


class LinkLost(Exception):
    """The connection is of no more use: the lease lapsed, or the control loop ended."""


class Build(Protocol):
    """Makes the control loop once the first policy, and with it the site, is known."""

    def __call__(self, policies: PolicySet, kernel_key: str, acknowledged: int) -> TickLoop:
        """Return the loop, not yet started. May take a second; runs on a thread of its own.

        Args:
            policies: the compiled policy, with the site.
            kernel_key: the pinned key, base64.
            acknowledged: the last report of this journal that the server's log holds; numbers go on behind it.
        """
        ...


class Kept(Protocol):
    """The file that a cell's reports are numbered in, as it may be asked from any thread; a `Journal` is one."""

    id: str
    first_seq: int

    def recall(self, after: int, before: int) -> Sequence[Entry]:
        """Return the entries between two numbers that the file holds. Raises `JournalUnavailable`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Who this cell is; `boot` names this run of the process, `journal` is what its reports are numbered in.

    `latched` is whether an earlier run left a stop: it stands until the loop says otherwise.
    """

    cell: str
    boot: str
    journal: Kept
    robot: str
    latched: bool
    token: str = field(repr=False)


class Link:
    """Keeps the cell connected. One asyncio task runs it; the control loop runs beside it on its own thread."""

    def __init__(
        self,
        identity: Identity,
        address: Callable[[], str],
        pin: KeyPin,
        build: Build,
        inbox: Inbox,
        outbox: Outbox,
        lease: Lease,
        say: Callable[[str], None],
    ) -> None:
        """Take the parts.

        Args:
            identity: who the cell is.
            address: the server's base address, asked for before every dial. May raise `OSError` or `ValueError`.
            pin: which kernel key is believed.
            build: makes the control loop when the first policy is there.
            inbox: orders for the loop.
            outbox: what the loop reports.
            lease: renewed by every frame.
            say: writes one line for people.
        """
        self._identity, self._address, self._pin, self._build = identity, address, pin, build
        self._inbox, self._outbox, self._lease, self._say = inbox, outbox, lease, say
        self._loop: TickLoop | None = None
        self._building: asyncio.Task[None] | None = None
        self._policy_digest: str | None = None
        self._profile: str | None = None
        self._kernel_key = ""
        self._wake = asyncio.Event()
        self._heard_ack = asyncio.Event()
        self._acknowledged = 0
        self._beats: deque[tuple[int, float]] = deque()  # which, and when it was sent; those not heard of yet
        self._vouched_s = float("-inf")  # when the newest was sent of what the server is known to have heard
        self._missing = False  # the server lacks reports that the journal has not kept: it would take none behind them
        self._watched = 0
        self._retry_s = FIRST_RETRY_S
        self._welcomed_s = float("inf")
        self._last_word = ""
        self._fault = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Dial until told to stop; then bring the robot to rest and hand up what is left.

        Raises:
            RuntimeError: the control loop broke; the cell must not go on.
        """
        here = asyncio.get_running_loop()

        def wake() -> None:
            here.call_soon_threadsafe(self._wake.set)

        self._outbox.wake = wake
        stopping = asyncio.create_task(stop.wait())
        try:
            while not stop.is_set():
                await self._connect_once(stopping)
                self._check_loop()
                await asyncio.wait({stopping}, timeout=self._pause_s())
        finally:
            stopping.cancel()
            await self._end_loop()
            self._outbox.wake = lambda: None

    async def _connect_once(self, stopping: asyncio.Task[bool]) -> None:
        try:
            await self._converse(stopping)
        except (OSError, ValueError, TimeoutError, WebSocketException, ProtocolError, LinkRefused, LinkLost) as error:
            self._say_once(f"link down: {_plain(error)}")

    def _pause_s(self) -> float:
        """Return how long to wait before the next dial: doubling, bounded, and never two cells in step."""
        if monotonic_s() - self._welcomed_s > STABLE_S:  # a server that greets and hangs up is no server yet
            self._retry_s = FIRST_RETRY_S
        self._welcomed_s = float("inf")
        retry_s, self._retry_s = self._retry_s, min(2 * self._retry_s, LAST_RETRY_S)
        return retry_s * random.uniform(0.5, 1.0)  # noqa: S311  # jitter, no secret

    async def _converse(self, stopping: asyncio.Task[bool]) -> None:
        await self._built()
        address = self._address().rstrip("/")
        if not address.startswith(("http://", "https://")):
            raise ValueError(f"`{address}` is no address of a server; valid is for instance `http://127.0.0.1:8000`")
        dial = connect(
            f"{address.replace('http', 'ws', 1)}/v1/cells/{self._identity.cell}/link",
            additional_headers={"Authorization": f"Bearer {self._identity.token}"},
            compression=None,
            proxy=None,  # a lease of 300 ms is no errand for a proxy
            ping_interval=None,  # beats do that, and sooner
            open_timeout=PATIENCE_S,
            close_timeout=FAREWELL_S,
            max_size=MAX_FRAME_BYTES,
        )
        async with dial as socket:
            hello, said_s = self._hello(), monotonic_s()
            await socket.send(protocol.encode(hello))
            beating = asyncio.create_task(self._beat(socket))  # from here on, or a line would count for twice as slow
            try:
                acknowledged = await self._be_welcomed(socket, hello, said_s)
                self._welcomed_s = monotonic_s()
                missing = f", {_lacking(acknowledged, hello.first_seq)}" if self._missing else ""
                self._say_once(f"linked to {address}{missing}")
                await self._keep_up(socket, stopping)
            finally:
                beating.cancel()
                await asyncio.gather(beating, return_exceptions=True)

    async def _keep_up(self, socket: ClientConnection, stopping: asyncio.Task[bool]) -> None:
        """Run the connection's tasks until one ends, which none does without a reason, or the cell is told to stop."""
        orders: asyncio.Queue[Down] = asyncio.Queue()
        jobs = {
            asyncio.create_task(self._listen(socket, orders)),
            asyncio.create_task(self._take_in_order(orders)),
            asyncio.create_task(self._report(socket)),
            asyncio.create_task(self._mind()),
        }
        try:
            done, _ = await asyncio.wait({*jobs, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if stopping in done:
                await self._take_leave()
            for job in done & jobs:
                job.result()
        finally:
            self._outbox.watched = 0  # the next welcome says it anew
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)

    def _hello(self) -> Hello:
        state = self._outbox.state
        return Hello(
            cell=self._identity.cell,
            boot=self._identity.boot,
            robot=self._identity.robot,
            policy_digest=self._policy_digest,
            profile=self._profile,
            invocation=state.invocation if state else None,
            latched=state.latched if state else self._identity.latched,
            journal=self._identity.journal.id,
            first_seq=self._identity.journal.first_seq,
            last_seq=self._outbox.last_seq,
        )

    async def _be_welcomed(self, socket: ClientConnection, hello: Hello, said_s: float) -> int:
        """Take the welcome to what was said at a time, and return the last report that the server has."""
        async with asyncio.timeout(PATIENCE_S):
            first = protocol.decode_down(await socket.recv())
            while isinstance(first, Estop | Human):  # a restraint overtakes even the welcome
                self._inbox.put(first)
                first = protocol.decode_down(await socket.recv())
        match first:
            case Welcome(version=protocol.VERSION):
                self._pin.check(first.kernel_key)
            case Welcome():
                raise LinkRefused(f"the server speaks link version `{first.version}`; valid: `{protocol.VERSION}`")
            case _:
                raise LinkRefused(f"the server began with `{first.type}`; valid: `welcome`")
        self._vouched_s = said_s
        self._check_age()
        self._kernel_key = first.kernel_key
        self._profile = first.profile
        self._missing = hello.first_seq > first.acknowledged + 1
        if self._loop is not None and not self._missing:
            await self._recall(first.acknowledged)
        self._acknowledge(first.acknowledged)
        self._lease.welcomed()
        self._inbox.put(Welcomed(profile=first.profile))
        return first.acknowledged

    async def _recall(self, acknowledged: int) -> None:
        """Have everything behind a number to send: what an acknowledgement let go of is in the journal's file still."""
        events = self._outbox.events
        oldest = events[0].seq if events else max(self._outbox.last_seq, self._acknowledged) + 1
        if acknowledged + 1 >= oldest:
            return
        try:
            entries = await asyncio.to_thread(self._identity.journal.recall, acknowledged, oldest)
        except JournalUnavailable as error:
            raise LinkLost(str(error)) from error
        if not entries or entries[0].seq != acknowledged + 1:
            raise LinkLost("the journal was compacted just now")  # the next `Hello` says what it still holds
        events.extendleft(UpEvent.model_construct(**entry._asdict()) for entry in reversed(entries))

    async def _listen(self, socket: ClientConnection, orders: asyncio.Queue[Down]) -> NoReturn:
        """Renew the lease with every frame. What restrains goes straight to the loop; the rest waits its turn.

        A restraint is said once more behind what it overtook: a session that was launched but not begun would never
        hear of its stop, and what lets a session go on, or leaves a latched stop, would have the last word.
        """
        while True:
            frame = await socket.recv()
            self._lease.heard()
            message = protocol.decode_down(frame)
            match message:
                case Beat():
                    self._vouch(message.n)
                case Ack():
                    self._acknowledge(message.seq)
                case Watch():
                    self._watched += message.on
                    self._outbox.watched = self._watched if message.on else 0
                case Jog():
                    self._inbox.put(message)
                case Estop() | Human(restrains=True):
                    self._inbox.put(message)
                    if not orders.empty():
                        orders.put_nowait(message)
                case _:
                    orders.put_nowait(message)

    async def _take_in_order(self, orders: asyncio.Queue[Down]) -> NoReturn:
        """Take policies and launches one after the other: a policy may need a second to compile, a launch needs it."""
        while True:
            message = await orders.get()
            match message:
                case Policy():
                    await self._take_policy(message)
                case Launch() | Human() | Estop() | Reset() | SetProfile():
                    self._inbox.put(message)
                case _:
                    raise LinkRefused(f"the server said `{message.type}` in between; valid: once, first")

    async def _take_policy(self, message: Policy) -> None:
        try:
            policies = await asyncio.to_thread(bundle.load_files, message.files)
        except GovernanceError as error:
            raise LinkRefused(f"the server's policy `{message.digest}` does not load: {error}") from error
        if policies.digest != message.digest:
            raise LinkRefused(f"the policy's files make the digest `{policies.digest}`, not `{message.digest}`")
        if self._loop is None:
            self._building = asyncio.create_task(self._begin(policies))
            await asyncio.shield(self._building)  # the connection may end meanwhile; there is one world all the same
        else:
            self._inbox.put(NewPolicy(policies=policies))
        self._policy_digest = message.digest

    async def _begin(self, policies: PolicySet) -> None:
        self._loop = await asyncio.to_thread(self._build, policies, self._kernel_key, self._acknowledged)
        self._loop.start()

    async def _built(self) -> None:
        """Wait for the world whose building outlived its connection; what it failed of is raised here, once."""
        building, self._building = self._building, None
        if building is not None:
            await building

    def _acknowledge(self, seq: int) -> None:
        self._acknowledged = seq
        self._heard_ack.set()
        self._outbox.acknowledge(seq)
        self._inbox.put(Ack(seq=seq))
        self._wake.set()

    async def _report(self, socket: ClientConnection) -> NoReturn:
        """Send what the loop hands over: events first, then telemetry, then the newest state if it is another."""
        sent, shown, drawing, sightings = self._acknowledged, None, Drawing(self._outbox), Sightings(self._outbox)
        while True:
            await self._wake.wait()
            self._wake.clear()
            for event in () if self._missing else self._outbox.after(sent, self._acknowledged + MOST_AHEAD):
                await socket.send(protocol.encode(event))
                sent = event.seq
            while self._outbox.batches:
                await socket.send(self._outbox.batches.popleft())
            await sightings.show(socket)
            await drawing.show(socket)
            state = self._outbox.state
            if state is not None and state is not shown:
                await socket.send(protocol.encode(state))
                shown = state
                self._say_fault("" if state.fault is None else state.fault.why)

    async def _beat(self, socket: ClientConnection) -> NoReturn:
        """Say that this cell is there, so that the server can say when it heard so."""
        self._beats.clear()
        n = 0
        while True:
            n += 1
            self._beats.append((n, monotonic_s()))
            await socket.send(protocol.encode(Beat(n=n)))
            await asyncio.sleep(protocol.BEAT_MS / 1000)

    def _vouch(self, n: int) -> None:
        """Take a beat of the server's: it was said after the `n`th of this cell's was heard."""
        while self._beats and self._beats[0][0] <= n:
            _, self._vouched_s = self._beats.popleft()

    def _check_age(self) -> None:
        """End the connection where what the server says may be old. Raises `LinkLost`."""
        if monotonic_s() - self._vouched_s > AGED_MS / 1000:
            raise LinkLost(f"nothing heard for {AGED_MS} ms that was said after this cell was heard: the line is slow")

    async def _mind(self) -> NoReturn:
        """End the connection when the lease lapsed, what is heard is old, or the control loop ended."""
        while True:
            await asyncio.sleep(MIND_S)
            if self._lease.lapsed():
                raise LinkLost(f"nothing heard for {protocol.LEASE_MS} ms")
            self._check_age()
            if self._loop is not None and not self._loop.alive():
                await self._hand_up()  # what broke, and that the cell is latched
                raise LinkLost("the control loop ended")

    async def _take_leave(self) -> None:
        """Come to rest, then stay until the server holds the last event, but not for long."""
        await self._end_loop()
        await self._hand_up()

    async def _hand_up(self) -> None:
        self._wake.set()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FAREWELL_S):
                while self._acknowledged < self._outbox.last_seq:
                    self._heard_ack.clear()
                    await self._heard_ack.wait()

    async def _end_loop(self) -> None:
        if self._building is not None:
            self._building.cancel()  # a loop that is made but never started moves nothing
        if self._loop is not None and self._loop.alive():
            self._inbox.put(Shutdown())
            await asyncio.to_thread(self._loop.join, 2 * STOPPING_S)

    def _check_loop(self) -> None:
        if self._loop is not None and self._loop.broken is not None:
            raise RuntimeError("the control loop broke; the cell ends") from self._loop.broken

    def _say_fault(self, why: str) -> None:
        if why != self._fault:
            self._say(f"nothing moves: {why}" if why else "the journal can be written again")
        self._fault = why

    def _say_once(self, word: str) -> None:
        if word != self._last_word:
            self._last_word = word
            self._say(word)


def _lacking(acknowledged: int, first_seq: int) -> str:
    return (
        f"whose log lacks the reports `{acknowledged + 1}` to `{first_seq - 1}`, which the journal has not kept: "
        "nothing is launched or reported until the server has its newer record back, or this cell is started without "
        "its journal"
    )


def _plain(error: Exception) -> str:
    match error:
        case InvalidStatus():
            code = error.response.status_code
            return f"the server answered {code}" + (": is the cell's token valid?" if code == 401 else _why(error))
        case TimeoutError():
            return "the server did not answer in time"
        case _:
            return str(error) or type(error).__name__


def _why(refused: InvalidStatus) -> str:
    """Return what a server says of its refusal, as one line; nothing where it does not say it as ours do."""
    try:
        detail = str(orjson.loads(refused.response.body or b"")["detail"])
    except (ValueError, TypeError, KeyError):
        return ""
    return f": {detail[:MAX_WHY]}" if detail.isprintable() else ""
