"""HTTP exchanges as uvicorn has them, but that a whole answer leaves as one, and every refusal is a problem.

Uvicorn writes the head of an answer, and then its body. Each write is a system call and a packet, and the second one
costs as much as deciding on a proposal. So a head waits for what follows it, at most until the event loop comes round:
streams and answers without a body begin as early as before.

What is no HTTP is refused here, before there is a request that a route could refuse. So is a handshake that the
websocket's reader would not read to its end; uvicorn leaves such a peer without an answer for good.

A peer that begins a request and does not go on has its connection closed: whoever holds many such open, and nobody
knows yet who that is, would take the descriptors by which somebody else comes in to stop a robot. Each connection looks
at itself once a second, so that a request costs no timer and no reading of a clock. Who comes when there are too many
already takes the place of those that have let others wait for longest, or that rest; what is being answered is let be.
"""

from __future__ import annotations

import logging
import resource
import select
from typing import TYPE_CHECKING, ClassVar, Final, cast

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from websockets.http11 import MAX_LINE_LENGTH, MAX_NUM_HEADERS

from app.api.frame import SECURITY_HEADERS
from app.api.problems import Problem
from app.api.staying import CUT, FOLLOWED, GONE, UNREAD

if TYPE_CHECKING:
    import asyncio

    from httptools import HttpRequestParser
    from uvicorn._types import ASGI3Application
    from uvicorn.protocols.http.httptools_impl import RequestResponseCycle

log = logging.getLogger(__name__)
log.setLevel(logging.ERROR)  # what anybody may send without a token has no end: it is answered, and makes no noise

FRAMING = (b"content-length", b"transfer-encoding")  # header fields that say that a body follows
SAYING = ("POST", "PUT")  # methods of requests that say something; by the others somebody asks
SPARE_BYTES = 64  # of a line, for what is neither name nor value
HEAD_BYTES = 65_536  # of one request: its line, its header fields, whatever else of it is no body
LOOK_S: Final = 1.0
MOST_LOOKS: Final = 5  # at a peer that lets others wait
# At one that takes nothing of its answer. A line of 20 kB/s may empty the system's buffer for half a minute meanwhile.
MOST_STUCK: Final = 60
MOST_CONNECTIONS: Final = 4096
HEAD, BODY, NOTHING = "head", "body", "nothing"  # what of a request has not come yet
TOO_LARGE = Problem("head_too_large", f"valid: at most {HEAD_BYTES} bytes of request line and header fields")
HOSTLESS = Problem("http_malformed", "`Host` is given never, or twice; valid: once (RFC 9112, 3.2)")
BODY_LATE = Problem("body_late", f"valid: no {MOST_LOOKS * LOOK_S:.0f} s without a part of the body")


