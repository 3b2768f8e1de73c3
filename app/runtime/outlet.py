"""One console's outlet: what waits for it, in order, and how much of it is still under way.

Text (snapshots, updates, beats) is never dropped: it waits, bounded, and a console that does not keep up is closed and
comes back for a snapshot. Pose frames are dropped freely: of each cell only the newest waits, and it leaves only while
little is under way, because whatever is written into a socket ahead of it makes it old. How much is under way is what
the console has not acknowledged: beats and frames are acknowledged, and with them everything sent before.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Final, NamedTuple, TypeAlias

from app.clock import monotonic_s

# Waiting and under way together: a browser that is held up for a second or two while proposals flood in is not turned
# away for it. What waits is the same text for all consoles, kept once.
MAX_BEHIND_BYTES: Final = 16 * 1024 * 1024
MAX_SILENT_S: Final = 15.0  # so long a beat may go unacknowledged
BUDGET_BYTES: Final = 6 * 1024  # under way when a frame leaves: 0.3 s of a 20 kB/s line
MAX_FRAMES: Final = 4  # of one cell, unacknowledged; a console acknowledges every second one
MAX_FRAME_AGE_S: Final = 0.3
FELL_BEHIND: Final = 4410
Key: TypeAlias = tuple[str | int, int]  # ("beat", n), or (cell, frame)


class Mark(NamedTuple):
    """Something that will be acknowledged: what, how much had been sent with it, and when."""

    key: Key
    sent: int
    at_s: float


class Frame(NamedTuple):
    """A pose frame that waits: its number and bytes, and when it came."""

    number: int
    content: bytes
    at_s: float


class Outlet:
    """What one console is to be sent."""

    def __init__(self) -> None:
        """Start empty."""
        self.ended: tuple[int, str] | None = None  # the close code and why
        self._texts: deque[tuple[str, Key | None]] = deque()
        self._waiting = 0
        self._frames: dict[int, Frame] = {}
        self._marks: deque[Mark] = deque()
        self._sent = self._heard = 0
        self._more = asyncio.Event()
        self._over = asyncio.Event()

    def say(self, text: str, mark: Key | None = None) -> None:
        """Queue text; with a `mark` the console will acknowledge it by that name."""
        if self.ended is not None:
            return
        self._texts.append((text, mark))
        self._waiting += len(text)
        self._more.set()
        if self._waiting + self._sent - self._heard > MAX_BEHIND_BYTES:
            self.end(FELL_BEHIND, "fell behind: come back for a snapshot")
        elif self._marks and monotonic_s() - self._marks[0].at_s > MAX_SILENT_S:
            self.end(FELL_BEHIND, f"nothing was acknowledged for {MAX_SILENT_S:.0f} s: come back for a snapshot")

    def show(self, cell: int, number: int, content: bytes) -> None:
        """Let a frame of a cell wait in place of the one before."""
        self._frames[cell] = Frame(number, content, monotonic_s())
        self._more.set()

    def forget_frames(self) -> None:
        """Drop the frames that wait: other cells are watched from now on, by other numbers."""
        self._frames.clear()

    def acknowledged(self, key: Key) -> None:
        """Note that the console has received what bears this mark, and everything before."""
        if not any(mark.key == key for mark in self._marks):
            return  # acknowledged already, or never sent
        while self._marks:
            mark = self._marks.popleft()
            self._heard = mark.sent
            if mark.key == key:
                break
        self._more.set()

    def end(self, code: int, reason: str) -> None:
        """Let it end: nothing more is sent, and the socket is to be closed with this code."""
        if self.ended is None:
            self.ended = code, reason
        self._texts.clear()
        self._frames.clear()
        self._more.set()
        self._over.set()

    async def over(self) -> tuple[int, str]:
        """Wait until it has ended, also while what was sent last does not get into the socket; return how it ended."""
        await self._over.wait()
        return self.ended or (FELL_BEHIND, "")

    async def next(self) -> str | bytes | None:
        """Return what to send next, as soon as there is something; None when it has ended."""
        while self.ended is None:
            if self._texts:
                return self._text()
            if (frame := self._frame()) is not None:
                return frame
            self._more.clear()
            await self._more.wait()
        return None

    def _text(self) -> str:
        text, mark = self._texts.popleft()
        self._waiting -= len(text)
        self._sent += len(text)
        if mark is not None:
            self._marks.append(Mark(mark, self._sent, monotonic_s()))
        return text

    def _frame(self) -> bytes | None:
        for cell in tuple(self._frames):
            number, content, at_s = self._frames[cell]
            now_s = monotonic_s()
            if now_s - at_s > MAX_FRAME_AGE_S:
                del self._frames[cell]  # the cell's own stream has stopped: what it was is not what it is
            elif self._free(cell, len(content)):
                del self._frames[cell]
                self._sent += len(content)
                self._marks.append(Mark((cell, number), self._sent, now_s))
                return content
        return None

    def _free(self, cell: int, size: int) -> bool:
        under_way = self._sent - self._heard
        if under_way and under_way + size > BUDGET_BYTES:
            return False
        return sum(mark.key[0] == cell for mark in self._marks) < MAX_FRAMES
