"""Protocol `physical`: the paper's distribution of trials, executed in the workcell (paper, Experiments 1 to 3).

A trial is one capability invocation. Its truth is the ungoverned twin; see `physical_trial`, `physical_rows` and
`draws` for how trials are drawn, run and read. The long run is stratified instead of drawn: so many trials of each
violation, of each failure, and clean ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

from app.evaluation.extensions import find_method
from app.evaluation.jobs import Job
from app.evaluation.model import Failure, Kind, Violation
from app.evaluation.physical_rows import COLUMNS, row
from app.evaluation.physical_trial import Bench, prepare
from app.evaluation.physical_trial import run as run_trial

if TYPE_CHECKING:
    from app.evaluation.model import Row
    from app.governance.policy import PolicySet

__all__ = ["COLUMNS", "jobs", "results", "run"]

CHUNK: Final = 10
LONG: Final[tuple[tuple[Kind | Violation | Failure, int], ...]] = (
    *((violation, 340) for violation in Violation),
    *((failure, 260) for failure in Failure),
    (Kind.CLEAN, 1160),
    (Kind.UNAUTHORIZED, 500),
)
"""The long run: 5,000 trials, of every violation more than 300, clean ones more than 1,000."""

_SEPARATOR: Final = "+"
_bench: dict[str, Bench] = {}


def jobs(
    *, methods: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], trials: int, long: bool
) -> Sequence[Job]:
    """Cut the campaign into jobs of ten trials; all methods of a trial are one job, because they share executions.

    Args:
        methods: Names of the methods.
        tasks: Must be empty: a trial is one capability invocation.
        seeds: Seeds of the runs.
        trials: Trials for each seed; the long run has its own numbers, spread over the seeds.
        long: The stratified long run.

    Raises:
        ValueError: Tasks were named.
    """
    if tasks:
        raise ValueError(f"tasks `{', '.join(tasks)}`: valid are none, a physical trial is one capability invocation")
    together = _SEPARATOR.join(methods)
    wanted = [(_name(kind), count // len(seeds)) for kind, count in LONG] if long else [("", trials)]
    return [
        Job(f"{what or 'drawn'}_{seed}_{first:05d}", together, what, seed, first, min(CHUNK, count - first))
        for what, count in wanted
        for seed in seeds
        for first in range(0, count, CHUNK)
    ]


def run(job: Job, policy: PolicySet) -> Iterator[Row]:
    """Run ten trials under all methods."""
    bench = _bench.setdefault(policy.digest, Bench.of(policy))
    methods = [find_method(name) for name in job.method.split(_SEPARATOR)]
    wanted = _wanted(job.task)
    for number in range(job.first, job.first + job.count):
        trial = prepare(bench, job.seed, number, wanted=wanted)
        ran = run_trial(bench, trial, methods)
        for method in methods:
            yield row(policy, trial, method, ran[method.name])


def _name(wanted: Kind | Violation | Failure) -> str:
    return f"{type(wanted).__name__.lower()}-{wanted.value}"


def _wanted(name: str) -> Kind | Violation | Failure | None:
    for types in (Kind, Violation, Failure):
        for one in types:
            if _name(one) == name:
                return one
    return None


def results(rows: Iterable[Row], policy: PolicySet) -> dict[str, object]:
    """Sum up all rows."""
    raise NotImplementedError
