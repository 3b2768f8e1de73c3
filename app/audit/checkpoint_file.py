"""The checkpoints outside the database: one signed note after the other, each followed by an empty line.

The database commits a batch first and this file gets its note right after. So the file is never ahead of an untouched
database, and behind by one note at most: the next batch is not committed before the note that is missing stands here.
"""

from __future__ import annotations

import os
from itertools import islice, zip_longest
from typing import TYPE_CHECKING

from app.audit.checkpoint import SIGNATURE_MARK, NoteInvalid
from app.audit.errors import RecordDamaged
from app.disk import sync_folder

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from app.audit.checkpoint import Verifier

LINES_PER_NOTE = 6  # origin, size, root, empty, signature, empty
MAX_NOTE_BYTES = 1024
TAIL_BYTES = 4 * MAX_NOTE_BYTES


class CheckpointFile:
    """The writer's side: appends notes durably, and keeps the one it could not write until it can."""

    def __init__(self, path: Path) -> None:
        """Open or create the file; what a crash left half written is cut off before the next note.

        Raises:
            OSError: the file cannot be opened for writing.
            RecordDamaged: the end is no note, nor the torn beginning of one.
        """
        new = not path.exists()
        # O_DSYNC: the write itself returns only when the bytes are on the disk, in one system call.
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_DSYNC, 0o644)
        if new:
            sync_folder(path.parent)
        self.missing: str | None = None
        self.last, torn = last_note(path)
        self._length = path.stat().st_size - torn
        self._torn = torn > 0

    def append(self, note: str) -> None:
        """Write a note; where that fails it is kept as `missing`, and what got written is cut off before the next one.

        Raises:
            OSError: the disk did not take it all.
        """
        self.missing = note
        data = (note + "\n").encode()
        if self._torn:
            os.ftruncate(self._descriptor, self._length)
        self._torn = True
        written = os.write(self._descriptor, data)
        if written != len(data):
            raise OSError(f"`{written}` of `{len(data)}` bytes of a checkpoint were written")
        self._torn = False
        self._length += len(data)
        self.last = note
        self.missing = None

    def catch_up(self) -> None:
        """Write the note that is missing, if one is.

        Raises:
            OSError: the disk still does not take it.
        """
        if self.missing is not None:
            self.append(self.missing)

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._descriptor)


def last_note(path: Path) -> tuple[str | None, int]:
    """Return the last whole note in a file, if any, and how many bytes of a torn one follow it.

    Raises:
        OSError: the file cannot be read.
        RecordDamaged: the end is no note, nor the torn beginning of one.
    """
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        parts = file.read().split(b"\n\n")
    mark = SIGNATURE_MARK.encode()
    signed = [index for index, part in enumerate(parts[:-1]) if index and part.startswith(mark)]
    torn = len(b"\n\n".join(parts[signed[-1] + 1 :] if signed else parts))
    if torn > MAX_NOTE_BYTES:
        raise RecordDamaged(path, f"the last `{torn}` bytes are no checkpoint")
    if not signed:
        return None, torn
    return (parts[signed[-1] - 1] + b"\n\n" + parts[signed[-1]] + b"\n").decode(errors="replace"), torn


def read_notes(path: Path, length: int | None = None) -> Iterator[str]:
    """Yield the notes in a file from the first on; a half written one at the end does not count.

    Lines out of form are yielded as they stand, for the reader to find that it knows no such note.

    Args:
        path: the file.
        length: how many bytes to look at, for a running server goes on appending.

    Raises:
        OSError: the file cannot be read.
    """
    end = path.stat().st_size if length is None else length
    with path.open("rb") as file:
        while file.tell() < end:
            lines = list(islice(file, LINES_PER_NOTE))
            if len(lines) < LINES_PER_NOTE or not lines[-1].endswith(b"\n"):
                return
            yield b"".join(lines if lines[-1] != b"\n" else lines[:-1]).decode(errors="replace")


def read_kept(path: Path, verifier: Verifier) -> dict[int, bytes]:
    """Return the roots of the checkpoints in a file that somebody kept, by how many events they vouch for.

    Args:
        path: a copy of `checkpoints.log`, or one checkpoint as an export has it; witnesses may have signed it as well.
        verifier: the key of the log.

    Raises:
        OSError: the file cannot be read.
        NoteInvalid: it holds no checkpoint of that log, or something else as well, or two that contradict each other.
    """
    roots: dict[int, bytes] = {}
    try:
        for note in _split(path.read_text(encoding="utf-8")):
            head = verifier.open(note)
            _require_one(roots.setdefault(head.size, head.root) == head.root, head.size)
    except (NoteInvalid, UnicodeDecodeError) as error:
        raise NoteInvalid(
            f"`{path}` holds what is no checkpoint by the key `{verifier.text()}`: {error}; valid is a copy of "
            "`checkpoints.log`, or the `.checkpoint` of an export. Where it is one, this log or its key was replaced"
        ) from error
    return roots


def _split(text: str) -> Iterator[str]:
    """Yield the notes of a text: each a text and, behind an empty line, signatures."""
    parts = text.rstrip("\n").split("\n\n")
    for signed, signatures in zip_longest(parts[::2], parts[1::2], fillvalue=""):
        yield f"{signed}\n\n{signatures}\n"


def _require_one(same: bool, size: int) -> None:
    if not same:
        raise NoteInvalid(f"two roots over `{size}` events, both signed: the log had two histories")
