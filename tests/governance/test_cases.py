from __future__ import annotations

import re

import pytest

from app.governance import bundle, cases
from app.governance.errors import PolicyErrors
from tests.governance.policy_world import POLICIES, files, shipped

CASE = (
    "cases:\n  - {name: drives, profile: %s, capability: navigate_to, params: {target: dock}, expect: {status: %s}}\n"
)


def test_every_shipped_case_holds():
    results = cases.run(shipped(), bundle.read_cases(POLICIES))
    assert [(result.file, result.line, result.differences) for result in results if not result.passed] == []


def test_every_policy_file_has_cases():
    tested = {name.rpartition("/")[2] for name in bundle.read_cases(POLICIES)}
    assert {name.rpartition("/")[2] for name in files()} == tested


def test_a_case_that_does_not_hold_says_what_was_found():
    (result,) = cases.run(shipped(), {"tests/x.yaml": CASE % ("sim-relaxed", "denied")})
    assert (result.line, result.differences) == (2, ("status: expected `denied`, found `allowed`",))


def test_a_case_in_an_unknown_profile_is_an_error():
    with pytest.raises(PolicyErrors, match="no profile `moon`"):
        cases.run(shipped(), {"tests/x.yaml": CASE % ("moon", "denied")})


def test_every_problem_of_the_case_files_is_reported_with_its_line():
    case = CASE % ("sim-relaxed", "allowed")
    with pytest.raises(PolicyErrors) as caught:
        cases.run(
            shipped(),
            {
                "tests/a.yaml": case.replace("expect:", "context: {stand: mars}, expect:"),
                "tests/b.yaml": case.replace("params:", "param:"),
                "tests/c.yaml": "cases: [",
                "tests/d.yaml": "cases: []",
            },
        )
    told = {problem.file: str(problem) for problem in caught.value.problems}
    assert "a.yaml:2" in told["tests/a.yaml"]
    assert "no target `mars`" in told["tests/a.yaml"]
    assert "unknown key `param`" in told["tests/b.yaml"]
    assert set(told) == {"tests/a.yaml", "tests/b.yaml", "tests/c.yaml", "tests/d.yaml"}


STRANGE = [
    ("capability: grasp_object\n    params: {object_id: mug_9}", "allowed", 4,
     "cases[0].params.object_id: there is no object `mug_9`; valid: `mug_1`, "),
    ("capability: grasp_object\n    params: {object_id: mug_9}", "rejected, codes: [not_held]", 4, "no object `mug_9`"),
    ("capability: navigate_to\n    params: {target: dock, corridor: moon}", "denied", 4,
     "cases[0].params.corridor: there is no corridor `moon`; valid: `aisle`"),
    ("capability: grasp_objekt", "awaiting_approval", 3,
     "cases[0].capability: there is no capability `grasp_objekt`; valid: `grasp_object`, "),
    ("capability: navigate_to\n    params: {target: dock}\n    context: {holding: mug_9}", "allowed", 5,
     "cases[0].context.holding: there is no object `mug_9`; valid: `mug_1`, "),
    ("capability: navigate_to\n    params: {target: moon}\n    context: {unseen: [mug_1, mug_9]}", "invalid", 5,
     "cases[0].context.unseen[1]: there is no object `mug_9`; valid: `mug_1`, "),
    ("capability: navigate_to\n    params: {target: moon}\n    context: {unreachable: [mug_9]}", "rejected", 5,
     "cases[0].context.unreachable[0]: there is no object `mug_9`; valid: `mug_1`, "),
    ("capability: navigate_to\n    params: {target: dock}\n    context:\n      at:\n        mug_9: [1, 2]", "denied", 7,
     "cases[0].context.at.mug_9: there is no object `mug_9`; valid: `mug_1`, "),
    ("capability: navigate_to\n    params: {target: dock}\n    context: {stand: benk_b_stand}", "allowed", 5,
     "cases[0].context.stand: there is no target `benk_b_stand`; valid: `bench_b_stand`, "),
]  # fmt: skip


@pytest.mark.parametrize(("case", "status", "line", "said"), STRANGE)
def test_a_case_that_names_what_does_not_exist_is_an_error(case, status, line, said):
    text = f"profile: sim-relaxed\ncases:\n  - {case}\n    name: x\n    expect: {{status: {status}}}\n"
    with pytest.raises(PolicyErrors) as caught:
        cases.read(shipped(), {"tests/x.yaml": text})
    (problem,) = caught.value.problems
    assert problem.line == line
    assert said in str(problem)


