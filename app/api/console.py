"""The console's door: `WS /v1/console`, as docs/design/console.md says.

The first frame signs in, because a token has no place in a URL and a browser can set no header here; who can set it has
signed in by it before the handshake. From then on one
task reads what the console says, another writes what its outlet holds; whichever ends first ends the other. What is
shown is made by the runtime, once for all consoles.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias
from urllib.parse import urlsplit

import orjson
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from app.api.access import WEBSOCKET, allowed_roles, check_role
from app.api.faults import field_errors
from app.api.parts import parts_of
from app.api.problems import Problem
from app.api.staying import close_code, until_refused
from app.api.wire import parse
from app.clock import monotonic_s, wall_s
from app.governance.control import lateness
from app.governance.model import Role, Wish
from app.runtime.outlet import Outlet

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from fastapi import APIRouter

    from app.api.parts import Parts
    from app.runtime.invocation import Principal

PATH: Final = "/v1/console"
SUBPROTOCOL: Final = "reins.console.1"
VERSION: Final = 1
NOT_HOLDER: Final = "not_holder"
HELLO_S: Final = 5.0
CLOSE_S: Final = 1.0  # for a close frame to get into a socket that may not drain
MAX_FRAME: Final = 8192  # characters; a `watch` of many cells is the longest there is
MAX_FRAME_BYTES: Final = 4 * MAX_FRAME  # as UTF-8; the server reads no more of one, whoever sends it
MOST_FRAMES, WITHIN_S = 2_000, 1.0  # a browser that drives and watches says about sixty a second
# What is said costs so much of a person's ration: a snapshot, scenes of cells, and little otherwise.
SIGN_IN_COSTS, WATCH_COSTS, WORD_COSTS = 100, 20, 1
# Most of what a browser says, in the one way that it writes it; of two equal keys it has room for none.
_N: Final = "(0|[1-9][0-9]{0,14})"
_ACK: Final = re.compile(rf'\{{"type":"ack",(?:"cell":{_N},"frame":{_N}|"beat":{_N})\}}')
NO_MESSAGE, FORBIDDEN, NO_HELLO, NO_SEAT = 4400, 4403, 4408, 4429


class Word(BaseModel):
    """What a console says: unknown fields, NaN and infinities are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Hello(Word):
    """Signs in; `after` is the last `seq` seen."""

    type: Literal["hello"]
    token: Annotated[str, Field(max_length=512)]
    after: Annotated[int, Field(ge=0, lt=2**63)] | None = None


class Watch(Word):
    """Names the cells whose poses are wanted from now on, in place of those before."""

    type: Literal["watch"]
    cells: Annotated[list[Annotated[str, Field(max_length=128)]], Field(max_length=32)]


class Ack(Word):
    """Says that a beat, or a frame of a cell, has come, and with it everything before."""

    type: Literal["ack"]
    beat: Annotated[int, Field(ge=0)] | None = None
    cell: Annotated[int, Field(ge=0)] | None = None
    frame: Annotated[int, Field(ge=0)] | None = None

    def key(self) -> tuple[str | int, int]:
        """Return the mark it names. Raises `NotAWord`."""
        match self:
            case Ack(beat=int(beat), cell=None, frame=None):
                return "beat", beat
            case Ack(beat=None, cell=int(cell), frame=int(frame)):
                return cell, frame
            case _:
                raise NotAWord("an `ack` names a `beat`, or a `cell` and a `frame`")


class Ping(Word):
    """Wants its own time back, to measure the line by."""

    type: Literal["ping"]
    at_ms: float


Speed: TypeAlias = Annotated[list[float], Field(min_length=3, max_length=3)]


class Jog(Word):
    """One hold-to-run command, good for 100 ms: m/s and rad/s in the base frame.

    `beat` is the newest that its console had taken when it said it, `since_ms` before.
    """

    type: Literal["jog"]
    cell: Annotated[str, Field(max_length=128)]
    lease: Annotated[str, Field(max_length=128)]
    n: Annotated[int, Field(ge=0, lt=2**53)]
    base: Speed
    tool: Speed
    grip: Literal["open", "close"] | None = None
    beat: Annotated[int, Field(ge=0, lt=2**53)] | None = None
    since_ms: Annotated[float, Field(ge=0)] = 0.0


