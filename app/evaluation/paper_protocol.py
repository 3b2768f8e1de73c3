"""Protocol `paper`: the paper's generator and its Bernoulli watcher around Reins's real admission, guard and recovery.

A row is a plain function of policy, method, seed, task and number (but for `decision_us`, which a clock says). There
is one job of trials for every method, task and seed, and one of recoverable failures: trials of their own, half as
many, since the paper injects them into authorized requests, which are half of all.

What rows need is in `paper_generator` and `paper_runtime`, the smaller tables are in `paper_tables`, and what the
paper leaves open is in `paper_unpublished`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, cast

from app.evaluation import paper_tables
from app.evaluation.extensions import find_method
from app.evaluation.jobs import Job
from app.evaluation.methods import ABLATIONS
from app.evaluation.metrics import Entry, Tally
from app.evaluation.model import TASKS, Row, Violation
from app.evaluation.paper_generator import RECOVERY_FIRST, recoverable
from app.evaluation.paper_rows import row
from app.evaluation.paper_runtime import MEANINGS
from app.evaluation.paper_unpublished import UNPUBLISHED
from app.evaluation.statistics import effect_sizes

if TYPE_CHECKING:
    from app.governance.model import Json
    from app.governance.policy import PolicySet

TRIALS: Final = 1000
"""For each method, task and seed, as in the paper's artifact; its tables say 200."""

PER_TASK: Final = ("UAIR", "FRR", "RVDR", "CEF", "UCR", "RSR", "SRR", "RBSR", "RBSR_ALL", "RPC")


def jobs(
    *, methods: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], trials: int, long: bool = False
) -> list[Job]:
    """List the work; the methods of a task and a seed follow each other, since they share its trials.

    Args:
        methods: Names of methods and ablations.
        tasks: Names of task types, or `all` for capabilities alone; empty: the paper's eight.
        seeds: Seeds of the runs.
        trials: How many trials for each, without the recoverable ones.
        long: Nothing in this protocol: who wants more trials asks for them.
    """
    del long
    listed: list[Job] = []
    for task in tasks or tuple(TASKS):
        for seed in seeds:
            for method in methods:
                name = f"{method}.{task}.{seed}"
                listed.append(Job(name, method, task, seed, 0, trials))
                listed.append(Job(f"{name}.recovery", method, task, seed, RECOVERY_FIRST, recoverable(trials)))
    return listed


def run(job: Job, policy: PolicySet) -> Iterator[Row]:
    """Yield a job's rows; one per trial, in order of number.

    Args:
        job: A stretch of trials.
        policy: Π of every profile.

    Raises:
        UnknownName: There is no such method or task.
    """
    method = find_method(job.method)
    for place in range(job.count):
        yield row(method, policy, job.seed, job.task, job.first + place)


class _Sums:
    """Everything that is counted of one method."""

    def __init__(self) -> None:
        self.tally = Tally()
        self.tasks: dict[str, Tally] = defaultdict(lambda: Tally(PER_TASK))
        self.classes: dict[str, Counter[str]] = defaultdict(Counter)
        self.confusion = paper_tables.Confusion()

    def add(self, one: Row) -> None:
        self.tally.add(one)
        self.tasks[str(one["task"])].add(one)
        self.classes[str(one["kind"])][str(one["class"])] += 1
        self.confusion.add(one)

    def shares(self) -> dict[str, dict[str, float]]:
        """Return, for every kind of trial, the share of each class."""
        return {
            kind: {name: count / counted.total() for name, count in sorted(counted.items())}
            for kind, counted in self.classes.items()
        }


def results(rows: Iterable[Row], policy: PolicySet) -> dict[str, Json]:
    """Sum up; what `results.json` holds.

    Human override, the sensitivity sweep and latencies are tables of their own: they are run here, with the seeds and
    as many trials as the rows have, over capabilities alone.

    Args:
        rows: Of every job.
        policy: Π that they were run under.
    """
    sums: dict[str, _Sums] = defaultdict(_Sums)
    trials: dict[int, int] = {}
    for one in rows:
        sums[str(one["method"])].add(one)
        seed, number = _whole(one["seed"]), _whole(one["trial"])
        if number < RECOVERY_FIRST:
            trials[seed] = max(trials.get(seed, 0), number + 1)
    entries = {name: mine.tally.entries() for name, mine in sums.items()}
    methods = {name: found for name, found in entries.items() if name not in ABLATIONS}
    seeds, most = list(trials), max(trials.values(), default=0)
    tables: dict[str, Any] = {
        "methods": methods,
        "classes": {name: mine.shares() for name, mine in sums.items()},
        "class_meanings": {ending.value: meaning for ending, meaning in MEANINGS.items()},
        "per_type": {name: _per_type("RVDR", found) for name, found in entries.items()},
        "unsafe_per_type": {name: _per_type("UCR", found) for name, found in entries.items()},
        "per_task": _per_task(sums),
        "ablations": {name: found for name, found in entries.items() if name in ABLATIONS},
        "human_override": paper_tables.human_override(policy, seeds, most),
        "sensitivity": paper_tables.sensitivity(policy, seeds, most),
        "latency": paper_tables.latency(policy, seeds, most),
        "confusion": {name: mine.confusion.table() for name, mine in sums.items()},
        "effect_sizes": effect_sizes(methods),
        "unpublished": [one.describe() for one in UNPUBLISHED],
    }
    return cast("dict[str, Json]", tables)  # all of it is numbers and names


def _whole(value: Any) -> int:  # noqa: ANN401  # a column
    return int(value)


def _per_type(metric: str, entries: Mapping[str, Entry]) -> dict[str, Entry]:
    return {violation.value: entries[f"{metric}_{violation.name}"] for violation in Violation}


def _per_task(sums: Mapping[str, _Sums]) -> dict[str, dict[str, dict[str, Entry]]]:
    """Return task → method → metric → entry."""
    tasks = dict.fromkeys(task for mine in sums.values() for task in mine.tasks)
    return {
        task: {name: mine.tasks[task].entries() for name, mine in sums.items() if task in mine.tasks} for task in tasks
    }