@pytest.mark.parametrize("expect", ["invalid", "rejected", "rejected, codes: [unknown_object]"])
def test_a_case_may_propose_what_does_not_exist_where_it_expects_to_be_told_so(expect):
    text = (CASE % ("sim-relaxed", expect)).replace("dock", "moon")
    assert [found.profile for found in cases.read(shipped(), {"tests/x.yaml": text})] == ["sim-relaxed"]
    assert cases.read(shipped(), {"tests/x.yaml": text.replace("navigate_to", "fly")})


def test_a_case_with_parameters_that_do_not_fit_is_invalid():
    text = (CASE % ("sim-relaxed", "invalid")).replace("target: dock", "target: 3")
    assert [result.passed for result in cases.run(shipped(), {"tests/x.yaml": text})] == [True]


def test_a_case_says_who_is_permitted_what_and_what_is_seen():
    text = """
cases:
  - name: hazmat may
    profile: sim-relaxed
    capability: grasp_object
    params: {object_id: solvent_1}
    context: {permissions: [manipulation, hazmat]}
    expect: {status: allowed}
  - name: where it is seen counts
    profile: sim-relaxed
    capability: grasp_object
    params: {object_id: mug_1}
    context: {at: {mug_1: [5.0, 1.0]}, people_count: 2, people_nearest_m: 0.5, arm_retracted: false}
    expect: {status: denied, codes: [forbidden_zone]}
  - name: what the fingers feel counts
    profile: sim-relaxed
    capability: grasp_object
    params: {object_id: mug_1}
    context: {gripper_empty: false}
    expect: {status: deferred}
"""
    assert [result.differences for result in cases.run(shipped(), {"tests/x.yaml": text})] == [(), (), ()]


def told(case: str, expect: str) -> tuple[str, ...]:
    (result,) = cases.run(shipped(), {"tests/x.yaml": f"cases:\n  - {{name: x, {case}, expect: {expect}}}\n"})
    return result.differences


GRASP = "profile: human-shared, capability: grasp_object, params: {object_id: glass_1}"


def test_a_case_can_say_which_rules_and_no_others_determined_it():
    assert told(GRASP, "{status: awaiting_approval, rules: [organization/fragile-grip]}") == ()
    assert told(GRASP, "{status: awaiting_approval, determined_by: [organization/fragile-grip]}") != ()


def test_a_case_can_say_what_holds_a_session():
    assert (
        told(GRASP, "{status: awaiting_approval, session: {timeout_s: 20, watch: {zone: {below: 0}, ghost: null}}}")
        == ()
    )
    assert told(GRASP, "{status: awaiting_approval, session: {watch: {zone: {below: 0.1, enter: stop}}}}") == (
        "session.watch.zone.below: expected `0.1`, found `0.0`",
    )


@pytest.mark.parametrize(
    ("expect", "says"),
    [
        ("rules: [a, b]", r"rules: expected `\[a, b\]`, found `\[.+\]`"),
        ("changes: {force_n: 30, speed_mps: 0.15}", r"changes\.force_n: expected `30(\.0)?`, found `20(\.0)?`"),
        ("changes: {force_n: 20}", r"changes\.speed_mps: expected `nothing`, found `0\.15`"),
        ("changes: {force_n: 20, speed_mps: 0.15, dwell_s: null}", r"changes: expected `{force_n: .+}`, found `{.+}`"),
        ("changes: {object_id: true, force_n: 20, speed_mps: 0.15}", r"changes\.object_id: expected `true`, found .+"),
    ],
)
def test_a_case_says_value_by_value_wherein_it_differs_as_a_case_file_writes_them(expect: str, says: str):
    (difference,) = told(
        GRASP.replace("}", ", force_n: 40, speed_mps: 0.3}"), f"{{status: awaiting_approval, {expect}}}"
    )
    assert re.fullmatch(says, difference)


def test_nothing_holds_a_session_of_what_does_not_exist():
    assert told("profile: human-shared, capability: fly", "{status: rejected, session: {}}") == ()


def test_a_case_may_be_about_governance_and_about_other_permissions():
    regrasp = "profile: human-shared, capability: regrasp, params: {object_id: mug_1}, context: {agent: governance"
    assert told(f"{regrasp}}}", "{status: allowed}") == ()
    assert told(f"{regrasp}, permissions: [manipulation]}}", "{status: rejected, codes: [recovery_only]}") == ()
