"""Cases that are found for a profile: true of it, each about something, and failing where the profile is changed."""

from __future__ import annotations

from functools import cache

from app.authoring.holding import Held, hold, searched
from app.authoring.mutants import mutants
from app.authoring.mutation import Fate, fates
from app.authoring.rule_coverage import rule_coverage
from app.authoring.workbench import Workbench
from app.governance import cases
from app.governance.bundle_shapes import CaseShape
from app.governance.policy import PolicySet
from tests.authoring.test_templates import made

NAME = "personal-care"
FILE = f"tests/{NAME}.yaml"


@cache
def held() -> tuple[PolicySet, Held]:
    policy, _ = made(NAME)
    return policy, hold(policy.files, NAME)


def by_name() -> dict[str, CaseShape]:
    policy, found = held()
    return {one.case.name: one.case for one in cases.read(policy, {FILE: found.text})}


def test_every_case_holds_and_every_bound_and_rule_of_the_profile_decides_one():
    policy, found = held()
    results = cases.run(policy, {FILE: found.text})
    assert [one.name for one in results if not one.passed] == []
    assert len(results) == found.count == len(by_name())
    never = rule_coverage(policy, {FILE: found.text}).never
    assert [rule for rule in never if rule.startswith(f"{NAME}/")] == []


def test_a_bound_has_a_case_just_beyond_it_and_one_right_on_it():
    beyond = by_name()["tcp_speed_mps changes speed_mps of grasp_object beyond 0.2"]
    on = by_name()["tcp_speed_mps leaves speed_mps of grasp_object at 0.2"]
    assert (beyond.params["speed_mps"], beyond.expect.changes) == (0.201, {"speed_mps": 0.2})
    assert beyond.expect.determined_by == [f"{NAME}/tcp_speed_mps"]
    assert (on.params["speed_mps"], on.expect.changes, on.expect.policy) == (0.2, {}, "allow")


def test_what_asks_what_sets_a_name_and_what_no_agent_may_have_cases_too():
    asked = by_name()[f"{NAME}-confidence decides grasp_object"].expect
    assert (asked.status, asked.policy) == ("awaiting_approval", "escalate")
    assert f"{NAME}/{NAME}-confidence" in (asked.determined_by or [])
    corridor = by_name()["corridor sets corridor of navigate_to"].expect.changes or {}
    assert corridor["corridor"] == "aisle"
    assert by_name()["what holds transport_object"].expect.approvers == 1


def test_no_change_of_the_profile_goes_unnoticed():
    policy, found = held()
    bench = Workbench(policy.files)
    listed = mutants(bench.documents, bench.known)
    mine = [number for number, one in enumerate(listed) if NAME in (one.file[9:-5], one.path[-1])]
    outcomes = fates(policy.files, {FILE: found.text}, mine, processes=1)
    assert [str(one.mutant) for one in outcomes if one.fate is Fate.SURVIVED] == []
    assert found.missed == ()
    assert sum(one.fate is Fate.KILLED for one in outcomes) == found.noticed > 400


def test_what_is_forbidden_under_a_profile_is_refused_in_a_case():
    files = dict(held()[0].files)
    file = "capabilities/operate_tool.yaml"
    assert f"{NAME}: approval-required" in files[file]
    files[file] = files[file].replace(f"{NAME}: approval-required", f"{NAME}: forbidden")
    found = {case["name"]: case for case in searched(Workbench(files), NAME)}
    assert found["refuses operate_tool"]["expect"]["status"] == "rejected"
    assert "what holds operate_tool" not in found
