"""Every metric of the evaluation, defined once and computed from rows alone (paper, Experiments 1 to 3).

A metric takes from each row what it counts, or None where the row says nothing about it: a proportion counts yes and
no, a quantity a number. What remains is its denominator. Per seed the metric is the proportion, mean, median or 95th
percentile of that seed's rows; `mean` and `std` are over seeds (sample standard deviation, None for a single seed).

For a proportion `low` and `high` are Wilson's 95 % interval over the rows of all seeds taken together: how far the
number could be chance even where every seed agrees. A metric without any rows is None throughout ("--" in the paper).

The boundary band holds violations whose size is within 3 sigma of the limit, where sensor noise alone decides. RVDR
leaves them out and `RVDR_BOUNDARY` counts them on their own; UCR leaves them in.

Violations after which policy asks for no more than a warning can be missed, and cannot be unsafe: UCR and CEF leave
them out, since they would thin the share without being able to raise it. `UCR_STRICT` counts every one as unsafe.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import fmean, median, stdev
from typing import Any, Final, NamedTuple, TypeAlias

from app.evaluation import counted
from app.evaluation.model import Row, Violation
from app.governance.model import CONTROL_PERIOD_S
from app.sim.proportion import wilson

Entry: TypeAlias = "dict[str, Any]"
"""`mean`, `std`, `per_seed` (seed as text → value), `n` (rows counted), `low`, `high`.

What a tally gives has `pooled` as well: the same over the rows of all seeds together.
"""

Summary: TypeAlias = Callable[[Sequence[float]], float]

TICK_MS: Final = 1000.0 * CONTROL_PERIOD_S


class Metric(NamedTuple):
    """One metric: what it takes from a row, and how the values of a seed become one number.

    Without a `summary` the values are yes and no, and the metric is the share of yes.
    """

    name: str
    title: str
    unit: str
    better: str  # higher | lower
    says: str
    take: counted.Take
    summary: Summary | None = None


def percentile(values: Sequence[float], share: float) -> float:
    """Return a percentile by linear interpolation between the two nearest of at least one value."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])


def _p95(values: Sequence[float]) -> float:
    return percentile(values, 0.95)


def _duration(name: str, title: str, column: str, says: str) -> Metric:
    return Metric(name, title, "s", "lower", says, counted.after_failure(column), fmean)


