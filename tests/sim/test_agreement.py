"""What governance says of a skill is what the skill does: its phases, and where it can be started from."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from app.governance.conditions import ARRIVED_M, ARRIVED_RAD, NEAR_M, NEAR_RAD
from app.governance.continuing import DRIVES_M, REACH_M
from app.governance.vocabulary import properties
from app.sim import skills, skills_arm, skills_drive
from app.sim.robot import BASE_RADIUS_M
from app.sim.skills import SKILLS
from tests.governance.policy_world import shipped

SOURCES = sorted(Path(skills.__file__).parent.glob("skills*.py"))


def functions() -> dict[str, ast.FunctionDef]:
    found = [node for path in SOURCES for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)]
    assert len({node.name for node in found}) == len(found), "two functions of one name cannot be told apart here"
    return {node.name: node for node in found}


def phases(name: str) -> set[str]:
    """Return every phase a skill may enter: by itself, or in a function it refers to."""
    known, seen, todo, entered = functions(), set[str](), [name], set[str]()
    while todo:
        seen.add(at := todo.pop())
        for node in ast.walk(known[at]):
            if isinstance(node, ast.Name) and node.id in known and node.id not in seen:
                todo.append(node.id)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "enter":
                (first, *_) = node.args
                assert isinstance(first, ast.Constant), f"`{at}` enters a phase that has no fixed name"
                entered.add(str(first.value))
    return entered


@pytest.mark.parametrize("capability", sorted(SKILLS))
def test_a_manifest_lists_the_phases_of_its_skill(capability):
    assert set(shipped().capabilities[capability].phases) == phases(SKILLS[capability].__name__)


def test_what_is_admitted_near_a_stand_a_skill_can_do_there():
    assert ARRIVED_M < NEAR_M < skills_arm.SEEN_FROM_M
    assert ARRIVED_RAD < NEAR_RAD < skills_arm.SEEN_FROM_RAD


def test_policy_looks_as_far_as_what_recovers_a_session_drives_by_itself():
    assert max(skills_drive.REDOCK_WITHIN_M, skills_drive.RETREAT_M) <= DRIVES_M
    assert DRIVES_M + BASE_RADIUS_M <= REACH_M
    for capability in ("reposition_base", "safe_retreat"):  # nor does anybody tell them to drive farther
        assert set(properties(shipped().capabilities[capability])) == {"speed_mps"}
