"""Sensitivity: what the one number s of a profile moves, and what raising it while people are near would buy.

s acts on debounce times and CUSUM limits alone, so that is all it can move. The same trials run under s = 0.1 … 1.0,
fixed in every profile alike, under each profile's own, and under a schedule: 0.9 while a person is nearer than 4.5 m or
the profile expects people on the floor, 0.3 otherwise. The schedule changes the watcher between two ticks; what has
been counted and summed so far lives on.

In half of the trials somebody stands on the floor, out of the way, so that the schedule has something to go by; an
alarm about people is no false alarm there, and is not counted as one. Half of the clean
trials have sensors with twice their noise: with sensors as measured there are next to no false alarms to trade.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from app.evaluation.draws import Drawn, draw, of_type
from app.evaluation.methods import REINS, Passed
from app.evaluation.metrics import measure
from app.evaluation.model import Kind, Row, Violation
from app.evaluation.physical_rows import UNLOOKED, row
from app.evaluation.physical_trial import Ran, taken
from app.evaluation.study_trials import Part, Table, bench_of, executed, govern, grouped, study_row, table
from app.governance.model import EventKind
from app.governance.watcher import compile_watch
from app.sim.faults import Scenario
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.sensors import AS_MEASURED, Quality

if TYPE_CHECKING:
    from app.cell.runner import Runner
    from app.evaluation.episode import Execution
    from app.evaluation.physical_trial import Bench, Trial
    from app.governance.model import WatchPlan
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

NAME: Final = "sensitivity"
TITLE: Final = "Sensitivity: fixed, and raised while people are near"
ABOUT: Final = (
    "The same trials under s = 0.1 to 1.0 in every profile alike, under each profile's own s, and under a schedule "
    "that raises s from 0.3 to 0.9 while a person is nearer than 4.5 m or the profile expects people on the floor. s "
    "moves debounce times and CUSUM limits, and nothing else."
)
TRIALS: Final = 40
NEAR_M: Final = 4.5
STANDS: Final = (4.9, 2.2)
LOW, HIGH = 0.3, 0.9
FIXED: Final = tuple(step / 10 for step in range(1, 11))
SCHEDULE: Final = "raised while people are near"
OWN: Final = "each profile's own"
NOISY: Final = Quality(noise=2.0)
MIX: Final[tuple[Violation | None, ...]] = (
    Violation.SPEED,
    None,
    Violation.FORCE,
    None,
    Violation.POSTCONDITION,
    Violation.SPEED,
    Violation.ZONE,
    Violation.FORCE,
)
"""None: a clean trial. Speed has the CUSUM rules, postconditions the debounced ones of slip."""

SHOWN: Final = ("RVDR", "RVDR_BOUNDARY", "UCR", "FAS")

Change = Callable[["WatchPlan"], "WatchPlan"]


def parts(seeds: Sequence[int]) -> list[Part]:
    """Return the trials with sensors as measured, then those with twice the noise."""
    each = max(len(MIX), TRIALS // len(seeds))
    return [Part(kind, seed, number, 1) for kind in ("measured", "noisy") for seed in seeds for number in range(each)
            if (kind == "noisy") is _noisy(number)]  # fmt: skip


def _noisy(number: int) -> bool:
    return MIX[number % len(MIX)] is None and number % 4 == 3


def run(part: Part, policy: PolicySet) -> Iterator[Row]:
    """Run trials under every sensitivity."""
    bench = bench_of(policy, NOISY if part.condition == "noisy" else AS_MEASURED)
    for number in range(part.first, part.first + part.count):
        trial = taken(bench, lambda turn, number=number: _drawn(policy, part.seed, number, turn), whole=False)
        for s in FIXED:
            yield _under(bench, part, trial, f"s = {s:g}", s, change=partial(_fixed, s))
        yield _under(bench, part, trial, OWN, None)
        schedule = _Schedule(policy.profiles[trial.drawn.profile].shared_floor)
        yield _under(bench, part, trial, SCHEDULE, None, change=schedule.begin, during=schedule)


def _drawn(policy: PolicySet, seed: int, number: int, turn: int) -> Drawn:
    violation = MIX[number % len(MIX)]
    if violation is None:
        drawn = draw(policy, seed, number, kind=Kind.CLEAN, turn=turn)
    else:
        drawn = of_type(policy, seed, number, violation, turn=turn)
    if number // 2 % 2 or violation is Violation.ZONE:  # the ways along the zone lead past that place
        return drawn
    by = Walk(points=(STANDS,), start=Trigger(time_s=0.0), leaves=False)
    return replace(drawn, scenario=Scenario(faults=drawn.scenario.faults, people=(by,)))


def _fixed(s: float, plan: WatchPlan) -> WatchPlan:
    return replace(plan, sensitivity=s)


class _Schedule:
    """Raises s while people are near or expected, and lowers it again."""

    def __init__(self, expected: bool) -> None:
        self.expected = expected

    def begin(self, plan: WatchPlan) -> WatchPlan:
        """Return the plan as a session begins with it."""
        return replace(plan, sensitivity=HIGH if self.expected else LOW)

    def __call__(self, runner: Runner, cell: Workcell) -> None:
        """Set s by what the watcher knows of people; counts and sums go on where they are."""
        if runner.session is None:
            return
        run = runner.session.run
        near = run.watching.signals.separation_m < NEAR_M
        s = HIGH if self.expected or near else LOW
        if run.plan.sensitivity != s:
            run.plan = replace(run.plan, sensitivity=s)
            run.watcher = compile_watch(run.plan, runner.period_s)


def _under(
    bench: Bench,
    part: Part,
    trial: Trial,
    condition: str,
    s: float | None,
    *,
    change: Change = lambda plan: plan,
    during: Callable[[Runner, Workcell], None] = lambda runner, cell: None,
) -> Row:
    """Run a trial under one sensitivity."""
    done = govern(bench, trial, change=change, during=during)
    ran = Ran(Passed(True, "", trial.proposal.params, ()), 0.0, done, None)
    drawn = trial.drawn
    made = {**study_row(NAME, part._replace(condition=condition), drawn.number, drawn.profile),
            **row(bench.policy, trial, REINS, ran)}  # fmt: skip
    if drawn.kind is Kind.CLEAN:
        made["alarmed"] = _alarmed(trial, done)
    made.update(decision_us=None, sensitivity=s, missing=executed(done)["missing"], what=part.condition)
    return made


def _alarmed(trial: Trial, done: Execution) -> bool:
    about_people = {rule.id for rule in trial.plan.rules if rule.signal == "separation_m"}
    told = [one for one in done.of(EventKind.ALERT) if str(one.body["signal"]) not in UNLOOKED]
    return any(str(one.body["rule"]) not in about_people for one in told)


def sweep(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the fixed ones as `sensitivity` of results, for its plots."""
    found: list[dict[str, Any]] = []
    for s in FIXED:
        measured = measure([one for one in rows if one["sensitivity"] == s], SHOWN)
        if measured["RVDR"]["n"]:
            found.append({"s": s, "RVDR": measured["RVDR"], "UCR": measured["UCR"], "FAR": measured["FAS"]})
    return found


