"""Sensitivity: what the one number s of a profile moves, and what raising it while people are near would buy.

s acts on debounce times and CUSUM limits alone, so that is all it can move. The same trials run under s = 0.1 … 1.0,
fixed in every profile alike, under each profile's own, and under a schedule: 0.9 while a person is nearer than 4.5 m or
the profile expects people on the floor, 0.3 otherwise. The schedule changes the watcher between two ticks; what has
been counted and summed so far lives on.

With the shipped policy that is little: only what may flicker (slip, tracking) is debounced at all, so s moves
latencies by a tick. A second set of trials therefore asks where s does matter, in circumstances made for it (`HARD`): a
policy that debounces force and speed by 250 ms at s = 0.5 and stops at 0.97 of a speed limit already, sensors with
twice their noise, and faults that last 0.05 to 0.6 s and go beyond the limit by a quarter of what they do elsewhere.
There a low s lets brief faults pass and a high one takes noise for a violation: the frontier of the report.

In half of the trials somebody stands on the floor, out of the way, so that the schedule has something to go by; an
alarm about people is no false alarm there, and is not counted as one. Half of the clean
trials have sensors with twice their noise: with sensors as measured there are next to no false alarms to trade.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from app.evaluation.draws import Drawn, draw, of_type
from app.evaluation.methods import REINS, Passed
from app.evaluation.metrics import measure
from app.evaluation.model import Kind, Row, Violation
from app.evaluation.physical_rows import SIGNALS, alarmed_falsely, row
from app.evaluation.physical_trial import Ran, taken
from app.evaluation.study_trials import Part, Table, bench_of, executed, govern, grouped, study_row, table
from app.evaluation.truth import OVER
from app.governance.watcher import compile_watch
from app.sim.faults import Scenario
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.sensors import AS_MEASURED, Quality

if TYPE_CHECKING:
    from app.cell.runner import Runner
    from app.evaluation.physical_trial import Bench, Trial
    from app.governance.model import WatchPlan
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

NAME: Final = "sensitivity"
TITLE: Final = "Sensitivity: fixed, and raised while people are near"
ABOUT: Final = (
    "The same trials under s = 0.1 to 1.0 in every profile alike, under each profile's own s, and under a schedule "
    "that raises s from 0.3 to 0.9 while a person is nearer than 4.5 m or the profile expects people on the floor. s "
    "moves debounce times and CUSUM limits, and nothing else. In the shipped policy next to nothing is debounced, and "
    "the first table shows no trade: little depends on s there. The second is of circumstances in which much does: a "
    "policy that debounces force and speed by 250 ms at s = 0.5 and stops at 0.97 of a speed limit already (skills "
    "drive at 0.95), twice the sensor noise, and brief faults (0.05 to 0.6 s) near the limit, of force and speed "
    "alone. The frontier, the sweep and the ROC of the report are of these; the shipped policy is marked in them."
)
TRIALS: Final = 40
HARD_TRIALS: Final = 90
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

HARD: Final = "hard"
HARD_MIX: Final[tuple[Violation | None, ...]] = (Violation.SPEED, None, Violation.FORCE)
HARD_SIZE: Final = 0.25
HARD_S: Final = (0.05, 0.6)
DEBOUNCE_MS: Final = 250
DEBOUNCED: Final[Mapping[str, float]] = {
    "tcp_speed_mps": 0.97,
    "base_speed_mps": 0.97,
    "contact_force_n": OVER,
    "grip_force_n": OVER,
}
"""What is debounced there, and where its threshold lies, in units of the limit; skills drive at 0.95 of it."""

SHOWN: Final = ("RVDR", "RVDR_BOUNDARY", "UCR", "FAS")

Change = Callable[["WatchPlan"], "WatchPlan"]


def parts(seeds: Sequence[int]) -> list[Part]:
    """Return the trials with sensors as measured, then those with twice the noise, then those in hard circumstances."""
    each, hard = max(len(MIX), TRIALS // len(seeds)), max(len(HARD_MIX), HARD_TRIALS // len(seeds))
    return [
        *(Part(kind, seed, number, 1) for kind in ("measured", "noisy") for seed in seeds for number in range(each)
          if (kind == "noisy") is _noisy(number)),
        *(Part(HARD, seed, number, 1) for seed in seeds for number in range(hard)),
    ]  # fmt: skip


def _noisy(number: int) -> bool:
    return MIX[number % len(MIX)] is None and number % 4 == 3


def run(part: Part, policy: PolicySet) -> Iterator[Row]:
    """Run trials under every sensitivity."""
    bench = bench_of(policy, AS_MEASURED if part.condition == "measured" else NOISY)
    hard = part.condition == HARD
    drawn, first = (_drawn_hard, _debounced) if hard else (_drawn, _as_shipped)
    for number in range(part.first, part.first + part.count):
        trial = taken(bench, lambda turn, number=number: drawn(policy, part.seed, number, turn), whole=False)
        for s in FIXED:
            yield _under(bench, part, trial, f"s = {s:g}", s, change=partial(_fixed, s, first))
        yield _under(bench, part, trial, OWN, None, change=first)
        schedule = _Schedule(policy.profiles[trial.drawn.profile].shared_floor, first)
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


def _drawn_hard(policy: PolicySet, seed: int, number: int, turn: int) -> Drawn:
    """Draw a brief fault near its limit, or a clean trial; in half of them somebody stands out of the way."""
    violation = HARD_MIX[number % len(HARD_MIX)]
    if violation is None:
        drawn = draw(policy, seed, number, kind=Kind.CLEAN, turn=turn)
    else:
        drawn = of_type(policy, seed, number, violation, turn=turn, size=HARD_SIZE)
    rng = np.random.default_rng((seed, number, turn, 43))
    brief = tuple(
        fault if fault.kind == "blocked" else replace(fault, for_s=float(rng.uniform(*HARD_S)))
        for fault in drawn.scenario.faults  # a crate that hangs there does not go away
    )
    by = (Walk(points=(STANDS,), start=Trigger(time_s=0.0), leaves=False),) if number // len(HARD_MIX) % 2 else ()
    return replace(drawn, scenario=Scenario(faults=brief, people=by))


def _as_shipped(plan: WatchPlan) -> WatchPlan:
    return plan


def _debounced(plan: WatchPlan) -> WatchPlan:
    """Return the plan of a policy that debounces force and speed, and stops at speeds that are almost the limit."""
    rules = tuple(
        replace(rule, for_ms=DEBOUNCE_MS, method="threshold", threshold=rule.threshold / OVER * DEBOUNCED[rule.signal])
        if rule.signal in DEBOUNCED and rule.threshold is not None
        else rule
        for rule in plan.rules
    )
    return replace(plan, rules=rules)


def _fixed(s: float, first: Change, plan: WatchPlan) -> WatchPlan:
    return replace(first(plan), sensitivity=s)


class _Schedule:
    """Raises s while people are near or expected, and lowers it again."""

    def __init__(self, expected: bool, first: Change) -> None:
        self.expected, self._first = expected, first

    def begin(self, plan: WatchPlan) -> WatchPlan:
        """Return the plan as a session begins with it."""
        return replace(self._first(plan), sensitivity=HIGH if self.expected else LOW)

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
        made["alarmed"] = alarmed_falsely(done, trial.plan, SIGNALS[Violation.PEOPLE])
    made.update(decision_us=None, sensitivity=s, missing=executed(done)["missing"], what=part.condition)
    return made


def sweep(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the fixed ones in hard circumstances as `sensitivity` of results, for its plots.

    There every violation is near its limit, so RVDR counts those in the boundary band as well.
    """
    found: list[dict[str, Any]] = []
    for s in FIXED:
        measured = _hard([one for one in rows if one["sensitivity"] == s and one["what"] == HARD])
        if measured["RVDR"]["n"]:
            found.append({"s": s, "RVDR": measured["RVDR"], "UCR": measured["UCR"], "FAR": measured["FAS"]})
    return found


