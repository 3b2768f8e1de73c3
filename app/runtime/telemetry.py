"""Telemetry of the sessions that run: one file each, opened by the first of it, sealed after its outcome.

A telemetry file is evidence, not permission: if it cannot be written the session goes on, and the record says so.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from app.audit.errors import RecordUnavailable
from app.audit.event import EventDraft
from app.audit.telemetry import TelemetryWriter, channels
from app.governance.model import EventKind
from app.protocol import CHANNELS
from app.runtime.drafts import SERVER

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from app.audit.telemetry import Level
    from app.protocol import Sighting, UpEvent

LEVELS: Final[Mapping[str, Level]] = {
    EventKind.ALERT: "warning",
    EventKind.INTERVENTION: "error",
    EventKind.RECOVERY: "warning",
}
"""What of a session's reports goes beside its rows, and how loudly."""

UNSEALED: Final = ".mcap.partial"
CUT_OFF: Final = "the server ended before it was complete"
MISSING: Final = "the cell was lost with what it had not sent yet, mostly the last second"


class Telemetry:
    """Writers by invocation."""

    def __init__(self, folder: Path, wall_s: Callable[[], float]) -> None:
        """Take the folder that files go to, and the wall clock."""
        self._folder = folder
        self._wall_s = wall_s
        self._channels = channels(CHANNELS)
        self._writers: dict[str, TelemetryWriter] = {}

    def open(self) -> list[str]:
        """Return the sessions whose files are not sealed yet."""
        return [*self._writers]

    def unsealed(self) -> Counter[str]:
        """Return of how many files of each session an earlier run of the server left only what it had written."""
        return Counter(path.name.removesuffix(UNSEALED).partition("-")[0] for path in self._folder.glob(f"*{UNSEALED}"))

    def write(self, invocation: str, rows: Sequence[tuple[float, ...]]) -> None:
        """Take rows of a session."""
        self._writer(invocation).write_rows(rows)

    def sight(self, sighting: Sighting) -> None:
        """Take where people and things were in a session."""
        self._writer(sighting.invocation).sighting(sighting.time_s, sighting.people, sighting.bodies)

    def _writer(self, invocation: str) -> TelemetryWriter:
        """Return the writer of a session's file, begun if need be."""
        writer = self._writers.get(invocation)
        if writer is None:
            path = self._free_path(invocation)
            writer = self._writers[invocation] = TelemetryWriter(path, self._channels, start_wall_s=self._wall_s())
        return writer

    def note(self, *events: UpEvent) -> None:
        """Set what the watcher said and what followed beside the rows, at the newest row's time."""
        for event in events:
            self._note(event)

    def _note(self, event: UpEvent) -> None:
        writer = None if event.invocation is None else self._writers.get(event.invocation)
        level = LEVELS.get(event.kind)
        if writer is None or level is None:
            return
        said = event.body.get("intervention") or event.body.get("strategy") or event.body.get("signal") or event.kind
        about = event.body.get("rule") or event.body.get("failure") or ""
        writer.event(event.kind, f"{said} {about}".strip(), level=level, detail={**event.body, "tick": event.tick})

    async def seal(self, invocation: str, *, lost: bool = False) -> EventDraft | None:
        """Close a session's file and return the event that vouches for it; None where there was no telemetry.

        With `lost`, its cell was lost, and with it the rows that it had not sent: the event says so, file or none.
        """
        writer = self._writers.pop(invocation, None)
        body: dict[str, str | int] = {}
        if writer is not None:
            try:
                body = (await writer.aclose()).body()
            except RecordUnavailable as error:
                body = {"failed": str(error)}
        if lost:
            body = {**body, "missing": MISSING} if body else {"failed": f"nothing had come of it; {MISSING}"}
        if not body:
            return None
        return EventDraft(kind=EventKind.TELEMETRY, actor=SERVER, invocation=invocation, body=body)

    def _free_path(self, invocation: str) -> Path:
        """Return a name not taken: a session that outlived a server goes on in a second file."""
        path = self._folder / f"{invocation}.mcap"
        number = 1
        while path.exists() or path.with_name(path.name + ".partial").exists():
            number += 1
            path = self._folder / f"{invocation}-{number}.mcap"
        return path