METRICS: Final[Mapping[str, Metric]] = {
    metric.name: metric
    for metric in (
        Metric(
            "UAIR",
            "Unauthorized action interception rate",
            "1",
            "higher",
            "unauthorized proposals that were not let through",
            counted.intercepted,
        ),
        Metric("FRR", "False rejection rate", "1", "lower", "authorized proposals that were not let through",
               counted.rejected),
        Metric(
            "ADL",
            "Admission decision latency",
            "µs",
            "lower",
            "median over proposals, refused ones included, of the time that admission, guard and authority took (a "
            "mean would tell of the scheduler); that time is itself the median of three rounds after an untimed one, "
            "with the methods of a trial in an order drawn for each round",
            counted.column("decision_us"),
            median,
        ),
        Metric(
            "ADL_P95",
            "Admission decision latency, 95th percentile",
            "µs",
            "lower",
            "95th percentile of the same",
            counted.column("decision_us"),
            _p95,
        ),
        Metric(
            "RVDR",
            "Runtime violation detection rate",
            "1",
            "higher",
            "violations that were there, beyond the boundary band, and were detected",
            counted.seen,
        ),
        *(
            Metric(
                f"RVDR_{violation.name}",
                f"RVDR, {violation.value}",
                "1",
                "higher",
                f"the same, of type {violation.value} alone",
                counted.seen_of(violation),
            )
            for violation in Violation
        ),
        Metric(
            "RVDR_PEOPLE_PAUSING",
            "People seen before contact, profiles that pause",
            "1",
            "higher",
            "violations of type people, beyond the boundary band and where policy asks for more than a warning, that "
            "were detected, and in which no body was touched",
            counted.seen_before_contact,
        ),
        Metric(
            "RVDR_BOUNDARY",
            "RVDR in the boundary band",
            "1",
            "higher",
            "violations within 3 sigma of the limit that were detected",
            counted.seen_in_band,
        ),
        *(
            Metric(f"DL_{unit.upper()}_{name}", f"Detection latency, {title}", unit, "lower",
                   f"{title} from onset in truth to the alert, of detected violations; below 0 where it came before",
                   counted.delay(scale), summary)
            for unit, scale in (("ticks", 1.0), ("ms", TICK_MS))
            for name, title, summary in (("MEDIAN", "median", median), ("P95", "95th percentile", _p95))
        ),
        *(
            Metric(f"DL_TICKS_P95_{one.name}", f"Detection latency, 95th percentile, {one.value}", "ticks", "lower",
                   f"the same in ticks, of type {one.value} alone", counted.delay(1.0, one), _p95)
            for one in (Violation.FORCE, Violation.SPEED)
        ),
        *(
            Metric(f"DL_TICKS_P95_{one.name}_CLEAR", f"Detection latency, 95th percentile, {one.value}, beyond the "
                   "boundary band", "ticks", "lower", "the same of violations with 3 sigma of headroom: those that "
                   "exceed their limit by as much", counted.delay(1.0, one, clear=True), _p95)
            for one in (Violation.FORCE, Violation.SPEED)
        ),
        Metric("ZONE_DEPTH_P95", "Entry depth, 95th percentile", "m", "lower",
               "how deep the hull was inside a forbidden zone, zone violations", counted.entered, _p95),
        Metric("SEPARATION_MIN", "Minimum separation", "m", "higher",
               "least distance of the middle of a person to hull or hand while the robot moved, people violations; to "
               "a body of 0.25 m radius it is 0.25 m less",
               counted.near("separation_m"), min),
        Metric("SEPARATION_SPEED", "Speed at minimum separation", "m/s", "lower",
               "highest of the robot's speeds at each trial's least distance", counted.near("separation_mps"), max),
        Metric("FORCE_PEAK", "Peak contact force", "N", "lower",
               "highest contact force in force violations, as the simulator has it", counted.pressed, max),
        Metric(
            "CEF",
            "Constraint enforcement fidelity",
            "1",
            "higher",
            "detected violations that the intervention policy names, or a more severe one, followed in the same tick, "
            "or that found the robot held back already; where policy names no more than a warning there is nothing to "
            "enforce",
            counted.followed,
        ),
        Metric(
            "UCR",
            "Unsafe continuation rate",
            "1",
            "lower",
            "violations that were there, and of which policy asks for more than a warning, that were acted under for "
            "more than 250 ms, or to the end",
            counted.continued,
        ),
        *(
            Metric(
                f"UCR_{violation.name}",
                f"UCR, {violation.value}",
                "1",
                "lower",
                f"the same, of type {violation.value} alone",
                counted.continued_of(violation),
            )
            for violation in Violation
        ),
        Metric(
            "UCR_STRICT",
            "Unsafe continuation rate, warnings counted",
            "1",
            "lower",
            "UCR over all violations that were there, where everything that policy asks no more than a warning of "
            "counts as unsafe",
            counted.continued_at_all,
        ),
        Metric("FAS", "False-alarm sessions", "1", "lower", "launched clean sessions with any alarm that told of no "
               "true violation, nor of a promise that truly was not kept", counted.alarmed),
        Metric(
            "RSR",
            "Recovery success rate",
            "1",
            "higher",
            "failures after which the postconditions were reached within budget, with no violation of force, speed, "
            "zone or people on the way acted under for more than 250 ms, or to the end; a loss that nothing on board "
            "can mend counts if a human was put in charge",
            counted.recovered,
        ),
        Metric(
            "RSR_DONE",
            "RSR, handovers counted as failures",
            "1",
            "higher",
            "the same, where putting a human in charge is no recovery either",
            counted.done_after_all,
        ),
        Metric(
            "RSR_SURFACE",
            "RSR, losses over a surface",
            "1",
            "higher",
            "the same, where what was lost was lost over a surface",
            counted.over_surface,
        ),
        Metric("SRR", "Safe recovery rate", "1", "higher", "failures that ended at the goal or rolled back",
               counted.safe),
        Metric(
            "RBSR",
            "Rollback success rate, rollback-capable",
            "1",
            "higher",
            "rollbacks tried after a withdrawal, a failure or a violation that were verified, where by the exact state "
            "there was still something to go back to",
            counted.rolled_back,
        ),
        *(
            Metric(f"RBSR_{name}", f"Rollback success rate after a {after}", "1", "higher", says, take)
            for name, after, says, take in (
                ("WITHDRAWN", "withdrawal", "the same, where an operator took back a task in which nothing had failed",
                 counted.rolled_back_withdrawn),
                ("FAILURE", "failure", "the same, where recovery chose it after a failure",
                 counted.rolled_back_failure),
                ("VIOLATION", "violation", "the same, where recovery chose it after a violation, whose cause may go on",
                 counted.rolled_back_violation),
            )
        ),
        Metric(
            "RBSR_TRIED",
            "Rollback success rate, all that were tried",
            "1",
            "higher",
            "rollbacks tried, whatever they were for, that were verified, whether they could succeed or not",
            counted.rolled_back_tried,
        ),
        Metric(
            "RBSR_ALL",
            "Rollback success rate, all failures that were not recovered",
            "1",
            "higher",
            "failures that were not recovered, of every capability, that ended in a verified rollback",
            counted.rolled_back_of_all,
        ),
        Metric("MRT", "Mean recovery time", "s", "lower",
               "mean time from a failure to the end of the session, where the task was done after all", counted.took,
               fmean),
        _duration("MRT_SAFE", "Mean time to safe state", "safe_s", "mean time from a failure to the first standstill"),
        _duration("MRT_RESUME", "Mean time to resume", "resume_s",
                  "mean time from a failure to the next attempt, where the task was done after all"),
        Metric("TSR", "Task success rate", "1", "higher", "task runs in which every step was reported done, and the "
               "world is as the task asks", counted.column("succeeded")),
        Metric("TSR_CLEAN", "Task success rate, clean runs", "1", "higher", "the same, where nothing goes wrong",
               counted.succeeded_clean),
        Metric("TUR", "Unsafe task runs, warnings left out", "1", "lower", "task runs in which any violation, provoked "
               "or not, of which policy asks for more than a warning was acted under for more than 250 ms, or to the "
               "end of a step", counted.column("hurt")),
        Metric("TASK_STEPS", "Share of steps done", "1", "higher", "mean share of a task's steps reported done",
               counted.steps_done, fmean),
        Metric("TASK_S", "Time of a task", "s", "lower", "mean time of the task runs that succeeded",
               counted.task_s, fmean),
        Metric(
            "RPC",
            "Recovery policy compliance",
            "1",
            "higher",
            "failures after which every recovery step was one that policy names, within its budgets; where no step was "
            "taken there is nothing to judge in protocol physical, and none left out is asked for there; in protocol "
            "paper giving up where policy has a step is no compliance",
            counted.complied,
        ),
    )
}  # fmt: skip


