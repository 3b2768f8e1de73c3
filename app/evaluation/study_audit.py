"""Whether the entries of an execution tell the whole story, checked against what the evaluation saw from outside.

An auditor has the entries alone; here they are held against the execution itself: how often the simulator began the
capability, whether it ended, and whether it was held.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from app.evaluation.physical_rows import UNLOOKED
from app.governance.model import EventKind, Strategy

if TYPE_CHECKING:
    from app.cell.journal import Entry
    from app.evaluation.episode import Execution

_AGAIN = (Strategy.RETRY.value, Strategy.SAFER_MODE.value)


def missing(done: Execution) -> str:
    """Return the first thing that the entries leave untold, or nothing.

    1. Sequence numbers rise by one.
    2. The first entry is the launch, and there is one of it.
    3. Where the execution is over there is one outcome, of the session, after everything else of it.
    4. Every status follows from the one before it.
    5. Every intervention names a rule that an alert told of before, or in the same tick.
    6. Every recovery names the failure it is about; there are enough to account for every new attempt.
    """
    entries = list(done.entries)
    for told in (_sequence(entries), _launched(entries, done), _ended(entries, done.over), _statuses(entries)):
        if told:
            return told
    return _interventions(entries) or _recoveries(entries, done)


def _sequence(entries: list[Entry]) -> str:
    return next((f"gap after {a.seq}" for a, b in pairwise(entries) if b.seq != a.seq + 1), "")


def _launched(entries: list[Entry], done: Execution) -> str:
    launches = [one for one in entries if one.kind == EventKind.LAUNCH and "refused" not in one.body]
    if done.refused:
        return "" if any("refused" in one.body for one in entries) or not entries else "refusal"
    return "" if len(launches) == 1 and entries[0] is launches[0] else "launch"


def _ended(entries: list[Entry], over: bool) -> str:
    ends = [one for one in entries if one.kind == EventKind.OUTCOME]
    if not ends:
        return "outcome" if over else ""
    return "" if len(ends) == 1 and entries[-1] is ends[0] else "one outcome, last"


def _statuses(entries: list[Entry]) -> str:
    before = None
    for one in (entry for entry in entries if entry.kind == EventKind.STATUS):
        if one.body["before"] != before:
            return f"status between {before} and {one.body['before']}"
        before = one.body["status"]
    return ""


def _interventions(entries: list[Entry]) -> str:
    told = {str(one.body["rule"]): one.tick for one in reversed(entries) if _tells(one)}
    for one in entries:
        if one.kind == EventKind.INTERVENTION and told.get(str(one.body["rule"]), one.tick + 1) > one.tick:
            return f"alert of {one.body['rule']}"
    return ""


def _tells(one: Entry) -> bool:
    return one.kind == EventKind.ALERT and str(one.body["signal"]) not in UNLOOKED


def _recoveries(entries: list[Entry], done: Execution) -> str:
    steps = [one for one in entries if one.kind == EventKind.RECOVERY]
    if any(not one.body["failure"] for one in steps):
        return "failure of a recovery"
    accounted = sum(one.body["strategy"] in _AGAIN for one in steps)
    bound = sum(one.kind == EventKind.STATUS and one.body["reason"] == "new_attempt" for one in entries)
    return "" if bound <= accounted else "recovery of an attempt"
