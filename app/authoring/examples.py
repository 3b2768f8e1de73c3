"""Proposals and contexts that stand for the many there could be: names of the site, numbers on and beside every bound.

They are searched for one that two versions of a policy treat differently, the plainest first; the search is over
neighbourhoods and not over everything, so that finding none proves nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from app.authoring.numbers import probes
from app.governance.expression_tree import BOOL, Constant, children
from app.governance.model import Mode
from app.governance.policy_model import GOVERNANCE
from app.governance.vocabulary import always_there, properties, referring

if TYPE_CHECKING:
    from app.governance.expression_tree import Typed
    from app.governance.policy import PolicySet
    from app.governance.policy_model import Rule
    from app.governance.vocabulary import Vocabulary

Example: TypeAlias = dict[str, Any]
LONG: int = 65


class Examples:
    """Makes examples of one (capability, profile), from what either of two policies says about it."""

    def __init__(self, policies: Iterable[PolicySet], vocabulary: Vocabulary, capability: str, profile: str) -> None:
        """Take the policies whose bounds are probed."""
        self.policies = tuple(policies)
        self.vocabulary, self.capability, self.profile = vocabulary, capability, profile
        self.declared = [
            found for policy in self.policies if (found := policy.capabilities.get(capability)) is not None
        ]
        self.references = dict(referring(self.declared[0]))
        self.numbers = self._numbers()

    def __iter__(self) -> Iterator[Example]:
        """Yield examples, the plainest first."""
        plain = list(self._plain())
        yield from plain
        for example in plain:
            yield from self._varied(example)
            for context in self._contexts():
                yield {**example, "context": {**example.get("context", {}), **context}}

    # -- the plain ones: names in every combination that is needed, nothing else ---------------------------------------

    def _plain(self) -> Iterator[Example]:
        for params in self._named():
            agent = {"agent": GOVERNANCE} if self.declared[0].recovery else {}
            for holding in self._holdings():
                context = {**agent, **self._stand(params), **({} if holding is None else {"holding": holding})}
                example: Example = {"profile": self.profile, "capability": self.capability, "params": params}
                yield {**example, "context": context} if context else example

    def _named(self) -> Iterator[dict[str, Any]]:
        site, names = self.policies[0].site, self.references
        always = {name for declared in self.declared for name in always_there(declared)}
        if "tool" in names:
            for tool, found in site.tools.items():
                for action in found.actions:
                    yield {names["tool"]: tool, names["action"]: action} if "action" in names else {names["tool"]: tool}
            return
        known: Mapping[str, Iterable[str]] = {
            "object": site.objects, "surface": site.surfaces, "area": site.areas, "target": site.targets,
        }  # fmt: skip
        found = False
        for kind, listed in known.items():
            if kind in names and (names[kind] in always or kind == "target"):
                found = True
                yield from ({names[kind]: name} for name in listed)
        if not found:
            yield {}
        if "x_m" in properties(self.declared[0]) and "yaw_rad" in properties(self.declared[0]):
            yield from ({"x_m": x, "y_m": y, "yaw_rad": 0.0} for x, y in self._points())

    def _points(self) -> Iterator[tuple[float, float]]:
        site = self.policies[0].site
        x0, y0, x1, y1 = site.bounds_m
        yield (x0 + x1) / 2, (y0 + y1) / 2
        yield x1 + 1.0, y1
        yield from (
            (sum(x for x, _ in zone.polygon) / len(zone.polygon), sum(y for _, y in zone.polygon) / len(zone.polygon))
            for zone in site.zones.values()
        )

    def _holdings(self) -> tuple[str | None, ...]:
        if "object" in self.references:
            return (None,)
        carries = "carrying" in self.declared[0].preconditions
        objects = tuple(self.policies[0].site.objects)
        return (*objects, None) if carries else (None, *objects)

    def _stand(self, params: Mapping[str, Any]) -> dict[str, str]:
        site = self.policies[0].site
        for kind, known in (("surface", site.surfaces), ("tool", site.tools), ("area", site.areas)):
            found = known.get(str(params.get(self.references.get(kind, ""))))
            if found is not None and found.target != site.start:
                return {"stand": found.target}
        return {}

    # -- contexts, and one or two things beside the plain -------------------------------------------------------------

    def _contexts(self) -> Iterator[dict[str, Any]]:
        objects, site = list(self.policies[0].site.objects), self.policies[0].site
        yield from ({name: False} for name in ("arm_ready", "sensors_fresh", "operator_on_duty", "online"))
        yield from ({"unseen": objects}, {"unreachable": objects}, {"latched": True}, {"busy": "inv_other"})
        yield from ({"agent": name} for policy in self.policies for name in (*policy.agents, "stranger", GOVERNANCE))
        held = sorted(self.policies[0].permissions)
        mine = [GOVERNANCE] if self.declared[0].recovery else []
        yield from ({"permissions": [other for other in held if other != name] + mine} for name in held)
        yield {"permissions": held + mine}
        yield from ({"stand": name} for name in site.targets)

    def _varied(self, example: Example) -> Iterator[Example]:
        for name, values in self.numbers.items():
            for value in values:
                yield {**example, "params": {**example["params"], name: value}}
        for name, text in self._texts():
            yield {**example, "params": {**example["params"], name: text}}
        for left in example["params"]:
            yield {**example, "params": {name: held for name, held in example["params"].items() if name != left}}
        yield from ({**example, "metadata": metadata} for metadata in self._metadata())
        yield {**example, "mode": Mode.CAREFUL.value}

    def _texts(self) -> Iterator[tuple[str, str]]:
        site = self.policies[0].site
        listed: Mapping[str, Iterable[str]] = {"corridor": site.corridors, "target": site.targets}
        for kind, name in self.references.items():
            yield from ((name, text) for text in listed.get(kind, ()))
            yield from ((name, text) for text in ("", "x", "x" * (LONG - 2), "x" * (LONG - 1), "x" * LONG))

    def _metadata(self) -> Iterator[dict[str, Any]]:
        yield from ({"confidence": value} for value in (0.0, 1.0))
        for rule in self._rules():
            for constant in self._constants(rule):
                yield from ({"confidence": value} for value in probes(constant) if 0.0 <= value <= 1.0)

    # -- numbers ------------------------------------------------------------------------------------------------------

    def _numbers(self) -> dict[str, list[float]]:
        """Return where every number is probed: on and beside what bounds it, in either policy."""
        found: dict[str, dict[float, None]] = {}
        for policy, declared in zip(self.policies, self.declared, strict=False):
            limits = policy.profiles[self.profile].limits
            for name, spec in properties(declared).items():
                if spec.get("type") not in ("number", "integer"):
                    continue
                bounds = [spec[key] for key in ("minimum", "maximum", "default") if key in spec]
                bounds += [limit.maximum for limit in limits.values() if limit.unit == spec.get("unit")]
                kept = found.setdefault(name, {})
                for bound in cast("list[float]", bounds):
                    kept.update(dict.fromkeys(probes(bound)))
        for rule in self._rules():
            for setting in rule.settings:
                bounds = [bound for bound in (setting.minimum, setting.maximum) if bound is not None]
                for bound in bounds if setting.param in found else ():
                    found[setting.param].update(dict.fromkeys(probes(bound)))
        return {name: list(values) for name, values in found.items()}

    def _rules(self) -> Iterator[Rule]:
        for policy in self.policies:
            yield from (
                rule for rule in policy.rules.values() if rule.profiles is None or self.profile in rule.profiles
            )

    def _constants(self, rule: Rule) -> Iterator[float]:
        if rule.when is None or (rule.applies_to is not None and self.capability not in rule.applies_to):
            return
        yield from _literals(self.vocabulary.typed(rule.when, self.capability, BOOL))


def _literals(typed: Typed) -> Iterator[float]:
    if isinstance(typed, Constant) and isinstance(typed.value, (int, float)) and not isinstance(typed.value, bool):
        yield float(typed.value)
    for child in children(typed):
        yield from _literals(child)
