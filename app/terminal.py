"""What the commands share in speaking to people: two consoles, one way to say what went wrong, the exit codes."""

from __future__ import annotations

import contextlib
import signal
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from app.clock import monotonic_s

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

FINE: Final = 0
FINDING: Final = 1
MISUSE: Final = 2
INTERRUPTED: Final = 130  # by Ctrl-C, as a shell has it
DAMAGED: Final = 65  # EX_DATAERR of sysexits.h: what it would go on from cannot be read, now or at another start

SHOWN_AFTER_S: Final = 1.0

# What is recorded is shown as it stands: `:x:` is no picture.
out = Console(highlight=False, soft_wrap=True, emoji=False)
err = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)

DIRECTING: Final = (0x061C, 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A))  # lines and their direction
CONTROLS: Final = (*(code for code in range(0x20) if chr(code) not in "\n\t"), *range(0x7F, 0xA0))
ESCAPES: Final = {code: f"\\u{code:04x}" for code in (*CONTROLS, *DIRECTING)}


def stop_signals() -> tuple[signal.Signals, ...]:
    """Return what asks a process to stop in order; the end of its terminal does, unless that is ignored (`nohup`)."""
    asked = (signal.SIGINT, signal.SIGTERM)
    return asked if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (*asked, signal.SIGHUP)


def plain(text: str) -> str:
    """Return a text with what would steer a terminal, turn the order of what it shows, or is none, as JSON escapes it.

    What is none came as bytes that are no UTF-8: a file may be called so.
    """
    return text.translate(ESCAPES).encode(errors="backslashreplace").decode()


def say(message: str) -> None:
    """Write a line, or several, as they are; what steers a terminal is escaped."""
    out.print(plain(message), markup=False)


def remark(message: str) -> None:
    """Write a line that nothing depends on: a process that governs does not end because its log's disk is full."""
    with contextlib.suppress(OSError):
        say(message)


def complain(message: str, lines: Iterable[str] = (), *, hint: str = "") -> None:
    """Write what went wrong, and where, with nothing depending on it, as `remark` does."""
    with contextlib.suppress(OSError):
        say_error(message, hint=hint)
        for line in lines:
            err.print(f"  {plain(line)}", markup=False)


def say_error(message: str, *, hint: str = "") -> None:
    """Write what went wrong, and what to do about it."""
    err.print("[bold red]error:[/] ", end="")
    err.print(plain(message), markup=False)
    if hint:
        err.print(f"       {plain(hint)}", markup=False)


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
