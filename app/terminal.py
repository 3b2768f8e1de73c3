"""What the commands share in speaking to people: two consoles, one way to say what went wrong, the exit codes."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from app.clock import monotonic_s

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

FINE: Final = 0
FINDING: Final = 1
MISUSE: Final = 2
DAMAGED: Final = 65  # EX_DATAERR of sysexits.h: what it would go on from cannot be read, now or at another start

SHOWN_AFTER_S: Final = 1.0

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


def say(message: str) -> None:
    """Write a line."""
    out.print(message, markup=False)


def remark(message: str) -> None:
    """Write a line that nothing depends on: a process that governs does not end because its log's disk is full."""
    with contextlib.suppress(OSError):
        say(message)


def complain(message: str, lines: Iterable[str] = (), *, hint: str = "") -> None:
    """Write what went wrong, and where, with nothing depending on it, as `remark` does."""
    with contextlib.suppress(OSError):
        say_error(message, hint=hint)
        for line in lines:
            err.print(f"  {line}", markup=False)


def say_error(message: str, *, hint: str = "") -> None:
    """Write what went wrong, and what to do about it."""
    err.print("[bold red]error:[/] ", end="")
    err.print(message, markup=False)
    if hint:
        err.print(f"       {hint}", markup=False)


@contextlib.contextmanager
def counting(what: str) -> Generator[Callable[[int, int], None]]:
    """Yield what is told, in any thread, how many of how many are done; a bar shows it once that has taken a second."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    began_s = monotonic_s()
    with contextlib.ExitStack() as shown:
        bars = Progress(*columns, console=err, transient=True)

        def told(done: int, total: int) -> None:
            if not bars.tasks:
                if monotonic_s() < began_s + SHOWN_AFTER_S:
                    return
                shown.enter_context(bars)
                bars.add_task(what, total=total)
            bars.update(bars.tasks[0].id, completed=done)

        yield told
