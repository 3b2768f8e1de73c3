"""Where executions write what a cell keeps: it has to be written as it always is, and nobody will read it again."""

from __future__ import annotations

import weakref
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from app.cell.journal import Journal


class Journals:
    """A folder for journals that nobody will read again."""

    def __init__(self) -> None:
        """Make the folder; it goes with this object."""
        self._folder = Path(mkdtemp(prefix="reins-evaluation-"))
        self._remove = weakref.finalize(self, rmtree, self._folder)
        self._count = 0

    def open(self) -> Journal:
        """Return a fresh journal."""
        self._count += 1
        return Journal(self._folder / f"{self._count}.journal", boot="evaluation")

    def close(self) -> None:
        """Remove the folder."""
        self._remove()
