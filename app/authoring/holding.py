"""Cases that hold a profile: what it just allows, changes, asks about and refuses, and what its sessions keep to.

Nothing of them is made up. Proposals that stand for the many there could be (`examples`) are decided as `reins policy
test` decides them, and what came of one is what its case expects:
1. for each capability, an ordinary proposal, with what its session would be held to
2. for each limit, and each bound of a rule, a proposal just beyond it, which it changes, and one right on it
3. for each other rule of the profile, a proposal that it determines
4. for each change of the profile that these do not notice (`mutation`), a proposal that does, where one is found
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

import yaml

from app.authoring.examples import Examples
from app.authoring.mutation import Fate, Trial
from app.authoring.numbers import probes
from app.authoring.rule_coverage import determining
from app.governance import cases
from app.governance.bundle_schema import KINDS
from app.governance.bundle_shapes import CaseShape
from app.governance.decision import decide
from app.governance.policy_code import limit_for
from app.governance.vocabulary import properties

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.authoring.mutants import Mutant
    from app.authoring.workbench import Workbench
    from app.governance.decision import Decision
    from app.governance.model import Context, Json, Proposal
    from app.governance.policy import Gate, PolicySet
    from app.governance.policy_model import Rule
    from app.governance.vocabulary import Vocabulary

Case: TypeAlias = dict[str, Any]

TRIED: Final = 1000
"""At so many examples of a capability the search for what its bounds and rules do gives up."""
_LAUNCHED: Final = frozenset({"allowed", "awaiting_approval"})
_NAME: Final = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """Cases of a profile.

    Attributes:
        text: the file of them.
        count: how many there are.
        noticed: the changes of the profile that one of them notices.
        missed: those that none of them does, and that are not shown to decide nothing.
    """

    text: str
    count: int
    noticed: int
    missed: tuple[Mutant, ...]


def hold(files: Mapping[str, str], profile: str) -> Held:
    """Return cases for a profile of a policy, true of it as it stands.

    Raises:
        PolicyErrors: something is wrong with the policy.
    """
    trial = Trial(files, {})
    documents = trial.bench.documents
    found = list(searched(trial.bench, profile))
    for case in found:
        trial.hold(profile, _shape(case))
    file = next(file for file, found in documents.items() if _named(found.value) == profile)
    noticed = 0
    missed: list[Mutant] = []
    for mutant in trial.mutants:
        if not _of(mutant, profile, file):
            continue
        outcome = trial.outcome(mutant)
        if outcome.proposal:
            case = _telling(outcome.proposal, mutant)
            trial.hold(profile, _shape(case))
            found.append(case)
        if outcome.proposal or outcome.fate is Fate.KILLED:
            noticed += 1
        elif outcome.fate is Fate.SURVIVED:
            missed.append(mutant)
    head = (
        f"{KINDS['cases'].modeline()}\n# Cases for profiles/{profile}.yaml. What they expect is what came of them when "
        "the profile was made:\n# read them, and change the profile where one says what it should not.\n"
    )
    return Held(
        text=head + _written({"profile": profile, "cases": found}),
        count=len(found),
        noticed=noticed,
        missed=tuple(missed),
    )


def searched(bench: Workbench, profile: str) -> Iterator[Case]:
    """Yield the first three kinds of cases, as they are written, without asking what they notice."""
    return _Searching(bench.policy, bench.known.vocabulary, profile).all()


def _of(mutant: Mutant, profile: str, file: str) -> bool:
    """Say whether a change is one of this profile: of its file, or of how a capability stands under it."""
    return mutant.file == file or mutant.path == ("env_profile", profile)


def _telling(proposal: str, mutant: Mutant) -> Case:
    (case,) = cast("list[Case]", yaml.safe_load(proposal)["cases"])
    case.pop("profile")
    return {**case, "name": f"notices {mutant.what} in {mutant.key}"[:_NAME]}


def _named(content: Json) -> Json:
    """Return the name of the profile that a file describes; null where it describes none."""
    return content.get("profile") if isinstance(content, dict) else None


def _shape(case: Case) -> CaseShape:
    return CaseShape.model_validate(case)


class _Plain(yaml.SafeDumper):
    """Writes every value out: policy files have no aliases."""

    def ignore_aliases(self, data: object) -> bool:
        """Say that nothing is referred to."""
        return True


def _written(content: Mapping[str, Any]) -> str:
    return yaml.dump(content, Dumper=_Plain, sort_keys=False, default_flow_style=None, width=10_000, allow_unicode=True)


# What bounds and rules do --------------------------------------------------------------------------------------------


class _Bound(NamedTuple):
    """What a limit or a rule holds a parameter to; `value` is None where that goes by the proposal."""

    rule: str
    param: str
    value: float | None


class _Searching:
    """Goes through the capabilities under one profile."""

    def __init__(self, policy: PolicySet, vocabulary: Vocabulary, profile: str) -> None:
        self._policy, self._vocabulary, self._profile = policy, vocabulary, profile
        self._shown: set[object] = set()
        self._model: Mapping[str, Any] | None = None  # what the first session is held to; others say what differs

    def all(self) -> Iterator[Case]:
        """Yield cases, capability by capability."""
        for name in sorted(self._policy.capabilities):
            yield from self._ordinary(name)
            gate = self._policy.gates.get((name, self._profile))
            if gate is not None:
                yield from self._ruled(gate)

    def _examples(self, name: str) -> Iterator[Case]:
        for example in islice(Examples([self._policy], self._vocabulary, name, self._profile), TRIED):
            yield {key: held for key, held in example.items() if key != "profile"}

    def _asked(self, example: Case) -> tuple[Proposal, Context] | None:
        """Return what an example asks; None where its parameters do not fit the capability, whatever the profile."""
        shape = _shape({**example, "name": "an example", "expect": {"status": "allowed"}})
        return cases.asking(self._policy, self._profile, shape)

    def _decided(self, example: Case) -> Decision | None:
        asked = self._asked(example)
        return None if asked is None else decide(self._policy, *asked)

    def _case(self, name: str, example: Case) -> Case:
        """Return a case of an example: what comes of it, who determines it, and what they change."""
        found = cases.came_of(self._policy, self._asked(example), session=False)
        keys = ("status", "policy", "determined_by", "changes") + (("approvers",) if found.get("approvers") else ())
        expect = {key: found[key] for key in keys if found.get(key) is not None}
        return {"name": name[:_NAME], **{key: held for key, held in example.items() if held != {}}, "expect": expect}

    def _ordinary(self, name: str) -> Iterator[Case]:
        launched = (one for one in self._examples(name) if (held := self._decided(one)) and held.status in _LAUNCHED)
        plain = next(launched, None) if (name, self._profile) in self._policy.gates else None
        if plain is None:
            yield from (self._case(f"refuses {name}", one) for one in islice(self._examples(name), 1))
            return
        case = self._case(f"what holds {name}", plain)
        session = cases.came_of(self._policy, self._asked(plain))["session"]
        told = session if self._model is None else _apart(session, self._model) | {"params": session["params"]}
        self._model = self._model or session
        case["expect"]["session"] = told
        yield case

    def _ruled(self, gate: Gate) -> Iterator[Case]:
        bounds = {bound for bound in self._bounds(gate) if bound not in self._shown}
        rules = {rule.id for rule in self._mine(gate) if rule.id not in self._shown}
        for example in self._examples(gate.capability.name):
            if not bounds and not rules:
                return
            decision = self._decided(example)
            told = set[str]() if decision is None else determining(self._policy, decision)
            verdict = None if decision is None else decision.verdict
            changes = {} if verdict is None else {change.param: change.effective for change in verdict.changes}
            for bound in sorted(bounds, key=str):
                if bound.rule in told and bound.param in changes and bound.value in (None, changes[bound.param]):
                    bounds.remove(bound)
                    self._shown |= {bound, bound.rule}
                    yield from self._beside(bound, example)
            for rule in sorted((told & rules) - self._shown):
                self._shown.add(rule)
                yield self._case(f"{rule.partition('/')[2]} decides {gate.capability.name}", example)
            rules -= self._shown  # pyright: ignore[reportAssignmentType]  # what is shown are bounds and rules

    def _mine(self, gate: Gate) -> Iterator[Rule]:
        """Return the rules that the profile itself has for a capability."""
        for rule in self._policy.rules.values():
            everywhere = rule.applies_to is None or gate.capability.name in rule.applies_to
            if everywhere and rule.id.startswith(f"{self._profile}/"):
                yield rule

    def _bounds(self, gate: Gate) -> Iterator[_Bound]:
        for param, spec in properties(gate.capability).items():
            limit = limit_for(spec, gate.profile.limits)
            if limit is not None:
                yield _Bound(f"{self._profile}/{limit.name}", param, limit.maximum)
        for rule in self._mine(gate):
            for setting in rule.settings:
                named = (setting.minimum, setting.maximum)
                values = [value for value in named if value is not None] if setting.to is None else [None]
                yield from (_Bound(rule.id, setting.param, value) for value in values)

    def _beside(self, bound: _Bound, example: Case) -> Iterator[Case]:
        """Yield a proposal as little beyond a bound as there is one that it changes, and the same right on it."""
        rule = bound.rule.partition("/")[2]
        if bound.value is None:
            yield self._case(f"{rule} sets {bound.param} of {example['capability']}", example)
            return
        tried = [{**example, "params": {**example["params"], bound.param: value}} for value in probes(bound.value)]
        on, *others = tried
        beyond = next((one for one in others if self._changed(one, bound)), example)
        yield self._case(f"{rule} changes {bound.param} of {example['capability']} beyond {bound.value:g}", beyond)
        if not self._changed(on, bound):
            yield self._case(f"{rule} leaves {bound.param} of {example['capability']} at {bound.value:g}", on)

    def _changed(self, example: Case, bound: _Bound) -> bool:
        decision = self._decided(example)
        if decision is None or decision.verdict is None:
            return False
        return any(one.param == bound.param and one.effective == bound.value for one in decision.verdict.changes)


def _apart(one: Mapping[str, Any], model: Mapping[str, Any]) -> dict[str, Any]:
    """Return wherein one session differs from another; null stands for what only the other has."""
    told: dict[str, Any] = {key: None for key in model if key not in one}
    for key, held in one.items():
        other = model.get(key)
        if held != other:
            both = isinstance(held, dict) and isinstance(other, dict)
            told[key] = _apart(cast("Mapping[str, Any]", held), cast("Mapping[str, Any]", other)) if both else held
    return told
