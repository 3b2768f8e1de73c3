"""ADL: what the gate takes, timed so that the number tells of the method and not of its place in the list.

1. Every gate is passed once untimed: rules are compiled and caches filled where the first to come would pay for it.
2. Then come `ROUNDS` rounds over all methods, each in an order of its own, drawn from the trial.
3. A method's time for the trial is the median of its rounds: what the scheduler does to one of them does not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from app.clock import precise_ns
from app.evaluation.methods import Method, Passed, pass_gate

if TYPE_CHECKING:
    from app.governance.model import Context, Proposal
    from app.governance.policy import PolicySet

ROUNDS: Final = 3


class Timed(NamedTuple):
    """What a gate said, and the median of the times it took, µs."""

    passed: Passed
    decision_us: float


def time_gates(
    methods: Sequence[Method],
    policy: PolicySet,
    proposal: Proposal,
    context: Context,
    *,
    approved: bool,
    seed: tuple[int, int],
) -> Mapping[str, Timed]:
    """Take a proposal through the gate of every method; method → what it said, and how long that takes.

    Args:
        methods: Whose gates.
        policy: Π.
        proposal: q_t, parameters validated and complete.
        context: Γ_t.
        approved: Whether a human who is asked says yes.
        seed: Of the run, and number of the trial: they draw the order of each round.
    """
    said = {one.name: pass_gate(one, policy, proposal, context, approved=approved) for one in methods}
    spent: dict[str, list[float]] = {one.name: [] for one in methods}
    for method in _order(methods, seed):
        began = precise_ns()
        pass_gate(method, policy, proposal, context, approved=approved)
        spent[method.name].append((precise_ns() - began) / 1000.0)
    return {name: Timed(passed, median(spent[name])) for name, passed in said.items()}


def time_gate(method: Method, policy: PolicySet, proposal: Proposal, context: Context, *, approved: bool) -> Timed:
    """Take a proposal through the gate of one method; one alone has no order."""
    return time_gates((method,), policy, proposal, context, approved=approved, seed=(0, 0))[method.name]


def _order(methods: Sequence[Method], seed: tuple[int, int]) -> Sequence[Method]:
    """Return every method `ROUNDS` times, round by round; one alone needs no dice."""
    if len(methods) == 1:
        return list(methods) * ROUNDS
    rng = np.random.default_rng((*seed, 41))
    return [methods[int(place)] for _ in range(ROUNDS) for place in rng.permutation(len(methods))]
