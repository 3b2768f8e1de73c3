from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance.bundle_checks_dead import dead_steps
from app.governance.bundle_shapes import RecoveryShape
from app.governance.bundle_yaml import Reader, parse
from app.governance.model import CoveredRecovery, Mode, RecoveryPlan, RecoveryRule, Risk, Strategy
from app.governance.recovery import Budgets, RecoveryDecision, lead_back, recover, retracing, roll_back

S = Strategy
COVERED = (
    CoveredRecovery(strategy=S.RETRY, capability="grasp_object", params={}),
    CoveredRecovery(strategy=S.SAFER_MODE, capability="grasp_object", params={}, mode=Mode.CAREFUL),
    CoveredRecovery(strategy=S.RECOVERY_CAPABILITY, capability="release_and_retract", params={}),
    CoveredRecovery(strategy=S.ROLLBACK, capability="retrace", params={}),
)
PLAN = RecoveryPlan(
    risk=Risk.MEDIUM,
    can_ask=True,
    rules=(
        RecoveryRule(on="slip", do=(S.RECOVERY_CAPABILITY, S.RETRY, S.ASK_HUMAN), capability="release_and_retract"),
        RecoveryRule(on="miss", do=(S.RETRY, S.ROLLBACK, S.ASK_HUMAN), budget={S.RETRY: 2}),
        RecoveryRule(on="speed", do=(S.SAFER_MODE, S.TERMINATE)),
        RecoveryRule(on="blocked", do=(S.RECOVERY_CAPABILITY, S.RETRY), capability="reposition_base"),
        RecoveryRule(on="risky", do=(S.TERMINATE,), risks=frozenset({Risk.HIGH})),
        RecoveryRule(on="any", do=(S.ASK_HUMAN,)),
    ),
    retry_budget=3,
    rollback="optional",
    rollback_capability="retrace",
    careful_admitted=True,
)


def ask(failure: str, used: Budgets | None = None, plan: RecoveryPlan = PLAN, **changes: object) -> RecoveryDecision:
    given_: dict[str, object] = {"covered": COVERED, "after": None}
    return recover(failure, plan, used or Budgets(), **(given_ | changes))  # type: ignore[arg-type]


def test_the_first_step_of_the_matching_row_is_taken_with_the_parameters_it_is_covered_with() -> None:
    decision = ask("slip")
    assert decision.strategy is S.RECOVERY_CAPABILITY
    assert decision.covered is COVERED[2]
    assert decision.reason == "table"


def test_after_a_recovery_capability_the_row_is_read_on() -> None:
    first = ask("slip")
    second = ask("slip", first.used, after=first)
    assert second.strategy is S.RETRY
    assert second.used.retries == 1


def test_steps_are_used_up_one_after_the_other_and_budgets_are_never_given_back() -> None:
    used, taken = Budgets(), []
    for _ in range(4):
        decision = ask("miss", used)
        used = decision.used
        taken.append(decision.strategy)
    assert taken == [S.RETRY, S.RETRY, S.ROLLBACK, S.ASK_HUMAN]


def test_a_recovery_that_fails_differently_meets_the_same_retry_budget() -> None:
    plan = replace(PLAN, retry_budget=1)
    first = ask("miss", plan=plan)
    assert first.strategy is S.RETRY
    assert ask("speed", first.used, plan).strategy is S.TERMINATE
    assert ask("slip", ask("slip", first.used, plan).used, plan).strategy is S.ASK_HUMAN


def test_an_unknown_failure_is_any_failure_and_without_such_a_row_a_human_is_asked() -> None:
    assert ask("unheard_of").strategy is S.ASK_HUMAN
    nothing = ask("unheard_of", plan=replace(PLAN, rules=()))
    assert (nothing.strategy, nothing.reason) == (S.ASK_HUMAN, "no_row")


@pytest.mark.parametrize(("risk", "strategy"), [(Risk.HIGH, S.TERMINATE), (Risk.LOW, S.ASK_HUMAN)])
def test_a_row_holds_for_its_risks(risk: Risk, strategy: Strategy) -> None:
    assert ask("risky", plan=replace(PLAN, risk=risk)).strategy is strategy


def test_a_step_that_is_not_covered_asks_a_human_instead_of_trying_something_lesser() -> None:
    decision = ask("blocked")
    assert (decision.strategy, decision.reason) == (S.ASK_HUMAN, "not_covered")
    assert ask("slip", covered=()).reason == "not_covered"


