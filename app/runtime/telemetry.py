"""Telemetry of the sessions that run: one file each, opened by its first rows and closed with its outcome.

A telemetry file is evidence, not permission: if it cannot be written the session goes on, and the record says so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.audit.telemetry import TelemetryWriter, channels
from app.governance.model import EventKind
from app.protocol import CHANNELS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

SERVER = "server"


class Telemetry:
    """Writers by invocation."""

    def __init__(self, folder: Path, wall_s: Callable[[], float]) -> None:
        """Take the folder that files go to, and the wall clock."""
        self._folder = folder
        self._wall_s = wall_s
        self._channels = channels(CHANNELS)
        self._writers: dict[str, TelemetryWriter] = {}
        self._failed: dict[str, str] = {}
        self._done: dict[str, dict[str, str | int]] = {}

    def write(self, invocation: str, rows: Sequence[tuple[float, ...]]) -> None:
        """Take rows of a session; the first open its file."""
        if invocation in self._failed:
            return
        writer = self._writers.get(invocation)
        if writer is None:
            try:
                writer = TelemetryWriter(self._free_path(invocation), self._channels, start_wall_s=self._wall_s())
            except RecordUnavailable as error:
                self._failed[invocation] = str(error)
                return
            self._writers[invocation] = writer
        writer.write_rows(rows)

    async def finish(self, invocations: Sequence[str]) -> list[EventDraft]:
        """Close the files of sessions that ended, and return the events that vouch for them.

        Asked again before `recorded`, it returns the same events: the record may not have taken them.
        """
        for invocation in invocations:
            if invocation not in self._done:
                body = await self._close(invocation)
                if body is not None:
                    self._done[invocation] = body
        return [
            EventDraft(kind=EventKind.TELEMETRY, actor=SERVER, invocation=invocation, body=self._done[invocation])
            for invocation in invocations
            if invocation in self._done
        ]

    def recorded(self, invocations: Sequence[str]) -> None:
        """Forget sessions whose events are in the record."""
        for invocation in invocations:
            self._done.pop(invocation, None)

    async def close(self) -> None:
        """Complete the files of sessions that still run; their digests are not in the record."""
        await self.finish(list(self._writers))

    async def _close(self, invocation: str) -> dict[str, str | int] | None:
        writer = self._writers.pop(invocation, None)
        failed = self._failed.pop(invocation, None)
        if writer is not None:
            try:
                return (await writer.aclose()).body()
            except RecordUnavailable as error:
                failed = str(error)
        return None if failed is None else {"failed": failed}

    def _free_path(self, invocation: str) -> Path:
        """Return a name not taken: a session that outlived a server goes on in a second file."""
        path = self._folder / f"{invocation}.mcap"
        number = 1
        while path.exists() or path.with_name(path.name + ".partial").exists():
            number += 1
            path = self._folder / f"{invocation}-{number}.mcap"
        return path
