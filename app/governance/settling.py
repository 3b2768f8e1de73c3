"""Where one rule reads what another changes, the constrained proposal is checked once more.

`Modify` re-checks to `Allow` by itself where conditions read only what no rule and no limit changes, which is found out
on load. Elsewhere a lowered force, say, may let a rule begin to hold that asks for less speed. Only such pairs of
capability and profile pay for a second check; what does not settle by it is denied: it can be proposed otherwise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from app.governance.model import PolicyOutcome, Reason, Verdict
from app.governance.places import leading
from app.governance.vocabulary import properties, referring

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import Protocol, TypeAlias

    from app.governance.model import Capability, Context, Params, Proposal

    Check: TypeAlias = Callable[[Proposal, Context], Verdict]

    class Checking(Protocol):
        """A generated check; `given` are parameters to judge in the place of the proposal's own."""

        def __call__(self, proposal: Proposal, context: Context, given: Params | None = None) -> Verdict:
            """Return the verdict about the proposal, or about these parameters of it."""
            ...


UNSETTLED: Final = "unsettled"


def parameters_behind(paths: Iterable[str], capability: Capability) -> frozenset[str]:
    """Return the parameters behind what conditions read: `params.force_n` itself, the name that `place` follows from.

    Args:
        paths: What conditions read, by dotted path (`expression_tree.references`).
        capability: Whose parameters.
    """
    named = referring(capability)
    behind = {
        "params": frozenset(properties(capability)),
        "place": leading(named),
        "target": frozenset({named["object"]} if "object" in named else ()),
        "tool": frozenset({named["tool"]} if "tool" in named else ()),
    }
    found: set[str] = set()
    for path in paths:
        head, _, field = path.partition(".")
        found |= {field} if head == "params" and field else behind.get(head, frozenset())
    return frozenset(found)


def settled(check: Checking) -> Check:
    """Return the check that looks again at what it changed, and denies what would be changed or refused once more."""

    def check_again(proposal: Proposal, context: Context) -> Verdict:
        verdict = check(proposal, context)
        if not verdict.changes:
            return verdict
        again = check(proposal, context, verdict.effective)
        if not again.changes and again.outcome in (PolicyOutcome.ALLOW, verdict.outcome):
            return verdict
        return Verdict(
            outcome=PolicyOutcome.DENY,
            effective=proposal.params,
            reasons=(_unsettled(again), *again.reasons, *verdict.reasons),
        )

    return check_again


def _unsettled(again: Verdict) -> Reason:
    rule = again.reasons[0].rule
    return Reason(
        rule,
        UNSETTLED,
        f"policy changes this proposal, and `{rule}` would not have it as it then is",
        "propose parameters that policy leaves as they are",
    )