class Estop(Word):
    """The emergency stop of a cell: what `POST /v1/cells/{id}/estop` does, on a line that is open already."""

    type: Literal["estop"]
    cell: Annotated[str, Field(max_length=128)]


Words: TypeAlias = Annotated[Hello | Watch | Ack | Ping | Jog | Estop, Field(discriminator="type")]
_WORDS: Final[TypeAdapter[Words]] = TypeAdapter(Words)


class NotAWord(Exception):
    """A frame that is no message of this protocol; says what is wrong with it."""


class Refused(Exception):
    """The console may not come in, or not stay: the close code and why."""

    def __init__(self, code: int, reason: str) -> None:
        """Keep both."""
        self.code, self.reason = code, reason
        super().__init__(reason)


async def console(socket: WebSocket) -> None:
    """Serve one console until either side ends it; whose header is refused gets the problem's own status."""
    offered: list[str] = socket.scope["subprotocols"]
    parts, after = parts_of(socket), None
    recognize = partial(_recognize_by_header, socket, parts) if "authorization" in socket.headers else None
    try:
        principal = None if recognize is None else recognize()
    except Problem as problem:
        await socket.send_denial_response(problem.response(PATH))
        return
    await socket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        _check_origin(socket)
        if recognize is None or principal is None:
            hello, principal = await _sign_in(socket, parts)
            recognize, after = partial(_recognize, parts, hello.token), hello.after
        _check_subprotocol(offered)
        with _seated(parts, principal):
            await Console(socket, parts, principal, recognize).run(after)
    except WebSocketDisconnect:
        pass
    except NotAWord as error:
        await _close(socket, NO_MESSAGE, str(error))
    except Refused as refusal:
        await _close(socket, refusal.code, refusal.reason)


