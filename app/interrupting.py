"""Ctrl-C where several processes work at one thing: all of them get it at once, and one of them makes sense of it."""

from __future__ import annotations

import signal
from contextlib import contextmanager
from multiprocessing import active_children
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from concurrent.futures import ProcessPoolExecutor

R = TypeVar("R")


@contextmanager
def heard_here_alone() -> Generator[None]:
    """Let processes that start in here leave Ctrl-C to this one.

    A signal that is blocked stays blocked in them from their first instruction on; one that came meanwhile is heard at
    the end. Ignored by what they run first, it would still find them while they import, and each would say so.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def in_turn(pool: ProcessPoolExecutor, work: Callable[..., R], jobs: Iterable[tuple[object, ...]]) -> Generator[R]:
    """Have a fresh pool do jobs, and yield what came of each in their order; what is given up ends at once.

    Args:
        pool: whose processes start with these jobs.
        work: called in them.
        jobs: its arguments.

    Raises:
        BrokenProcessPool: a process died. Whatever `work` raises comes as it is.
    """
    before = set(active_children())
    with heard_here_alone():
        futures = [pool.submit(work, *job) for job in jobs]
    try:
        for future in futures:
            yield future.result()
    except BaseException:  # nobody waits for what they would still do; cancelled, it would be in the way of their end
        for process in set(active_children()) - before:
            process.terminate()
        raise