def test_a_row_that_ends_asks_a_human() -> None:
    plan = replace(PLAN, rules=(RecoveryRule(on="miss", do=(S.RETRY,)),))
    first = ask("miss", plan=plan)
    assert (ask("miss", first.used, plan).strategy, ask("miss", first.used, plan).reason) == (
        S.ASK_HUMAN,
        "row_exhausted",
    )


def test_careful_mode_is_skipped_where_the_profile_does_not_admit_it() -> None:
    assert ask("speed").strategy is S.SAFER_MODE
    assert ask("speed", plan=replace(PLAN, careful_admitted=False)).strategy is S.TERMINATE


def test_rollback_is_skipped_where_nothing_can_roll_back() -> None:
    used = Budgets(((1, S.RETRY), (1, S.RETRY)), 2)
    assert ask("miss", used).strategy is S.ROLLBACK
    assert ask("miss", used, replace(PLAN, rollback_capability=None)).strategy is S.ASK_HUMAN


@pytest.mark.parametrize("rollback", ["required", "always"])
def test_before_the_end_comes_the_rollback_the_profile_requires_and_only_once(rollback: str) -> None:
    plan = replace(PLAN, rollback=rollback, careful_admitted=False)
    first = ask("speed", plan=plan)
    assert (first.strategy, first.reason) == (S.ROLLBACK, "rollback_required")
    assert ask("speed", first.used, plan).strategy is S.TERMINATE


def test_a_required_rollback_that_is_not_covered_asks_a_human() -> None:
    plan = replace(PLAN, rollback="required", careful_admitted=False)
    assert ask("speed", plan=plan, covered=()).strategy is S.ASK_HUMAN
    assert ask("speed", plan=replace(plan, can_ask=False), covered=()).strategy is S.TERMINATE
    assert ask("speed", plan=replace(plan, rollback_capability=None)).strategy is S.TERMINATE


def test_where_nobody_can_be_asked_asking_is_the_end() -> None:
    decision = ask("unheard_of", plan=replace(PLAN, can_ask=False))
    assert (decision.strategy, decision.reason) == (S.TERMINATE, "nobody_to_ask")


def test_a_rollback_that_is_asked_for_outright_is_taken_once_and_only_if_covered() -> None:
    decision = roll_back("operator", PLAN, Budgets(), COVERED)
    assert decision is not None
    assert (decision.strategy, decision.covered) == (S.ROLLBACK, COVERED[3])
    assert roll_back("operator", PLAN, decision.used, COVERED) is None
    assert roll_back("operator", PLAN, Budgets(), ()) is None
    assert roll_back("operator", replace(PLAN, rollback_capability=None), Budgets(), COVERED) is None


rows = st.lists(
    st.builds(
        RecoveryRule,
        on=st.sampled_from(["slip", "miss", "any"]),
        do=st.lists(st.sampled_from(list(S)), min_size=1, max_size=5).map(tuple),
        capability=st.sampled_from(["release_and_retract", "other"]),
        budget=st.dictionaries(st.sampled_from(list(S)), st.integers(0, 3)),
    ),
    max_size=4,
)


@given(
    rows=rows,
    retries=st.integers(0, 3),
    rollback=st.sampled_from(["required", "optional", "always"]),
    failures=st.lists(st.sampled_from(["slip", "miss", "odd"]), min_size=60, max_size=60),
    can_ask=st.booleans(),
)
def test_whatever_fails_again_and_again_motion_ends_after_a_bounded_number_of_recoveries(
    rows: list[RecoveryRule], retries: int, rollback: str, failures: list[str], can_ask: bool
) -> None:
    plan = replace(PLAN, rules=tuple(rows), retry_budget=retries, rollback=rollback, can_ask=can_ask)
    used, moved = Budgets(), 0
    for failure in failures:
        decision = ask(failure, used, plan)
        assert decision.strategy is not S.ASK_HUMAN or can_ask
        if decision.strategy in (S.TERMINATE, S.ASK_HUMAN):
            continue
        moved += 1
        assert decision.covered is not None
        assert decision.used != used
        used = decision.used
    capability_budget = sum(row.budget.get(S.RECOVERY_CAPABILITY, 1) for row in rows)
    assert used.retries <= retries
    assert moved <= retries + 1 + capability_budget


def test_no_new_attempt_is_made_on_top_of_a_recovery_that_failed() -> None:
    used = ask("slip").used  # its one release and retract
    assert ask("slip", used, recovering=True).strategy is S.ASK_HUMAN
    assert ask("slip", used).strategy is S.RETRY
    assert ask("miss", recovering=True).strategy is S.ROLLBACK


