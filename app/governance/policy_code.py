"""Turns the rules that apply to one (capability, profile) into one Python function.

```
def check(proposal, context, given):     what is emitted, in this order
    params = …                           only the variables that some rule uses
    finite?                              a NaN that slipped through denies
    static limits                        reasons are constants, made beforehand
    if <condition>: …                    one block per rule, in a `try` of its own: an error denies and names the rule
    lower bound above upper bound?       an empty intersection denies
    clamp                                one Change per parameter, naming the tightest rule
    verdict                              deny > escalate > modify > allow
```

So the cost of a decision follows the rules that apply. Where a condition reads what another rule or a limit changes,
the function is run again on what it made (`settling`); where the input schema speaks of parameters together, what it
made is held to that again (`fitting`). Everything outside the rules' own blocks is guarded as a whole: whatever raises,
the answer is a denial with code `rule_error`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, assert_never, cast

from app.governance.errors import EvaluationError
from app.governance.expression_code import INTRINSICS, to_python
from app.governance.expression_tree import BOOL, STRING, references
from app.governance.fitting import coupled, filled, fitted
from app.governance.model import Change, PolicyOutcome, Reason, Verdict
from app.governance.places import finder, locator, names
from app.governance.policy_model import Effect
from app.governance.settling import parameters_behind, settled
from app.governance.vocabulary import NAMES, always_there, properties, referring

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from types import CodeType

    from app.governance.expression_tree import Type
    from app.governance.model import Capability, Context, Json, Params, Proposal, Site
    from app.governance.policy_model import Limit, Profile, Rule, Setting
    from app.governance.settling import Checking
    from app.governance.vocabulary import Vocabulary

Check: TypeAlias = "Callable[[Proposal, Context], Verdict]"

SCHEMA: Final = "the input schema"


class Parts(NamedTuple):
    """What a generated function is bound from: its code, the constants it names, and whether it looks again.

    `again` is whether what it made is checked once more, `whole` whether that is held to the input schema again.
    """

    code: CodeType
    constants: Mapping[str, object]
    again: bool
    whole: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Compiled:
    """A generated function, the text it was made of, and what it can be bound from again elsewhere (`bind`)."""

    check: Check
    source: str
    parts: Parts


def limit_for(spec: Mapping[str, Json], limits: Mapping[str, Limit]) -> Limit | None:
    """Return the limit that holds a parameter: the one its `x-limit` names, else the strictest of its unit.

    Parameters without a unit that any limit has (metres, seconds) are not limited by the profile as such.
    """
    named = spec.get("x-limit")
    if named is not None:
        return limits[str(named)]
    same = [limit for limit in limits.values() if limit.unit == spec.get("unit")]
    return min(same, key=lambda limit: limit.maximum, default=None)


def number(value: float) -> str:
    """Write a number as people do: `0.25`, `60`."""
    return f"{value:g}"


def read_metadata(metadata: Params) -> Params:
    """Return metadata that conditions can rely on.

    Raises:
        EvaluationError: `confidence` is no finite number in 0…1, `intent` no text, or `priority` no integer.
    """
    for name, fits in _METADATA.items():
        if name in metadata and not fits(metadata[name]):
            raise EvaluationError("wrong_type", f"metadata.{name}")
    return metadata


def metadata_fault(metadata: Params) -> str | None:
    """Return the name of the entry that is not what it should be, or None."""
    return next((name for name, fits in _METADATA.items() if name in metadata and not fits(metadata[name])), None)


_METADATA: Final[Mapping[str, Callable[[object], bool]]] = {
    "confidence": lambda value: type(value) in (int, float) and 0.0 <= cast("float", value) <= 1.0,
    "intent": lambda value: isinstance(value, str),
    "priority": lambda value: type(value) is int and abs(value) < 2**63,
}


def rule_error(rule: str, error: Exception) -> Reason:
    """Return the reason of a denial because a rule could not be evaluated."""
    detail = str(error) if isinstance(error, EvaluationError) else type(error).__name__
    return Reason(
        rule, "rule_error", f"the rule could not be evaluated ({detail}), so it denies", "tell the safety engineer"
    )


def empty_intersection(param: str, low: float, low_by: str, high: float, high_by: str) -> Reason:
    """Return the reason of a denial because no value satisfies every rule; one of the two is one."""
    message = (
        f"`{param}` must be at least {number(low)} ({low_by}) and at most {number(high)} ({high_by}): no value is both"
    )
    rule = low_by if high_by == SCHEMA else high_by
    return Reason(rule, "empty_intersection", message, "propose it for another object, place or profile")


_PRELUDE: Final[Mapping[str, str]] = {
    "facts": "facts = context.cell.facts",
    "agent": "agent = context.agent",
    "mode": "mode = proposal.mode",
    "on_duty": "on_duty = context.operator_on_duty",
    "metadata": "metadata = read_metadata(proposal.metadata) if proposal.metadata else proposal.metadata",
    "target": "target = find_target(params, context.cell.facts)",
    "place": "place = find_place(params, context.cell.facts)",
}


@dataclass(slots=True)
class _Bounded:
    """What may hold one numeric parameter: its schema's range, the profile's limit, and rules with bounds on it.

    Only numbers are bounded by rules, and they have a range; integers need none.
    """

    name: str
    minimum: float
    maximum: float
    limit: Limit | None
    rules: list[tuple[str, Setting]] = field(default_factory=list["tuple[str, Setting]"])

    @property
    def has_low(self) -> bool:
        return any(setting.minimum is not None for _, setting in self.rules)


@lru_cache(maxsize=256)
def _compiled(source: str, name: str) -> CodeType:
    """Return the code of a decision function: most of a candidate's are those of the policy in force."""
    return compile(source, name, "exec")


