"""A cell's process: journal, link and control loop put together around a simulated workcell.

The world is built when the first policy has come over the link, because the site is part of the policy. One process
per cell and data directory; a lock sees to that.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import signal
import sys
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final

import orjson

from app.cell.governed import GovernedCell
from app.cell.journal import Journal, JournalUnavailable
from app.cell.link import Identity, KeyPin, Link
from app.cell.loop import Lease, Outbox, TickLoop
from app.children import CellRuns, cell_lock
from app.clock import wall_s
from app.terminal import FINDING, FINE, MISUSE, say, say_error

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.cell.loop import Order
    from app.config import CellSettings
    from app.governance.policy import PolicySet

ROBOT: Final = "mobile-ur5e"
ORPHAN_S: Final = 60.0  # an idle child whose server is gone for so long leaves as well
LOOK_S: Final = 1.0
SWITCH_S: Final = 0.001  # how soon the link's thread gets its turn beside the loop's


def run_cell(settings: CellSettings) -> int:
    """Run a cell until it is told to stop; return the exit code.

    Raises:
        ConfigError: a setting cannot be used.
    """
    try:
        settings.data.mkdir(mode=0o700, parents=True, exist_ok=True)
        with cell_lock(settings.data):
            sys.setswitchinterval(SWITCH_S)
            return asyncio.run(_run(settings))
    except (CellRuns, JournalUnavailable) as error:
        say_error(f"{settings.id}: {error}")
    except OSError as error:
        say_error(f"the cell cannot use `{settings.data}`: {error.strerror}")
    return MISUSE


async def _run(settings: CellSettings) -> int:
    boot = f"boot_{secrets.token_hex(8)}"
    inbox: SimpleQueue[Order] = SimpleQueue()
    outbox, lease = Outbox(), Lease()

    journal = Journal(settings.data / "journal", boot=boot)

    def build(policies: PolicySet, kernel_key: str, acknowledged: int) -> TickLoop:
        from app.sim import make_workcell

        journal.number_behind(acknowledged)
        substrate = make_workcell(
            policies.site, cell_id=settings.id, seed=settings.seed, scenario=settings.scenario, robot=settings.robot
        )
        runner = GovernedCell(substrate, policies, kernel_key=kernel_key, journal=journal, outbox=outbox, wall=wall_s)
        return TickLoop(runner, inbox, outbox, lease, pace=settings.pace)

    link = Link(
        Identity(
            cell=settings.id,
            boot=boot,
            robot=settings.robot or ROBOT,
            token=settings.token,
        ),
        _address(settings),
        KeyPin(path=settings.data / "kernel.pub", fixed=settings.server_key),
        build,
        inbox,
        outbox,
        lease,
        lambda word: say(f"{settings.id}: {word}"),
    )
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    orphaned = asyncio.create_task(_leave_when_orphaned(settings.parent, outbox, stop))
    try:
        await link.run(stop)
    except RuntimeError as error:
        say_error(f"{settings.id}: {error}: {error.__cause__}")
        return FINDING
    finally:
        orphaned.cancel()
    return FINE


def _address(settings: CellSettings) -> Callable[[], str]:
    """Return where to dial: the address given, or what the server's own note says at that moment."""
    if (fixed := settings.server) is not None:
        return lambda: fixed
    note = settings.server_file

    def read() -> str:
        if note is None or not note.exists():
            raise ValueError("no server runs")
        return str(orjson.loads(note.read_bytes())["url"])

    return read


async def _leave_when_orphaned(parent: int | None, outbox: Outbox, stop: asyncio.Event) -> None:
    """Stop an idle child whose server does not come back. One that holds a session stays: somebody has to."""
    idle_s = 0.0
    while parent is not None and idle_s < ORPHAN_S:
        await asyncio.sleep(LOOK_S)
        state = outbox.state
        orphan = os.getppid() != parent and (state is None or (state.holding and state.invocation is None))
        idle_s = idle_s + LOOK_S if orphan else 0.0
    if parent is not None:
        stop.set()
