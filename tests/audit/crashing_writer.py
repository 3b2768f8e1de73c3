"""A process that appends for as long as it lives and says on its output what was acknowledged: `token seq …` a line."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

from app.audit.event import RowWrite
from app.audit.store import AuditStore
from tests.audit.conftest import TIME, draft


async def work(store: AuditStore, run: str, worker: int) -> None:
    number = 0
    while True:
        number += 1
        token = f"{run}-{worker}-{number}"
        events = [draft(token=token, part=part, filler="x" * 100 * (number % 30)) for part in range(1 + number % 4)]
        row = RowWrite(table="settings", values={"name": token, "value": b"1", "updated_at": TIME})
        seqs = await store.append(events, [row])
        os.write(1, f"{token} {' '.join(map(str, seqs))}\n".encode())


async def main(data: Path, run: str) -> None:
    store = AuditStore.open(data)
    await asyncio.gather(*(work(store, run, worker) for worker in range(8)))


asyncio.run(main(Path(sys.argv[1]), sys.argv[2]))
