"""A solution of the solver as something anybody can run: a case, made small, and confirmed by the real code.

1. `read` turns a model into a case: what the model does not speak of stays ordinary.
2. `confirm` runs the case through the real `admit` and `check`; numbers that are no doubles are tried at the doubles
   beside them.
3. `shrink` takes away whatever the fault does not need, one thing after the other, and shortens the numbers: the case
   that is left is the smallest in that nothing in it can be left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from fractions import Fraction
from itertools import islice, product
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

import yaml
import z3
from pydantic import ValidationError

from app.governance.bundle_shapes import CaseShape, ContextShape
from app.governance.cases import asking, run
from app.governance.decision import decide
from app.governance.policy_model import GOVERNANCE
from app.governance.vocabulary import referring
from app.proofs.formulas import Formula, holds, named, spelled
from app.proofs.space import FLAGS, STRANGER, Space

if TYPE_CHECKING:
    from app.governance.decision import Decision
    from app.governance.model import Context, Proposal, Reason
    from app.governance.policy import PolicySet

Case: TypeAlias = dict[str, Any]
NEIGHBOURS: Final = 243


class Seen(NamedTuple):
    """A case as the real code saw it, and what it decided."""

    status: str
    decision: Decision
    proposal: Proposal
    context: Context

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Return the guard's reasons."""
        return () if self.decision.verdict is None else self.decision.verdict.reasons


Shows: TypeAlias = Callable[[Seen], bool]


# From a model to a case ----------------------------------------------------------------------------------------------


def read(space: Space, profile: str, model: z3.ModelRef) -> Case:
    """Return a model as a case in a profile, without what is expected of it."""
    params = {
        name: found
        for name, slot in space.params.items()
        if _yes(model, space.given[name]) and (found := _payload(model, slot.value.cases)) is not None
    }
    metadata = {
        name: found
        for name, held in (
            ("confidence", z3.Real("metadata.confidence")),
            ("intent", z3.String("metadata.intent")),
            ("priority", z3.Int("metadata.priority")),
        )
        if _yes(model, named(f"given metadata.{name}"))
        and (found := _number(model.eval(held, model_completion=True))) is not None
    }
    return {
        "profile": profile,
        "capability": space.capability.name,
        "params": params,
        "metadata": metadata,
        "mode": space.modes.read(model) or "normal",
        "context": _context(space, model, params),
    }


def _context(space: Space, model: z3.ModelRef, params: Mapping[str, object]) -> Case:
    context: Case = {}
    for name in FLAGS:
        if (flag := holds(model, named(f"world.{name}"))) is not None:
            context[name] = flag
    holding = space.holding.read(model)
    if holding is not None:
        context["holding"] = holding
    count, near = space.people
    for name, held in (("people_count", count), ("people_nearest_m", near)):
        if (found := _number(model.eval(held))) is not None:
            context[name] = found
    context["operator_on_duty"] = holds(model, named("operator_on_duty")) is not False
    return context | _agent(space, model) | _perceived(space, model, params) | _stand(space, params)


def _agent(space: Space, model: z3.ModelRef) -> Case:
    name = space.agents.read(model)
    if name in (STRANGER, GOVERNANCE):
        held = sorted(permission for permission in space.held if _yes(model, space.holds(permission)))
        spoken = _number(model.eval(z3.String("agent.name")))
        return {"agent": GOVERNANCE if name == GOVERNANCE else spoken or _stranger(space), "permissions": held}
    return {} if name is None else {"agent": name}


def _stranger(space: Space) -> str:
    """Return what an agent may be called that policy does not declare."""
    known = space.policy.agents
    return next(name for name in ("another-agent", *(f"agent-{n}" for n in range(len(known) + 1))) if name not in known)


def _perceived(space: Space, model: z3.ModelRef, params: Mapping[str, object]) -> Case:
    point = [_number(model.eval(held)) for held in space.seen]
    thing = params.get(referring(space.capability).get("object", ""))
    return {"at": {str(thing): point}} if thing is not None and None not in point else {}


