"""A protocol without physics, as a plugin brings it: a row is a plain function of (method, task, seed, trial).

It writes aside what an execution in the workcell does, in a folder that has to be gone with its process.

What goes wrong on purpose is said by the environment, which reaches every worker:
TOY_DIE_ONCE names a file that the first worker to see it removes before it kills itself;
TOY_DIE makes the job of that name kill its worker every time; TOY_RAISE makes it raise;
TOY_FULL leaves it no room for what it writes;
TOY_GATE makes the last job wait until that file is there.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from app.clock import monotonic_s
from app.evaluation.extensions import ExtraFault, Registry, all_tasks, find_method
from app.evaluation.jobs import Job
from app.evaluation.journals import Journals
from app.evaluation.methods import REINS, Method
from app.evaluation.model import Row, Task, Violation

aside = Journals()
STRETCH = 5
GATE_S = 60.0


def jobs(*, methods: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], trials: int, long: bool) -> list[Job]:
    return [
        Job(f"{method}-{task}-{seed}-{first}", method, task, seed, first, min(STRETCH, trials - first))
        for method in methods
        for task in (tasks or all_tasks())
        for seed in seeds
        for first in range(0, trials, STRETCH)
    ]


def run(job: Job, policy: Any) -> Iterator[Row]:
    aside.open()
    misbehave(job)
    watched = find_method(job.method).watch.value
    for trial in range(job.first, job.first + job.count):
        rng = random.Random(f"{job.task}-{job.seed}-{trial}")  # noqa: S311  # it guards nothing
        yield {
            "method": job.method,
            "task": job.task,
            "seed": job.seed,
            "trial": trial,
            "kind": "clean",
            "breach": os.environ["OMP_NUM_THREADS"],
            "class": watched,
            "launched": rng.random() < 0.5,
            "latency_ticks": None if trial % 2 else rng.random(),
            "decision_us": None if trial % 4 == 3 else time.perf_counter_ns() / 1000,
        }


def results(rows: Iterable[Row], policy: Any) -> dict[str, Any]:
    counts: dict[str, list[float]] = {}
    for row in rows:
        counts.setdefault(str(row["method"]), []).append(float(bool(row["launched"])))
    return {"methods": {name: {"UAIR": {"mean": sum(found) / len(found)}} for name, found in counts.items()}}


def misbehave(job: Job) -> None:
    once = Path(os.environ.get("TOY_DIE_ONCE", "/nonexistent"))
    if once.exists():
        once.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    if os.environ.get("TOY_DIE") == job.name:
        os.kill(os.getpid(), signal.SIGKILL)
    if os.environ.get("TOY_RAISE") == job.name:
        raise ArithmeticError("as asked")
    if os.environ.get("TOY_FULL") == job.name:
        resource.setrlimit(resource.RLIMIT_FSIZE, (64, resource.RLIM_INFINITY))
    if "TOY_GATE" in os.environ and job.first > 0:
        deadline = monotonic_s() + GATE_S
        while not Path(os.environ["TOY_GATE"]).exists():
            assert monotonic_s() < deadline
            time.sleep(0.01)


def register(registry: Registry) -> None:
    registry.add_protocol("toy", SimpleNamespace(jobs=jobs, run=run, results=results))
    registry.add_method(Method(name="toy-method", title="Toy", tier=3, watch=REINS.watch))
    registry.add_task(Task("toy_task", "navigation", ("navigate_to",), {}))
    registry.add_fault(
        ExtraFault(
            "toy_fault", Violation.SPEED, lambda _rng, size: {"kind": "fade", "strength": size}, ("navigate_to",)
        )
    )
