"""Websockets as uvicorn has them, held open by no peer, and what many consoles are shown made into a frame once.

Long texts are compressed with that frame (RFC 7692). No message refers to one before it, so the same bytes serve every
console; a browser reads what is short, and poses, as they are.
"""

from __future__ import annotations

import asyncio
from collections import deque
from http.client import INTERNAL_SERVER_ERROR
from typing import TYPE_CHECKING, Any, ClassVar, Final

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.extensions.permessage_deflate import PerMessageDeflate, ServerPerMessageDeflateFactory
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from app.api.console import MAX_FRAME_BYTES, MOST_FRAMES
from app.api.console import PATH as CONSOLE_PATH
from app.api.problems import Problem
from app.clock import monotonic_s

if TYPE_CHECKING:
    from uvicorn._types import ASGIReceiveEvent, ASGISendEvent
    from websockets.http11 import Request
    from websockets.typing import StatusLike

LET_GO_S: Final = 2.0  # for a peer to take the last words and close its end
KEPT_FRAMES: Final = 4  # an update, a beat, and poses or a scene are under way at one time
# What is shorter costs less to copy than to compress; compressing what is longer would hold up a stop.
SHORTEST_DEFLATED, LONGEST_DEFLATED = 2_048, 4 * 1024 * 1024
WINDOW_BITS: Final = 15
# Frames that are no message of their own (pings, pongs, later parts of messages) cost nobody a ration of words.
# Browsers and cells send hardly any, and tens of thousands in one read would hold up everybody's stop.
MOST_ASIDE, ASIDE_S = 500, 1.0
PIECE_BYTES: Final = 4_096  # read at a time: so many bytes are at most 700 frames
_QUICKLY: Final = {"level": 1}
_DEFLATE: Final = PerMessageDeflate(
    remote_no_context_takeover=True,
    local_no_context_takeover=True,
    remote_max_window_bits=WINDOW_BITS,
    local_max_window_bits=WINDOW_BITS,
    compress_settings=_QUICKLY,
)


class Frames:
    """The frames made last: a text of many proposals is long, and every console gets the same."""

    def __init__(self) -> None:
        """Start without any."""
        self._made: deque[tuple[str | bytes, bool, bytes]] = deque(maxlen=KEPT_FRAMES)

    def of(self, content: str | bytes, deflated: bool) -> bytes:
        """Return the whole, unmasked frame of a text or of bytes; the very same object is made into one once.

        Args:
            content: what to send.
            deflated: whether the peer reads compressed messages; only long texts are.
        """
        deflated = deflated and isinstance(content, str) and SHORTEST_DEFLATED <= len(content) <= LONGEST_DEFLATED
        for known, is_deflated, frame in self._made:
            if known is content and is_deflated is deflated:
                return frame
        whole = Frame(Opcode.TEXT, content.encode()) if isinstance(content, str) else Frame(Opcode.BINARY, content)
        frame = whole.serialize(mask=False, extensions=[_DEFLATE] if deflated else [])
        self._made.append((content, deflated, frame))
        return frame


class Handshakes(ServerProtocol):
    """The library's reading and writing, but that what it refuses is a problem."""

    def reject(self, status: StatusLike, text: str) -> Response:
        """Return the refusal of a handshake."""
        code = "handshake_invalid" if status < INTERNAL_SERVER_ERROR else "internal"
        answer = Problem(code, text.strip() or "the websocket is refused").response("/")
        refusal = super().reject(answer.status_code, "")
        for name in ("Content-Type", "Content-Length"):
            del refusal.headers[name]
            refusal.headers[name] = answer.headers[name]
        return Response(refusal.status_code, refusal.reason_phrase, refusal.headers, bytes(answer.body))