class Generator:
    """Writes the function of one (capability, profile)."""

    def __init__(self, capability: Capability, profile: Profile, site: Site, vocabulary: Vocabulary) -> None:
        """Take what every rule of this pair has in common."""
        self.capability, self.profile, self.site, self.vocabulary = capability, profile, site, vocabulary
        self.constants: dict[str, object] = {}
        self.used: set[str] = set()
        self.read: set[str] = set()
        self.numbers = {
            name: _Bounded(
                name,
                cast("float", spec.get("minimum", float("-inf"))),
                cast("float", spec.get("maximum", float("inf"))),
                limit_for(spec, profile.limits),
            )
            for name, spec in properties(capability).items()
            if spec.get("type") in ("number", "integer")
        }
        self.names: dict[str, None] = {}
        self.inlined = {
            **{f"limits.{name}": repr(limit.maximum) for name, limit in profile.limits.items()},
            "capability.name": repr(capability.name),
            "capability.risk": repr(capability.risk.value),
            "profile.name": repr(profile.name),
            "profile.sensitivity": repr(profile.sensitivity),
            "profile.shared_floor": repr(profile.shared_floor),
        }

    def compile(self, rules: Sequence[Rule]) -> Compiled:
        """Return the decision function of these rules, which all apply to the pair."""
        relevant = [rule for rule in rules if rule.then is not Effect.MODIFY or self._settings(rule)]
        for rule in relevant:
            for setting in self._settings(rule):
                if setting.to is None:
                    self.numbers[setting.param].rules.append((rule.id, setting))
                else:
                    self.names[setting.param] = None
        blocks = [line for rule in relevant for line in self._rule(rule)]
        body = [*self._start(), *self._limits(), *blocks, *self._end()]
        prelude = [_PRELUDE[name] for name in _PRELUDE if name in self.used]
        if "tool" in self.used:
            prelude.append(f'tool = TOOLS[params["{referring(self.capability)["tool"]}"]]')
        lines = ["def check(proposal, context, given=None):"]
        lines += ["    params = proposal.params if given is None else given", "    try:"]
        lines += [f"        {line}" for line in (*prelude, *body)]
        lines += ["    except Exception as error:", "        return failed(params, error)", ""]
        source = "\n".join(lines)
        code = _compiled(source, f"<{self.profile.name}/{self.capability.name}>")
        parts = Parts(code, self.constants, again=self._interferes(), whole=self._couples())
        return Compiled(check=bind(self.capability, self.profile, self.site, parts), source=source, parts=parts)

    def _interferes(self) -> bool:
        """Say whether a condition reads what a rule or a limit may change."""
        return not parameters_behind(self.read, self.capability).isdisjoint(self._changing())

    def _couples(self) -> bool:
        """Say whether the input schema speaks together with others of what a rule, a limit or a default may change."""
        inputs = self.capability.inputs
        return not coupled(inputs).isdisjoint(self._changing()) or filled(inputs)

    def _changing(self) -> set[str]:
        bounded = {name for name, found in self.numbers.items() if found.rules or found.limit is not None}
        return bounded | self.names.keys()

    def _settings(self, rule: Rule) -> list[Setting]:
        return [setting for setting in rule.settings if setting.param in properties(self.capability)]

    def _constant(self, prefix: str, value: object) -> str:
        name = f"{prefix}{len(self.constants)}"
        self.constants[name] = value
        return name

    def _start(self) -> Iterator[str]:
        yield "denied = asked = bound = ()"
        there = always_there(self.capability)
        for name, bounded in self.numbers.items():
            yield f"v_{name} = params[{name!r}]" if name in there else f"v_{name} = params.get({name!r}, 0.0)"
            yield f"if v_{name} - v_{name} != 0.0: raise not_finite({name!r})"
            if bounded.rules:
                yield f"h_{name}, hb_{name} = {self._ceiling(bounded)}"
            if bounded.has_low:
                yield f"l_{name}, lb_{name} = {bounded.minimum!r}, {SCHEMA!r}"
        for name in self.names:
            yield f"n_{name} = nb_{name} = None"

    def _ceiling(self, bounded: _Bounded) -> str:
        limit = bounded.limit
        if limit is None or bounded.maximum < limit.maximum:
            return f"{bounded.maximum!r}, {SCHEMA!r}"
        return f"{limit.maximum!r}, {self._limit_id(limit)!r}"

    def _limit_id(self, limit: Limit) -> str:
        return f"{self.profile.name}/{limit.name}"

    def _limits(self) -> Iterator[str]:
        for name, bounded in self.numbers.items():
            if (limit := bounded.limit) is None:
                continue
            shown = f"{number(limit.maximum)} {limit.unit}"
            message = f"`{name}` is limited to {shown} in {self.profile.name} ({limit.source})"
            reason = Reason(self._limit_id(limit), "limit", message, f"at most {shown} here")
            constant = self._constant("R", (reason,))
            yield f"if not v_{name} <= {limit.maximum!r}: bound += {constant}"

    def _rule(self, rule: Rule) -> Iterator[str]:
        reason = self._constant("R", (Reason(rule.id, rule.code, rule.because, self._remedy(rule)),))
        match rule.then:
            case Effect.DENY:
                effect = [f"denied += {reason}"]
            case Effect.ESCALATE:
                effect = [f"asked += {reason}"]
            case Effect.MODIFY:
                effect = list(self._bounds(rule, reason))
            case _:
                assert_never(rule.then)
        if rule.when is not None:
            condition = self._text(rule.when, BOOL)
            effect = [f"if {condition}:", *(f"    {line}" for line in effect)]
        yield "try:"
        yield from (f"    {line}" for line in effect)
        yield "except Exception as error:"
        yield f"    denied += (rule_error({rule.id!r}, error),)"

    def _bounds(self, rule: Rule, reason: str) -> Iterator[str]:
        kept: list[str] = []
        for setting in self._settings(rule):
            name = setting.param
            if setting.to is not None:
                yield from self._name(rule, setting)
                kept.append(f"params.get({name!r}) == x_{name}")
            if setting.maximum is not None:
                yield f"if {setting.maximum!r} < h_{name}: h_{name}, hb_{name} = {setting.maximum!r}, {rule.id!r}"
                kept.append(f"v_{name} <= {setting.maximum!r}")
            if setting.minimum is not None:
                yield f"if {setting.minimum!r} > l_{name}: l_{name}, lb_{name} = {setting.minimum!r}, {rule.id!r}"
                kept.append(f"v_{name} >= {setting.minimum!r}")
        yield f"if not ({' and '.join(kept)}): bound += {reason}"

    def _name(self, rule: Rule, setting: Setting) -> Iterator[str]:
        name, source = setting.param, cast("str", setting.to)
        yield f"x_{name} = {self._text(source, STRING)}"
        yield f"if x_{name} not in {self._constant('N', self._values(name))}: raise no_such_value({name!r})"
        yield f"if n_{name} is None: n_{name}, nb_{name} = x_{name}, {rule.id!r}"
        yield f"elif n_{name} != x_{name}: denied += (two_names({rule.id!r}, {name!r}, n_{name}, x_{name}, nb_{name}),)"

    def _values(self, param: str) -> frozenset[str]:
        """Return what a named parameter may be set to: nobody checks an effective parameter after this."""
        spec = properties(self.capability)[param]
        if "enum" in spec:
            return frozenset(cast("list[str]", spec["enum"]))
        return names(self.site)[str(spec["x-ref"])]

    def _remedy(self, rule: Rule) -> str:
        if rule.remedy:
            return rule.remedy
        parts: list[str] = []
        for setting in self._settings(rule):
            unit = str(properties(self.capability)[setting.param].get("unit", ""))
            if setting.maximum is not None:
                parts.append(f"`{setting.param}` at most {number(setting.maximum)} {unit}".rstrip())
            if setting.minimum is not None:
                parts.append(f"`{setting.param}` at least {number(setting.minimum)} {unit}".rstrip())
        return ", ".join(parts) + (" here" if parts else "")

    def _end(self) -> Iterator[str]:
        yield "changes = ()"
        yield "effective = params"
        for bounded in self.numbers.values():
            yield from self._clamp(bounded)
        for name in self.names:
            yield f"if n_{name} is not None and params.get({name!r}) != n_{name}:"
            yield from self._change(name, f"params.get({name!r})", f"n_{name}", f"nb_{name}")
        yield "if denied: return verdict(DENY, params, denied + asked + bound, ())"
        yield "if asked: return verdict(ESCALATE, effective, asked + bound, changes)"
        yield "if changes: return verdict(MODIFY, effective, bound, changes)"
        yield "return verdict(ALLOW, params, (), ())"

    def _clamp(self, bounded: _Bounded) -> Iterator[str]:
        name, limit = bounded.name, bounded.limit
        if bounded.rules:
            yield from self._emptiness(bounded)
            high, by = f"h_{name}", f"hb_{name}"
        elif limit is not None:
            high, by = repr(limit.maximum), repr(self._limit_id(limit))
        else:
            return
        yield f"if not v_{name} <= {high}:"
        yield from self._change(name, f"v_{name}", high, by)
        if bounded.has_low:
            yield f"if not v_{name} >= l_{name}:"
            yield from self._change(name, f"v_{name}", f"l_{name}", f"lb_{name}")

    def _change(self, name: str, requested: str, value: str, by: str) -> Iterator[str]:
        yield "    if effective is params: effective = {**params}"
        yield f"    effective[{name!r}] = {value}"
        yield f"    changes += (new(Change, ({name!r}, {requested}, {value}, {by})),)"

    def _emptiness(self, bounded: _Bounded) -> Iterator[str]:
        name = bounded.name
        low = f"l_{name}, lb_{name}" if bounded.has_low else f"{bounded.minimum!r}, {SCHEMA!r}"
        yield f"if {low.partition(',')[0]} > h_{name}:"
        yield f"    denied += (empty_intersection({name!r}, {low}, h_{name}, hb_{name}),)"

    def _text(self, source: str, expect: Type) -> str:
        typed = self.vocabulary.typed(source, self.capability.name, expect)
        self.read |= references(typed).keys()
        self.used |= {NAMES[path.partition(".")[0]] for path in references(typed) if path not in self.inlined}
        return to_python(typed, {**NAMES, **self.inlined})