class Console:
    """One console that has signed in."""

    def __init__(
        self, socket: WebSocket, parts: Parts, principal: Principal, recognize: Callable[[], Principal]
    ) -> None:
        """Take an accepted socket, who is behind it, and what says who that is by now, or raises `Problem`."""
        self._socket, self._parts = socket, parts
        self._principal, self._recognize = principal, recognize
        self._outlet = Outlet()
        self._jogged: dict[str, tuple[str, str | None]] = {}  # of cells there are, and of nobody who only looks
        self._stopping: dict[str, tuple[int, asyncio.Task[object]]] = {}  # by cell: which stop, and who says it

    async def run(self, after: int | None) -> None:
        """Show and listen until either side ends it.

        Raises:
            NotAWord, Refused, WebSocketDisconnect: why it ended.
        """
        self._say(
            {
                "type": "welcome",
                "version": VERSION,
                "name": self._principal.name,
                "role": self._principal.role,
                "station": self._principal.station,
                "boot": self._parts.broadcast.boot,
                "at": wall_s(),
            }
        )
        self._parts.broadcast.join(self._outlet, after)
        jobs = [asyncio.create_task(job) for job in (self._show(), self._keep_up(), self._listen(), self._stay_known())]
        try:
            done, _ = await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._parts.broadcast.leave(self._outlet)
            self._parts.fleet.screens.watch(self._outlet, [])
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)
        for job in done:
            job.result()

    async def _keep_up(self) -> None:
        """End the console when its outlet has ended: whoever reads nothing neither looks on nor drives."""
        raise Refused(*await self._outlet.over())

    async def _show(self) -> None:
        outlet, send = self._outlet, self._socket.send
        while (frame := await outlet.next()) is not None:
            if isinstance(frame, str):
                await send({"type": "websocket.send", "text": frame})
            else:
                await send({"type": "websocket.send", "bytes": frame})
        raise Refused(*await outlet.over())

    async def _listen(self) -> None:
        taken, since_s = 0, monotonic_s()
        while True:
            word = await _receive(self._socket)
            if isinstance(word, Estop):
                self._stop(word)  # before anybody counts what was said
            self._pay(WATCH_COSTS if isinstance(word, Watch) else WORD_COSTS)
            self._take(word)
            taken += 1
            if taken < MOST_FRAMES:
                continue
            # Shown out, not slowed down: a command for driving that waited in a queue would be obeyed too late.
            if monotonic_s() - since_s < WITHIN_S:
                raise NotAWord(f"a console says at most {MOST_FRAMES} frames in {WITHIN_S:g} s")
            taken, since_s = 0, monotonic_s()

    def _pay(self, amount: int) -> None:
        words = self._parts.words
        if not words.take(self._principal.name, amount):
            raise NotAWord(f"`{self._principal.name}` says more than {words.most} frames in {words.within_s:g} s")

    def _take(self, word: Words) -> None:
        match word:
            case Ack():
                self._outlet.acknowledged(word.key())
            case Ping():
                self._say({"type": "pong", "at_ms": word.at_ms})
            case Watch():
                self._parts.governor.kernel.heard(self._principal)
                self._parts.fleet.screens.watch(self._outlet, word.cells)
            case Jog():
                self._jog(word)
            case Estop():
                pass  # done when it came
            case Hello():
                raise NotAWord("`hello` was said already: valid once, first")

    def _stop(self, word: Estop) -> None:
        """Stop a cell and latch it; of one that stays latched, or that there is not, nothing is done or recorded.

        A console that says it here says it over HTTP too, where it is answered. While somebody is leaving the stop it
        repeats nothing, and keeps the cell stopped. What is said next, of another cell too, does not wait for the
        record of it.
        """
        fleet = self._parts.fleet
        cell = fleet.cell(word.cell) if fleet.knows(word.cell) else None
        if cell is None or (cell.latched and cell.armed_by is None and not cell.resetting):
            return
        said, doing = self._stopping.get(cell.id, (-1, None))
        if said != cell.stops or doing is None or doing.done():  # else it is about to be done already
            doing = asyncio.create_task(self._parts.governor.estop(cell.id, self._principal))
            self._stopping[cell.id] = cell.stops, doing

    def _jog(self, word: Jog) -> None:
        """Pass a hold-to-run command on at once, and say what becomes of them whenever that changes."""
        if self._principal.role is not Role.OPERATOR or not self._parts.fleet.knows(word.cell):
            self._say_jogged(word, NOT_HOLDER)
            return
        governor, (vx, vy, wz), (tx, ty, tz) = self._parts.governor, word.base, word.tool
        wish = Wish((vx, vy, wz), (tx, ty, tz), word.grip)
        why = governor.jog(self._principal, word.cell, word.lease, word.n, wish, self._late_s(word))
        refused = governor.jogged(word.cell) if why is None else why
        if self._jogged.get(word.cell, ()) != (word.lease, refused):
            self._jogged[word.cell] = (word.lease, refused)
            self._say_jogged(word, refused)

    def _late_s(self, word: Jog) -> float:
        """Return how late a command comes, as far as it says of when it is."""
        if word.beat is None:
            return 0.0
        return lateness(self._parts.broadcast.since_beat_s(word.beat), word.since_ms / 1000.0)

    def _say_jogged(self, word: Jog, refused: str | None) -> None:
        self._say({"type": "jogged", "cell": word.cell, "n": word.n, "refused": refused})

    async def _stay_known(self) -> None:
        """End the console when its token is withdrawn or expires."""
        raise _shown_out(await until_refused(self._let_in))

    def _let_in(self) -> None:
        """Recognize who signed in. Raises `Problem`, also where the token stands for another role or station by now."""
        if self._recognize() != self._principal:
            raise Problem("token_invalid", "the token stands for somebody else now: sign in again")

    def _say(self, message: dict[str, object]) -> None:
        self._outlet.say(orjson.dumps(message).decode())


