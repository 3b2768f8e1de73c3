"""A process whose disk gets full: no file may grow beyond a limit of the system's. Says as JSON what it saw."""

from __future__ import annotations

import asyncio
import json
import resource
import sys
from pathlib import Path

from app.audit.errors import RecordUnavailable
from app.audit.store import AuditStore
from app.clock import monotonic_s
from tests.audit.conftest import draft

DEADLINE_S = 20.0


async def main(data: Path) -> None:
    store = AuditStore.open(data)
    await store.append([draft(n=0)])
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
    acknowledged, refusals = 1, []
    while len(refusals) < 3:
        try:
            await store.append([draft(filler="x" * 20_000)])
            acknowledged += 1
        except RecordUnavailable as error:
            refusals.append(error.reason)
    seen = {"acknowledged": acknowledged, "refusals": refusals, "healthy": store.healthy, "reason": store.reason}
    seen |= {"size": store.size, "readable": len(await store.events(limit=1000)), "verified": (await store.verify()).ok}
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    deadline = monotonic_s() + DEADLINE_S
    while not store.healthy and monotonic_s() < deadline:
        await asyncio.sleep(0.02)
    seen["healthy_again"] = store.healthy
    seen["next"] = (await store.append([draft()]))[0]
    seen["verified_again"] = (await store.verify()).problem
    await store.close()
    print(json.dumps(seen))


asyncio.run(main(Path(sys.argv[1])))
