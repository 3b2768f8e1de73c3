"""HTTP exchanges as uvicorn has them, but that an answer known as a whole leaves as one.

Uvicorn writes the head of an answer, and then its body. Each write is a system call and a packet, and the second one
costs as much as deciding on a proposal. So a head waits for what follows it, at most until the event loop comes round:
streams and answers without a body begin as early as before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

if TYPE_CHECKING:
    import asyncio


class Exchanges(HttpToolsProtocol):
    """One connection's exchanges."""

    def on_headers_complete(self) -> None:
        """Begin an exchange, and see to how it is answered."""
        before = self.cycle
        super().on_headers_complete()
        if self.cycle is not before:  # else a websocket takes over
            self.cycle.transport = cast("asyncio.Transport", Answer(self.transport, self.loop))


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