async def _sign_in(socket: WebSocket, parts: Parts) -> tuple[Hello, Principal]:
    address = "" if socket.client is None else socket.client.host
    try:
        async with parts.ungreeted.stand(address, HELLO_S):
            hello = await _receive(socket)
    except TimeoutError:
        raise Refused(NO_HELLO, f"nobody signed in within {HELLO_S:.0f} s") from None
    except Problem as problem:
        raise Refused(NO_SEAT, problem.detail) from problem
    if not isinstance(hello, Hello):
        raise NotAWord(f"a console begins with `hello`, not with `{hello.type}`")
    try:
        return hello, _recognize(parts, hello.token)
    except Problem as problem:
        raise _shown_out(problem) from problem


def _recognize(parts: Parts, token: str) -> Principal:
    principal = parts.principals.recognize(token)
    check_role(principal, allowed_roles(WEBSOCKET, PATH) or frozenset())
    return principal


def _recognize_by_header(socket: WebSocket, parts: Parts) -> Principal:
    principal = parts.principals.authenticate(socket.headers)
    check_role(principal, allowed_roles(WEBSOCKET, PATH) or frozenset())
    return principal


def _check_subprotocol(offered: list[str]) -> None:
    if offered and SUBPROTOCOL not in offered:
        raise NotAWord(f"the subprotocol is not known here: valid is `{SUBPROTOCOL}`")


def _shown_out(problem: Problem) -> Refused:
    return Refused(close_code(problem), problem.detail)


def _check_origin(socket: WebSocket) -> None:
    """Refuse a page of another server; what is no browser names no origin."""
    origin = socket.headers.get("origin")
    if origin is not None and not _is_own(origin, socket.headers.get("host")):
        raise Refused(FORBIDDEN, "the page comes from another origin: valid is this server's own console")


def _is_own(origin: str, host: str | None) -> bool:
    """Say whether an origin names the host that was asked for; what is no address at all does not."""
    try:
        return bool(host) and urlsplit(origin).netloc == host
    except ValueError:
        return False


async def _receive(socket: WebSocket) -> Words:
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message["code"], message.get("reason"))
    text: str | None = message.get("text")
    if text is None:
        raise NotAWord("a console speaks in text frames")
    if len(text) > MAX_FRAME:
        raise NotAWord(f"a frame has at most {MAX_FRAME} characters")
    if (ack := _ACK.fullmatch(text)) is not None:
        cell, frame, beat = (None if said is None else int(said) for said in ack.groups())
        return Ack.model_construct(type="ack", cell=cell, frame=frame, beat=beat)
    try:
        parse(text.encode())  # as strictly as a body: of two equal keys none wins
        return _WORDS.validate_json(text)
    except Problem as problem:
        raise NotAWord(problem.detail) from problem
    except ValidationError as error:
        untold = [{**one, "input": ()} for one in error.errors(include_input=False)]  # what was sent may be a token
        first = field_errors(untold)[0]
        where = f" at `{first['field']}`" if first["field"] else ""
        raise NotAWord(f"no message{where}: {first['message']}") from None


@contextlib.contextmanager
def _seated(parts: Parts, principal: Principal) -> Generator[None]:
    if not parts.words.take(principal.name, SIGN_IN_COSTS):
        raise Refused(NO_SEAT, f"`{principal.name}` signs in too often, or says too much: come back in a second")
    try:
        with parts.consoles.take(principal.name):
            yield
    except Problem as problem:
        raise Refused(NO_SEAT, problem.detail) from problem


async def _close(socket: WebSocket, code: int, reason: str) -> None:
    """Say why, if the socket still takes it; one that does not drain is cut when this returns."""
    if socket.application_state is WebSocketState.CONNECTED:
        with contextlib.suppress(TimeoutError, RuntimeError, WebSocketDisconnect):
            async with asyncio.timeout(CLOSE_S):
                await socket.close(code, reason.encode()[:120].decode(errors="ignore"))


def register(router: APIRouter) -> None:
    """Add the console's door."""
    router.add_api_websocket_route(PATH, console)
