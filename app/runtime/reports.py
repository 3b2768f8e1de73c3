"""What the fleet asks of whoever makes its cells' reports part of the record."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from app.audit.event import RowWrite
    from app.protocol import Ended, Hello, Sighting, UpEvent


class Reports(Protocol):
    """Who makes a cell's reports, its return and its absence part of the record."""

    def check(self, cell: str, event: UpEvent) -> None:
        """Refuse a report that this cell may not make. Raises `ProtocolError`."""
        ...

    async def absorb(self, cell: str, events: Sequence[UpEvent], rows: Sequence[RowWrite]) -> None:
        """Record reports, the rows given, and what follows for invocations. Raises `RecordUnavailable`."""
        ...

    async def attached(self, cell: str, hello: Hello) -> None:
        """Record that a cell is there. Raises `RecordUnavailable`."""
        ...

    async def reconcile(self, cell: str, hello: Hello, believed: str | None) -> None:
        """Compare what the cell held at `Hello` with the session it was believed to have, older reports being in."""
        ...

    async def left(self, cell: str) -> None:
        """Record that a cell's link is gone."""
        ...

    async def unrecorded(self, cell: str, ended: Sequence[Ended]) -> None:
        """See to sessions that a cell says are over, and cannot report in its journal."""
        ...

    async def overdue(self, cell: str) -> None:
        """See to what a cell owes: a session while it is away, word of its launch, or what became of an answer."""
        ...

    def telemetry(self, cell: str, invocation: str, rows: Sequence[tuple[float, ...]]) -> None:
        """Keep rows of telemetry."""
        ...

    def sighting(self, cell: str, sighting: Sighting) -> None:
        """Keep where people and things were, with the telemetry."""
        ...
