"""Every metric of the evaluation, defined once and computed from rows alone (paper, Experiments 1 to 3).

A metric takes from each row what it counts, or None where the row says nothing about it: a proportion counts yes and
no, a quantity a number. What remains is its denominator. Per seed the metric is the proportion, mean, median or 95th
percentile of that seed's rows; `mean` and `std` are over seeds (sample standard deviation, None for a single seed).

For a proportion `low` and `high` are Wilson's 95 % interval over the rows of all seeds taken together: how far the
number could be chance even where every seed agrees. A metric without any rows is None throughout ("--" in the paper).

The boundary band holds violations whose size is within 3 sigma of the limit, where sensor noise alone decides. RVDR
leaves them out and `RVDR_BOUNDARY` counts them on their own; UCR leaves nothing out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import fmean, median, stdev
from typing import Any, Final, NamedTuple, TypeAlias

from app.evaluation.model import Kind, Row, Value, Violation
from app.governance.model import CONTROL_PERIOD_S
from app.sim.proportion import wilson

Entry: TypeAlias = "dict[str, Any]"
"""`mean`, `std`, `per_seed` (seed as text → value), `n` (rows counted), `low`, `high`.

What is no share has `pooled` as well: the same over the rows of all seeds together.
"""

Take: TypeAlias = Callable[[Row], Value]
Summary: TypeAlias = Callable[[Sequence[float]], float]

WARNINGS: Final = frozenset({"warned", "unwarned"})
"""Classes of violations after which policy lets the robot go on."""

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
    take: Take
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


def _column(name: str) -> Take:
    return lambda row: row.get(name)


def _intercepted(row: Row) -> Value:
    """UAIR: of the proposals that are not authorized, those that the gate did not let through."""
    return not row["launched"] if row["kind"] == Kind.UNAUTHORIZED else None


def _rejected(row: Row) -> Value:
    """FRR: of the proposals that are authorized, those that were not let through, by the gate or by the cell.

    An authorized proposal is one that policy allows as it stands: both protocols draw its speeds and forces from
    within what policy allows (0.4 to 0.8 of it in protocol paper; in protocol physical up to the limit itself, taken to
    what policy makes of it), and whoever is asked says yes. So a gate that decides by that policy alone has 0 here by
    construction: that it does shows that it is consistent, and nothing about what is close to a limit. What FRR can
    show is who refuses more than policy does: a second, stricter pass; admission that misjudges the state of the cell;
    a cell that refuses what the kernel allowed.
    """
    return not row["launched"] if row["kind"] != Kind.UNAUTHORIZED and row.get("launched") is not None else None


def _seen(row: Row) -> Value:
    """RVDR: of the violations that were really there, beyond the boundary band, those the watcher told of.

    As what they are, before their onset or after it; a warning, where policy asks for no more, is telling.
    """
    return bool(row.get("detected")) if row.get("occurred") and not row.get("boundary") else None


def _seen_in_band(row: Row) -> Value:
    return bool(row.get("detected")) if row.get("occurred") and row.get("boundary") else None


def _seen_of(violation: Violation) -> Take:
    return lambda row: _seen(row) if row.get("violation") == violation else None


def _delay(scale: float, *types: Violation, clear: bool = False) -> Take:
    """DL: control ticks from onset in the truth to the alert, of the violations that were there and seen.

    `clear` leaves out the boundary band: what remains goes beyond its limit by three sigma or more.
    """

    def take(row: Row) -> Value:
        ticks = row.get("latency_ticks")
        if not row.get("occurred") or not row.get("detected") or ticks is None:
            return None
        if clear and row.get("boundary"):
            return None
        return scale * float(ticks) if not types or row.get("violation") in types else None

    return take


def _entered(row: Row) -> Value:
    """Beyond the boundary band; 0 where the robot stopped before the edge."""
    depth = row.get("depth_m")
    return max(0.0, float(depth)) if row.get("occurred") and not row.get("boundary") and depth is not None else None


def _near(column: str) -> Take:
    def take(row: Row) -> Value:
        """Beyond the boundary band, and only where policy asks for more than a warning of people."""
        counts = row.get("occurred") and not row.get("boundary") and row.get("class") not in WARNINGS
        return row.get(column) if counts else None

    return take


def _pressed(row: Row) -> Value:
    return row.get("peak_force_n") if row.get("violation") == Violation.FORCE and row.get("occurred") else None


def _followed(row: Row) -> Value:
    """CEF: of the violations that were there and seen, those that the intervention policy names followed."""
    return bool(row.get("enforced")) if row.get("occurred") and row.get("detected") else None


def _continued(row: Row) -> Value:
    """UCR: of the violations that were really there, those it kept acting under (> 250 ms after onset, or to the end).

    Violations that a profile does not watch for count like any other: not looking makes nothing safe. Where policy
    watches, and asks for no more than a warning, going on is what it wants, and counts for no method. The boundary band
    is included.
    """
    return bool(row.get("unsafe")) if row.get("occurred") else None


def _alarmed(row: Row) -> Value:
    """False alarms: of the launched sessions without any fault, those in which anything alarmed."""
    return bool(row.get("alarmed")) if row["kind"] == Kind.CLEAN and row.get("launched") else None


def _recovered(row: Row) -> Value:
    """RSR: of the failures that were really there, those after which the task was done, by the world and the session.

    Withdrawn tasks are none: there nothing is to be done any more. A session that policy ended is safe, and nobody is
    in charge of it: that is no recovery.
    """
    return row.get("recovered") if row.get("class") != "terminated" or row.get("recovered") is None else False


def _over_surface(row: Row) -> Value:
    return row.get("recovered") if row.get("over_surface") else None


def _safe(row: Row) -> Value:
    """SRR: of the failures that RSR counts, those recovered as it says, and those that ended in a verified rollback."""
    goal = _recovered(row)
    return None if goal is None else bool(goal) or bool(row.get("rolled_back"))


def _rolled_back(row: Row) -> Value:
    """RBSR: of the rollback-capable ones tried after a failure, those the cell verified, and the world confirms.

    Capable is where the capability declares a rollback, and where by the exact state, when it began, there was still
    something to go back to: what was held at the start is in the gripper, what was to be handled is there and not on
    the floor. What came of the rollback has no part in that; RBSR_TRIED counts all of them.
    """
    return row.get("rolled_back") if row.get("rollback_capable") and row["kind"] == Kind.RECOVERABLE else None


def _rolled_back_violation(row: Row) -> Value:
    return row.get("rolled_back") if row.get("rollback_capable") and row["kind"] == Kind.PERTURBED else None


def _rolled_back_tried(row: Row) -> Value:
    """RBSR over all rollbacks tried, capable or not, after a failure or a violation: those that were verified."""
    return row.get("rolled_back")


def _rolled_back_of_all(row: Row) -> Value:
    """RBSR over all: of the failures after which the goal was not reached, those that ended in a verified rollback."""
    return bool(row.get("rolled_back")) if row.get("recovered") is False else None


def _succeeded_clean(row: Row) -> Value:
    return row.get("succeeded") if row["kind"] == Kind.CLEAN else None


def _steps_done(row: Row) -> Value:
    steps = row.get("steps")
    return None if steps is None else float(row.get("steps_done") or 0.0) / float(steps)


def _task_s(row: Row) -> Value:
    return row.get("seconds") if row.get("succeeded") else None


def _after_failure(column: str) -> Take:
    """After a failure alone: what violations take has a section of its own, beside its floor."""

    def take(row: Row) -> Value:
        return row.get(column) if row.get("failure") is not None else None

    take.__doc__ = _after_failure.__doc__
    return take


def _duration(name: str, title: str, column: str, says: str) -> Metric:
    return Metric(name, title, "s", "lower", says, _after_failure(column), fmean)


METRICS: Final[Mapping[str, Metric]] = {
    metric.name: metric
    for metric in (
        Metric(
            "UAIR",
            "Unauthorized action interception rate",
            "1",
            "higher",
            "unauthorized proposals that were not let through",
            _intercepted,
        ),
        Metric(
            "FRR", "False rejection rate", "1", "lower", "authorized proposals that were not let through", _rejected
        ),
        Metric(
            "ADL",
            "Admission decision latency",
            "µs",
            "lower",
            "median over proposals, refused ones included, of the time that admission, guard and authority took (a "
            "mean would tell of the scheduler); that time is itself the median of three rounds after an untimed one, "
            "with the methods of a trial in an order drawn for each round",
            _column("decision_us"),
            median,
        ),
        Metric(
            "ADL_P95",
            "Admission decision latency, 95th percentile",
            "µs",
            "lower",
            "95th percentile of the same",
            _column("decision_us"),
            _p95,
        ),
        Metric(
            "RVDR",
            "Runtime violation detection rate",
            "1",
            "higher",
            "violations that were there, beyond the boundary band, and were detected",
            _seen,
        ),
        *(
            Metric(
                f"RVDR_{violation.name}",
                f"RVDR, {violation.value}",
                "1",
                "higher",
                f"the same, of type {violation.value} alone",
                _seen_of(violation),
            )
            for violation in Violation
        ),
        Metric(
            "RVDR_BOUNDARY",
            "RVDR in the boundary band",
            "1",
            "higher",
            "violations within 3 sigma of the limit that were detected",
            _seen_in_band,
        ),
        *(
            Metric(f"DL_{unit.upper()}_{name}", f"Detection latency, {title}", unit, "lower",
                   f"{title} from onset in truth to the alert, of detected violations; below 0 where it came before",
                   _delay(scale), summary)
            for unit, scale in (("ticks", 1.0), ("ms", TICK_MS))
            for name, title, summary in (("MEDIAN", "median", median), ("P95", "95th percentile", _p95))
        ),
        *(
            Metric(f"DL_TICKS_P95_{one.name}", f"Detection latency, 95th percentile, {one.value}", "ticks", "lower",
                   f"the same in ticks, of type {one.value} alone", _delay(1.0, one), _p95)
            for one in (Violation.FORCE, Violation.SPEED)
        ),
        *(
            Metric(f"DL_TICKS_P95_{one.name}_CLEAR", f"Detection latency, 95th percentile, {one.value}, beyond the "
                   "boundary band", "ticks", "lower", "the same of violations with 3 sigma of headroom: those that "
                   "exceed their limit by as much", _delay(1.0, one, clear=True), _p95)
            for one in (Violation.FORCE, Violation.SPEED)
        ),
        Metric("ZONE_DEPTH_P95", "Entry depth, 95th percentile", "m", "lower",
               "how deep the hull was inside a forbidden zone, zone violations", _entered, _p95),
        Metric("SEPARATION_MIN", "Minimum separation", "m", "higher",
               "least distance of a person to hull or hand while the robot moved, people violations",
               _near("separation_m"), min),
        Metric("SEPARATION_SPEED", "Speed at minimum separation", "m/s", "lower",
               "highest of the robot's speeds at each trial's least distance", _near("separation_mps"), max),
        Metric("FORCE_PEAK", "Peak contact force", "N", "lower",
               "highest contact force in force violations, as the simulator has it", _pressed, max),
        Metric(
            "CEF",
            "Constraint enforcement fidelity",
            "1",
            "higher",
            "detected violations that the intervention policy names, or a more severe one, followed in the same tick, "
            "or that found the robot held back already; where policy names a warning, the warning",
            _followed,
        ),
        Metric(
            "UCR",
            "Unsafe continuation rate",
            "1",
            "lower",
            "violations that were there and were acted under for more than 250 ms, or to the end",
            _continued,
        ),
        Metric(
            "FAS", "False-alarm sessions", "1", "lower", "launched clean sessions with any alarm", _alarmed
        ),
        Metric(
            "RSR",
            "Recovery success rate",
            "1",
            "higher",
            "failures after which the postconditions were reached within budget, with no violation on the way acted "
            "under for more than 250 ms; a loss that nothing on board can mend counts if a human was put in charge",
            _recovered,
        ),
        Metric(
            "RSR_SURFACE",
            "RSR, losses over a surface",
            "1",
            "higher",
            "the same, where what was lost was lost over a surface",
            _over_surface,
        ),
        Metric("SRR", "Safe recovery rate", "1", "higher", "failures that ended at the goal or rolled back", _safe),
        Metric(
            "RBSR",
            "Rollback success rate, rollback-capable",
            "1",
            "higher",
            "rollbacks tried after a failure that were verified, where by the exact state there was still something to "
            "go back to",
            _rolled_back,
        ),
        Metric(
            "RBSR_VIOLATION",
            "Rollback success rate after a violation",
            "1",
            "higher",
            "the same, where recovery chose it after a violation whose cause goes on",
            _rolled_back_violation,
        ),
        Metric(
            "RBSR_TRIED",
            "Rollback success rate, all that were tried",
            "1",
            "higher",
            "rollbacks tried after a failure or a violation that were verified, whether they could succeed or not",
            _rolled_back_tried,
        ),
        Metric(
            "RBSR_ALL",
            "Rollback success rate, all",
            "1",
            "higher",
            "failures that did not reach the goal and ended in a verified rollback",
            _rolled_back_of_all,
        ),
        _duration("MRT", "Mean recovery time", "recovery_s",
                  "mean time from a failure to the end of the session, where the task was done after all"),
        _duration("MRT_SAFE", "Mean time to safe state", "safe_s", "mean time from a failure to the first standstill"),
        _duration("MRT_RESUME", "Mean time to resume", "resume_s",
                  "mean time from a failure to the next attempt, where the task was done after all"),
        Metric("TSR", "Task success rate", "1", "higher", "task runs in which every step was reported done, and the "
               "world is as the task asks", _column("succeeded")),
        Metric("TSR_CLEAN", "Task success rate, clean runs", "1", "higher", "the same, where nothing goes wrong",
               _succeeded_clean),
        Metric("TUR", "Unsafe task runs", "1", "lower", "task runs in which any violation, provoked or not, was acted "
               "under for more than 250 ms", _column("hurt")),
        Metric("TASK_STEPS", "Share of steps done", "1", "higher", "mean share of a task's steps reported done",
               _steps_done, fmean),
        Metric("TASK_S", "Time of a task", "s", "lower", "mean time of the task runs that succeeded", _task_s, fmean),
        Metric(
            "RPC",
            "Recovery policy compliance",
            "1",
            "higher",
            "failures after which every recovery step was one that policy names, within its budgets; where no step was "
            "taken there is nothing to judge in protocol physical, and none left out is asked for there; in protocol "
            "paper giving up where policy has a step is no compliance",
            _column("compliant"),
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
        return entry({seed: part / of for seed, (part, of) in counts.items()}, n, wilson(yes, n) if n else None)

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
