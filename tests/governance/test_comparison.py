"""A change is called a tightening only where every part of it is plainly stricter."""

from __future__ import annotations

from functools import cache

import pytest

from app.governance import bundle
from app.governance.changes import Comparison, Direction
from app.governance.comparison import compare
from tests.governance.policy_world import files, shipped

SHARED, ORGANIZATION, AUTHORITY, SITE = (
    "profiles/human-shared.yaml", "organization.yaml", "authority.yaml", "site.yaml",
)  # fmt: skip
NEW_RULE = """
  - id: no-mug
    applies_to: [grasp_object]
    when: params.object_id == "mug_1"
    then: deny
    because: The mug stays where it is.
"""


def edited(*edits: tuple[str, str, str]) -> dict[str, str]:
    changed = files()
    for name, before, after in edits:
        assert before in changed[name], f"`{before}` is not in `{name}`"
        changed[name] = changed[name].replace(before, after, 1)
    return changed


@cache
def compared(*edits: tuple[str, str, str]) -> Comparison:
    return compare(shipped(), bundle.load_files(edited(*edits)))


TIGHTER = (SHARED, "grip_force_n: {max: 60", "grip_force_n: {max: 50")
WIDER = (SHARED, "grip_force_n: {max: 60", "grip_force_n: {max: 70")


def test_a_policy_compared_with_itself_is_the_same() -> None:
    assert compare(shipped(), shipped()) == Comparison(direction=Direction.SAME)


def test_a_lower_limit_tightens_and_says_what_it_was() -> None:
    found = compared(TIGHTER)
    assert found.direction is Direction.TIGHTENS
    (only,) = found.differences
    assert (only.part, only.before, only.after) == (
        "profiles/human-shared/limits/grip_force_n/maximum", "60.0", "50.0",
    )  # fmt: skip


def test_a_lower_limit_that_a_condition_reads_is_not_known_to_tighten() -> None:
    assert compared((SHARED, "payload_kg: {max: 3", "payload_kg: {max: 2")).loosens


def test_a_higher_limit_loosens() -> None:
    assert compared(WIDER).direction is Direction.LOOSENS


def test_one_limit_lower_and_another_higher_is_both() -> None:
    other = ("profiles/real-restricted.yaml", "grip_force_n: {max: 80", "grip_force_n: {max: 90")
    found = compared(TIGHTER, other)
    assert found.direction is Direction.BOTH
    assert found.loosens


def test_one_more_rule_tightens_and_one_less_loosens() -> None:
    more = edited((ORGANIZATION, "rules:\n", "rules:" + NEW_RULE))
    grown = bundle.load_files(more)
    assert compare(shipped(), grown).direction is Direction.TIGHTENS
    assert compare(grown, shipped()).direction is Direction.LOOSENS


def test_other_words_are_no_change_of_what_is_allowed() -> None:
    found = compared((ORGANIZATION, "because: ", "because: Well, "))
    assert found.direction is Direction.SAME
    assert found.differences[0].direction is Direction.SAME


def test_another_condition_counts_as_a_loosening_whatever_it_means() -> None:
    found = compared((ORGANIZATION, "when: target.hazardous", "when: target.hazardous && true"))
    assert found.loosens


def test_a_comment_changes_the_digest_and_nothing_else() -> None:
    other = bundle.load_files(edited((ORGANIZATION, "rules:\n", "# a remark\nrules:\n")))
    assert other.digest != shipped().digest
    assert compare(shipped(), other).direction is Direction.SAME


@pytest.mark.parametrize("narrower", [True, False])
def test_what_an_agent_may_do_tightens_with_less_and_loosens_with_more(narrower: bool) -> None:
    with_all = bundle.load_files(files())
    text = files()[ORGANIZATION]
    line = next(line for line in text.splitlines() if "permissions: [" in line and "planner" in line)
    first = line.split("permissions: [")[1].split(",")[0].split("]")[0]
    less = bundle.load_files({**files(), ORGANIZATION: text.replace(line, line.replace(f"{first}, ", "", 1), 1)})
    old, new = (with_all, less) if narrower else (less, with_all)
    assert compare(old, new).direction is (Direction.TIGHTENS if narrower else Direction.LOOSENS)
