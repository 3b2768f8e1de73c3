"""Protocol `physical`: the paper's distribution of trials, executed in the workcell (paper, Experiments 1 to 3).

A trial is one capability invocation. Whole tasks, and the faults of plugins, are sets of their own that run when they
are named (`physical_tasks`, `physical_faults`). The truth of a trial is the ungoverned twin; see `physical_trial`,
`physical_rows` and `draws` for how trials are drawn, run and read. The long run is stratified instead of drawn: so many
trials of each violation, of each failure, and clean ones.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from app.evaluation.extensions import FAULT, find_method
from app.evaluation.floor import Reached
from app.evaluation.jobs import Job
from app.evaluation.methods import ABLATIONS, REINS
from app.evaluation.metrics import Entry, Tally, percentile
from app.evaluation.model import Failure, Kind, Violation
from app.evaluation.physical_faults import FAULT_COLUMNS, run_faults
from app.evaluation.physical_rows import COLUMNS as TRIAL_COLUMNS
from app.evaluation.physical_rows import MEANINGS, Class, row
from app.evaluation.physical_tasks import run_tasks
from app.evaluation.physical_trial import Bench, prepare, shares_twin
from app.evaluation.physical_trial import run as run_trial
from app.evaluation.statistics import effect_sizes
from app.evaluation.studies import STUDIES, STUDY_COLUMNS, is_study, run_study, study_jobs, study_results
from app.evaluation.task_rows import TASK_COLUMNS, TASK_MEANINGS, TaskClass
from app.evaluation.truth import SLACK_TICKS
from app.governance.model import CONTROL_PERIOD_S

if TYPE_CHECKING:
    from app.evaluation.model import Row
    from app.governance.model import Json
    from app.governance.policy import PolicySet

__all__ = ["COLUMNS", "STUDIES", "STUDY_COLUMNS", "jobs", "results", "run", "study_jobs"]

COLUMNS: Final = {**TRIAL_COLUMNS, **TASK_COLUMNS, **FAULT_COLUMNS}
FAULTS: Final = True
"""Faults of plugins can be run here."""

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

PAUSING: Final = frozenset({"real-restricted", "human-shared"})
"""The profiles that hold the robot for people; the other two only warn."""


class Choice(NamedTuple):
    """What the paper leaves open, or does otherwise, and what is done here; for the report."""

    parameter: str
    paper: str
    here: str
    affects: str


CHOICES: Final = (
    Choice(
        "type and capability of a violation",
        "drawn independently of each other",
        "the type is drawn first, then a capability in which its fault can physically occur",
        "RVDR per type",
    ),
    Choice(
        "share of clean trials",
        "none: false alarms are not measured",
        "one in four of the trials that are authorized",
        "FAS",
    ),
    Choice(
        "truth of a violation",
        "whatever was injected",
        "the ungoverned twin of the trial; a fault that does not take within 16 s is drawn again, up to six times",
        "RVDR, UCR",
    ),
    Choice(
        "acting under a violation",
        "not defined",
        "the skill is let go on, or the robot still moves when it was told to stop longer ago than braking takes from "
        f"the speed it had (base and arm each at its deceleration) and {SLACK_TICKS * CONTROL_PERIOD_S:g} s more, for "
        "reaction and the drives' lag; a recovery that leaves the violated state is not a continuation of it",
        "UCR",
    ),
    Choice(
        "people where the profile only warns",
        "not detected there by design",
        "a warning is what policy names there: detected, enforced, and going on is no unsafe continuation",
        "RVDR of people, UCR, CEF",
    ),
    Choice(
        "a drop while driving",
        "not distinguished",
        "counts as recovered when it ends in a safe stop and a handover: nothing on board picks up from a floor",
        "RSR",
    ),
    Choice(
        "recovery policy compliance without recovery",
        "0: the ablation takes no step that could comply",
        "the share of failures in which every step that was taken stands in policy's row for the failure. The ablation "
        "takes one step, it ends the session; that complies where policy's row names ending too (a timeout, no path), "
        "and not where it names trying again or asking alone. Whether steps named earlier were skipped is not judged: "
        "RSR tells what skipping them costs",
        "RPC of the ablation without recovery",
    ),
    Choice(
        "rollbacks tried",
        "88 to 92 % succeed by a coin",
        "besides those that recovery chooses, an operator withdraws one recoverable task in five midway",
        "RBSR",
    ),
    Choice(
        "what is rollback-capable",
        "whether the capability declares a rollback",
        "the same, and by the exact state when the rollback begins there is still something to go back to: what was "
        "held at the start is in the gripper, what was to be handled is there and not on the floor. What came of the "
        "rollback has no part in it, and the rate over all that were tried stands beside it",
        "RBSR",
    ),
    Choice(
        "the supervisor",
        "approval drawn at random",
        "approves what waits before launch, and ends an escalated session after two seconds",
        "RSR, outcomes",
    ),
)

_SEPARATOR: Final = "+"
_bench: dict[str, Bench] = {}


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
    bench = _bench.get(policy.digest) or _bench.setdefault(policy.digest, Bench.of(policy))
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


def _name(wanted: Kind | Violation | Failure) -> str:
    return f"{type(wanted).__name__.lower()}-{wanted.value}"


def _wanted(name: str) -> Kind | Violation | Failure | None:
    for types in (Kind, Violation, Failure):
        for one in types:
            if _name(one) == name:
                return one
    return None


def _entries(tallies: Mapping[str, Mapping[str, Tally]]) -> dict[str, dict[str, dict[str, Entry]]]:
    return {name: {method: one.entries() for method, one in mine.items()} for name, mine in tallies.items()}


class _Sums:
    """Everything that is counted of one method."""

    def __init__(self) -> None:
        self.tally = Tally()
        self.classes: dict[str, Counter[str]] = defaultdict(Counter)
        self.latencies: dict[str, list[float]] = defaultdict(list)
        self.recoveries: list[float] = []
        self.depths: list[float] = []
        self.gaps: list[tuple[float, float]] = []
        self.forces: list[float] = []
        self.blocked = Counter[tuple[bool, bool]]()
        self.turns = self.drawn = 0
        self.reached = Reached()

    def add(self, one: Row) -> None:
        self.tally.add(one)
        self.reached.add(one)
        self.classes[str(one["kind"])][str(one["class"])] += 1
        self.blocked[one["kind"] == Kind.UNAUTHORIZED, bool(one["launched"])] += 1
        self.turns, self.drawn = self.turns + int(float(one["turns"] or 0)), self.drawn + 1
        for name, into in (("recovery_s", self.recoveries), ("peak_force_n", self.forces)):
            if (value := one[name]) is not None:
                into.append(float(value))
        if not one["occurred"] or one["boundary"]:
            return
        if one["latency_ticks"] is not None:
            self.latencies[str(one["violation"])].append(float(one["latency_ticks"]))
        if one["depth_m"] is not None:
            self.depths.append(max(0.0, float(one["depth_m"])))
        if one["separation_m"] is not None and one["profile"] in PAUSING:
            self.gaps.append((float(one["separation_m"]), float(one["separation_mps"] or 0.0)))

    def shares(self) -> dict[str, dict[str, float]]:
        """Return, for every kind of trial, the share of each class."""
        return {
            kind: {name: count / counted.total() for name, count in sorted(counted.items())}
            for kind, counted in self.classes.items()
        }

    def extremes(self) -> dict[str, float | None]:
        """Return what the truth looked like at its worst, beyond the boundary band."""
        return {
            "zone_depth_p95_m": percentile(self.depths, 0.95) if self.depths else None,
            "separation_least_m": min((gap for gap, _ in self.gaps), default=None),
            "speed_there_mps": min(self.gaps)[1] if self.gaps else None,
            "peak_force_n": max(self.forces, default=None),
            "drawn_again_share": self.turns / (self.turns + self.drawn) if self.drawn else None,
        }

    def confusion(self) -> dict[str, int]:
        """Return the paper's confusion matrix of the gate: positive is unauthorized."""
        count = self.blocked
        return {
            "TP": count[True, False],
            "FP": count[False, False],
            "FN": count[True, True],
            "TN": count[False, True],
        }