def _stand(space: Space, params: Mapping[str, object]) -> Case:
    """Let the base stand where what the proposal names is within reach."""
    site, references = space.policy.site, referring(space.capability)
    for kind, known in (("surface", site.surfaces), ("tool", site.tools), ("area", site.areas)):
        found = known.get(str(params.get(references.get(kind, ""))))
        if found is not None and found.target != site.start:
            return {"stand": found.target}
    return {}


def _yes(model: z3.ModelRef, formula: object) -> bool:
    return holds(model, cast("Formula", formula)) is True


def _payload(model: z3.ModelRef, cases: tuple[tuple[object, object], ...]) -> object:
    for guard, payload in cases:
        if len(cases) > 1 and not _yes(model, guard):
            continue
        if isinstance(payload, z3.ExprRef):
            return _number(model.eval(payload))
        return payload
    return None


def _number(value: z3.ExprRef) -> bool | int | float | str | None:
    """Return a model's value as Python's; None where the model leaves it open."""
    if isinstance(value, z3.IntNumRef):
        return value.as_long()
    if isinstance(value, z3.RatNumRef):
        return _double(Fraction(value.numerator_as_long(), value.denominator_as_long()))
    if isinstance(value, z3.AlgebraicNumRef):
        near = value.approx(30)
        return _double(Fraction(near.numerator_as_long(), near.denominator_as_long()))
    if isinstance(value, z3.SeqRef) and z3.is_string_value(value):
        return spelled(value)
    return z3.is_true(value) if z3.is_true(value) or z3.is_false(value) else None


def _double(value: Fraction) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.copysign(1.7976931348623157e308, value)


# Running it ----------------------------------------------------------------------------------------------------------


def decided(policy: PolicySet, case: Case) -> Seen | None:
    """Return the real decision about a case; None where its parameters are invalid."""
    try:
        shape = CaseShape.model_validate({**case, "name": "a case", "expect": {"status": "allowed"}})
    except ValidationError:
        return None
    asked = asking(policy, case["profile"], shape)
    if asked is None:
        return None
    decision = decide(policy, *asked)
    return Seen(str(decision.status), decision, *asked)


def confirm(policy: PolicySet, case: Case, shows: Shows) -> Case | None:
    """Return the case, its numbers moved to a double beside them if need be, that shows the fault; None without one."""
    return confirm_by(_shown_by(policy, shows), case)


def confirm_by(shown: Callable[[Case], bool], case: Case) -> Case | None:
    """Return the case as `confirm` does, whatever it is that shows the fault."""
    return next((candidate for candidate in islice(_nearby(case), NEIGHBOURS) if shown(candidate)), None)


def _shown_by(policy: PolicySet, shows: Shows) -> Callable[[Case], bool]:
    def shown(case: Case) -> bool:
        found = decided(policy, case)
        return found is not None and shows(found)

    return shown


def _nearby(case: Case) -> Iterator[Case]:
    steps = [(value, math.nextafter(value, -math.inf), math.nextafter(value, math.inf)) for *_, value in _numbers(case)]
    for values in product(*steps):
        moved = deepcopy(case)
        for (held, key, _), value in zip([*_numbers(moved)], values, strict=True):
            held[key] = value
        yield moved


def _numbers(case: Case) -> Iterator[tuple[Any, Any, float]]:
    """Yield every number that a model may have put between two doubles: where it stands, under which key, and what."""
    points = case["context"].get("at", {}).values()
    for held in (case["params"], case["metadata"], *points):
        for key, value in list(enumerate(held) if isinstance(held, list) else held.items()):
            if isinstance(value, float):
                yield held, key, value


# Making it small -----------------------------------------------------------------------------------------------------


def shrink(policy: PolicySet, case: Case, shows: Shows) -> Case:
    """Return the smallest case that still shows the fault."""
    return shrink_by(_shown_by(policy, shows), case)