def shipped(rows: Sequence[Row]) -> dict[str, Any]:
    """Return what the shipped policy comes to under each profile's own s, for the same plots; sensors as measured."""
    mine = [one for one in rows if one["condition"] == OWN and one["what"] == "measured"]
    measured = measure(mine, ("RVDR", "UCR", "FAS"))
    return {"RVDR": measured["RVDR"], "UCR": measured["UCR"], "FAR": measured["FAS"]}


def _hard(rows: Sequence[Row]) -> dict[str, Any]:
    """Return what a sensitivity does in hard circumstances, the boundary band included."""
    return {**measure(rows, SHOWN), "RVDR": measure([{**one, "boundary": False} for one in rows], ["RVDR"])["RVDR"]}


def tables(rows: Sequence[Row], policy: PolicySet) -> list[Table]:
    """Return the frontier: what each sensitivity sees, how late, and what it alarms of falsely."""
    found: Mapping[str, list[Row]] = grouped([one for one in rows if one["what"] != HARD], "condition")
    hard: Mapping[str, list[Row]] = grouped([one for one in rows if one["what"] == HARD], "condition")
    return [
        table(
            "Fixed sensitivities, and the schedule, with the shipped policy",
            "Sensitivity",
            {name: _summed(mine) for name, mine in found.items()},
            "FAS: clean sessions with an alarm, with sensors as measured and with twice their noise. Latency in "
            "control ticks from the onset in truth.",
        ),
        table(
            "The same in circumstances in which s matters",
            "Sensitivity",
            {name: _summed_hard(mine) for name, mine in hard.items()},
            "RVDR over all violations, most of which are near their limit. A brief fault that is over before the "
            "debounce time is missed, one that outlasts it is acted under until then; noise that outlasts it is a "
            "false alarm.",
        ),
    ]


def _summed_hard(rows: Sequence[Row]) -> dict[str, Any]:
    measured, late = _hard(rows), measure(rows, ("DL_TICKS_MEDIAN", "DL_TICKS_P95"))
    return {
        "RVDR": measured["RVDR"],
        "UCR": measured["UCR"],
        "FAS": measured["FAS"],
        "ticks, median": late["DL_TICKS_MEDIAN"]["mean"],
        "ticks, p95": late["DL_TICKS_P95"]["mean"],
    }


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
