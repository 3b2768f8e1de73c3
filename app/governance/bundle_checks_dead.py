"""Rows and steps of a recovery table that could never be taken, read as `recover` reads the table.

The first row holds that matches the failure, the capability and its risk, whether its steps are used up or not. So a
row is dead where those before it match all that it matches. A step is dead behind one that always ends the row, and
where it stands in the row before: they share one budget.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Final, TypeAlias

from app.governance.model import Risk
from app.governance.policy_model import FAILURES
from app.governance.recovery import DEFAULT_BUDGET

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from app.governance import bundle_shapes as shapes
    from app.governance.bundle_checks import Known
    from app.governance.bundle_yaml import Reader
    from app.governance.errors import PolicyError

Case: TypeAlias = tuple[str, str, str]
"""What a row is chosen for: a failure, a capability, its risk."""

OTHER: Final = ""  # a failure or a capability that no row names
RISKS: Final = tuple(risk.value for risk in Risk)
FINAL: Final = ("ask_human", "terminate")
AGAIN: Final = "recovery_capability"  # what a row is read on from once it has succeeded


def dead_rows(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    """Yield a problem for every row that none is left for."""
    covered = [_cases(row, shape, known) for row in shape.recovery]
    taken: dict[Case, int] = {}
    for index, cases in enumerate(covered):
        path = ("recovery", index)
        if not cases:
            message = "a dead row: no capability that it applies to is of such a risk"
            yield reader.problem((*path, "risks"), message, _risks(shape.recovery[index], known))
        elif cases <= taken.keys():
            before = _before(cases, covered[:index], taken)
            lines = " and ".join(f"`recovery[{at}]` (line {reader.document.line(('recovery', at))})" for at in before)
            covers = "covers" if len(before) == 1 else "cover"
            message = f"a dead row: the first row that matches holds, and {lines} {covers} all of it"
            movable = not any(covered[at] <= cases for at in before)
            valid = [f"above recovery[{before[0]}]"] if movable else []
            yield reader.problem(path, message, [*valid, "left out"])
        for case in cases:
            taken.setdefault(case, index)


def _before(cases: set[Case], covered: Sequence[set[Case]], taken: Mapping[Case, int]) -> list[int]:
    """Return the row that matches all of what a later one does, else those that do so together."""
    alone = [index for index, wider in enumerate(covered) if cases <= wider]
    return alone[:1] or sorted({taken[case] for case in cases})


def _cases(row: shapes.RecoveryShape, shape: shapes.ProfileShape, known: Known) -> set[Case]:
    """Return all that a row matches; what nothing is known of may be of any risk."""
    named = {name for one in shape.recovery for name in one.applies_to or ()}
    failures = {*FAILURES, *(one.on for one in shape.recovery), OTHER} if row.on == "any" else {row.on}
    capabilities = {*named, OTHER} if row.applies_to is None else set(row.applies_to)
    return {
        (failure, name, risk)
        for name in capabilities
        for failure, risk in product(failures, row.risks or RISKS)
        if name not in known.capabilities or known.capabilities[name].risk == risk
    }


def _risks(row: shapes.RecoveryShape, known: Known) -> list[str]:
    return sorted({known.capabilities[name].risk.value for name in row.applies_to or ()})


def dead_steps(reader: Reader, index: int, row: shapes.RecoveryShape) -> Iterator[PolicyError]:
    """Yield a problem for every step that could never be taken; behind a final one, for the first."""
    for at, step in enumerate(row.do):
        path, before = ("recovery", index, "do", at), row.do[:at]
        if before and before[-1] in FINAL:
            message = f"a dead step: `{before[-1]}` is always the last of its row, and `{step}` stands behind it"
            yield reader.problem(path, message, [f"do: [{', '.join(before)}]"])
            return
        if step in before and not _comes_again(step, before, row):
            message = f"a dead step: `{step}` stands in this row before, and its budget is counted for both"
            again = [f"budget: {{{step}: {row.do.count(step)}}}"] if step == AGAIN else []
            yield reader.problem(path, message, [f"{step} once", *again])


def _comes_again(step: str, before: Sequence[str], row: shapes.RecoveryShape) -> bool:
    """Say whether a step that stands in a row before may be taken in this place as well.

    A row is read on behind a recovery that has succeeded: so another one may follow it while the budget lasts, and a
    new attempt that was passed over, because a recovery had failed just then, may be made behind it.
    """
    if step == AGAIN:
        budget = {str(name): count for name, count in row.budget.items()}
        return budget.get(step, DEFAULT_BUDGET) > before.count(step)
    passed = len(before) - before[::-1].index(step)
    return step != "rollback" and AGAIN in before[passed:]
