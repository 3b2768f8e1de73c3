"""What stands in for a cell's parts in an ordeal: a workcell that remembers what it was told, and a disk that fills."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.cell.journal import Journal, JournalUnavailable
from app.sim.workcell import Workcell

if TYPE_CHECKING:
    from app.cell.journal import Entry
    from app.governance.model import Command, Observation


class Witness(Workcell):
    """A workcell that remembers what its drives were told."""

    sent: Command | None = None
    before: Command | None = None

    def step(self, command: Command) -> Observation:
        """Do a step, and note what the drives follow in it."""
        follows = self._grant is not None and self.powered
        self.before, self.sent = self.sent, command if follows else self.hold()
        return super().step(command)


class Disk(Journal):
    """A journal whose disk may be full."""

    full = False

    def append(self, **entry: object) -> Entry:  # type: ignore[override]  # passed on as it came
        """Write an entry, if there is room."""
        self.require_room()
        return super().append(**entry)  # type: ignore[arg-type]

    def require_room(self) -> None:
        """Say whether there is room."""
        if self.full:
            raise JournalUnavailable("the disk is full")