def bind(capability: Capability, profile: Profile, site: Site, parts: Parts) -> Check:
    """Return the decision function of a pair, from the parts that were compiled here or by another process."""
    namespace: dict[str, object] = {
        **INTRINSICS,
        **parts.constants,
        **_SUPPORT,
        "CAPABILITY": capability,
        "PROFILE": profile,
        "LIMITS": {name: limit.maximum for name, limit in profile.limits.items()},
        "TOOLS": site.tools,
        "find_target": finder(referring(capability), site),
        "find_place": locator(referring(capability), site),
    }
    exec(parts.code, namespace)  # noqa: S102  # our own text: names are identifiers, values are reprs of checked constants
    checking = cast("Checking", namespace["check"])
    check = settled(checking) if parts.again else checking
    return fitted(check, capability.inputs) if parts.whole else check


def _setter(name: str) -> Callable[[Verdict, object], None]:
    return cast("Callable[[Verdict, object], None]", vars(Verdict)[name].__set__)  # slots are descriptors


_set_outcome = _setter("outcome")
_set_effective = _setter("effective")
_set_reasons = _setter("reasons")
_set_changes = _setter("changes")


def _verdict(
    outcome: PolicyOutcome, effective: Params, reasons: tuple[Reason, ...], changes: tuple[Change, ...]
) -> Verdict:
    """Make a verdict past the frozen dataclass's own constructor, which takes a third of the whole decision.

    The generated text has established what that constructor would check: a modify has changes.
    """
    made = object.__new__(Verdict)
    _set_outcome(made, outcome)
    _set_effective(made, effective)
    _set_reasons(made, reasons)
    _set_changes(made, changes)
    return made


