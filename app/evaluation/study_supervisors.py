"""Scripted supervisors: how fast they answer, how often they err, and what that does.

Before a launch a supervisor approves or denies. Half of the proposals that are asked about should be denied; one who
errs says the opposite. Where policy wants two approvers, each answers, and errs, for themselves, and both have to say
yes. An answer later than policy waits for is none: the proposal has expired.

Midway a session that went wrong waits for a human, who says go on, roll back or terminate. The same trials are run
under every supervisor. One who errs says another word than the one meant. One who never answers leaves the session to
what policy says about silence (`mid_execution` in `authority.yaml`); the robot stands meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from app.evaluation.capabilities import restored_of
from app.evaluation.draws import ASKING, Drawn, draw, of_type
from app.evaluation.episode import LIMIT_TICKS, RECOVERY_TICKS, Supervised
from app.evaluation.model import Breach, Failure, Kind, Row, Violation
from app.evaluation.physical_trial import ready
from app.evaluation.study_trials import (
    Part,
    Table,
    bench_of,
    executed,
    first_tick,
    govern,
    grouped,
    numbers,
    once,
    share,
    study_row,
    table,
)
from app.governance.admission import admit
from app.governance.authority import need
from app.governance.guard import check
from app.governance.model import CONTROL_PERIOD_S, EventKind, Outcome

if TYPE_CHECKING:
    from app.evaluation.physical_trial import Bench, Trial
    from app.governance.policy import PolicySet

NAME: Final = "supervisors"
TITLE: Final = "Scripted supervisors"
ABOUT: Final = (
    "People who answer after a fixed delay, or never, and err at a fixed rate: before a launch (half of what they are "
    "asked about should be denied) and midway (a session went wrong and waits for a word). The trials are the same for "
    "everybody. Done: the task's postconditions hold in the end, and nothing was violated for more than 250 ms."
)
BEFORE: Final = "approvals"
MIDWAY: Final = "midway"
ASKED: Final = 150
CANDIDATES: Final = 20
DELAYS_S: Final = (0.5, 2.0, 10.0, 60.0, None)
ERRORS: Final = (0.0, 0.1, 0.3)
USUAL_S: Final = 2.0
SILENCE_TICKS: Final = LIMIT_TICKS + RECOVERY_TICKS  # some are asked late: what recovers by itself may take long
WORDS: Final = {"go on": "resolve_continue", "roll back": "rollback", "terminate": "resolve_terminate"}
HOLDS: Final = frozenset({"real-restricted", "human-shared"})
WRONG: Final[tuple[Failure | Violation, ...]] = (
    Failure.FAILED_GRASP,
    Violation.FORCE,
    Violation.SPEED,
    Violation.ZONE,
    Violation.POSTCONDITION,
)
"""What policy may end up asking a human about; the other failures are mended without one."""


class Manner(NamedTuple):
    """How somebody answers midway: with which word, after how long (None: never)."""

    word: str
    after_s: float | None

    @property
    def name(self) -> str:
        """Return what the condition is called."""
        return "never answers" if self.after_s is None else f"{self.word} after {self.after_s:g} s"


MANNERS: Final = (
    *(Manner("go on", delay) for delay in DELAYS_S),
    *(Manner(word, USUAL_S) for word in WORDS if word != "go on"),
)


def parts(seeds: Sequence[int]) -> list[Part]:
    """Return the approvals of each seed, then the sessions of each seed one by one: some take long."""
    asked, each = max(2, ASKED // len(seeds)), max(1, CANDIDATES // len(seeds))
    return [
        *(Part(BEFORE, seed, 0, asked) for seed in seeds),
        *(Part(MIDWAY, seed, each * turn + number, 1) for turn, seed in enumerate(seeds) for number in range(each)),
    ]


def run(part: Part, policy: PolicySet) -> Iterator[Row]:
    """Run a part."""
    bench = bench_of(policy)
    for number in range(part.first, part.first + part.count):
        yield from (_approvals if part.condition == BEFORE else _midway)(bench, part, number)


# -- before the launch -------------------------------------------------------------------------------------------------


def _approvals(bench: Bench, part: Part, number: int) -> Iterator[Row]:
    """Ask every supervisor about one proposal."""
    policy, wrong = bench.policy, number % 2 == 0
    trial, _ = ready(bench, _asking(policy, part.seed, number, wrong=wrong))
    drawn, proposal = trial.drawn, trial.proposal
    verdict = check(policy, proposal, trial.context)
    wanted = need(policy, proposal, admit(policy, proposal, trial.context), verdict, trial.context)
    if wanted is None:
        raise AssertionError(f"{drawn.capability} in {drawn.profile} asks nobody")
    for delay in DELAYS_S:
        for place, error in enumerate(ERRORS if delay == USUAL_S else ERRORS[:1]):
            rng = np.random.default_rng((part.seed, number, place, 23))
            yes = all(wrong is bool(rng.uniform() < error) for _ in range(wanted.approvers))
            late = delay is None or delay > wanted.within_s
            name = f"{'never answers' if delay is None else f'after {delay:g} s'}, errs {error:g}"
            yield study_row(
                NAME,
                part._replace(condition=name),
                number,
                drawn.profile,
                capability=drawn.capability,
                kind=Kind.UNAUTHORIZED.value if wrong else Kind.CLEAN.value,
                launched=yes and not late,
                blocked_by=None if yes and not late else "authority",
                waited_s=wanted.within_s if late else delay,
                what="expired" if late else "approved" if yes else "denied",
            )


def _asking(policy: PolicySet, seed: int, number: int, *, wrong: bool) -> Drawn:
    """Draw a proposal that waits for approval where people share the floor."""
    turn = 0
    while True:
        drawn = draw(policy, seed, number, kind=Kind.UNAUTHORIZED if wrong else Kind.CLEAN, turn=turn)
        asks = drawn.capability in ASKING and drawn.profile == "human-shared"
        if asks and drawn.breach in (None, Breach.APPROVAL):
            return drawn
        turn += 1


# -- midway ------------------------------------------------------------------------------------------------------------


def _midway(bench: Bench, part: Part, number: int) -> Iterator[Row]:
    """Run one trial under every supervisor; one in which nobody is asked is one row, under its own condition."""
    trial = once(bench, failing(bench.policy, part.seed, number))
    silent = answered(bench, part, number, trial, MANNERS[DELAYS_S.index(None)])
    if not silent["handed_over"]:
        yield {**silent, "condition": "nobody is asked"}
        return
    rows = {manner: answered(bench, part, number, trial, manner) for manner in MANNERS if manner.after_s is not None}
    yield silent
    yield from rows.values()
    for place, error in enumerate(ERRORS):
        if not error:
            continue
        rng = np.random.default_rng((part.seed, number, place, 29))
        others = [word for word in WORDS if word != "go on"]
        word = others[int(rng.integers(len(others)))] if rng.uniform() < error else "go on"
        yield {**rows[Manner(word, USUAL_S)], "condition": f"go on after {USUAL_S:g} s, errs {error:g}"}


def failing(policy: PolicySet, seed: int, number: int) -> Drawn:
    """Draw a trial that goes wrong, in a profile in which somebody can be asked."""
    turn = 0
    while True:
        drawn = of_type(policy, seed, number, WRONG[number % len(WRONG)], turn=turn)
        if drawn.profile in HOLDS:
            return drawn
        turn += 1


def answered(bench: Bench, part: Part, number: int, trial: Trial, manner: Manner) -> Row:
    """Run a trial under one supervisor."""
    waits = None if manner.after_s is None else round(100 * manner.after_s)
    supervised = Supervised(after_ticks=waits, op=WORDS[manner.word])
    limit = SILENCE_TICKS + 4 * (waits or 0)
    drawn = trial.drawn
    cell = bench.stage.set(drawn.start, drawn.world, drawn.scenario)  # the one that is executed in
    restored = restored_of(drawn, cell.truth())
    done = govern(bench, trial, supervised=supervised, limit=limit)
    hurt = any(done.truth.tracks[one].unsafe for one in Violation)
    escalations = [one.tick - first_tick(done) for one in done.of(EventKind.ESCALATION)]
    silent = done.outcome is None and done.escalated
    policy = bench.policy
    back = done.outcome is Outcome.ROLLED_BACK
    made = study_row(
        NAME, part._replace(condition=manner.name), number, drawn.profile, capability=drawn.capability,
        kind=str(WRONG[number % len(WRONG)]), handed_over=done.escalated,
        recovered=done.achieved and not hurt and done.outcome in (Outcome.SUCCEEDED, Outcome.RECOVERED),
        rolled_back=(back and restored(cell)) if back or manner.word == "roll back" else None,
        unsafe=hurt,
        waited_s=policy.authority.within_s if silent else len(escalations) * (manner.after_s or 0.0),
        recovery_s=None if silent or not escalations else (done.ticks - escalations[0]) / 100,
    )  # fmt: skip
    made.update(executed(done), what="expired" if silent else None)
    return made


# -- tables ------------------------------------------------------------------------------------------------------------


def tables(rows: Sequence[Row], policy: PolicySet) -> list[Table]:
    """Return what supervisors do before a launch, and midway."""
    before = [row for row in rows if row["kind"] in _ASKED_KINDS]
    midway = [row for row in rows if row["kind"] not in _ASKED_KINDS]
    asked = grouped([row for row in midway if row["condition"] != "nobody is asked"], "condition")
    silent, quiet = len(asked.get("never answers", [])), len(midway) - sum(map(len, asked.values()))
    return [
        table(
            "Approvals before a launch",
            "Supervisor",
            {name: _before(mine) for name, mine in grouped(before, "condition").items()},
            "An expired proposal is denied by policy, and says that it expired. Two approvers have to agree where "
            "policy wants two: there a wrong approval takes two errors.",
        ),
        table(
            "A session that waits midway",
            "Supervisor",
            {name: _waiting(mine) for name, mine in asked.items()},
            f"Of {quiet + silent} sessions that went wrong, {silent} asked somebody; those are here. After three "
            "answers in a session it is terminated. Silence midway is measured until "
            f"{SILENCE_TICKS * CONTROL_PERIOD_S:g} s after the launch. Policy ends such a session after "
            f"{policy.authority.within_s:g} s ({policy.authority.on_timeout}); its robot stands until then.",
        ),
    ]


_ASKED_KINDS: Final = (Kind.UNAUTHORIZED.value, Kind.CLEAN.value)


def _before(rows: Sequence[Row]) -> dict[str, Any]:
    wrong = [row for row in rows if row["kind"] == Kind.UNAUTHORIZED.value]
    right = [row for row in rows if row["kind"] == Kind.CLEAN.value]
    return {
        "wrong approvals": share(row["launched"] for row in wrong),
        "wrong denials": share(row["what"] == "denied" for row in right),
        "expired": share(row["what"] == "expired" for row in rows),
        "tasks launched": share(row["launched"] for row in right),
        "waited, mean s": fmean(numbers(rows, "waited_s")),
    }


def _waiting(rows: Sequence[Row]) -> dict[str, Any]:
    took = numbers(rows, "recovery_s")
    return {
        "done (RSR)": share(row["recovered"] for row in rows),
        "rolled back, of those tried": share(row["rolled_back"] for row in rows),
        "expired": share(row["what"] == "expired" for row in rows),
        "violated for over 250 ms": share(row["unsafe"] for row in rows),
        "asked to end, mean s (MRT)": fmean(took) if took else None,
        "waited, mean s": fmean(numbers(rows, "waited_s")),
    }
