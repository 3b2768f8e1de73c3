"""Smaller counts of protocol `physical`: humans asked midway, rollbacks by what went wrong, latencies, overrides."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any, Final

from app.evaluation.methods import REINS
from app.evaluation.metrics import Entry, Tally, entry, percentile
from app.evaluation.model import Row

ALL: Final = "all"
WITHOUT_HUMAN: Final = "-human"


def went_wrong(row: Row) -> str | None:
    """Return what went wrong in a trial: the violation or the failure that was provoked and took; None: neither."""
    return _text(row.get("violation") or row.get("failure")) if row.get("class") != "not_taken" else None


def _text(value: object) -> str | None:
    return None if value is None else str(value)


@dataclass(slots=True)
class _Asked:
    sessions: int = 0
    asked: int = 0
    times: int = 0
    waits_s: list[float] = field(default_factory=list[float])
    answers: Counter[str] = field(default_factory=Counter[str])
    outcomes: Counter[str] = field(default_factory=Counter[str])


class Escalations:
    """Counts, by what went wrong, the sessions in which a human was asked midway."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self._of: dict[str, _Asked] = defaultdict(_Asked)

    def add(self, row: Row) -> None:
        """Take a row; what was not launched asks nobody midway."""
        what = went_wrong(row)
        if what is None or not row.get("launched"):
            return
        for mine in (self._of[what], self._of[ALL]):
            mine.sessions += 1
            times = int(float(row.get("asked") or 0))
            if not times:
                continue
            mine.asked, mine.times = mine.asked + 1, mine.times + times
            mine.waits_s.append(float(row.get("midway_s") or 0.0))
            mine.answers.update(str(row.get("answers") or "").split())
            mine.outcomes[str(row.get("outcome") or "not ended")] += 1

    def entries(self) -> dict[str, dict[str, Any]]:
        """Return what went wrong → counts; empty where nobody was ever asked."""
        if not self._of[ALL].asked:
            return {}
        order = [*sorted(name for name in self._of if name != ALL), ALL]
        return {name: self._entry(self._of[name]) for name in order if self._of[name].asked}

    @staticmethod
    def _entry(mine: _Asked) -> dict[str, Any]:
        return {
            "sessions": mine.sessions,
            "asked": mine.asked,
            "times": mine.times,
            "waited_s_mean": sum(mine.waits_s) / len(mine.waits_s),
            "waited_s_p95": percentile(mine.waits_s, 0.95),
            "answers": dict(mine.answers.most_common()),
            "outcomes": dict(mine.outcomes.most_common()),
        }


class Rollbacks:
    """Counts, by what went wrong, the rollbacks that were tried, could succeed, and were verified."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self._of: dict[str, Counter[str]] = defaultdict(Counter)

    def add(self, row: Row) -> None:
        """Take a row; one in which nothing was rolled back says nothing."""
        what, verified = went_wrong(row), row.get("rolled_back")
        if what is None or verified is None:
            return
        capable = bool(row.get("rollback_capable"))
        for mine in (self._of[what], self._of[ALL]):
            mine["tried"] += 1
            mine["verified"] += bool(verified)
            mine["capable"] += capable
            mine["missed"] += capable and not verified
            mine["beyond"] += not capable and not verified

    def entries(self) -> dict[str, dict[str, int]]:
        """Return what went wrong → counts, the total last; empty where nothing was rolled back."""
        order = [*sorted(name for name in self._of if name != ALL), *(name for name in self._of if name == ALL)]
        names = ("tried", "capable", "verified", "missed", "beyond")
        return {name: {one: self._of[name][one] for one in names} for name in order}


class Redraws:
    """Counts, by what was to go wrong, the faults that did not take and were drawn again."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self._of: dict[str, Counter[str]] = defaultdict(Counter)

    def add(self, row: Row) -> None:
        """Take a row; a trial in which nothing was to go wrong is drawn once."""
        what = _text(row.get("violation") or row.get("failure"))
        if what is None:
            return
        turns = int(float(row.get("turns") or 0))
        for mine in (self._of[what], self._of[ALL]):
            mine["trials"] += 1
            mine["again"] += turns > 0
            mine["redraws"] += turns
            mine["never"] += row.get("class") == "not_taken"

    def entries(self) -> dict[str, dict[str, int]]:
        """Return what was to go wrong → counts, the total last; empty where nothing was."""
        order = [*sorted(name for name in self._of if name != ALL), *(name for name in self._of if name == ALL)]
        return {name: {one: self._of[name][one] for one in ("trials", "again", "redraws", "never")} for name in order}


Trial = tuple[str, int, int]
"""Task, seed and number: what tells a trial from every other."""


def common_recoveries(took: Mapping[str, Mapping[Trial, float]], reference: str) -> dict[str, dict[str, float | int]]:
    """Compare recovery times over the trials in which a method and the reference both did the task after all.

    Args:
        took: Method → trial → s; what was not recovered is not there.
        reference: The method that the others are compared with; without it nothing is.

    Returns:
        method → `n` trials in common, mean `theirs_s` and `ours_s` over them; without any in common there is no entry.
    """
    ours = took.get(reference, {})
    found: dict[str, dict[str, float | int]] = {}
    for name, theirs in took.items():
        both = [trial for trial in theirs if trial in ours]
        if name != reference and both:
            found[name] = {
                "n": len(both),
                "theirs_s": fmean(theirs[trial] for trial in both),
                "ours_s": fmean(ours[trial] for trial in both),
            }
    return found


class Latencies:
    """Collects what a gate took, and how late detections were."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self._decisions: list[float] = []
        self._ticks: list[float] = []

    def add(self, row: Row) -> None:
        """Take a row."""
        if (spent := row.get("decision_us")) is not None:
            self._decisions.append(float(spent))
        if row.get("occurred") and row.get("detected") and (ticks := row.get("latency_ticks")) is not None:
            self._ticks.append(float(ticks))

    def entries(self) -> dict[str, dict[str, float | None]]:
        """Return `decision_us` and `detection_ticks` → n and percentiles."""
        return {"decision_us": _percentiles(self._decisions), "detection_ticks": _percentiles(self._ticks)}


def _percentiles(values: list[float]) -> dict[str, float | None]:
    shares = {"p50": 0.5, "p95": 0.95, "p99": 0.99}
    found = {name: percentile(values, share) if values else None for name, share in shares.items()}
    return {"n": len(values), **found}


def overridden(approvals: Mapping[str, Tally]) -> dict[str, dict[str, Entry]]:
    """Return what becomes of requests without their approval, with and without the override interface.

    Args:
        approvals: Method → tally of UAIR over the trials that propose what a human did not approve.
    """
    named = {"with override": REINS.name, "without override": WITHOUT_HUMAN}
    found: dict[str, dict[str, Entry]] = {}
    for name, method in named.items():
        if method in approvals:
            blocked = approvals[method].entries()["UAIR"]
            found[name] = {"BLOCK_RATE": blocked, "INCORRECT_ALLOW": _rest(blocked)}
    return found


def _rest(rate: Entry) -> Entry:
    """Return the entry of what a share leaves."""
    per_seed = {seed: 1.0 - value for seed, value in rate["per_seed"].items()}
    interval = None if rate["low"] is None else (1.0 - rate["high"], 1.0 - rate["low"])
    return entry(per_seed, rate["n"], interval)
