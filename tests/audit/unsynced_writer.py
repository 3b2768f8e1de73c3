"""A process whose disk takes every write and makes none durable: the system answers fsync with an error.

Says what the last append was told, and dies at once, before anything else is written.
"""

from __future__ import annotations

import asyncio
import ctypes
import errno
import os
import platform
import struct
import sys
from pathlib import Path

from app.audit.errors import RecordUnavailable
from app.audit.event import RowWrite
from app.audit.store import AuditStore
from tests.audit.conftest import TIME, draft

NOT_HERE = 3
SECCOMP, FSYNC, FDATASYNC = {"x86_64": (317, 74, 75), "aarch64": (277, 82, 83)}.get(platform.machine(), (0, 0, 0))
NO_NEW_PRIVILEGES, FILTER, EVERY_THREAD = 38, 1, 1
LOAD, EQUAL, ANSWER = 0x20, 0x15, 0x06  # words of the packet filter that such a rule is written in
FAIL, ALLOW = 0x0005_0000, 0x7FFF_0000


class Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("steps", ctypes.c_void_p))


def fail_every_sync() -> None:
    """Have the system refuse fsync and fdatasync to every thread of this process, from now on."""
    steps = (
        (LOAD, 0, 0, 0),  # the number of the system call
        (EQUAL, 1, 0, FSYNC),
        (EQUAL, 0, 1, FDATASYNC),
        (ANSWER, 0, 0, FAIL | errno.EIO),
        (ANSWER, 0, 0, ALLOW),
    )
    text = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    system = ctypes.CDLL(None, use_errno=True)
    program = Program(len(steps), ctypes.cast(text, ctypes.c_void_p))
    system.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if not SECCOMP or system.syscall(SECCOMP, FILTER, EVERY_THREAD, ctypes.byref(program)):
        os._exit(NOT_HERE)


def setting(name: str, value: bytes) -> RowWrite:
    return RowWrite(table="settings", values={"name": name, "value": value, "updated_at": TIME})


async def main(data: Path) -> None:
    store = AuditStore.open(data)
    await store.append([draft(said="acknowledged")], [setting("profile", b"strict")])
    fail_every_sync()
    try:
        await store.append([draft(said="refused", filler="x" * 50_000)], [setting("profile", b"loose")])
    except RecordUnavailable as error:
        os.write(1, error.reason.encode())
    os._exit(0)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
