"""One cell's link as the server holds it: what goes out, in order and without waiting; what comes in, checked.

Sending never waits: `post` puts a message into the outlet and returns, a task of its own drains it into the socket. A
restraint (pause, stop, emergency stop) goes to the front, and is said once more in its place if it overtook something
that lets the robot move: what was ordered before it must not have the last word. A socket that does not drain closes
the link, and then the cell holds by itself (lease).

Reports (`UpEvent`) are numbered. Those already in the log are dropped, a gap is refused, the rest is recorded in
batches and acknowledged only then. When the record cannot be written the link stays, because a stop must get through:
the batch is tried again until it is in. So it does where the cell has had more recorded than one cell may: what else it
says is taken meanwhile, and a cell that waits for acknowledgements sends no more reports.
"""

from __future__ import annotations

import asyncio
import base64
from collections import deque
from itertools import accumulate, islice
from typing import TYPE_CHECKING, Any, Final, Protocol, assert_never

from app.audit.errors import EventMalformed, RecordUnavailable
from app.clock import monotonic_s
from app.protocol import (
    VERSION,
    Ack,
    Beat,
    Hello,
    Human,
    Launch,
    Path,
    Policy,
    ProtocolError,
    Reset,
    Scene,
    Sighting,
    State,
    UpEvent,
    Welcome,
    decode_up,
    encode,
    is_poses,
    unpack_batch,
)

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence

    from app.protocol import Message
    from app.runtime.cells import Cell
    from app.runtime.screens import Screens

MAX_WAITING_FRAMES: Final = 256
MAX_WAITING_EVENTS: Final = 4096
MAX_WAITING: Final = 16 * 1024 * 1024  # characters of reports that wait for the record
BATCH_EVENTS: Final = 256
BATCH: Final = 1024 * 1024  # characters of those: while they are made ready for the record, no word reaches any cell
MAX_SHOWN: Final = 256 * 1024  # characters of a report, a state, or whatever else is not shown once in a link
MAX_READ: Final = 512 * 1024  # of any message: while a longer one is read or shown, no word reaches any cell
MOST_VALUES: Final = 20_000  # of any text, counted by its commas: each may be an error, and takes its time
RETRY_S: Final = 0.5
DEAD_S: Final = 1.0  # a link that has been silent so long may be replaced
SILENT_S: Final = 6.0  # and after this it is closed: the socket may hang half open
NORMAL_CLOSURE: Final = 1000
PROTOCOL_VIOLATION: Final = 1002
INTERNAL_ERROR: Final = 1011
TRY_LATER: Final = 1013
LETS_MOVE: Final = (Launch, Human, Reset)


class Link(Protocol):
    """What carries frames to one cell; a websocket route implements it."""

    async def send(self, frame: str) -> None:
        """Send one text frame. Raises anything at all when the socket is gone."""
        ...

    async def close(self, code: int, reason: str) -> None:
        """Close the socket; closing it twice does no harm."""
        ...


class Hub(Protocol):
    """Where links lead: what a link tells of its cell, and asks; the fleet is one."""

    screens: Screens
    kernel_key: str
    policy_digest: str
    policy_files: Mapping[str, str]

    async def take_place(self, attachment: Attachment, hello: Hello) -> None:
        """Make this the cell's link. Raises `ProtocolError` where another one lives."""
        ...

    def welcome(self, attachment: Attachment, hello: Hello) -> None:
        """Deliver what the cell is owed."""
        ...

    async def arrived(self, attachment: Attachment, hello: Hello) -> None:
        """Record that the cell is there."""
        ...

    async def caught_up(self, attachment: Attachment) -> None:
        """Hear that every report which has come is in the log."""
        ...

    async def leave(self, attachment: Attachment) -> None:
        """Forget a link whose socket is gone."""
        ...

    def closing(self, closing: Coroutine[Any, Any, None]) -> None:
        """Close a socket without waiting for it."""
        ...

    def take_state(self, cell: Cell, state: State) -> None:
        """Keep the newest state."""
        ...

    def take_telemetry(self, cell: Cell, invocation: str, rows: Sequence[tuple[float, ...]]) -> None:
        """Pass rows of telemetry on."""
        ...

    def take_sighting(self, cell: Cell, sighting: Sighting) -> None:
        """Pass on where people and things were."""
        ...

    def check_report(self, cell: Cell, event: UpEvent) -> None:
        """Refuse a report that this cell may not make. Raises `ProtocolError`."""
        ...

    def record(
        self, attachment: Attachment, batch: Sequence[UpEvent], lengths: Sequence[int]
    ) -> Coroutine[Any, Any, None]:
        """Record a batch of reports, each of so many characters. Raises `RecordUnavailable`, `ProtocolError`."""
        ...