def _two_names(rule: str, param: str, one: str, other: str, by: str) -> Reason:
    message = f"`{param}` must be `{one}` ({by}) and `{other}` ({rule}): no value is both"
    return Reason(rule, "empty_intersection", message, "propose it for another object, place or profile")


def _failed(params: Params, error: Exception) -> Verdict:
    return Verdict(outcome=PolicyOutcome.DENY, effective=params, reasons=(rule_error("guard", error),))


def _no_such_value(param: str) -> EvaluationError:
    return EvaluationError("unknown_name", f"it sets `{param}` to a name there is not")


def _not_finite(param: str) -> EvaluationError:
    return EvaluationError("not_finite", f"params.{param}")


_SUPPORT: Final[Mapping[str, object]] = {  # pyright: ignore[reportUnknownVariableType]  # tuple.__new__
    "ALLOW": PolicyOutcome.ALLOW,
    "MODIFY": PolicyOutcome.MODIFY,
    "ESCALATE": PolicyOutcome.ESCALATE,
    "DENY": PolicyOutcome.DENY,
    "Change": Change,
    "new": tuple.__new__,  # pyright: ignore[reportUnknownMemberType]
    "verdict": _verdict,
    "empty_intersection": empty_intersection,
    "failed": _failed,
    "not_finite": _not_finite,
    "no_such_value": _no_such_value,
    "read_metadata": read_metadata,
    "rule_error": rule_error,
    "two_names": _two_names,
}