def tables(rows: Sequence[Row], policy: PolicySet) -> list[Table]:
    """Return the frontier: what each sensitivity sees, how late, and what it alarms of falsely."""
    found: Mapping[str, list[Row]] = grouped(rows, "condition")
    return [
        table(
            "Fixed sensitivities, and the schedule",
            "Sensitivity",
            {name: _summed(mine) for name, mine in found.items()},
            "FAS: clean sessions with an alarm, with sensors as measured and with twice their noise. Latency in "
            "control ticks from the onset in truth.",
        )
    ]


def _summed(rows: Sequence[Row]) -> dict[str, Any]:
    measured = measure(rows, (*SHOWN, "DL_TICKS_MEDIAN", "DL_TICKS_P95", "RVDR_SPEED"))
    noisy = [one for one in rows if one["what"] == "noisy"]
    plain = [one for one in rows if one["what"] != "noisy"]
    speed = [one for one in rows if one["violation"] == Violation.SPEED.value]
    return {
        "RVDR": measured["RVDR"],
        "RVDR in the band": measured["RVDR_BOUNDARY"],
        "UCR": measured["UCR"],
        "FAS": measure(plain, ["FAS"])["FAS"],
        "FAS, noise x 2": measure(noisy, ["FAS"])["FAS"],
        "ticks, median": measured["DL_TICKS_MEDIAN"]["mean"],
        "ticks, p95": measured["DL_TICKS_P95"]["mean"],
        "speed: ticks, median": measure(speed, ["DL_TICKS_MEDIAN"])["DL_TICKS_MEDIAN"]["mean"],
    }
