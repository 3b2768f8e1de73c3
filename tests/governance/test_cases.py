from __future__ import annotations

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
