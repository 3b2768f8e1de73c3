"""What a decision was made on goes into the record and comes back as it was: the same decision follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import orjson
import pytest

from app.governance.decision import decide
from app.governance.model import Context, Grant, GrantScope, Mode, Proposal
from app.governance.policy_model import GOVERNANCE
from app.governance.recorded import Agents, circumstances, read
from tests.governance.policy_world import context, proposal, shipped


def plain(value: object) -> object:
    """Write what JSON does not know, as the log does."""
    return dict(value) if isinstance(value, Mapping) else value._asdict()  # type: ignore[attr-defined]


def kept(said: Proposal, given: Context) -> dict[str, Any]:
    decision = decide(shipped(), said, given)
    return orjson.loads(orjson.dumps(circumstances(said, given, shipped(), decision), default=plain))


GRASP = proposal("grasp_object", object_id="mug_1", force_n=80.0, speed_mps=0.2)
CASES = [
    (proposal("navigate_to", target="dock", speed_mps=2.0), context("human-shared")),
    (proposal("navigate_to", target="dock", mode=Mode.CAREFUL), context("sim-relaxed", busy="inv_other")),
    (GRASP, context("human-shared", people_count=2, people_nearest_m=1.5)),
    (replace(GRASP, metadata={"confidence": 0.2}), context("real-restricted", latched=True)),
    (replace(GRASP, preconditions=("arm_ready",)), context("test-audit", arm_ready=False, operator_on_duty=False)),
    (proposal("place_object", surface="bench_b"), context("human-shared", holding="mug_1")),
    (proposal("navigate_to", target="dock"), context("human-shared", agent=GOVERNANCE)),
    (proposal("navigate_to", target="dock"), context("human-shared", agent="stranger")),
]


@pytest.mark.parametrize(("said", "given"), CASES)
def test_a_decision_made_again_from_the_record_is_the_same(said: Proposal, given: Context) -> None:
    record = kept(said, given)
    again, circumstance = read(record, given.profile, shipped(), Agents(shipped()))
    assert again == said
    assert circumstance == given
    decided = decide(shipped(), again, circumstance)
    assert decided == decide(shipped(), said, given)
    assert record["decided"] == decided.status
    assert record["policy_version"] == shipped().digest


def test_a_cell_that_says_nothing_comes_back_as_one() -> None:
    given = context("human-shared")
    given = replace(given, cell=replace(given.cell, facts=None))
    assert read(kept(GRASP, given), "human-shared", shipped(), Agents(shipped()))[1] == given


def test_a_cell_that_cannot_record_comes_back_as_one() -> None:
    given = context("human-shared")
    given = replace(given, cell=replace(given.cell, recording=False))
    assert read(kept(GRASP, given), "human-shared", shipped(), Agents(shipped()))[1] == given


@pytest.mark.parametrize("version", ["of the record", "another"])
def test_a_grant_holds_under_the_policy_it_was_given_under_or_the_one_that_stands_in_for_it(version: str) -> None:
    digest = shipped().digest if version == "of the record" else "sha256:another"
    grant = Grant(
        id="g",
        capability="grasp_object",
        agent="planner",
        cell="case",
        profile="human-shared",
        policy_digest=digest,
        scope=GrantScope.OBJECT,
        issued_by="op",
        issued_at_s=0.0,
        expires_at_s=60.0,
        object="mug_1",
    )
    given = replace(context("human-shared"), grants=(grant,))
    record = kept(GRASP, given)
    candidate = replace(shipped(), digest="sha256:candidate")
    (found,) = read(record, "human-shared", candidate, Agents(candidate))[1].grants
    expected = "sha256:candidate" if version == "of the record" else "sha256:another"
    assert found == replace(grant, policy_digest=expected)


def test_each_agent_is_looked_up_once() -> None:
    agents = Agents(shipped())
    assert agents("planner") is agents("planner")
    assert agents(GOVERNANCE) == shipped().governance()


def test_what_is_no_record_of_circumstances_says_so() -> None:
    record = kept(GRASP, context("human-shared"))
    del record["cell"]["facts"]
    with pytest.raises(KeyError):
        read(record, "human-shared", shipped(), Agents(shipped()))