def test_a_rollback_that_was_given_up_may_be_had_again_and_all_else_stays_used() -> None:
    used = Budgets(((1, S.RETRY),), 1)
    undoing = roll_back("operator", PLAN, used, COVERED)
    assert undoing is not None
    assert roll_back("operator", PLAN, undoing.used, COVERED) is None
    assert undoing.used.giving_up() == used
    assert roll_back("operator", PLAN, undoing.used.giving_up(), COVERED) == undoing


def test_a_rollback_that_ended_elsewhere_is_led_back_once_if_that_is_covered() -> None:
    retreat = replace(PLAN, rollback_capability="safe_retreat")
    decision = lead_back("contact", retreat, Budgets(retries=1, rolled_back=True), COVERED)
    assert decision is not None
    assert (decision.strategy, decision.reason, decision.covered) == (S.ROLLBACK, "elsewhere", COVERED[3])
    assert decision.used == Budgets(retries=1, rolled_back=True, led_back=True)
    assert decision.used.taking(0, S.RETRY).led_back
    assert lead_back("contact", retreat, decision.used, COVERED) is None
    assert lead_back("contact", retreat, Budgets(), COVERED[:3]) is None
    assert lead_back("contact", PLAN, Budgets(), COVERED) is None  # that was the way back already


def test_what_a_human_has_driven_is_undone_along_the_recorded_path_if_that_is_covered() -> None:
    released = replace(PLAN, rollback_capability="release_and_retract")
    assert retracing(released, COVERED) == PLAN
    assert retracing(released, COVERED[:3]) == released
    assert retracing(replace(PLAN, rollback_capability=None), COVERED[:3]).rollback_capability is None


# What a check of policy calls dead is never chosen, and all else is by some way of things -----------------------------


def chosen(row: RecoveryRule, rollback: str | None) -> set[int]:
    """Return every step of a row that some way of things leads to, beside rows that recover and use up attempts."""
    rules = (
        replace(row, on="a", capability=CLEARS),
        RecoveryRule(on="b", do=(S.RECOVERY_CAPABILITY,), capability=CLEARS),
        RecoveryRule(on="c", do=(S.RETRY, S.SAFER_MODE)),
    )
    plan = replace(PLAN, rules=rules, retry_budget=2, rollback_capability=rollback)
    found: set[int] = set()
    seen: set[object] = set()
    open_: list[tuple[Budgets, RecoveryDecision | None]] = [(Budgets(), None)]
    while open_:
        used, under_way = open_.pop()
        failing = under_way is not None
        answers = [recover(name, plan, used, covered=COVERED, recovering=failing) for name in "abc"]
        if under_way is not None:  # it may succeed as well
            answers.append(recover(under_way.failure, plan, used, covered=COVERED, after=under_way))
        for answer in answers:
            if answer.row == 0:
                found.add(answer.step)
            if answer.covered is None or answer.strategy is S.ROLLBACK:  # nothing is read from these rows behind it
                continue
            left = answer.used._replace(steps=tuple(sorted(answer.used.steps)))
            place = (answer.row, answer.step) if answer.strategy is S.RECOVERY_CAPABILITY else None
            if (left, place) not in seen:
                seen.add((left, place))
                open_.append((left, answer if place else None))
    return found


CLEARS = "release_and_retract"
ROWS = [steps for length in (1, 2, 3) for steps in product(S, repeat=length)]


@pytest.mark.parametrize("budget", [{}, {S.RECOVERY_CAPABILITY: 2}], ids=["one each", "two recoveries"])
def test_a_step_is_called_dead_where_nothing_leads_to_it_and_nowhere_else(budget: dict[Strategy, int]) -> None:
    document, _ = parse("x.yaml", "x: 1")
    wrong = []
    for steps in ROWS:
        kept = {step: count for step, count in budget.items() if step in steps}
        shape = RecoveryShape.model_validate(
            {"on": "any", "do": [step.lower() for step in steps], "budget": {s.lower(): n for s, n in kept.items()}}
        )
        told = {int(problem.key[-2]) for problem in dead_steps(Reader(document=document), 0, shape)}
        behind = set(range(min(told), len(steps))) if told and steps[min(told) - 1] in ENDS else told
        row = RecoveryRule(on="a", do=steps, budget=kept)
        if set(range(len(steps))) - chosen(row, "retrace") - chosen(row, None) != behind:
            wrong.append((steps, told))
    assert not wrong


ENDS = (S.ASK_HUMAN, S.TERMINATE)
