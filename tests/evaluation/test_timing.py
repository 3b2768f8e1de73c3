"""ADL: each gate is warm when it is timed, and no method has a place of its own in the order."""

from __future__ import annotations

from collections import Counter

import pytest

from app.evaluation import timing
from app.evaluation.draws import draw
from app.evaluation.methods import ABLATIONS, METHODS, Method, Passed, pass_gate
from app.evaluation.physical_trial import Trial, ready
from app.evaluation.timing import ROUNDS, time_gate, time_gates
from tests.evaluation.physical_world import bench
from tests.governance.policy_world import shipped

ALL = (*METHODS.values(), *ABLATIONS.values())


def drawn(number: int) -> Trial:
    """What a gate decides about; nothing of it is executed."""
    one, _ = ready(bench(), draw(shipped(), 7, number))
    return one


def test_says_what_the_gates_say() -> None:
    for number in range(6):
        one = drawn(number)
        said = time_gates(ALL, shipped(), one.proposal, one.context, approved=True, seed=(7, number))
        assert list(said) == [method.name for method in ALL]
        for method in ALL:
            assert said[method.name].passed == pass_gate(method, shipped(), one.proposal, one.context, approved=True)
            assert said[method.name].decision_us > 0.0
        assert time_gate(ALL[0], shipped(), one.proposal, one.context, approved=True).passed == said["direct"].passed


def test_every_gate_is_passed_untimed_first_and_then_in_orders_that_favour_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, passed = drawn(0), list[str]()

    def gate(method: Method, *words: object, approved: bool) -> Passed:
        passed.append(method.name)
        return Passed(True, "", {}, ())

    monkeypatch.setattr(timing, "pass_gate", gate)
    first = Counter[str]()
    names = [method.name for method in ALL]
    for number in range(200):
        passed.clear()
        time_gates(ALL, shipped(), one.proposal, one.context, approved=True, seed=(7, number))
        assert passed[: len(ALL)] == names
        rounds = [passed[len(ALL) * k : len(ALL) * (k + 1)] for k in range(1, ROUNDS + 1)]
        assert all(sorted(turn) == sorted(names) for turn in rounds)
        first.update(turn[0] for turn in rounds)
    assert set(first) == set(names)
    assert max(first.values()) < 3 * 200 * ROUNDS / len(ALL)