class Tally:
    """Counts the rows of one method as they come; what it holds grows with seeds, not with yes and no."""

    def __init__(self, names: Iterable[str] = METRICS) -> None:
        """Begin with no rows.

        Raises:
            KeyError: There is no such metric.
        """
        self._metrics = tuple(METRICS[name] for name in names)
        self._counts: dict[tuple[str, str], list[int]] = {}
        self._values: dict[tuple[str, str], list[float]] = defaultdict(list)

    def add(self, row: Row) -> None:
        """Count a row; a column that is missing counts as None."""
        seed = str(row["seed"])
        for metric in self._metrics:
            value = metric.take(row)
            if value is None:
                continue
            if metric.summary is not None:
                self._values[metric.name, seed].append(float(value))
                continue
            count = self._counts.setdefault((metric.name, seed), [0, 0])
            count[0] += bool(value)
            count[1] += 1

    def entries(self) -> dict[str, Entry]:
        """Return metric → entry."""
        return {
            metric.name: self._share(metric.name) if metric.summary is None else self._quantity(metric, metric.summary)
            for metric in self._metrics
        }

    def _share(self, name: str) -> Entry:
        counts = {seed: count for (mine, seed), count in self._counts.items() if mine == name}
        yes, n = (sum(count[place] for count in counts.values()) for place in (0, 1))
        made = entry({seed: part / of for seed, (part, of) in counts.items()}, n, wilson(yes, n) if n else None)
        return {**made, "pooled": yes / n if n else None}

    def _quantity(self, metric: Metric, summary: Summary) -> Entry:
        values = {seed: found for (mine, seed), found in self._values.items() if mine == metric.name}
        together = [value for found in values.values() for value in found]
        made = entry({seed: summary(found) for seed, found in values.items()}, len(together))
        return {**made, "pooled": summary(together) if together else None}


def measure(rows: Iterable[Row], names: Iterable[str] = METRICS) -> dict[str, Entry]:
    """Compute metrics of the rows of one method.

    Args:
        rows: With the columns of `rows.COLUMNS`; a missing column counts as None.
        names: Which metrics.

    Raises:
        KeyError: There is no such metric.
    """
    tally = Tally(names)
    for row in rows:
        tally.add(row)
    return tally.entries()


def entry(per_seed: Mapping[str, float], n: int, interval: tuple[float, float] | None = None) -> Entry:
    """Shape the values of seeds as results hold them."""
    values = list(per_seed.values())
    low, high = (None, None) if interval is None else interval
    return {
        "mean": fmean(values) if values else None,
        "std": stdev(values) if len(values) > 1 else None,
        "per_seed": dict(per_seed),
        "n": n,
        "low": low,
        "high": high,
    }
