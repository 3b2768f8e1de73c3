"""What `properties.yaml` says is read and type-checked against the policy it is about."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.governance.bundle import read_properties
from app.governance.errors import PolicyErrors
from app.governance.stated import Stated, read
from tests.governance.policy_world import POLICIES, PROFILES, shipped

BROKEN = [
    ("order: [human-shared, moon]\n", 1, "order[1]: there is no profile `moon`; valid: `human-shared`"),
    ("order: [human-shared, human-shared]\n", 1, "order[1]: `human-shared` stands twice; valid: `each once`"),
    ("order: []\nproperties: [{id: a, says: So.}]\n", 2, "`a` promises nothing; valid: `always`, `approvers`, `never`"),
    ("properties: [{id: a, says: So., never: [allowed], applies_to: [dance]}]\n", 1, "there is no capability `dance`"),
    ("properties: [{id: a, says: So., never: [allowed], profiles: [moon]}]\n", 1, "there is no profile `moon`"),
    ("properties: [{id: a, says: So., never: [allowed], when: target.weight > 1.0}]\n", 1, "no field `weight`"),
    ("properties: [{id: a, says: So., never: [allowed], when: place.name == 'dok'}]\n", 1,
     "properties[0].when: column 12: `dok` is compared with what is never that (for `grasp_object`); valid: `dock`, "),
    ("properties: [{id: a, says: So., always: params.force_n <= 1.0, applies_to: [navigate_to]}]\n", 1,
     "properties[0].always: column 8: "),
    ("properties:\n  - {id: a, says: So., nevr: [allowed]}\n", 2, "unknown key `nevr`"),
    ("properties: [{id: a, says: So., never: [allowed]}, {id: a, says: So., never: [allowed]}]\n", 1,
     "properties[1]: `a` stands twice"),
    ("properties: [\n", 2, "not readable as YAML"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "said"), BROKEN)
def test_says_what_is_wrong_with_a_promise(text: str, line: int, said: str) -> None:
    with pytest.raises(PolicyErrors) as caught:
        read(shipped(), text)
    told = [problem for problem in caught.value.problems if said in str(problem)]
    assert [(problem.file, problem.line) for problem in told] == [("properties.yaml", line)], str(caught.value)


def test_says_that_no_enabled_pair_is_left_to_a_promise() -> None:
    policy = shipped()
    gone = {pair: gate for pair, gate in policy.gates.items() if pair != ("grasp_object", "human-shared")}
    text = "properties: [{id: a, says: So., never: [allowed], applies_to: [grasp_object], profiles: [human-shared]}]\n"
    assert read(policy, text).properties[0].pairs == {("grasp_object", "human-shared")}
    with pytest.raises(
        PolicyErrors,
        match="`a` is about no enabled pair of capability and profile; valid: `grasp_object in real-restricted`",
    ):
        read(replace(policy, gates=gone), text)


def test_without_a_file_nothing_is_promised() -> None:
    assert read(shipped(), None) == Stated()


def test_reads_the_shipped_promises() -> None:
    found = read(shipped(), read_properties(POLICIES))
    assert found.order == tuple(reversed(PROFILES))
    assert all(promised.pairs and promised.line > 1 for promised in found.properties)


def test_a_promise_without_capabilities_is_about_those_it_can_speak_of() -> None:
    (found,) = read(shipped(), "properties: [{id: a, says: So., always: params.force_n <= 200.0}]\n").properties
    assert {capability for capability, _ in found.pairs} == {
        name for name, known in shipped().capabilities.items() if "force_n" in known.inputs["properties"]
    }
