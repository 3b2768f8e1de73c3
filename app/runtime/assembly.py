"""Puts the runtime together, and runs what it does in the background."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from app.audit.event import EventDraft
from app.clock import wall_s as wall_clock_s
from app.governance.model import EventKind, Outcome
from app.runtime.broadcast import Broadcast
from app.runtime.desk import Desk
from app.runtime.feed import Feed
from app.runtime.fleet import Fleet
from app.runtime.governor import Governor
from app.runtime.kernel import Kernel
from app.runtime.register import Register
from app.runtime.sessions import ABSENT_S, Sessions
from app.runtime.shadow import Shadow
from app.runtime.succession import Succession
from app.runtime.telemetry import Telemetry
from app.runtime.versions import Versions

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from app.audit.store import AuditStore
    from app.governance.policy import PolicySet
    from app.runtime.examining import Examine
    from app.runtime.invocation import Invocation


class Runtime:
    """A governor with everything it stands on."""

    def __init__(  # noqa: PLR0913  # the parts of a server, each by its name
        self,
        store: AuditStore,
        policy: PolicySet,
        signing_key: Ed25519PrivateKey,
        *,
        default_profile: str,
        examine: Examine,
        promises: str | None = None,
        telemetry_folder: Path | None = None,
        absent_s: float = ABSENT_S,
        take_directory: bool = False,
        wall_s: Callable[[], float] = wall_clock_s,
        may_give: Callable[[str], bool] = lambda _: True,
        may_vouch: Callable[[str], bool] = lambda _: True,
    ) -> None:
        """Wire the parts of one server.

        Args:
            store: the opened record.
            policy: what the directory of this start holds; in force, unless an engineer put another version there.
            signing_key: what authorizations are signed with.
            default_profile: for a cell never seen before.
            examine: who examines candidates of policy.
            promises: what the directory's `properties.yaml` says; None where it says nothing.
            telemetry_folder: where telemetry files go; the store's own by default.
            absent_s: how long a cell with a session may be away before the session is given up.
            take_directory: `policy` comes into force in any case.
            wall_s: the wall clock; deadlines go by it.
            may_give: whether somebody of that name may answer questions now; what they granted ends when not.
            may_vouch: whether somebody of that name may put policy in force now; their word is worth nothing when not.
        """
        self.store = store
        self.register = Register(store, wall_s)
        self.feed = Feed(store)
        self.fleet = Fleet(self.register, default_profile=default_profile)
        self.kernel = Kernel(self.register, self.fleet, policy, signing_key)
        self.desk = Desk(self.register, self.fleet, self.kernel)
        self.desk.grants.may_give = may_give
        self.succession = Succession(self.register, self.fleet, self.desk, self.kernel)
        self.versions = Versions(self.register, self.kernel, self.succession, examine, promises)
        self.versions.may_vouch = may_vouch
        self.shadow = Shadow(self.register, self.versions)
        self._take_directory = take_directory
        self.telemetry = Telemetry(telemetry_folder or store.places.telemetry, wall_s)
        self.sessions = Sessions(self.register, self.fleet, self.desk, self.telemetry, absent_s=absent_s)
        self.fleet.report_to(self.sessions)
        self.broadcast = Broadcast(store, self.register, self.desk, self.fleet)
        self.register.on_final = self._release
        self.governor = Governor(
            register=self.register, kernel=self.kernel, fleet=self.fleet, desk=self.desk, feed=self.feed
        )

        self.governor.shadowed = self.shadow.observe
        self.governor.sealed = self.sessions.sealed
        self._tasks: list[asyncio.Task[None]] = []

    def _release(self, invocation: Invocation) -> None:
        ended = invocation.outcome is not Outcome.FAULT  # a fault is the server's word; the cell may hold it still
        self.fleet.release(invocation.cell, invocation.id, ended=ended)

    def _broke(self, task: asyncio.Task[None]) -> None:
        """Let a bug in the background end all of it: without beats every cell holds by itself, and health says why."""
        error = None if task.cancelled() else task.exception()
        if error is None:
            return
        self.governor.broken = f"`{task.get_name()}` broke: {error!r}"
        for other in self._tasks:
            other.cancel()
        message = f"`{task.get_name()}` broke, and all work in the background ends with it"
        asyncio.get_running_loop().call_exception_handler({"message": message, "exception": error})

    async def start(self) -> None:
        """Read back what an earlier run left, close what is overdue, and record that the server is there.

        Raises:
            RecordUnavailable: nothing can be recorded, so nothing may start.
            PolicyErrors, NotFound, RowUnreadable, ExaminationFailed: the version that an engineer put in force cannot
                be enforced any more.
        """
        drafts, rows = await self.versions.recall(take_directory=self._take_directory)
        await self.register.recall()
        await self.fleet.roster.recall()
        await self.desk.recall()
        await self.sessions.recall()
        body: dict[str, Any] = {
            "policy_version": self.kernel.policy.digest,
            "unfinished": [known.id for known in self.register.live()],
        }
        if self.register.unfounded:
            body["unfounded"] = self.register.unfounded
        await self.store.append(
            [EventDraft(kind=EventKind.BOOT, actor="server", body=body), *drafts],
            rows,
        )
        await self.sessions.tell_unsealed()
        await self.versions.proving.recall()
        await self.shadow.recall()
        await self.succession.prepare(self.versions.compiled)
        await self.desk.expire_due()
        done = self.succession.at_once()
        await self.succession.recall()
        await self.succession.afterwards(done)
        await self.broadcast.open()

    @asynccontextmanager
    async def running(self) -> AsyncGenerator[Governor]:
        """Start, and keep beats, deadlines and cells tended inside the context."""
        await self.start()
        tasks = self._tasks = [
            asyncio.create_task(self.fleet.beat(), name="beat"),
            asyncio.create_task(self.fleet.watch(), name="links"),
            asyncio.create_task(self.fleet.tend(), name="tend"),
            asyncio.create_task(self.governor.watch_leases(), name="leases"),
            asyncio.create_task(self.broadcast.run(), name="broadcast"),
            asyncio.create_task(self.desk.watch_deadlines(), name="deadlines"),
            asyncio.create_task(self.desk.grants.watch(), name="grants"),
            asyncio.create_task(self.succession.watch(), name="succession"),
            asyncio.create_task(self.succession.keep_holding(), name="holding"),
        ]
        for task in tasks:
            task.add_done_callback(self._broke)
        try:
            yield self.governor
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            await self.succession.close()
            self.feed.close()
            self.broadcast.close()
            await self.sessions.close()
