"""One bench for all tests that execute in the workcell: preparing its starts takes seconds."""

from __future__ import annotations

from functools import cache

from app.evaluation.episode import LIMIT_TICKS, RECOVERY_TICKS
from app.evaluation.methods import REINS, Method
from app.evaluation.model import Failure, Kind, Row, Violation
from app.evaluation.physical_rows import row
from app.evaluation.physical_trial import Bench, Change, Trial, prepare, run
from tests.governance.policy_world import shipped


@cache
def bench() -> Bench:
    return Bench.of(shipped())


@cache
def trial(seed: int, number: int, wanted: Kind | Violation | Failure | None = None) -> Trial:
    return prepare(bench(), seed, number, wanted=wanted)


@cache
def shown(seed: int, number: int, wanted: Kind | Violation | Failure) -> Trial:
    """Prepare a trial for those who only ask of its twin whether the fault took: it ends when it has shown that."""
    return prepare(bench(), seed, number, wanted=wanted, whole=False)


def ran(
    one: Trial, method: Method = REINS, *, change: Change | None = None, limit: int = LIMIT_TICKS + RECOVERY_TICKS
) -> Row:
    """Run a trial and read its row."""
    return row(shipped(), one, method, run(bench(), one, (method,), change=change, limit=limit)[method.name])


@cache
def watched(seed: int, number: int, wanted: Violation | Failure) -> Row:
    """Read the row of a trial under REINS, executed once for all who look at it."""
    return ran(shown(seed, number, wanted))
