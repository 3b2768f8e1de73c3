"""The proof of a stated property in one (capability, profile), and the order of profiles between two of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import z3

from app.governance.admission import ACCEPT
from app.governance.authority import answers, need
from app.governance.bundle import PROPERTIES
from app.governance.decision import decide
from app.governance.expression_tree import BOOL
from app.governance.model import AuthorityMode, Verdict
from app.governance.policy_code import Generator
from app.governance.policy_model import Effect, Rule
from app.proofs.asking import UNDECIDED, Asking, Undecided
from app.proofs.findings import Finding, Kind
from app.proofs.formulas import Formula, both, either, no, some
from app.proofs.obligations import never
from app.proofs.values import NotCoveredError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.bundle_promises import PropertyShape
    from app.governance.policy import Gate
    from app.governance.stated import Property
    from app.proofs.obligations import Court
    from app.proofs.pair import Pair
    from app.proofs.witness import Seen

PROBE: Final = "properties/probe"
LAUNCHED: Final = frozenset({"allowed", "awaiting_approval"})


# Stated properties ---------------------------------------------------------------------------------------------------


def statuses(pair: Pair) -> Mapping[str, Formula]:
    """Return where an idle, ready cell gives which status, without a standing grant."""
    gate = pair.gate
    escalates = either(pair.first.asked, pair.space.supervised)
    denied = either(pair.denied, False if answers(gate) else escalates)
    awaiting = both(no(denied), _always_asks(gate) or escalates) if answers(gate) else False
    return {"denied": denied, "awaiting_approval": awaiting, "allowed": both(no(denied), no(awaiting))}


def _always_asks(gate: Gate) -> bool:
    """Say whether authority asks about every proposal of this pair."""
    approval = gate.profile.approval
    by_risk = AuthorityMode.APPROVAL_REQUIRED in gate.profile.authority
    marked = gate.capability.env_profile[gate.profile.name] == "approval-required"
    listed = approval is not None and by_risk and gate.capability.risk in approval.risks
    return answers(gate) and (marked or listed)


def people(gate: Gate) -> int:
    """Return how many people a pair asks where no rule wants more."""
    approval = gate.profile.approval
    return 0 if approval is None else approval.approvers.get(gate.capability.risk, approval.default_approvers)


def _too_few(pair: Pair, wanted: int) -> Formula:
    """Return where fewer people are asked than wanted, of what may be launched."""
    found = statuses(pair)
    return both(no(found["denied"]), no(both(found["awaiting_approval"], at_least(pair, wanted))))


def at_least(pair: Pair, count: int) -> Formula:
    """Return where at least so many people have to approve, of what has to be approved."""
    asking = [rule.id for rule in pair.rules if rule.then is Effect.ESCALATE and rule.approvers >= count]
    return people(pair.gate) >= count or some(pair.first.fires[rule] for rule in asking)


def applies(court: Court, promised: Property) -> bool:
    """Say whether a promise is about anything that can be proposed in this pair, as far as that is known."""
    if promised.shape.when is None:
        return True
    try:
        when = _holds_or_fails(court.pair, promised.shape.when)
    except NotCoveredError:
        return True
    return court.solve(court.pair.space.ready(), when) is not None


def property_holds(court: Court, promised: Property) -> Iterator[Finding]:
    """Yield where a promise is not kept in this pair."""
    pair, shape = court.pair, promised.shape
    message = f"`{shape.id}` does not hold of {court.where}: {shape.says}"
    try:
        when = True if shape.when is None else _holds_or_fails(pair, shape.when)
        broken = _broken(pair, shape)
    except NotCoveredError as why:
        reading = f"`{shape.id}` reads {why}, which proofs do not cover"
        found = court.judged(Kind.PROPERTY, UNDECIDED, reading, never)
    else:
        answer = court.solve(pair.space.ready(), when, broken)
        found = court.judged(Kind.PROPERTY, answer, message, lambda seen: Judge(pair, shape).broken(seen))
    for finding in found:
        yield replace(finding, file=PROPERTIES, line=promised.line, rule=shape.id)


def _holds_or_fails(pair: Pair, source: str) -> Formula:
    value = pair.first.value(source, BOOL)
    return either(value.truth, value.error)


def _broken(pair: Pair, shape: PropertyShape) -> Formula:
    found = statuses(pair)
    broken = [found[status] for status in shape.never]
    if shape.always is not None:
        kept = pair.second.value(shape.always, BOOL)
        broken.append(both(no(found["denied"]), no(kept.holds)))
    if shape.approvers is not None:
        broken.append(_too_few(pair, shape.approvers))
    return some(broken)


class Judge:
    """Says of a real decision whether it breaks a promise; its conditions are compiled as those of rules are."""

    def __init__(self, pair: Pair, shape: PropertyShape) -> None:
        """Compile the promise's conditions."""
        self._shape = shape
        self._when, self._always = (_compiled(pair, source) for source in (shape.when, shape.always))

    def broken(self, seen: Seen) -> bool:
        """Say whether this decision breaks the promise."""
        verdict = seen.decision.verdict
        if verdict is None or (self._when is not None and not _reason(self._when(seen.proposal, seen.context))):
            return False
        need, wanted = seen.decision.need, self._shape.approvers
        few = wanted is not None and seen.status in LAUNCHED and (need is None or need.approvers < wanted)
        return seen.status in self._shape.never or few or (seen.status in LAUNCHED and not self._kept(seen, verdict))

    def _kept(self, seen: Seen, verdict: Verdict) -> bool:
        if self._always is None:
            return True
        launched = replace(seen.proposal, params=verdict.effective)
        return _reason(self._always(launched, seen.context)) == "probe"


