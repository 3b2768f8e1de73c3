"""What a disk takes: asked before anything moves on a record, and the names in a folder made durable.

Whoever keeps a record, the server's log or a cell's journal, asks here and says in its own error what comes of it.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

ROOM_BYTES: Final = 64 * 1024  # less than this is no room for the record of a session that comes to its end in order


def full(where: Path | int, what: str) -> str | None:
    """Return why a disk takes no more, as far as it says so without being written to; None: it may.

    One with less than `ROOM_BYTES` free counts as full, one that cannot be looked at as broken.

    Args:
        where: a folder on it, or an open file.
        what: is kept on it, for the words.
    """
    try:
        disk = os.statvfs(where)
    except OSError as error:
        return f"the disk of the {what} cannot be looked at: {error.strerror}"
    free = disk.f_frsize * (disk.f_bfree if os.geteuid() == 0 else disk.f_bavail)
    if disk.f_flag & os.ST_RDONLY:
        return f"the disk of the {what} is read-only"
    if disk.f_blocks and free < ROOM_BYTES:  # a file system without blocks does not say
        return f"the disk of the {what} is full: `{free}` bytes are free; valid: `{ROOM_BYTES}` or more"
    return None


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable.

    Raises:
        OSError: the folder cannot be synced.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
