"""The cells `reins serve` starts for itself: one process each, watched, started again when it dies, stopped at the end.

A cell that cannot be started as it is told (exit code 2) would end the same way again, so it is given up at once; where
nothing else was seen of it, the server ends as well, because the same settings are its own. So is one whose journal is
damaged (65): no start mends that, and what it holds is for somebody to look at.

A cell outlives its server on purpose: it holds the robot where it is and dials on. So a server that comes back first
looks whether the cell of that name is still there (its lock is held) and adopts it instead of starting another.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import signal
import sys
import time
from collections import deque
from typing import TYPE_CHECKING, Final, TextIO, cast

from app.clock import monotonic_s
from app.config import CELL_TOKEN_VARIABLE, cell_terms
from app.terminal import DAMAGED, MISUSE

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import Callable, Generator, Mapping
    from pathlib import Path

    from app.config import Settings

LOCK_FILE: Final = "cell.lock"
LOCK_TRIES: Final = 10
LOCK_PAUSE_S: Final = 0.01
RESTARTS: Final = 5  # within RESTARTS_WITHIN_S; after that a cell stays down until somebody starts it, or the server
RESTARTS_WITHIN_S: Final = 120.0
LOOK_S: Final = 0.25
STOP_S: Final = 3.5  # a controlled stop, the last events, and leave


class CellRuns(Exception):
    """Another process is this cell already."""

    def __init__(self, folder: Path, pid: int | None) -> None:
        """Name the folder and the process that has it."""
        self.pid = pid
        super().__init__(f"`{folder}` belongs to a cell that runs (process `{pid}`); valid: one process for each cell")


@contextlib.contextmanager
def cell_lock(folder: Path, started_with: Mapping[str, object] | None = None) -> Generator[None]:
    """Be the one process of a cell; the lock is free again however the process ends.

    Its file holds the process id, and in a second line what the process was started with, for a server that adopts it.

    Raises:
        CellRuns: another process is.
        OSError: the folder cannot be written.
    """
    with (folder / LOCK_FILE).open("a+") as file:
        if not _locked(file):
            raise CellRuns(folder, running_cell(folder))
        file.truncate(0)
        file.write(f"{os.getpid()}\n{json.dumps(dict(started_with or {}))}\n")
        file.flush()
        yield


def _locked(file: TextIO) -> bool:
    """Take the lock of a cell, and say whether it could be had; who looks whether the cell runs has it for a moment."""
    for _ in range(LOCK_TRIES):
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        time.sleep(LOCK_PAUSE_S)
    return False


def running_cell(folder: Path) -> int | None:
    """Return the process id of the cell that holds this folder's lock, None if none does."""
    with contextlib.suppress(FileNotFoundError), (folder / LOCK_FILE).open("r") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            text = file.readline().strip()
            return int(text) if text.isdigit() else None
    return None


def kept_settings(folder: Path, wanted: Mapping[str, object]) -> str:
    """Say what a running cell was started with otherwise than is wanted now: it keeps that until it is started again.

    Empty where nothing differs, or the cell did not say.
    """
    try:
        _, _, text = (folder / LOCK_FILE).read_text().partition("\n")
        known: object = json.loads(text or "{}")
    except (OSError, ValueError):
        return ""
    if not isinstance(known, dict):
        return ""
    found = cast("dict[str, object]", known)
    return ", ".join(
        f"{name} `{_shown(found[name])}` (not `{_shown(value)}`)"
        for name, value in wanted.items()
        if name in found and found[name] != value
    )


def _shown(value: object) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


