"""Protocol `physical`: the paper's distribution of trials, executed in the workcell (paper, Experiments 1 to 3).

A trial is one capability invocation. Whole tasks, and the faults of plugins, are sets of their own that run when they
are named (`physical_tasks`, `physical_faults`). The truth of a trial is the ungoverned twin; see `physical_trial`,
`physical_rows` and `draws` for how trials are drawn, run and read. The long run is stratified instead of drawn: so many
trials of each violation, of each failure, and clean ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from app.evaluation.circumstances import Circumstances
from app.evaluation.extensions import FAULT, find_method
from app.evaluation.jobs import Job
from app.evaluation.model import Failure, Kind, Violation
from app.evaluation.physical_faults import FAULT_COLUMNS, run_faults
from app.evaluation.physical_rows import COLUMNS as TRIAL_COLUMNS
from app.evaluation.physical_rows import row
from app.evaluation.physical_sums import results
from app.evaluation.physical_tasks import run_tasks
from app.evaluation.physical_trial import Bench, prepare, shares_twin
from app.evaluation.physical_trial import run as run_trial
from app.evaluation.studies import STUDIES, STUDY_COLUMNS, is_study, run_study, study_jobs
from app.evaluation.task_rows import TASK_COLUMNS

if TYPE_CHECKING:
    from app.evaluation.model import Row
    from app.governance.policy import PolicySet

__all__ = ["COLUMNS", "STUDIES", "STUDY_COLUMNS", "jobs", "results", "run", "study_jobs"]

COLUMNS: Final = {**TRIAL_COLUMNS, **TASK_COLUMNS, **FAULT_COLUMNS}
FAULTS: Final = True
"""Faults of plugins can be run here."""

CIRCUMSTANCES: Final = True
"""Trials can be run with other sensors, fault sizes and ways of walking."""

TASK_TRIALS: Final = 10
"""Runs of each task and seed, if nobody says otherwise: a task takes as long as several trials."""

CHUNK: Final = 10
TASK_CHUNK: Final = 2
LONG: Final[tuple[tuple[Kind | Violation | Failure, int], ...]] = (
    (Violation.FORCE, 370),
    (Violation.SPEED, 375),
    (Violation.RETRY, 345),
    (Violation.POSTCONDITION, 345),
    (Violation.ZONE, 345),
    (Violation.PEOPLE, 345),
    *((failure, 250) for failure in Failure),
    (Kind.CLEAN, 1125),
    (Kind.UNAUTHORIZED, 500),
)
"""The long run: 5,000 trials, of every violation more than 300, clean ones more than 1,000.

More are drawn of what has a boundary band: an eighth of the speeds fall into it, and 300 are to be left beyond it.
"""

_SEPARATOR: Final = "+"
_bench: dict[tuple[str, str], Bench] = {}


def jobs(
    *, methods: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], trials: int, long: bool
) -> Sequence[Job]:
    """Cut the campaign into jobs of ten trials; all methods of a trial are one job, because they share executions.

    Args:
        methods: Names of the methods.
        tasks: Names of tasks, and `fault-NAME` for a plugin's fault; these alone are run then. Empty: single
            capability invocations.
        seeds: Seeds of the runs.
        trials: Trials for each seed, and task; the long run has its own numbers, spread over the seeds.
        long: The stratified long run; it has no tasks.
    """
    together = _SEPARATOR.join(methods)
    wanted = [(_name(kind), count // len(seeds)) for kind, count in LONG] if long else [("", trials)]
    if tasks:
        wanted = [(task, trials) for task in tasks]
    return [
        Job(f"{what or 'drawn'}_{seed}_{first:05d}", together, what, seed, first, min(chunk, count - first))
        for what, count in wanted
        for chunk in (TASK_CHUNK if tasks and not what.startswith(FAULT) else CHUNK,)
        for seed in seeds
        for first in range(0, count, chunk)
    ]


def run(job: Job, policy: PolicySet) -> Iterator[Row]:
    """Run the trials of a job under all its methods, or a part of a study.

    Raises:
        UnknownName: There is no such method, task or fault.
    """
    if is_study(job):
        yield from run_study(job, policy)
        return
    bench = _bench_for(policy, job.under)
    names = job.method.split(_SEPARATOR)
    if job.task.startswith(FAULT):
        yield from run_faults(bench, job, names)
        return
    wanted = _wanted(job.task)
    if job.task and wanted is None:
        yield from run_tasks(bench, job, names)
        return
    methods = [find_method(name) for name in names]
    whole = any(map(shares_twin, methods))
    for number in range(job.first, job.first + job.count):
        trial = prepare(bench, job.seed, number, wanted=wanted, whole=whole)
        ran = run_trial(bench, trial, methods)
        for method in methods:
            yield row(policy, trial, method, ran[method.name])


def _bench_for(policy: PolicySet, under: str) -> Bench:
    """Return this process's bench: preparing its worlds takes seconds."""
    key = (policy.digest, under)
    if key not in _bench:
        _bench[key] = Bench.in_circumstances(policy, Circumstances.read(under))
    return _bench[key]


def _name(wanted: Kind | Violation | Failure) -> str:
    return f"{type(wanted).__name__.lower()}-{wanted.value}"


def _wanted(name: str) -> Kind | Violation | Failure | None:
    for types in (Kind, Violation, Failure):
        for one in types:
            if _name(one) == name:
                return one
    return None
