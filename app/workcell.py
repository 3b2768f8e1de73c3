"""A cell's process: journal, link and control loop put together around a simulated workcell.

The world is built when the first policy has come over the link, because the site is part of the policy. One process
per cell and data directory; a lock sees to that.
"""

from __future__ import annotations

import asyncio
import gc
import os
import secrets
import sys
import traceback
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final

import orjson

from app.cell.governed import GovernedCell
from app.cell.journal import Journal, JournalDamaged, JournalUnavailable
from app.cell.latch import Latch
from app.cell.link import Identity, Link
from app.cell.loop import Lease, Outbox, TickLoop
from app.cell.pin import KeyPin
from app.cell.recorder import Recorder
from app.cell.runner import close_left_open, left_latched
from app.children import CellRuns, cell_lock
from app.clock import wall_s
from app.config import ConfigError, cell_terms
from app.governance.bundle_yaml import parse
from app.sim.faults import Scenario
from app.sim.robot import load_robot
from app.sim.workcell import make_workcell
from app.terminal import DAMAGED, FINDING, FINE, MISUSE, remark, say_error, stop_signals

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from app.cell.loop import Order
    from app.config import CellSettings
    from app.governance.policy import PolicySet

SCENARIOS: Final = Path(__file__).resolve().parent / "sim" / "scenarios"
ROBOT: Final = "mobile-ur5e"
ORPHAN_S: Final = 60.0  # an idle child whose server is gone for so long leaves as well
LOOK_S: Final = 1.0
SWITCH_S: Final = 0.001  # how soon the link's thread gets its turn beside the loop's


def run_cell(settings: CellSettings) -> int:
    """Run a cell until it is told to stop; return the exit code.

    Raises:
        ConfigError: a setting cannot be used.
    """
    scenario, robot = read_scenario(settings.scenario), robot_model(settings.robot)  # before anything is left behind
    try:
        settings.data.mkdir(mode=0o700, parents=True, exist_ok=True)
        with cell_lock(settings.data, cell_terms(settings)):
            sys.setswitchinterval(SWITCH_S)
            return asyncio.run(_run(settings, scenario, robot))
    except JournalUnavailable as error:
        say_error(f"{settings.id}: {error}")
        return DAMAGED if isinstance(error, JournalDamaged) else FINDING
    except CellRuns as error:
        say_error(f"{settings.id}: {error}")
    except OSError as error:
        say_error(f"the cell cannot use `{settings.data}`: {error.strerror}")
    return MISUSE


async def _run(settings: CellSettings, scenario: Scenario | None, robot: Path | None) -> int:
    boot = f"boot_{secrets.token_hex(8)}"
    journal, latch = Journal(settings.data / "journal", boot=boot, now_s=wall_s()), Latch(settings.data / "latch")
    close_left_open(journal, Recorder(journal, wall_s, lambda _: None))
    inbox: SimpleQueue[Order] = SimpleQueue()
    outbox, lease = Outbox(journal.last_seq), Lease()

    def build(policies: PolicySet, kernel_key: str, acknowledged: int) -> TickLoop:
        journal.number_behind(acknowledged)
        with suppress(JournalUnavailable):  # they are forgotten all the same; only the file was not made smaller
            journal.acknowledge(acknowledged)
        check_names(settings.scenario, scenario, policies)
        substrate = make_workcell(
            policies.site,
            cell_id=settings.id,
            seed=settings.seed,
            scenario=scenario,
            robot_mjcf=robot,
        )
        runner = GovernedCell(
            substrate, policies, kernel_key=kernel_key, journal=journal, outbox=outbox, wall=wall_s, latch=latch
        )
        runner.write_behind()
        # The loop lives in this process: a collector that walks all that was built at the start, because a policy is
        # being compiled beside it, would take five control periods at once.
        gc.freeze()  # without collecting first: that holds up the link's thread as long
        return TickLoop(runner, inbox, outbox, lease, pace=settings.pace)

    link = Link(
        Identity(
            cell=settings.id,
            boot=boot,
            journal=journal,
            robot=settings.robot or ROBOT,
            latched=left_latched(journal, latch),
            token=settings.token,
        ),
        _address(settings),
        KeyPin(path=settings.data / "kernel.pub", fixed=settings.server_key),
        build,
        inbox,
        outbox,
        lease,
        lambda word: remark(f"{settings.id}: {word}"),
    )
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in stop_signals():
        loop.add_signal_handler(number, stop.set)
    orphaned = asyncio.create_task(_leave_when_orphaned(settings.parent, outbox, stop))
    try:
        await link.run(stop)
    except RuntimeError as error:
        say_error(f"{settings.id}: {error}")
        traceback.print_exception(error)
        return FINDING
    finally:
        orphaned.cancel()
    return FINE


def read_scenario(name: str | None) -> Scenario | None:
    """Return what happens in the simulated world: a scenario that comes with Reins, by name, or a YAML file.

    Raises:
        ConfigError: there is no such scenario, or it says something that means nothing.
    """
    if name is None:
        return None
    path = Path(name) if name.endswith((".yaml", ".yml")) else SCENARIOS / f"{name}.yaml"
    try:
        return _scenario_of(path)
    except (OSError, ValueError) as error:
        shipped = ", ".join(sorted(known.stem for known in SCENARIOS.glob("*.yaml")))
        raise ConfigError("scenario", name, f"a YAML file, or one of {shipped} ({error})") from error


def check_names(name: str | None, scenario: Scenario | None, policies: PolicySet) -> None:
    """Refuse a scenario about an object that the site does not have, or of a moment that never comes.

    Raises:
        ConfigError: there is such an object, or such a capability or phase of one, in it.
    """
    found = Scenario() if scenario is None else scenario
    things = [str(fault.sizes["object"]) for fault in found.faults if "object" in fault.sizes]
    _known(name, "faults of the site's objects", things, policies.site.objects)
    moments = [*(fault.at for fault in found.faults), *(person.start for person in found.people)]
    for moment in (one for one in moments if one.time_s is None):
        _known(name, "moments of the capabilities", [moment.capability], policies.capabilities)
        phases = policies.capabilities[moment.capability].phases
        _known(name, f"moments of the phases of `{moment.capability}`", [moment.phase], phases)


def _known(name: str | None, what: str, names: Iterable[str], known: Collection[str]) -> None:
    if strange := sorted(set(names).difference(known)):
        raise ConfigError("scenario", name, f"{what}: {', '.join(known)} (not `{strange[0]}`)")


def _scenario_of(path: Path) -> Scenario:
    document, problems = parse(path.name, path.read_text())
    if problems:
        raise ValueError("; ".join(map(str, problems)))
    return Scenario.read(document.value)


def robot_model(name: str | None) -> Path | None:
    """Return the MJCF file of another robot: a path, or a name from an installed menagerie.

    Raises:
        ConfigError: there is no such model, or the workcell cannot drive it.
    """
    if name is None:
        return None
    path = _robot_file(name)
    try:
        load_robot(path)
    except ValueError as error:
        raise ConfigError("robot", name, f"a model that the workcell can drive ({error})") from error
    return path


def _robot_file(name: str) -> Path:
    path = Path(name)
    if path.suffix == ".xml" and path.is_file():
        return path.resolve()
    menagerie = find_spec("mujoco_menagerie")
    for folder in menagerie.submodule_search_locations or [] if menagerie else []:
        for found in sorted(Path(folder).glob(f"**/{name}/{name}.xml")):
            return found
    raise ConfigError("robot", name, "the path of an MJCF file, or a model's name where a menagerie is installed")


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
