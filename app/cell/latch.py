"""A latched stop that outlives the process where the journal cannot say so: one byte, in a file of its own.

A journal whose disk is full, or that was deleted under the cell, takes nothing more, and whatever starts the cell again
would find no stop in it. The byte has its place from the start and is overwritten there, which a full disk takes.
Where not even that can be written (a disk that is read-only or gone) no journal can be opened either: nothing starts.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

from app.cell.journal import JournalUnavailable
from app.disk import sync_folder

if TYPE_CHECKING:
    from pathlib import Path

LATCHED: Final = b"1"
FREE: Final = b"0"


class Latch:
    """One byte on disk. `found` is whether an earlier run of the cell left its stop here."""

    def __init__(self, path: Path) -> None:
        """Open or create the file.

        Raises:
            JournalUnavailable: it cannot be.
        """
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            known = os.pread(self._file, 1, 0)
            self.found = known not in (b"", FREE)
            if not known:
                self._write(FREE)
                sync_folder(path.parent)
        except OSError as error:
            raise JournalUnavailable(f"cannot open `{path}`: {error.strerror}") from error
        self._kept = self.found

    def keep(self) -> None:
        """Return once the disk has the stop. Raises `JournalUnavailable`."""
        self._set(True)

    def leave(self) -> None:
        """Return once the disk has it no more; at once where it never had. Raises `JournalUnavailable`."""
        if self._kept:
            self._set(False)

    def _set(self, kept: bool) -> None:
        self._kept = True  # as long as nobody knows better
        try:
            self._write(LATCHED if kept else FREE)
        except OSError as error:
            raise JournalUnavailable(f"cannot keep the stop beside the journal: {error.strerror}") from error
        self._kept = kept

    def _write(self, byte: bytes) -> None:
        os.pwrite(self._file, byte, 0)
        os.fsync(self._file)