def shrink_by(shown: Callable[[Case], bool], case: Case) -> Case:
    """Return the smallest case as `shrink` does, whatever it is that shows the fault."""
    small, again = deepcopy(case), True
    while again:
        again = False
        for simpler in _simpler(small):
            if shown(simpler):
                small, again = simpler, True
                break
    return small


def _simpler(case: Case) -> Iterator[Case]:
    """Yield the case with one thing less in it, or one number shorter."""
    if case["mode"] != "normal":
        yield {**case, "mode": "normal"}
    every = [(part, name) for part in ("context", "metadata", "params") for name in case[part]]
    for part, left_out in every:
        if left_out != "stand":  # the base stands where what the proposal names is within reach
            yield {**case, part: {key: held for key, held in case[part].items() if key != left_out}}
    permissions = case["context"].get("permissions", [])
    for permission in permissions:
        fewer = [other for other in permissions if other != permission]
        yield {**case, "context": {**case["context"], "permissions": fewer}}
    for part, name in every:
        shorter = _shorter(case[part][name]) if isinstance(case[part][name], float) else ()
        yield from ({**case, part: {**case[part], name: value}} for value in shorter)


def _shorter(value: float) -> Iterator[float]:
    """Yield numbers near this one that are shorter to write."""
    length = len(f"{value!r}")
    for digits in range(1, 17):
        step = 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1) if value else 1.0
        rounded = float(f"{value:.{digits}g}")
        for candidate in (rounded, rounded + step, rounded - step):
            short = float(f"{candidate:.{digits}g}")
            if len(f"{short!r}") < length:
                yield short


# Writing it down -----------------------------------------------------------------------------------------------------


class WritingError(Exception):
    """A case does not say what was found: a bug of this module."""


class _Dumper(yaml.SafeDumper):
    """Writes texts so that YAML 1.2 reads them as texts, and small mappings on one line."""

    def ignore_aliases(self, data: object) -> bool:
        """Write everything out: case files know no aliases."""
        return True


def _text(dumper: yaml.SafeDumper, data: str) -> yaml.ScalarNode:
    plain = data.isascii() and data[:1].isalpha() and data.lower() not in ("true", "false", "null")
    plain = plain and data.replace("_", "").replace("-", "").replace(" ", "").isalnum()
    return dumper.represent_scalar("tag:yaml.org,2002:str", data, style=None if plain else '"')


_Dumper.add_representer(str, _text)


def written(policy: PolicySet, case: Case, name: str) -> tuple[str, Case]:
    """Return a case as the YAML of a case file, expecting what really comes of it; and as a body for `/v1/check`.

    Raises:
        WritingError: The case, read back, does not come out as it did: the writing is at fault.
    """
    found = decided(policy, case)
    if found is None:
        raise WritingError(f"a case that was confirmed is not valid: {case}")
    verdict = found.decision.verdict
    reasons = [*found.decision.admission.reasons, *found.reasons]
    expect: Case = {"status": found.status}
    if verdict is not None:
        expect["policy"] = verdict.outcome.value
        if verdict.changes:
            expect["changes"] = {change.param: change.effective for change in verdict.changes}
    if reasons:
        expect["codes"] = sorted({reason.code for reason in reasons})
    kept = {key: held for key, held in case.items() if held != {} and (key, held) != ("mode", "normal")}
    entry = {"cases": [{"name": name, **kept, "expect": expect}]}
    text = yaml.dump(entry, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    (result,) = run(policy, {"tests/counterexample.yaml": text})
    if not result.passed:
        raise WritingError(f"{text}\n{result.differences}")
    body = {key: held for key, held in kept.items() if key in ("capability", "mode", "metadata")}
    body["params"] = case["params"]
    context = kept.get("context", {})
    body["agent"] = context.get("agent", ContextShape().agent)  # people, who alone are shown examples, have to name one
    return text, body
