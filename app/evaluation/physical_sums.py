"""What the rows of protocol `physical` come to: metrics, classes, distributions, tables; what `results.json` holds."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final, cast

from app.evaluation.methods import ABLATIONS, REINS
from app.evaluation.metrics import METRICS, Entry, Tally, percentile
from app.evaluation.model import Breach, Kind, Violation
from app.evaluation.physical_choices import CHOICES
from app.evaluation.physical_counts import Escalations, Latencies, Redraws, Rollbacks, common_recoveries, overridden
from app.evaluation.physical_rows import MEANINGS, Class
from app.evaluation.safe_state import Reached
from app.evaluation.statistics import effect_sizes
from app.evaluation.studies import study_results
from app.evaluation.task_rows import TASK_MEANINGS, TaskClass

if TYPE_CHECKING:
    from app.evaluation.model import Row
    from app.evaluation.physical_counts import Trial
    from app.governance.model import Json
    from app.governance.policy import PolicySet

PAUSING: Final = frozenset({"real-restricted", "human-shared"})
"""The profiles that hold the robot for people; the other two only warn."""


def _entries(tallies: Mapping[str, Mapping[str, Tally]]) -> dict[str, dict[str, dict[str, Entry]]]:
    return {name: {method: one.entries() for method, one in mine.items()} for name, mine in tallies.items()}


class _Sums:
    """Everything that is counted of one method."""

    def __init__(self) -> None:
        self.tally = Tally()
        self.classes: dict[str, Counter[str]] = defaultdict(Counter)
        self.latencies: dict[str, list[float]] = defaultdict(list)
        self.recoveries: dict[Trial, float] = {}
        self.depths: list[float] = []
        self.gaps: list[tuple[float, float]] = []
        self.forces: list[float] = []
        self.blocked = Counter[tuple[bool, bool]]()
        self.turns = self.drawn = 0
        self.reached = Reached()
        self.asked, self.undone, self.told, self.again = Escalations(), Rollbacks(), Latencies(), Redraws()
        self.unended = 0

    def add(self, one: Row) -> None:
        self.tally.add(one)
        self.reached.add(one)
        self.asked.add(one)
        self.undone.add(one)
        self.told.add(one)
        self.again.add(one)
        self.unended += one.get("ended") is False
        self.classes[str(one["kind"])][str(one["class"])] += 1
        self.blocked[one["kind"] == Kind.UNAUTHORIZED, bool(one["launched"])] += 1
        self.turns, self.drawn = self.turns + int(float(one["turns"] or 0)), self.drawn + 1
        if (force := one["peak_force_n"]) is not None:
            self.forces.append(float(force))
        if (took := METRICS["MRT"].take(one)) is not None:
            self.recoveries[str(one["task"] or ""), int(one["seed"] or 0), int(one["trial"] or 0)] = float(took)
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
    approvals: dict[str, Tally] = defaultdict(lambda: Tally(["UAIR"]))
    studied: list[Row] = []
    for one in rows:
        if one.get("study"):
            studied.append(one)
            continue
        sums[str(one["method"])].add(one)
        if one.get("breach") == Breach.APPROVAL:
            approvals[str(one["method"])].add(one)
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
        "unsafe_per_type": {
            name: {one.value: found[f"UCR_{one.name}"] for one in Violation} for name, found in entries.items()
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
            "recovery_s": {name: [*mine.recoveries.values()] for name, mine in sums.items() if mine.recoveries},
        },
        "common_recoveries": common_recoveries({name: mine.recoveries for name, mine in sums.items()}, REINS.name),
        "redraws": ours.again.entries(),
        "human_override": overridden(approvals),
        "latencies": {name: mine.told.entries() for name, mine in sums.items()},
        "escalations": {name: found for name, mine in sums.items() if (found := mine.asked.entries())},
        "rollbacks": {name: found for name, mine in sums.items() if (found := mine.undone.entries())},
        "unended": {name: mine.unended for name, mine in sums.items()},
        "unpublished": [one._asdict() for one in CHOICES],
        **study_results(studied, policy),
    }
    return cast("dict[str, Json]", tables)  # all of it is numbers and names
