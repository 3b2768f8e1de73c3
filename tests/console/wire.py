"""A wire between browser and server that can be cut: a TCP proxy on loopback, in a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

CHUNK = 65_536


class Wire:
    """Carries bytes both ways; `cut` ends every connection at once, `swallow` leaves them open and carries nothing.

    What comes takes `takes_s` to each side; set it before anything is carried, or what is on its way is overtaken.
    """

    def __init__(self, port: int) -> None:
        self.target = port
        self.port = 0
        self.refusing = False
        self.takes_s = 0.0
        self.loop = asyncio.new_event_loop()
        self.flowing = asyncio.Event()
        self.ends: set[asyncio.StreamWriter] = set()
        self.ending: asyncio.Task[None] | None = None  # kept: the loop itself holds no more than a weak reference

    def cut(self) -> None:
        """Abort what is open, as a reset would, and refuse what comes."""
        self._do(self._cut)

    def swallow(self) -> None:
        """Carry nothing more: no byte, no close."""
        self._do(self.flowing.clear)

    def mend(self) -> None:
        """Carry again; what was swallowed on the way is lost with its connections."""
        self._do(self._mend)

    async def serve(self) -> None:
        self.server = await asyncio.start_server(self._carry, "127.0.0.1", 0)
        self.port = self.server.sockets[0].getsockname()[1]
        self.flowing.set()

    def end(self) -> None:
        self._do(self._end)

    def _cut(self) -> None:
        self.refusing = True
        for writer in tuple(self.ends):
            writer.transport.abort()

    def _mend(self) -> None:
        if not self.flowing.is_set():
            self._cut()
        self.refusing = False
        self.flowing.set()

    def _end(self) -> None:
        self.server.close()
        self._cut()
        self.ending = asyncio.ensure_future(self._finish())

    async def _finish(self) -> None:
        """End what still carries, and let what was aborted close, before the loop stops."""
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        self.loop.call_soon(self.loop.stop)

    def _do(self, act: Callable[[], object]) -> None:
        done = threading.Event()

        def run() -> None:
            act()
            done.set()

        self.loop.call_soon_threadsafe(run)
        assert done.wait(5.0), "the wire's thread does not answer"

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.refusing:
            writer.transport.abort()
            return
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self.target)
        self.ends |= {writer, far_writer}
        ways = [self._way(reader, far_writer), self._way(far_reader, writer)]
        await asyncio.wait({asyncio.ensure_future(way) for way in ways})
        self.ends -= {writer, far_writer}

    async def _way(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(CHUNK):
                await self.flowing.wait()
                if self.takes_s:
                    self.loop.call_later(self.takes_s, writer.write, data)
                    continue
                writer.write(data)
                await writer.drain()
            await asyncio.sleep(self.takes_s)  # what is on its way still comes
        writer.transport.abort()


@contextmanager
def wire_to(port: int) -> Iterator[Wire]:
    """Lay a wire to a local port; it is taken away with the block."""
    wire = Wire(port)
    thread = threading.Thread(target=wire.loop.run_forever)
    thread.start()
    try:
        asyncio.run_coroutine_threadsafe(wire.serve(), wire.loop).result(5.0)
        yield wire
    finally:
        wire.end()
        thread.join(5.0)
        wire.loop.close()