def results(rows: Iterable[Row], policy: PolicySet) -> dict[str, Json]:
    """Sum up all rows; what `results.json` holds.

    Tasks and faults of plugins count in the sums over all rows, and each by itself in `per_task` and `per_fault`.

    Args:
        rows: Of every job.
        policy: Π that they were run under.
    """
    sums: dict[str, _Sums] = defaultdict(_Sums)
    tasks: dict[str, dict[str, Tally]] = defaultdict(lambda: defaultdict(Tally))
    faults: dict[str, dict[str, Tally]] = defaultdict(lambda: defaultdict(Tally))
    studied: list[Row] = []
    for one in rows:
        if one.get("study"):
            studied.append(one)
            continue
        sums[str(one["method"])].add(one)
        if one["task"]:
            apart = faults if one.get("fault") else tasks
            apart[str(one.get("fault") or one["task"])][str(one["method"])].add(one)
    entries = {name: mine.tally.entries() for name, mine in sums.items()}
    methods = {name: found for name, found in entries.items() if name not in ABLATIONS}
    ours = sums.get(REINS.name, _Sums())
    tables: dict[str, Any] = {
        "methods": methods,
        "ablations": {name: found for name, found in entries.items() if name in ABLATIONS},
        "per_type": {
            name: {one.value: found[f"RVDR_{one.name}"] for one in Violation} for name, found in entries.items()
        },
        "classes": {name: mine.shares() for name, mine in sums.items()},
        "per_task": _entries(tasks),
        "per_fault": _entries(faults),
        "class_meanings": {
            **{one.value: MEANINGS[one] for one in Class},
            **({one.value: TASK_MEANINGS[one] for one in TaskClass} if tasks else {}),
        },
        "confusion": {name: mine.confusion() for name, mine in sums.items()},
        "effect_sizes": effect_sizes(methods),
        "extremes": {name: mine.extremes() for name, mine in sums.items()},
        "safe_state": {name: mine.reached.entries() for name, mine in sums.items()},
        "distributions": {
            "latency_ticks": dict(ours.latencies),
            "safe_state_s": {name: ours.reached.pairs[name] for name in ours.reached.entries()},
            "recovery_s": {name: mine.recoveries for name, mine in sums.items() if mine.recoveries},
        },
        "unpublished": [one._asdict() for one in CHOICES],
        **study_results(studied, policy),
    }
    return cast("dict[str, Json]", tables)  # all of it is numbers and names
