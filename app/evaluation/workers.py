"""Worker processes that take jobs one at a time, and whose death is noticed.

A pool of the standard library gives up on everything when one process dies, and cannot say what that one was doing.
Here each worker has a pipe of its own: the parent knows which job it held, starts another worker and gives the job out
once more. Jobs are handed out when a worker is free, so that long ones balance themselves.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Sequence
from multiprocessing import connection, get_context
from types import ModuleType
from typing import TYPE_CHECKING, Final, Protocol

from app.interrupting import heard_here_alone

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from app.evaluation.jobs import Job

ATTEMPTS: Final = 2  # a machine may kill a process once; a job that kills its worker twice does it by itself
END_S: Final = 2.0
LISTEN_S: Final = 0.5
# The disk's matter: no line of code is to blame.
NO_ROOM: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class JobFailed(Exception):
    """A job that raised, or whose worker died again and again."""

    def __init__(self, job: Job, why: str, trace: str = "") -> None:
        """Name the job and what went wrong; `trace` is the worker's own."""
        self.job, self.trace = job, trace
        super().__init__(f"job `{job.name}` failed: {why}")


class Work(Protocol):
    """What a worker does: made in the parent, pickled, opened once in the worker, then called for every job."""

    def open(self) -> Callable[[Job], None]:
        """Load what all jobs need, and return what runs one."""
        ...


class Worker:
    """One process and the job that it holds."""

    def __init__(self, work: Work) -> None:
        """Start it."""
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(target=_serve, args=(work, theirs), daemon=True)
        with _one_thread(), _by_itself(), heard_here_alone():
            self.process.start()
        theirs.close()
        self.job: Job | None = None

    def give(self, job: Job) -> None:
        """Hand it a job. A worker that is dead already is noticed when its answer is waited for."""
        self.job = job
        with contextlib.suppress(BrokenPipeError):
            self.pipe.send(job)

    def answer(self) -> tuple[str, str] | None:
        """Return None if its job is done, else why it failed and the trace.

        Raises:
            EOFError, OSError: the process died.
        """
        answer: tuple[str, str] | None = self.pipe.recv()
        return answer

    def end(self) -> None:
        """End the process; by force if it does not listen."""
        self.process.terminate()
        self.process.join(END_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()


def run_jobs(jobs: Sequence[Job], work: Work, *, workers: int, done: Callable[[Job], None]) -> None:
    """Run jobs in processes until all are done.

    Args:
        jobs: What to do; handed out in this order.
        work: How.
        workers: How many processes.
        done: Called here after each job, in the order in which they end.

    Raises:
        JobFailed: a job raised, or its worker died `ATTEMPTS` times. The workers are ended, done jobs stay done.
    """
    with _listening() as heed:
        _run_jobs(jobs, work, workers, done, heed)


@contextlib.contextmanager
def _listening() -> Generator[Callable[[], None]]:
    """Remember Ctrl-C besides raising it: raised inside a finalizer, it would be lost, and nobody presses it twice."""
    heard = False

    def note(_signal: int, _frame: object) -> None:
        nonlocal heard
        heard = True
        raise KeyboardInterrupt

    def heed() -> None:
        if heard:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield heed
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield heed
    finally:
        signal.signal(signal.SIGINT, before)


def _run_jobs(
    jobs: Sequence[Job], work: Work, workers: int, done: Callable[[Job], None], heed: Callable[[], None]
) -> None:
    waiting, deaths = deque(jobs), dict.fromkeys((job.name for job in jobs), 0)
    crew = [Worker(work) for _ in range(min(workers, len(jobs)))]
    try:
        for worker in crew:
            worker.give(waiting.popleft())
        while busy := [worker for worker in crew if worker.job is not None]:
            heed()
            for pipe in connection.wait([worker.pipe for worker in busy], LISTEN_S):
                index = next(index for index, worker in enumerate(crew) if worker.pipe is pipe)
                if _settle(crew[index], waiting, deaths, done):
                    crew[index].end()
                    crew[index] = Worker(work)
                if waiting:
                    crew[index].give(waiting.popleft())
    finally:
        for worker in crew:
            worker.end()


def _settle(worker: Worker, waiting: deque[Job], deaths: dict[str, int], done: Callable[[Job], None]) -> bool:
    """Take a worker's answer; return whether it died, its job waiting again."""
    job = worker.job
    assert job is not None  # noqa: S101  # only busy workers are waited for
    worker.job = None
    try:
        failure = worker.answer()
    except (EOFError, OSError):
        worker.process.join(END_S)
        deaths[job.name] += 1
        if deaths[job.name] >= ATTEMPTS:
            why = f"its process died {ATTEMPTS} times, the last time with exit code `{worker.process.exitcode}`"
            raise JobFailed(job, why) from None
        waiting.appendleft(job)
        return True
    if failure is not None:
        raise JobFailed(job, *failure)
    done(job)
    return False


def _serve(work: Work, pipe: connection.Connection) -> None:
    """Run jobs until the parent is gone; when told to end, tidy up."""
    signal.signal(signal.SIGTERM, _leave)
    try:
        run = work.open()
    except Exception as error:  # whatever it was, the parent says it
        run = _raising(error)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            job: Job = pipe.recv()
            try:
                run(job)
            except Exception as error:  # whatever it was, the parent says it
                full = isinstance(error, OSError) and error.errno in NO_ROOM
                pipe.send((str(error), "") if full else (f"{type(error).__name__}: {error}", traceback.format_exc()))
            else:
                pipe.send(None)


def _leave(_signal: int, _frame: object) -> None:
    """End as any process does, finalizers and all: a signal's own way out would leave folders of journals behind."""
    raise SystemExit(0)


def _raising(error: Exception) -> Callable[[Job], None]:
    def run(_job: Job) -> None:
        raise error

    return run


@contextlib.contextmanager
def _by_itself() -> Generator[None]:
    """Let a child that starts now leave alone what this process was started as: it would import that anew for nothing.

    A command line brings along what only a human needs, and a job is run by what its own modules name.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


@contextlib.contextmanager
def _one_thread() -> Generator[None]:
    """Let a child that starts now use one thread for linear algebra: processes are what is parallel here."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