class Children:
    """The child cells of one server."""

    def __init__(
        self,
        settings: Settings,
        token: str,
        report: Callable[[str, str], None],
        restarts: int = RESTARTS,
        expect: Callable[[str, bool], None] = lambda _, __: None,
    ) -> None:
        """Take what the cells are started with.

        Args:
            settings: the server's.
            token: the cells' bearer token; reaches them through their environment.
            report: called with a cell's name and what happened to it.
            restarts: how often in `RESTARTS_WITHIN_S` a cell that died is started again.
            expect: told which cell is being started, and (False) which is given up.

        `misused` is set when a cell cannot be started with these settings: the server has no use for them either.
        """
        self._settings = settings
        self._token = token
        self._report = report
        self._restarts = restarts
        self._expect = expect
        self._given_up: dict[str, str] = {}
        self._stopping = asyncio.Event()
        self._watches: list[asyncio.Task[None]] = []
        self.misused = asyncio.Event()

    def start(self) -> None:
        """Start or adopt every cell; returns at once."""
        self._watches = [asyncio.create_task(self._keep(cell)) for cell in self._settings.cell_ids()]

    def trouble(self) -> str | None:
        """Return which cells were given up, and why; None while every cell runs or is about to."""
        return "; ".join(f"`{cell}` {why}" for cell, why in sorted(self._given_up.items())) or None

    async def stop(self) -> None:
        """Ask every cell for a controlled stop, wait, and end by force what does not leave."""
        self._stopping.set()
        await asyncio.gather(*self._watches)

    async def _keep(self, cell: str) -> None:
        """Keep a cell until told to stop; whatever ends that sooner is said, and keeps no other from being ended."""
        try:
            await self._keep_running(cell)
        except Exception as error:
            self._expect(cell, False)
            self._given_up[cell] = f"is not kept any more: {error or type(error).__name__}"
            self._report(cell, self._given_up[cell])

    async def _keep_running(self, cell: str) -> None:
        folder = self._settings.layout.cell(cell)
        deaths: deque[float] = deque()
        known = False
        while not self._stopping.is_set():
            code: int | str
            try:
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                if (pid := running_cell(folder)) is not None:
                    known = True
                    await self._watch_adopted(cell, folder, pid)
                    continue
                self._expect(cell, True)
                code = await self._watch_child(await self._spawn(cell))
            except OSError as error:  # the system has no process or file to give just now: a death like any other
                code = error.strerror or type(error).__name__
            if self._stopping.is_set():
                return
            why = _hopeless(code, folder)
            if code == MISUSE and why and not known:
                self.misused.set()
            known = known or (isinstance(code, int) and code != MISUSE)
            if why is None and _died_often(deaths, self._restarts):
                why = f"ended {len(deaths)} times in a row, the last time with `{code}`"
                deaths.clear()
            if why is not None:
                await self._give_up(cell, folder, why)
                continue
            self._report(cell, f"ended with `{code}`; starting it again, idle")
            self._expect(cell, True)
            await self._rest(0.2 * 2 ** len(deaths))

    async def _give_up(self, cell: str, folder: Path, why: str) -> None:
        """Start a cell no more, say so, and wait for somebody to start it by hand."""
        self._expect(cell, False)
        self._given_up[cell] = f"{why}; not started again"
        self._report(cell, self._given_up[cell])
        while not self._stopping.is_set() and running_cell(folder) is None:
            await self._rest(LOOK_S)
        del self._given_up[cell]

    async def _spawn(self, cell: str) -> Process:
        layout, settings = self._settings.layout, self._settings
        words = ["cell", "--id", cell, "--server-file", str(layout.server), "--data", str(layout.cell(cell))]
        words += ["--pace", str(settings.pace), "--seed", str(settings.seed), "--parent", str(os.getpid())]
        for flag, value in (("--scenario", settings.scenario), ("--robot", settings.robot)):
            words += [flag, value] if value is not None else []
        return await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "app.cli",
            *words,
            stdin=asyncio.subprocess.DEVNULL,
            env={**os.environ, CELL_TOKEN_VARIABLE: self._token},
            start_new_session=True,  # Ctrl-C is the server's to hear; it stops its cells in order
        )

    async def _watch_child(self, child: Process) -> int:
        ended = asyncio.create_task(child.wait())
        stopping = asyncio.create_task(self._stopping.wait())
        await asyncio.wait({ended, stopping}, return_when=asyncio.FIRST_COMPLETED)
        stopping.cancel()
        if not ended.done():
            child.send_signal(signal.SIGTERM)
            await asyncio.wait({ended}, timeout=STOP_S)
            if not ended.done():
                child.kill()
        return await ended

    async def _watch_adopted(self, cell: str, folder: Path, pid: int) -> None:
        kept = kept_settings(folder, cell_terms(self._settings))
        word = f"; it keeps {kept} until it is started again" if kept else ""
        self._report(cell, f"runs already (process `{pid}`); adopted{word}")
        while running_cell(folder) == pid:
            await self._rest(LOOK_S)
            if self._stopping.is_set():
                await _end_adopted(folder, pid)
                return

    async def _rest(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._stopping.wait(), seconds)


def _hopeless(code: int | str, folder: Path) -> str | None:
    """Return why a cell that ended so is not started again; None where that may help."""
    if code == MISUSE and running_cell(folder) is None:  # else another process was faster, and is adopted
        return f"cannot be started as it is told: it ended with `{code}`"
    return f"cannot go on from a damaged journal: it ended with `{code}`" if code == DAMAGED else None


def _died_often(deaths: deque[float], restarts: int) -> bool:
    """Note a death, and say whether there were more of them lately than a cell may have."""
    deaths.append(monotonic_s())
    while deaths[0] < monotonic_s() - RESTARTS_WITHIN_S:
        deaths.popleft()
    return len(deaths) > restarts


async def _end_adopted(folder: Path, pid: int) -> None:
    for number, patience_s in ((signal.SIGTERM, STOP_S), (signal.SIGKILL, 1.0)):
        if running_cell(folder) != pid:  # it has left meanwhile, and its number may be another's by now
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
        end_s = monotonic_s() + patience_s
        while monotonic_s() < end_s:
            if running_cell(folder) != pid:
                return
            await asyncio.sleep(LOOK_S / 5)