def most_connections() -> int:
    """Return how many connections there may be before some of them make room: three quarters of the descriptors."""
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if descriptors == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return min(MOST_CONNECTIONS, descriptors * 3 // 4)


class HeadRefused(Exception):
    """A request's header fields are more than is read, or do not name the host once."""


class Exchanges(HttpToolsProtocol):
    """One connection's exchanges."""

    look_s: ClassVar[float] = LOOK_S
    most: ClassVar[int] = most_connections()

    _since_s = 0.0
    _unread = 0  # bytes that came since the parser last had something whole
    _owed = HEAD
    _hostless = False
    _looks = 0  # since the peer last did what it owes
    _left = _stuck = 0  # bytes of an answer that do not leave, and for how many looks
    _looking: asyncio.TimerHandle | None = None
    _begun: RequestResponseCycle | None = None  # what is being answered, or was last

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, and keep an eye on the peer."""
        super().connection_made(transport)
        self.logger = log
        self._looking = self.loop.call_later(self.look_s, self._look)
        self._since_s = self.loop.time()
        if len(self.connections) > self.most:
            self._make_room()

    def connection_lost(self, exc: Exception | None) -> None:
        """End; what was said by then, behind a request that was not answered yet, is taken all the same."""
        self._look_away()
        super().connection_lost(exc)
        if self._begun is not None and not self._begun.response_complete:
            self._begun.disconnected = True
            self._begun.message_event.set()
        while self.pipeline:  # it may be a stop; whatever lets something move finds its speaker gone
            cycle, app = self.pipeline.pop()
            if cycle.scope["method"] in SAYING and not cycle.more_body:
                cycle.transport, cycle.disconnected = cast("asyncio.Transport", Nowhere()), False
                self._start_asgi_task(cycle, app)

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: ASGI3Application) -> None:
        self._begun = cycle
        super()._start_asgi_task(cycle, app)

    def data_received(self, data: bytes) -> None:
        """Read what came; what never becomes whole, say a field without an end, is not kept without one either."""
        self._unread += len(data)
        super().data_received(data)
        if self._unread > HEAD_BYTES and not self.transport.is_closing():
            self._end(TOO_LARGE)

    def on_message_begin(self) -> None:
        """Begin to read a request."""
        self._unread = 0
        self._owed = HEAD
        super().on_message_begin()
        scope = cast("dict[str, object]", self.scope)
        scope[CUT], scope[GONE], scope[FOLLOWED] = self.transport.abort, self.gone, self.followed

    def gone(self) -> bool:
        """Say whether the peer has ended the connection, or its own side of it.

        A request and the end of its connection may have waited in the socket together. The end is read in the event
        loop's next round, which comes too late for what is decided in this one, so the system is asked.
        """
        if self.transport.is_closing():
            return True
        asked = select.poll()
        asked.register(self.transport.get_extra_info("socket").fileno(), select.POLLRDHUP)
        return bool(asked.poll(0))

    def followed(self) -> bool:
        """Say whether a request waits until the one before it is answered."""
        return bool(self.pipeline)

    def on_body(self, body: bytes) -> None:
        """Take a part of the body; how much of it is read is a route's matter."""
        self._unread = 0
        if not self.cycle.response_complete:  # nobody waits for what comes behind the answer
            self._looks = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """End a request."""
        self._unread = self._looks = 0
        self._owed = NOTHING
        super().on_message_complete()

    def on_headers_complete(self) -> None:
        """Begin an exchange, and see to how it is answered."""
        self._unread = self._looks = 0
        self._owed = BODY
        self._hostless = self._nameless()
        if self._hostless or self._too_large():
            raise HeadRefused  # ends the parser, which has it refused below
        before = self.cycle
        super().on_headers_complete()
        if self.cycle is not before:  # else a websocket takes over
            self.cycle.transport = cast("asyncio.Transport", Answer(self.transport, self.loop))
            if cast("HttpRequestParser", self.parser).should_upgrade():  # what follows is not read as HTTP
                self.cycle.keep_alive = False
                cast("dict[str, object]", self.scope)[UNREAD] = self._has_body()
        if self.pipeline:
            before.message_event.set()  # else nothing is read any more, not even that the peer has gone

    def handle_websocket_upgrade(self) -> None:
        """Let a websocket take over, if its reader can read the handshake."""
        lines = [self.url, *(name + value for name, value in self.headers)]
        longest = max(map(len, lines))
        if len(self.headers) > MAX_NUM_HEADERS:
            found = f"it has {len(self.headers)} header fields; valid: at most {MAX_NUM_HEADERS}"
        elif longest > MAX_LINE_LENGTH - SPARE_BYTES:
            found = f"a line of it has over {longest} bytes; valid: at most {MAX_LINE_LENGTH - SPARE_BYTES}"
        else:
            self._look_away()
            super().handle_websocket_upgrade()
            return
        self._refuse(Problem("handshake_invalid", f"the websocket's handshake cannot be read: {found}"))

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, and end the connection: nobody knows where in it the next request would begin."""
        cycle = cast("RequestResponseCycle | None", self.cycle)
        malformed = Problem("http_malformed", f"{msg} Valid: HTTP/1.1 as RFC 9112 has it")
        if cycle is not None and cycle.more_body and not cycle.response_complete:
            malformed = Problem("http_malformed", "the body is not what its header fields say; valid: RFC 9112")
        self._end(self._too_large() or (HOSTLESS if self._hostless else malformed))

    def _should_upgrade(self) -> bool:
        """Say whether a websocket is wished for: by a GET without a body (RFC 6455 §4.1), with no answer under way.

        Another request is answered as if it had not wished for it, which is a server's to decide (RFC 9110 §7.8).
        """
        if not self._answered():  # what is still written would be read as frames
            return False
        if self.scope["method"] != "GET" or self.scope["http_version"] != "1.1" or not super()._should_upgrade():
            return False
        return not self._has_body()

    def _has_body(self) -> bool:
        framing = [field for field in self.headers if field[0] in FRAMING]
        return any(field != (b"content-length", b"0") for field in framing)

    def _look(self) -> None:
        """See whether the peer lets others wait, and end that once it has for long enough."""
        self._looking = self.loop.call_later(self.look_s, self._look)
        self._look_at_answer()
        if self.transport.is_closing():
            if self._looks >= MOST_LOOKS:  # it does not even take the last word
                self.transport.abort()
        elif not self._lets_wait():
            self._looks = 0
        elif self._looks < MOST_LOOKS - 1:
            self._looks += 1
        else:
            self._looks = MOST_LOOKS
            self._end_late()

    def _look_at_answer(self) -> None:
        """Cut a peer that takes nothing of a long answer any more: what it holds, others could have."""
        left = self.transport.get_write_buffer_size()
        self._stuck = self._stuck + 1 if left and left == self._left else 0
        self._left = left
        if self._stuck >= MOST_STUCK:
            self.transport.abort()

    def _make_room(self) -> None:
        """End an eighth of the connections: first those whose peers let others wait, of each kind the oldest first."""
        others = [one for one in self.connections if isinstance(one, Exchanges) and one is not self]
        waited_for = {one: one._lets_wait() for one in others if one._lets_wait() or one._rests()}
        first = sorted(waited_for, key=lambda one: (not waited_for[one], -one._looks, one._since_s))
        for one in first[: self.most // 8 + 1]:
            self.connections.discard(one)
            one.transport.abort()

    def _look_away(self) -> None:
        if self._looking is not None:
            self._looking.cancel()
            self._looking = None

    def _lets_wait(self) -> bool:
        """Say whether something is owed by the peer, and not by the application, which may take its time."""
        if self.flow.read_paused:
            return False
        if not self._answered():  # who waits for the word to go on, and was not given it, owes no body
            return self._owed is BODY and not self.cycle.waiting_for_100_continue
        # Of a connection that rests uvicorn takes care, until something comes that need not be a request.
        return self._owed is not NOTHING or self.timeout_keep_alive_task is None

    def _end_late(self) -> None:
        if self._owed is not BODY or self._answered() or self.cycle.response_started:
            self.transport.close()
        else:
            self._refuse(BODY_LATE)

    def _rests(self) -> bool:
        """Say whether nothing is owed to the peer any more, not even what has been written and has not left yet."""
        return self._answered() and not self.transport.get_write_buffer_size()

    def _answered(self) -> bool:
        """Say whether everything that came whole is answered."""
        cycle = cast("RequestResponseCycle | None", self.cycle)
        return cycle is None or cycle.response_complete

    def _too_large(self) -> Problem | None:
        size = len(self.url) + sum(len(name) + len(value) for name, value in self.headers)
        return TOO_LARGE if size > HEAD_BYTES else None

    def _nameless(self) -> bool:
        """Say whether a request of HTTP/1.1 does not name the host it is for, or names two."""
        named = sum(name == b"host" for name, _ in self.headers)
        return named != 1 and cast("HttpRequestParser", self.parser).get_http_version() == "1.1"

    def _end(self, problem: Problem) -> None:
        """Refuse what comes now, and end the connection once what came whole before it is answered."""
        if self._answered():
            self._refuse(problem)
        elif not self.cycle.more_body:
            self.cycle.keep_alive = False
            self.flow.pause_reading()
        elif self.cycle.response_started:
            self.transport.close()
        else:
            self._refuse(problem)

    def _refuse(self, problem: Problem) -> None:
        answer = problem.response("/")
        headers = (
            *self.server_state.default_headers,
            *answer.raw_headers,
            *SECURITY_HEADERS,
            (b"connection", b"close"),
        )
        head = b"".join(name + b": " + value + b"\r\n" for name, value in headers)
        self.transport.write(STATUS_LINE[answer.status_code] + head + b"\r\n" + bytes(answer.body))
        self.transport.close()


class Nowhere:
    """Where the answer to somebody who has gone is written."""

    def write(self, data: bytes) -> None:
        """Write nothing."""

    def is_closing(self) -> bool:
        """Say that it is over."""
        return True

    def close(self) -> None:
        """Leave it as it is."""


class Answer:
    """What one exchange writes: of a transport, that which uvicorn uses to answer."""

    __slots__ = ("_head", "_loop", "_transport")

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        """Answer over a connection."""
        self._transport, self._loop = transport, loop
        self._head: bytes | None = None  # what was written first, until it is out

    def write(self, data: bytes) -> None:
        """Write: what comes first waits for what comes next, or for the end of this round of the event loop."""
        head, self._head = self._head, b""
        if head is None:
            self._head = data
            self._loop.call_soon(self._let_go)
        else:
            self._transport.write(head + data if head else data)

    def is_closing(self) -> bool:
        """Say whether the connection ends."""
        return self._transport.is_closing()

    def close(self) -> None:
        """End the connection, once everything is written."""
        self._let_go()
        self._transport.close()

    def _let_go(self) -> None:
        head, self._head = self._head, b""
        if head and not self._transport.is_closing():
            self._transport.write(head)