class Attachment:
    """A link while it is attached. The route calls `receive` for every frame, and `detach` when the socket is gone."""

    def __init__(self, hub: Hub, cell: Cell, link: Link) -> None:
        """Bind a link to a cell's place in the fleet; nothing is sent before `Hello`."""
        self.cell = cell
        self.hello: Hello | None = None
        self.heard_s = monotonic_s()
        self.closed = False
        self._hub = hub
        self._link = link
        self._outlet: deque[Message] = deque()
        self._jog: Message | None = None
        self._reports: deque[UpEvent] = deque()
        self._lengths: deque[int] = deque()  # of them, in characters
        self._waiting = 0  # all of those
        self._next_seq = 0
        self._beat = 0
        self._outgoing = asyncio.Event()
        self._incoming = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self._arrival: asyncio.Task[None] | None = None

    @property
    def welcomed(self) -> bool:
        """Say whether the cell has said `Hello` and was answered, and the link still stands."""
        return self.hello is not None and not self.closed

    @property
    def settled(self) -> bool:
        """Say whether every report that has come is in the log."""
        return not self._reports

    def silent_s(self) -> float:
        """Return for how long nothing has been heard."""
        return monotonic_s() - self.heard_s

    # -- going out ---------------------------------------------------------------------------------------------------

    def post(self, message: Message, *, urgent: bool = False) -> None:
        """Send a message without waiting; an urgent one overtakes what waits."""
        if self.closed:
            return
        again = urgent and any(isinstance(waiting, LETS_MOVE) for waiting in self._outlet)
        if urgent:
            self._outlet.appendleft(message)
        if again or not urgent:
            self._outlet.append(message)
        self._outgoing.set()
        if len(self._outlet) > MAX_WAITING_FRAMES:
            self.shut(TRY_LATER, "frames pile up: the cell does not read")

    def jog(self, command: Message) -> None:
        """Send a jog command once nothing else waits, in the place of an older one that waits still."""
        if not self.closed:
            self._jog = command
            self._outgoing.set()

    def beat(self) -> None:
        """Keep the lease alive and say which beat was heard last, unless frames wait already: a later one says it."""
        if not self._outlet:
            self.post(Beat(n=self._beat))

    async def _drain(self) -> None:
        while True:
            await self._outgoing.wait()
            self._outgoing.clear()
            while self._outlet or self._jog is not None:
                try:
                    await self._link.send(encode(self._next()))
                except Exception as error:  # whatever the socket raises, it is gone
                    self.shut(NORMAL_CLOSURE, f"sending failed: {type(error).__name__}")
                    return

    def _next(self) -> Message:
        """Return the next message: a restraint stands first in the outlet, and no jog command goes before it."""
        if self._outlet or self._jog is None:
            return self._outlet.popleft()
        jog, self._jog = self._jog, None
        return jog

    # -- coming in ---------------------------------------------------------------------------------------------------

    async def receive(self, frame: str | bytes) -> None:
        """Take one frame as it came from the socket; a bad one closes the link and says why."""
        if self.closed:
            return
        self.heard_s = monotonic_s()
        try:
            if isinstance(frame, bytes):
                self._take_bytes(frame)
            else:
                await self._take(frame)
        except ProtocolError as error:
            self.shut(PROTOCOL_VIOLATION, str(error))

    async def _take(self, frame: str) -> None:
        if len(frame) > MAX_READ:
            raise ProtocolError(f"a message of `{len(frame)}` characters: valid are `{MAX_READ}`")
        if frame.count(",") > MOST_VALUES:
            raise ProtocolError(f"a message of more than `{MOST_VALUES}` values")
        message = decode_up(frame)
        if self.hello is None:
            if not isinstance(message, Hello):
                raise ProtocolError(f"a link begins with `hello`, not with `{message.type}`")
            await self._greet(message)
            return
        if len(frame) > MAX_SHOWN and not isinstance(message, Scene):
            raise ProtocolError(f"a `{message.type}` of `{len(frame)}` characters: valid are `{MAX_SHOWN}`")
        match message:
            case Hello():
                raise ProtocolError("`hello` was said already: valid once per link")
            case UpEvent():
                self._queue(message, len(frame))
            case _:
                self._show(message)

    def _show(self, message: State | Scene | Path | Sighting | Beat) -> None:
        """Pass on what the cell shows of itself; no decision waits for its record."""
        match message:
            case State():
                self._hub.take_state(self.cell, message)
            case Scene() | Path():
                self._hub.screens.draw(self.cell.id, message)
            case Sighting():
                self._hub.take_sighting(self.cell, message)
            case Beat():
                self._beat = message.n
            case _:
                assert_never(message)

    def _take_bytes(self, frame: bytes) -> None:
        if self.hello is None:
            raise ProtocolError("a link begins with `hello`, not with telemetry")
        if len(frame) > MAX_READ:
            raise ProtocolError(f"a message of `{len(frame)}` bytes: valid are `{MAX_READ}`")
        if is_poses(frame):
            self._hub.screens.show(self.cell.id, frame)
            return
        invocation, rows = unpack_batch(frame)
        self._hub.take_telemetry(self.cell, invocation, rows)

    async def _greet(self, hello: Hello) -> None:
        if hello.cell != self.cell.id:
            raise ProtocolError(f"this is the link of `{self.cell.id}`, the cell says it is `{hello.cell}`")
        if hello.version != VERSION:
            raise ProtocolError(f"the cell speaks version `{hello.version}` of the link: valid is `{VERSION}`")
        await self._hub.take_place(self, hello)
        self.hello = hello
        self._next_seq = self.cell.up_seq + 1
        self._arrival = asyncio.create_task(self._hub.arrived(self, hello))
        recording = asyncio.create_task(self._record(self._arrival))
        self._tasks = [asyncio.create_task(self._drain()), recording]
        for task in self._tasks:
            task.add_done_callback(self._broke)
        self.post(
            Welcome(
                kernel_key=self._hub.kernel_key,
                policy_digest=self._hub.policy_digest,
                profile=self.cell.profile,
                acknowledged=self.cell.up_seq,
            )
        )
        if hello.policy_digest != self._hub.policy_digest:
            self.post(Policy(digest=self._hub.policy_digest, files=dict(self._hub.policy_files)))
        self._hub.welcome(self, hello)

    def _queue(self, event: UpEvent, length: int) -> None:
        if event.seq < self._next_seq:
            self.post(Ack(seq=self.cell.up_seq))
            return
        if event.seq > self._next_seq:
            raise ProtocolError(f"report `{event.seq}` leaves a gap: `{self._next_seq}` comes next")
        if len(self._reports) >= MAX_WAITING_EVENTS:
            raise ProtocolError(f"more than `{MAX_WAITING_EVENTS}` reports wait for the record")
        if self._waiting + length > MAX_WAITING:
            raise ProtocolError(f"reports of more than `{MAX_WAITING}` characters wait for the record")
        self._hub.check_report(self.cell, event)
        self._next_seq += 1
        self._reports.append(event)
        self._lengths.append(length)
        self._waiting += length
        self._incoming.set()

    async def _record(self, arrival: asyncio.Task[None]) -> None:
        await asyncio.shield(arrival)  # a disk may take its time for that; what else the cell says is heard meanwhile
        while True:
            await self._incoming.wait()
            self._incoming.clear()
            while self._reports:
                if (owed_s := self.cell.records.owed_s()) > 0:
                    await asyncio.sleep(owed_s)
                    continue
                batch = self._batch()
                if not await self._recorded(batch):
                    await asyncio.sleep(RETRY_S)
                    continue
                for _ in batch:
                    self._reports.popleft()
                    self._waiting -= self._lengths.popleft()
                self.post(Ack(seq=self.cell.up_seq))
            await self._hub.caught_up(self)

    def _batch(self) -> list[UpEvent]:
        """Return the reports that are recorded next: at least one."""
        ends = accumulate(islice(self._lengths, BATCH_EVENTS))
        return list(islice(self._reports, max(1, sum(end <= BATCH for end in ends))))

    async def _recorded(self, batch: Sequence[UpEvent]) -> bool:
        try:
            await self._hub.record(self, batch, list(islice(self._lengths, len(batch))))
        except RecordUnavailable:
            return False
        except (ProtocolError, EventMalformed) as error:  # the second: what JSON may say and the record cannot
            self.shut(PROTOCOL_VIOLATION, str(error))
            await asyncio.Event().wait()  # `detach` ends this task; nothing more is taken from this link
        return True

    # -- ending ------------------------------------------------------------------------------------------------------

    def shut(self, code: int, reason: str) -> None:
        """Close the link and say why; the route's reading ends, and it detaches."""
        if self.closed:
            return
        self.closed = True
        self._hub.closing(self._link.close(code, reason[:120]))

    def _broke(self, task: asyncio.Task[None]) -> None:
        """Let a bug end the link, not hide behind it: the cell holds, and the loop's handler hears of it."""
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self.shut(INTERNAL_ERROR, f"the server failed: {type(error).__name__}")
            context = {"message": f"the link of `{self.cell.id}` failed", "exception": error}
            asyncio.get_running_loop().call_exception_handler(context)

    async def detach(self) -> None:
        """Take the link out of the fleet, once the socket is gone."""
        self.closed = True
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)
        await self._hub.leave(self)


def key_text(public_key: bytes) -> str:
    """Return a raw public key as `Welcome` carries it."""
    return base64.b64encode(public_key).decode()
