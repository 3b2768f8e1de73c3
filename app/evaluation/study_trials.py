"""What studies share: benches, governed executions that are looked at from outside, rows, and tables of them.

A study's rows have the columns of `STUDY_COLUMNS` besides those of a physical trial; `complete` holds for every
execution of every study whether its entries tell the whole story.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from app.cell.runner import Runner
from app.evaluation.capabilities import judge_of
from app.evaluation.episode import LIMIT_TICKS, RECOVERY_TICKS, Execution, Supervised, governed
from app.evaluation.jobs import Job
from app.evaluation.methods import REINS
from app.evaluation.metrics import entry
from app.evaluation.model import Row, Value
from app.evaluation.physical_rows import COLUMNS, UNLOOKED
from app.evaluation.physical_trial import Bench, Trial, looking, ready
from app.evaluation.study_audit import missing
from app.governance.model import EventKind, Intervention
from app.sim.proportion import wilson
from app.sim.sensors import AS_MEASURED, Quality

if TYPE_CHECKING:
    from app.cell.journal import Entry
    from app.evaluation.draws import Drawn
    from app.governance.model import WatchPlan
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

TASK: Final = "study:"
STUDY_COLUMNS: Final = {
    "study": "name of the study",
    "condition": "under which of the study's conditions",
    "told": "the watch rule that spoke first",
    "ticks": "control ticks, from and to what the study says",
    "held": "whether the robot was stopped, held, or went into a mode that policy names",
    "sensitivity": "sensitivity s; empty where the profile's own holds or it moves",
    "waited_s": "how long a human was waited for, s",
    "what": "what became of it, in the study's words",
    "missing": "what the entries of the execution do not tell; empty where they tell everything",
}
KEPT_BENCHES: Final = 2
_NO_NAME: Final = re.compile(r"[^A-Za-z0-9._]+")  # what a job's name may not hold
ANSWERS: Final = Supervised()

Table: TypeAlias = "dict[str, Any]"
"""`caption`, `stub`, `rows`: row → column → value, or an entry of `metrics`; `remark`."""

_benches: dict[tuple[str, Quality], Bench] = {}


class Part(NamedTuple):
    """A stretch of a study's trials: under one condition, of one seed."""

    condition: str
    seed: int
    first: int
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]  # nobody counts the fields of a part

    def job(self, study: str) -> Job:
        """Return the job that runs this part."""
        name = f"study_{study}_{_NO_NAME.sub('-', self.condition)}_{self.seed}_{self.first:05d}"
        return Job(name, REINS.name, f"{TASK}{study}:{self.condition}", self.seed, self.first, self.count)

    @classmethod
    def of(cls, job: Job) -> tuple[str, Part]:
        """Return the study of a job, and its part of it."""
        study, condition = job.task.removeprefix(TASK).split(":", 1)
        return study, cls(condition, job.seed, job.first, job.count)


def spread(total: int, seeds: Sequence[int]) -> int:
    """Return how many of some trials fall on each seed; at least one."""
    return max(1, total // len(seeds))


def bench_of(policy: PolicySet, quality: Quality = AS_MEASURED) -> Bench:
    """Return this process's bench for a policy and sensors of a quality; only the last few are kept."""
    key = (policy.digest, quality)
    bench = _benches.pop(key, None) or Bench.of(policy, quality)
    _benches[key] = bench  # the newest last
    while len(_benches) > KEPT_BENCHES:
        _benches.pop(next(iter(_benches))).journals.close()
    return bench


def began_s(bench: Bench, drawn: Drawn) -> float:
    """Return the cell time at which an execution of this trial begins, for triggers that count from there."""
    return bench.stage.set(drawn.start, drawn.world, drawn.scenario).truth().time_s


def govern(  # an execution has that many sides
    bench: Bench,
    trial: Trial,
    *,
    supervised: Supervised = ANSWERS,
    change: Callable[[WatchPlan], WatchPlan] = lambda plan: plan,
    during: Callable[[Runner, Workcell], None] = lambda runner, cell: None,
    limit: int = LIMIT_TICKS + RECOVERY_TICKS,
) -> Execution:
    """Execute a trial's proposal under Reins, from the start of the trial."""
    drawn = trial.drawn
    cell = bench.stage.set(drawn.start, drawn.world, drawn.scenario)
    return governed(
        cell,
        REINS,
        bench.policy,
        trial.proposal,
        drawn.profile,
        looking(bench.policy, drawn, trial.plan),
        judge_of(drawn),
        bench.journals,
        supervised=supervised,
        plan_change=change,
        during=lambda runner: during(runner, cell),
        limit=limit,
    )


def once(bench: Bench, drawn: Drawn) -> Trial:
    """Return a trial as it is drawn, without asking whether its fault takes."""
    return ready(bench, drawn)[0]


def study_row(study: str, part: Part, number: int, profile: str, **columns: Value) -> Row:
    """Return a row of a study with the columns that it fills."""
    made: Row = dict.fromkeys((*COLUMNS, *STUDY_COLUMNS))
    made.update(
        method=REINS.name,
        task="",
        seed=part.seed,
        trial=number,
        study=study,
        condition=part.condition,
        profile=profile,
    )
    made.update(columns)
    return made


def executed(done: Execution) -> dict[str, Value]:
    """Return the columns that every execution fills."""
    return {
        "launched": not done.refused,
        "outcome": None if done.outcome is None else done.outcome.value,
        "achieved": done.achieved,
        "seconds": done.ticks / 100,
        "attempts": done.attempts,
        "missing": missing(done),
    }


def first_tick(done: Execution) -> int:
    """Return the runner's tick at the launch, from which an execution's ticks count."""
    return done.entries[0].tick if done.entries else 0


def first_alert(done: Execution, since: int = 0) -> Entry | None:
    """Return the first entry that tells of something wrong, at or after a tick of the execution."""
    began = first_tick(done)
    for one in done.of(EventKind.ALERT):
        if str(one.body["signal"]) not in UNLOOKED and one.tick - began >= since:
            return one
    return None


def first_hold(done: Execution, since: int = 0) -> int | None:
    """Return the tick of the first intervention that restrains, at or after a tick of the execution."""
    began = first_tick(done)
    for one in done.of(EventKind.INTERVENTION):
        if one.tick - began >= since and one.body["intervention"] != Intervention.CONTINUE.value:
            return one.tick - began
    return None


def share(values: Iterable[Value]) -> dict[str, Any]:
    """Return the share of yes among the values that say yes or no, as an entry with its interval."""
    said = [bool(value) for value in values if value is not None]
    yes, n = sum(said), len(said)
    made = entry({"all": yes / n} if n else {}, n, wilson(yes, n) if n else None)
    return {**made, "per_seed": {}}


def grouped(rows: Iterable[Row], *names: str) -> dict[str, list[Row]]:
    """Return rows by what stands in some columns, in the order in which they come."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(" · ".join(str(row[name]) for name in names), []).append(row)
    return found


def table(caption: str, stub: str, rows: Mapping[str, Mapping[str, Any]], remark: str = "") -> Table:
    """Return a table as results hold it."""
    return {"caption": caption, "stub": stub, "rows": {name: dict(cells) for name, cells in rows.items()},
            "remark": remark}  # fmt: skip


def numbers(rows: Iterable[Row], name: str) -> list[float]:
    """Return what stands in a column, as far as anything does."""
    return [float(value) for row in rows if (value := row[name]) is not None]


def in_profile(drawn: Drawn, profile: str) -> Drawn:
    """Return the same trial in another profile."""
    return replace(drawn, profile=profile)
