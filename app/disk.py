"""What a disk takes, and whether an open file has its name still: asked before anything moves on a record.

And the names in a folder made durable.

Whoever keeps a record, the server's log or a cell's journal, asks here and says in its own error what comes of it.
"""

from __future__ import annotations

import errno
import os
import secrets
from contextlib import suppress
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

ROOM_BYTES: Final = 64 * 1024  # less than this is no room for the record of a session that comes to its end in order
KEPT_BYTES: Final = 256 * 1024 * 1024  # of a disk for the record alone, or this share of it where that is less
KEPT_SHARE: Final = 0.05


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
    free = _free(disk)
    if disk.f_flag & os.ST_RDONLY:
        return f"the disk of the {what} is read-only"
    if disk.f_blocks and free < ROOM_BYTES:  # a file system without blocks does not say
        return f"the disk of the {what} is full: `{free}` bytes are free; valid: `{ROOM_BYTES}` or more"
    return None


def scarce(where: Path | int) -> bool:
    """Return whether what a disk has left is for the record alone: whatever may be lost is not written there any more.

    Args:
        where: a folder on it, or an open file.

    Raises:
        OSError: it cannot be looked at.
    """
    disk = os.statvfs(where)
    return _free(disk) < min(KEPT_BYTES, KEPT_SHARE * disk.f_frsize * disk.f_blocks)


def _free(disk: os.statvfs_result) -> int:
    """Return how many bytes this process may still put there: root may take what is kept back from others."""
    return disk.f_frsize * (disk.f_bfree if os.geteuid() == 0 else disk.f_bavail)


def displaced(path: Path, held: os.stat_result, what: str) -> str | None:
    """Return why what is written to an open file will not be found under its name; None: it will.

    A file that was deleted or replaced takes everything that is written to it, and loses it with the process.

    Args:
        path: where it was opened.
        held: what was opened there.
        what: it is, for the words.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        return f"the {what} was deleted under the process that writes it: nothing more would be kept"
    except OSError as error:
        return f"the {what} cannot be looked at: {error.strerror}"
    return None if os.path.samestat(found, held) else f"another file stands in the place of the {what}"


def write_private(path: Path, content: bytes) -> None:
    """Put a file in place in one step, readable by its owner alone from the first byte on, and there to stay.

    Raises:
        OSError: the disk did not take it; what stood there stands there still, unless its new name could not be synced.
    """
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def lay_by(path: Path) -> None:
    """Have as many bytes as a file has stand beside it, for `replace_private`; where there is no room, none."""
    with suppress(OSError):
        write_private(_spare(path), bytes(path.stat().st_size))


def replace_private(path: Path, content: bytes) -> None:
    """Put a file in place as `write_private` does, also on a full disk: there it goes over what was laid by.

    Raises:
        OSError: the disk did not take it; as `write_private`.
    """
    try:
        write_private(path, content)
    except OSError as error:
        spare = _spare(path)
        full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        if not full or not spare.is_file() or spare.stat().st_size < len(content):
            raise
        with spare.open("r+b") as file:
            file.write(content)
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        spare.replace(path)
        sync_folder(path.parent)


def _spare(path: Path) -> Path:
    return path.with_name(f"{path.name}.spare")


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
