"""What the commands share in speaking to people: two consoles, one way to say what went wrong, the exit codes."""

from __future__ import annotations

import contextlib
import signal
import unicodedata
from typing import TYPE_CHECKING, Any, Final

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

STEERING: Final = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs"})
"""Categories of Unicode: what steers a terminal, turns a line round, is there and not to be seen, or is no text."""


class Lines(Console):
    """Where all that commands say is written; whoever wrote a text, it steers no terminal."""

    def print(self, *objects: Any, **how: Any) -> None:  # noqa: ANN401  # what rich prints, and how
        """Write as rich does, with each text `plain`."""
        super().print(*[plain(one) if isinstance(one, str) else one for one in objects], **how)


def plain(text: str) -> str:
    """Return a text with escapes, as JSON has them, for what would steer a terminal, turn a line, or not be seen.

    What is no text came as bytes that are no UTF-8: a file may be called so.
    """
    return text if text.isprintable() else "".join(map(_shown, text))


def _shown(character: str) -> str:
    if character in "\n\t" or unicodedata.category(character) not in STEERING:
        return character
    units = character.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[place : place + 4]}" for place in range(0, len(units), 4))


# What is recorded is shown as it stands: `:x:` is no picture.
out = Lines(highlight=False, soft_wrap=True, emoji=False)
err = Lines(stderr=True, highlight=False, soft_wrap=True, emoji=False)


def stop_signals() -> tuple[signal.Signals, ...]:
    """Return what asks a process to stop in order; the end of its terminal does, unless that is ignored (`nohup`)."""
    asked = (signal.SIGINT, signal.SIGTERM)
    return asked if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (*asked, signal.SIGHUP)


def say(message: str) -> None:
    """Write a line, or several, as they are."""
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