def _compiled(pair: Pair, source: str | None) -> Callable[..., Verdict] | None:
    if source is None:
        return None
    rule = Rule(
        id=PROBE, applies_to=None, profiles=None, when=source, then=Effect.DENY, settings=(), approvers=0,
        because="It holds.", remedy="",
    )  # fmt: skip
    gate = pair.gate
    return Generator(gate.capability, gate.profile, gate.site, pair.vocabulary).compile([rule]).check


def _reason(verdict: Verdict) -> str | None:
    """Return `probe` where a compiled condition holds, `rule_error` where it fails, None where it does not hold."""
    return next((reason.code for reason in verdict.reasons if reason.rule == PROBE), None)


# The order of profiles -----------------------------------------------------------------------------------------------


def order_holds(court: Court, wide: Pair, asking: Asking) -> Iterator[Finding]:
    """Yield where the stricter profile (the court's) lets something through that the wider one would not.

    Deny > escalate > modify > allow: for no proposal is the stricter profile's verdict the weaker one, and where the
    wider profile asks for every approval, the stricter one does, and never fewer people. Only who may be launched is
    asked about: what does not meet its preconditions is deferred by admission, whatever the guard says.
    """
    strict = court.pair
    name, one, other = strict.gate.capability.name, strict.gate.profile, wide.gate.profile
    if _always_asks(wide.gate) and not (_always_asks(strict.gate) and people(strict.gate) >= people(wide.gate)):
        message = (
            f"`{name}` is approved by {people(wide.gate)} in {other.name}, and by fewer in {one.name}, the stricter"
        )
        fewer = _asked(asking, strict, strict.space.ready(), *_same_mode(strict, wide), *_unasked(strict, wide))
        yield from court.judged(Kind.ORDER, fewer, message, lambda seen: _fewer_people(court, seen, wide))
    weaker = some((
        both(strict.allowed, no(wide.allowed)),
        both(strict.modified, either(wide.escalated, wide.denied)),
        both(strict.escalated, wide.denied),
        _fewer(strict, wide),
    ))  # fmt: skip
    admitted = strict.space.modes.where([mode.value for mode in one.admits])
    foreign = no(strict.space.modes.where([mode.value for mode in other.admits]))
    answer = _asked(asking, strict, admitted, either(weaker, both(foreign, no(strict.denied))))
    message = (
        f"{one.name} lets something through about `{name}` that {other.name} does not, or asks fewer people, and is "
        "declared the stricter"
    )
    yield from court.judged(Kind.ORDER, answer, message, lambda seen: _weaker(court, seen, other.name))


def _asked(asking: Asking, strict: Pair, *parts: Formula) -> z3.ModelRef | Undecided | None:
    """Ask; of the solutions, prefer one that neither rounds nor lies on an edge."""
    answer = asking.ask(*parts)
    if isinstance(answer, z3.ModelRef) and strict.space.approximate:
        plain = asking.ask(*parts, *strict.space.plain())
        return plain if isinstance(plain, z3.ModelRef) else answer
    return answer


_RANKS: Final = ("allow", "modify", "escalate", "deny")


def _fewer(strict: Pair, wide: Pair) -> Formula:
    """Return where the stricter profile asks fewer people about what both ask about."""
    counts = {people(wide.gate), *(rule.approvers for rule in wide.rules)}
    asked = both(*(statuses(pair)["awaiting_approval"] for pair in (strict, wide)))
    return both(asked, some(both(at_least(wide, count), no(at_least(strict, count))) for count in counts if count > 1))


def _same_mode(strict: Pair, wide: Pair) -> Iterator[Formula]:
    """Yield that a proposal's mode is one that both profiles admit."""
    for pair in (strict, wide):
        yield strict.space.modes.where([mode.value for mode in pair.gate.profile.admits])


def _unasked(strict: Pair, wide: Pair) -> tuple[Formula, ...]:
    """Return where the stricter profile launches, or asks fewer people than authority always asks in the wider one."""
    mine, theirs = statuses(strict), statuses(wide)
    enough = both(mine["awaiting_approval"], at_least(strict, people(wide.gate)))
    return no(mine["denied"]), theirs["awaiting_approval"], no(enough)


def _fewer_people(court: Court, seen: Seen, wide: Pair) -> bool:
    """Say whether fewer people are really asked about a case than authority always asks in the wider profile.

    What a rule of the wider profile wants beyond that is another matter: while a case is made small it would let the
    case turn into one that both profiles ask about.
    """
    theirs = decide(court.policy, seen.proposal, replace(seen.context, profile=wide.gate.profile.name))
    asked = 0 if seen.decision.need is None else seen.decision.need.approvers
    return seen.status in LAUNCHED and theirs.status in LAUNCHED and asked < people(wide.gate)


def _weaker(court: Court, seen: Seen, wide: str) -> bool:
    """Say whether the real verdict in the wider profile is the stricter one, or asks more people."""
    mine = seen.decision.verdict
    context = replace(seen.context, profile=wide)
    theirs = decide(court.policy, seen.proposal, context).verdict
    if mine is None:
        return False
    if theirs is None or _RANKS.index(theirs.outcome.value) > _RANKS.index(mine.outcome.value):
        return True
    one = need(court.policy, seen.proposal, ACCEPT, mine, seen.context)
    other = need(court.policy, seen.proposal, ACCEPT, theirs, context)
    return one is not None and other is not None and one.approvers < other.approvers


__all__ = ["Judge", "applies", "at_least", "order_holds", "people", "property_holds", "statuses"]
