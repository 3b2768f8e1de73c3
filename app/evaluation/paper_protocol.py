"""Protocol `paper`: the paper's generator and its Bernoulli watcher around Reins's real admission, guard and recovery.

`jobs` lists the work, `run` does a stretch of it anywhere (a row is a plain function of policy, method, seed, task and
number), `results` makes the tables. Recovery failures are trials of their own: half as many as there are others, since
the paper injects them into authorized requests, which are half of all.

What the rows need is in `paper_generator` and `paper_runtime`, the smaller tables are in `paper_tables`, and what the
paper leaves open is in `paper_unpublished`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from app.evaluation import paper_tables
from app.evaluation.jobs import Job
from app.evaluation.methods import METHODS, Method
from app.evaluation.metrics import METRICS, Entry, measure
from app.evaluation.model import Row, Value, Violation
from app.evaluation.paper_generator import RECOVERY_FIRST, recoverable
from app.evaluation.paper_rows import method_named, row
from app.evaluation.paper_unpublished import UNPUBLISHED
from app.evaluation.statistics import effect_sizes

if TYPE_CHECKING:
    from app.governance.policy import PolicySet

PROTOCOL: Final = "paper"
PER_TASK: Final = ("UAIR", "FRR", "RVDR", "CEF", "UCR", "RSR", "SRR", "RBSR", "RBSR_ALL", "RPC")


def jobs(methods: Sequence[Method], seeds: Sequence[int], trials: int, tasks: Sequence[str]) -> list[Job]:
    """List the work: for every method, task and seed one job of trials, and one of recoverable failures.

    Args:
        methods: What is measured; methods and ablations alike.
        seeds: Seeds of the runs.
        trials: How many trials per method, task and seed, without the recoverable ones.
        tasks: Names of task types, or `all`.
    """
    listed: list[Job] = []
    for task in tasks:
        for seed in seeds:
            for method in methods:
                name = f"{PROTOCOL}-{method.name}-{task}-{seed}"
                listed.append(Job(name, method.name, task, seed, 0, trials))
                listed.append(Job(f"{name}-recovery", method.name, task, seed, RECOVERY_FIRST, recoverable(trials)))
    return listed


def run(job: Job, policy: PolicySet) -> list[Row]:
    """Run a job; one row per trial, in order of number.

    Args:
        job: A stretch of trials.
        policy: Π of every profile.

    Raises:
        ValueError: There is no such method or task.
    """
    method = method_named(job.method)
    return [row(method, policy, job.seed, job.task, job.first + place) for place in range(job.count)]


def results(rows: Sequence[Row], *, policy: PolicySet, seeds: Sequence[int], trials: int) -> dict[str, Any]:
    """Return the content of `results.json`.

    Ablations, human override, the sensitivity sweep and latencies are tables of their own: they are run here, on the
    pooled task, and take nothing from the rows.

    Args:
        rows: Of every job.
        policy: Π that they were run under.
        seeds: Seeds of the runs.
        trials: How many trials there were per method, task and seed.
    """
    by_method = _grouped(rows, "method")
    methods = {name: measure(mine) for name, mine in by_method.items()}
    for name in methods:
        methods[name]["ADL"] = paper_tables.decision_latency(method_named(name), policy, seeds, trials)
    return {
        "protocol": PROTOCOL,
        "seeds": list(seeds),
        "trials": trials,
        "policy": policy.digest,
        "methods": methods,
        "classes": {name: _classes(mine) for name, mine in by_method.items()},
        "per_type": {name: _per_type(entries) for name, entries in methods.items()},
        "per_task": {
            str(task): {name: measure(mine, PER_TASK) for name, mine in _grouped(of_task, "method").items()}
            for task, of_task in _grouped(rows, "task").items()
        },
        "ablations": paper_tables.ablations(policy, seeds, trials),
        "human_override": paper_tables.human_override(policy, seeds, trials),
        "sensitivity": paper_tables.sensitivity(policy, seeds, trials),
        "latency": paper_tables.latency(policy, seeds, trials),
        "confusion": {name: paper_tables.confusion(mine) for name, mine in by_method.items()},
        "effect_sizes": effect_sizes({name: entries for name, entries in methods.items() if name in METHODS}),
        "unpublished": [one._asdict() for one in UNPUBLISHED],
    }


def _grouped(rows: Iterable[Row], column: str) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = defaultdict(list)
    for one in rows:
        found[str(one[column])].append(one)
    return dict(found)


def _classes(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return, for every kind of trial, the share of each class."""
    found: dict[str, dict[str, float]] = {}
    for kind, mine in _grouped(rows, "kind").items():
        counted: Counter[Value] = Counter(one["class"] for one in mine)
        found[kind] = {str(name): count / len(mine) for name, count in counted.most_common()}
    return found


def _per_type(entries: Mapping[str, Entry]) -> dict[str, Entry]:
    return {violation.value: entries[f"RVDR_{violation.name}"] for violation in Violation}


__all__ = ["METRICS", "PROTOCOL", "jobs", "results", "run"]
