"""What mutation calls equivalent by folding conditions, the solver shows to decide nothing otherwise."""

from __future__ import annotations

from functools import partial

from app.authoring.equivalence import equivalent
from app.authoring.mutants import mutants
from app.authoring.mutation import concerns
from app.authoring.workbench import Workbench
from app.governance.errors import PolicyErrors
from app.proofs.difference import difference
from tests.governance.policy_world import files
from tests.proofs.planted import standing

EVERY = 3  # of the organization's mutants: its conditions read the site, which is what is folded


def test_the_solver_finds_no_other_decision_where_a_mutant_is_called_equivalent() -> None:
    bench = Workbench(files())
    of_rules = [mutant for mutant in mutants(bench.documents, bench.known) if mutant.file == "organization.yaml"]
    called = 0
    for mutant in of_rules[::EVERY]:
        try:
            other = bench.changed(mutant)
        except PolicyErrors:
            continue  # it would not be loaded
        same = equivalent(bench.policy, other, bench.known.vocabulary, partial(concerns, mutant))
        if same:
            called += 1
            assert difference(bench.policy, other, now=standing).decisions == (), mutant.key
    assert called