class Sockets(WebSocketsSansIOProtocol):
    """Uvicorn's websockets, held open by no peer, and where ASGI's denial response is an answer as well.

    Uvicorn marks a handshake as answered when it is accepted or closed, not when it is denied, and then complains of
    every denial that it was left without an answer. It waits for a peer's half of the close for ten seconds, and for
    good until the peer has read what was written; it reads long frames from whoever sends them; and it logs a traceback
    for every text that is no UTF-8.
    """

    shown: ClassVar[Frames] = Frames()

    def __init__(self, *given: Any, **named: Any) -> None:  # noqa: ANN401  # what uvicorn makes it of
        """Read short frames only: nobody has said yet who they are."""
        super().__init__(*given, **named)
        self.conn = Handshakes(max_size=MAX_FRAME_BYTES, logger=self.logger)
        self._asides, self._asides_since_s = 0, monotonic_s()
        self._unread, self._reads_on = memoryview(b""), False

    def data_received(self, data: bytes) -> None:
        """Read piece by piece, and nothing more of what came from a peer that is shown out."""
        self._unread = memoryview(bytes(self._unread) + data)
        self._read_on()

    def _read_on(self) -> None:
        """Read what has come: of a cell no further than to what it says, until that is taken and others had a turn."""
        while self._unread and not self.transport.is_closing() and not (self.read_paused and self._is_cells()):
            piece, self._unread = self._unread[:PIECE_BYTES], self._unread[PIECE_BYTES:]
            super().data_received(bytes(piece))

    def _is_cells(self) -> bool:
        """Say whether it is a cell that was let in, who may say long things."""
        return self.conn.max_message_size != MAX_FRAME_BYTES

    async def receive(self) -> ASGIReceiveEvent:
        """Return the next message, or that there is none any more; others come in between two pieces of a cell's."""
        if self._reads_on:
            self._reads_on = False
            await asyncio.sleep(0)
        message = await super().receive()
        self._reads_on = bool(self._unread)
        self._read_on()
        return message

    def handle_ping(self) -> None:
        """Answer a ping, of which there may be few."""
        if self._few_asides():
            super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        """Take a pong, of which there may be few."""
        if self._few_asides():
            super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        """Take a later part of a message, of which there may be few."""
        if self._few_asides():
            super().handle_cont(event)

    def send_receive_event_to_app(self) -> None:
        """Hand a message on, unless more wait than a console may say, or it comes behind the last word."""
        if not self._is_cells() and self.queue.qsize() > MOST_FRAMES:
            self.transport.abort()
        elif not self.close_sent and not self._is_text():
            self.conn.fail(CloseCode.INVALID_DATA, "a text is UTF-8")
            self.handle_parser_exception()
        elif not self.close_sent or self._few_asides():
            super().send_receive_event_to_app()

    def _is_text(self) -> bool:
        """Say whether a message that came as text is one."""
        if self.curr_msg_data_type == "text":
            self.frames = [b"".join(self.frames)]
            try:
                self.frames[0].decode()
            except UnicodeDecodeError:
                return False
        return True

    def _few_asides(self) -> bool:
        """Count a frame that is no message of its own; cut off who sends too many, whether signed in or not."""
        if self.transport.is_closing():
            return False
        self._asides += 1
        if self._asides <= MOST_ASIDE:
            return True
        now_s = monotonic_s()
        within = now_s - self._asides_since_s < ASIDE_S
        self._asides, self._asides_since_s = 1, now_s
        if within:
            self.transport.abort()
        return not within

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """Cut what the application is done with, if the peer does not let go of it."""
        super().on_task_complete(task)
        self.loop.call_later(LET_GO_S, self._cut)

    def _cut(self) -> None:
        """End the connection, unless that is over: asyncio cuts none that was closed once all was written."""
        if not self.disconnected:
            self.transport.abort()

    def handle_connect(self, event: Request) -> None:
        """Offer compression to consoles alone: cells say what is short, or measured."""
        if event.path.partition("?")[0] == CONSOLE_PATH:
            self.conn.available_extensions = [ServerPerMessageDeflateFactory(server_no_context_takeover=True)]
        super().handle_connect(event)

    async def send(self, message: ASGISendEvent) -> None:
        """Send one message. A denial's last part ends the handshake; a cell that is let in may say long things."""
        if message["type"] == "websocket.send" and self.scope["path"] == CONSOLE_PATH:
            await self._show(message)
            return
        if message["type"] == "websocket.close":
            self.writable.set()  # also where the peer reads nothing: the application waits to be told that it is over
        if message["type"] == "websocket.accept" and self.scope["path"] != CONSOLE_PATH:
            self.conn.max_message_size = self.config.ws_max_size
        await super().send(message)
        self._read_on()  # behind the last word, for that of the peer
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True

    async def _show(self, message: ASGISendEvent) -> None:
        """Send a console what others are sent too; where that cannot be, it is uvicorn's to say so."""
        await self.writable.wait()
        content = message.get("text") or message.get("bytes")
        if content and self.conn.state is State.OPEN and not self.disconnected:
            self.transport.write(self.shown.of(content, self._inflates()))
        else:
            await super().send(message)

    def _inflates(self) -> bool:
        """Say whether the peer reads what was compressed with the window used here; all may be left uncompressed."""
        return any(
            isinstance(one, PerMessageDeflate) and one.local_max_window_bits == WINDOW_BITS
            for one in self.conn.extensions
        )
