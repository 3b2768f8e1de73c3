"""What can go wrong while recording or reading the record.

AuditError
├── RecordUnavailable   nothing was acknowledged: disk full, read-only, I/O error, closed, backlog
├── RecordUnreadable    what is stored cannot be read now, and nobody knows whether it is good: descriptors, locks, I/O
├── RecordDamaged       what is stored contradicts what was signed, or cannot be read as a log
├── EventUnreadable     a stored event cannot be read as one
├── StoreInUse          another process holds this data directory
├── EventMalformed      the draft cannot become canonical bytes; the caller's bug
├── RowMalformed        the row does not fit its table; the caller's bug
├── RowUnreadable       a stored row of state cannot be read as what its table holds
└── RowExists           a row that may be written once is there already (a used permit, a taken idempotency key)
"""

from __future__ import annotations

from json import JSONDecodeError
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class AuditError(Exception):
    """Everything the record raises."""


class RecordUnavailable(AuditError):
    """The events are not known to be recorded, so nothing may move on them (design, rule 2)."""

    def __init__(self, reason: str) -> None:
        """Keep the reason as a person reads it in the health report."""
        self.reason = reason
        super().__init__(f"the record cannot be written: {reason}")


class RecordUnreadable(AuditError):
    """What is stored could not be read at this moment, which says nothing about what it holds."""

    def __init__(self, path: Path, problem: str) -> None:
        """Name the file and why; where it lies concerns nobody who asks over the network."""
        self.path = path
        self.problem = problem
        super().__init__(f"the record cannot be read now: `{path.name}`: {problem}")


class RecordDamaged(AuditError):
    """The stored log is missing, no log, or contradicts its own signatures."""

    def __init__(self, path: Path, problem: str) -> None:
        """Name the file and what is wrong with it."""
        self.path = path
        self.problem = problem
        super().__init__(f"`{path}`: {problem}")


class EventUnreadable(AuditError, ValueError):
    """The bytes of a stored event are not what a server writes: the database was damaged or changed."""

    def __init__(self, seq: int) -> None:
        """Name the event; what it holds may be anything, and is not shown."""
        self.seq = seq
        super().__init__(f"event `{seq}` cannot be read: its bytes are no event")


class StoreInUse(AuditError):
    """A second writer would fork the log."""

    def __init__(self, path: Path) -> None:
        """Name the directory that is taken."""
        self.path = path
        super().__init__(f"`{path}` is in use by another server: valid is a data directory of its own")


class EventMalformed(AuditError):
    """A draft holds something that canonical JSON cannot say."""

    def __init__(self, kind: str, problem: str) -> None:
        """Name the kind of the event and what is wrong with it."""
        self.kind = kind
        self.problem = problem
        super().__init__(f"an event of kind `{kind}` cannot be recorded: {problem}")


class RowMalformed(AuditError):
    """A row names an unknown table or column, misses a column, or holds a value of another type."""


class RowUnreadable(AuditError):
    """A stored row of state cannot be read as what its table holds: the database was damaged or changed."""

    def __init__(self, table: str, key: str, cause: Exception) -> None:
        """Name the row and what is wrong with it; what it holds may be anything, and is not shown."""
        self.table = table
        self.key = key
        self.problem = (
            f"its content is {'no JSON' if isinstance(cause, JSONDecodeError) else 'not what a server writes'}"
        )
        super().__init__(f"the row `{key}` of the table `{table}` cannot be read: {self.problem}")


class RowExists(AuditError):
    """A row to be written once exists already; the events it came with were not recorded either."""

    def __init__(self, table: str, key: tuple[object, ...]) -> None:
        """Name the table and the key that is taken."""
        self.table = table
        self.key = key
        super().__init__(f"`{table}` holds a row for `{'/'.join(map(str, key))}` already")
