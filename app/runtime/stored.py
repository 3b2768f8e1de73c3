"""Rows of state, read back as values.

Nobody signs a row, and a disk, a restore or a hand may have damaged it. One that cannot be read stops whoever asks for
that one thing, by name; it keeps nobody from everything else. What was found damaged stands in `/healthz`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from app.audit.errors import RowUnreadable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from app.audit.reader import Row

T = TypeVar("T")
KEYS = ("id", "name", "digest")
CONTENT = ("document", "value", "files")


class Stored:
    """Reads rows of one server's state, and remembers which of them could not be read."""

    def __init__(self) -> None:
        """Start with nothing read."""
        self._damaged: dict[tuple[str, str], str] = {}

    def read(self, table: str, row: Row, parse: Callable[[bytes], T]) -> T:
        """Return what a row holds.

        Args:
            table: the row's.
            row: as the store returned it.
            parse: makes a value of the row's content.

        Raises:
            RowUnreadable: it cannot be read as what the table holds.
        """
        key = str(next(row[name] for name in KEYS if name in row))
        content = next(row[name] for name in CONTENT if name in row)
        try:
            return parse(content)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            found = RowUnreadable(table, key, error)
            self._damaged[table, key] = found.problem
            raise found from error

    def those_of(self, table: str, rows: Sequence[Row], parse: Callable[[bytes], T]) -> list[T]:
        """Return what rows hold, without those that cannot be read: `trouble` names them."""
        found: list[T] = []
        for row in rows:
            try:
                found.append(self.read(table, row, parse))
            except RowUnreadable:
                continue
        return found

    def trouble(self) -> str | None:
        """Say which rows could not be read, since the server started."""
        if not self._damaged:
            return None
        named = "; ".join(
            f"`{key}` in the table `{table}`: {why}" for (table, key), why in sorted(self._damaged.items())
        )
        return f"{named}; nothing comes of such a row, and lists leave it out; valid: look with `reins audit verify`"
