"""An agent is told of every end in words, and what to do next."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from app.runtime.failures import failure
from app.runtime.sessions import LOST_WITH_CELL

SIMULATION = Path(__file__).parents[2] / "app" / "sim"
RAISED = {
    code
    for file in SIMULATION.glob("*.py")
    for code in re.findall(r'SubstrateError\(\s*"(\w+)"', file.read_text(encoding="utf-8"))
}
NEVER_TOLD = {"busy", "not_covered", "not_started", "wrong_cell"}  # permits are verified before: these would be bugs


@pytest.mark.parametrize("code", sorted(LOST_WITH_CELL | {"launch_unconfirmed", "holding"} | RAISED - NEVER_TOLD))
def test_says_what_happened_and_what_to_do(code: str) -> None:
    (told,) = failure(code)["reasons"]
    assert code not in told["message"]
    assert told["remedy"]


def test_says_of_an_object_that_was_lost_only_what_the_pads_know() -> None:
    (told,) = failure("object_lost")["reasons"]
    assert told["message"] == "the grip holds the object no more"  # it slipped, or somebody took it
