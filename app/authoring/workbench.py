"""A policy that one thing is changed in at a time: what a change leaves as it was is neither read nor compiled again.

The result is what `bundle.load_files` would make of the changed files (tests compare the two), but for the digest: a
changed set still bears that of the original, so that grants and records bound to it mean the same in both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from app.governance import bundle, bundle_build, bundle_checks, bundle_checks_profile, bundle_checks_site
from app.governance import bundle_shapes as shapes
from app.governance.bundle_checks import Known
from app.governance.bundle_fit import fit
from app.governance.bundle_yaml import Reader
from app.governance.errors import PolicyErrors
from app.governance.policy import Gate, PolicySet

if TYPE_CHECKING:
    from app.authoring.mutants import Mutant
    from app.governance.errors import PolicyError
    from app.governance.model import Capability
    from app.governance.policy_model import Profile, Rule
    from app.governance.vocabulary import Vocabulary

Pair: TypeAlias = "tuple[str, str]"


class Workbench:
    """One policy, and what there is to make changed ones of it quickly.

    Attributes:
        policy: The policy as it stands.
        documents: Its files by path, parsed.
        known: What it declares.
    """

    def __init__(self, files: Mapping[str, str]) -> None:
        """Load a policy.

        Raises:
            PolicyErrors: Something is wrong with it; everything that is.
        """
        self.policy = bundle.load_files(files)
        self._source = bundle.read_shapes(files)
        self.known = bundle.know(self._source)
        self.documents = {
            reader.document.file: reader.document
            for reader, _ in (*self._source.capabilities, *self._source.profiles, *self._source.single.values())
        }

    def changed(self, mutant: Mutant) -> PolicySet:
        """Return the policy with one change in it.

        Raises:
            PolicyErrors: What the change makes of it would not be loaded.
        """
        document = self.documents[mutant.file]
        other = replace(document, value=mutant.applied(document.value))
        shape, misfits = fit(bundle.shape_of(mutant.file), other)  # pyright: ignore[reportArgumentType]  # it was loaded
        if shape is None:
            raise PolicyErrors(misfits)
        reader = Reader(document=other)
        match shape:
            case shapes.CapabilityShape():
                return self._with_capability(reader, shape)
            case shapes.ProfileShape():
                return self._with_profile(reader, shape)
            case _:
                return self._with_single(mutant.file, reader, shape)

    def _with_capability(self, reader: Reader, shape: shapes.CapabilityShape) -> PolicySet:
        found = bundle_build.capability(shape)
        _refuse([*bundle_checks.inputs(reader, shape)])
        _refuse([*bundle_checks.vocabulary(reader, found)])
        policy = self.policy
        capabilities = {**policy.capabilities, shape.name: found}
        known = replace(
            self.known,
            capabilities=capabilities,
            recoveries=frozenset(name for name, held in capabilities.items() if held.recovery),
            vocabulary=self._vocabulary(found),
        )
        listed = [(held, was) if was.name != shape.name else (reader, shape) for held, was in self._source.capabilities]
        _refuse(bundle.check(replace(self._source, capabilities=listed), known))
        inputs = {**policy.inputs, shape.name: bundle.make_inputs(found)}
        return self._made(replace(policy, capabilities=capabilities, inputs=inputs), known)

    def _vocabulary(self, found: Capability) -> Vocabulary:
        known = self.known
        return (
            known.vocabulary
            if known.capabilities[found.name].inputs == found.inputs
            else known.vocabulary.replacing(found)
        )

    def _with_profile(self, reader: Reader, shape: shapes.ProfileShape) -> PolicySet:
        known = replace(self.known, modes={**self.known.modes, shape.profile: frozenset(shape.authority.modes)})
        _refuse([
            *bundle_checks_profile.profile(reader, shape, known),
            *bundle_checks.rules(reader, shape.rules, known),
            *bundle_checks_site.authority(*self._source.authority, known),
        ])  # fmt: skip
        policy = self.policy
        mine = [bundle_build.rule(shape.profile, rule, frozenset({shape.profile})) for rule in shape.rules]
        profiles = {**policy.profiles, shape.profile: bundle_build.profile(shape)}
        return self._made(replace(policy, profiles=profiles, rules=self._rules(shape.profile, mine)), known)

    def _with_single(self, file: str, reader: Reader, shape: shapes.Shape) -> PolicySet:
        source = replace(self._source, single={**self._source.single, file: (reader, shape)})
        known = self.known
        match shape:
            case shapes.OrganizationShape():
                if frozenset(shape.permissions) != known.permissions:
                    known = bundle.know(source)
                    _refuse(bundle.check(source, known))
                _refuse([*bundle_checks_site.organization(reader, shape)])
                owner, changed = (
                    "organization",
                    {"agents": bundle_build.agents(shape), "permissions": known.permissions},
                )
            case shapes.AuthorityFileShape():
                _refuse([*bundle_checks_site.authority(reader, shape, known)])
                owner, changed = "authority", {"authority": bundle_build.authority(shape)}
            case _:
                raise TypeError(f"`{file}` is not changed here")
        _refuse([*bundle_checks.rules(reader, shape.rules, known)])
        rules = [
            bundle_build.rule(owner, rule, None if rule.profiles is None else frozenset(rule.profiles))
            for rule in shape.rules
        ]
        return self._made(replace(self.policy, rules=self._rules(owner, rules), **changed), known)

    def _rules(self, owner: str, rules: list[Rule]) -> dict[str, Rule]:
        """Return all rules, one owner's exchanged; those that did not change stay the very same objects."""
        kept: dict[str, list[Rule]] = {name: [] for name in (*self.policy.profiles, "organization", "authority")}
        for rule in self.policy.rules.values():
            kept[rule.id.partition("/")[0]].append(rule)
        was = {rule.id: rule for rule in kept[owner]}
        kept[owner] = [was[rule.id] if was.get(rule.id) == rule else rule for rule in rules]
        return {rule.id: rule for name in kept for rule in kept[name]}

    def _made(self, policy: PolicySet, known: Known) -> PolicySet:
        return replace(policy, gates=_Gates(policy, known, self.policy))


def _refuse(problems: list[PolicyError]) -> None:
    if problems:
        raise PolicyErrors(problems)


class _Gates(Mapping["Pair", Gate]):
    """The pairs of a changed policy, each compiled when it is first asked for; one that did not change is not."""

    def __init__(self, policy: PolicySet, known: Known, original: PolicySet) -> None:
        self._policy, self._known, self._original = policy, known, original
        self._made: dict[Pair, Gate] = {}

    def __contains__(self, pair: object) -> bool:
        name, profile = pair  # pyright: ignore[reportGeneralTypeIssues, reportUnknownVariableType]  # a mapping's key
        found = self._policy.capabilities.get(name)  # pyright: ignore[reportUnknownArgumentType]
        return found is not None and found.env_profile.get(profile, "forbidden") != "forbidden"  # pyright: ignore[reportUnknownArgumentType]

    def __getitem__(self, pair: Pair) -> Gate:
        if pair not in self._made:
            if pair not in self:
                raise KeyError(pair)
            self._made[pair] = self._gate(*pair)
        return self._made[pair]

    def __iter__(self) -> Iterator[Pair]:
        return (
            pair
            for name in self._policy.capabilities
            for profile in self._policy.profiles
            if (pair := (name, profile)) in self
        )

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _gate(self, name: str, profile: str) -> Gate:
        now, was = self._policy, self._original.gates.get((name, profile))
        capability, environment = now.capabilities[name], now.profiles[profile]
        rules = _applying(now, name, profile)
        if (
            was is not None
            and was.capability is capability
            and _same_checked(was.profile, environment)
            and rules == _applying(self._original, name, profile)
        ):
            return replace(was, profile=environment)
        return bundle.make_gate(capability, environment, rules, now.site, self._known.vocabulary)


def _applying(policy: PolicySet, capability: str, profile: str) -> list[Rule]:
    return [
        rule
        for rule in policy.rules.values()
        if (rule.applies_to is None or capability in rule.applies_to)
        and (rule.profiles is None or profile in rule.profiles)
    ]


def _same_checked(one: Profile, other: Profile) -> bool:
    """Say whether two profiles are the same in what a compiled check reads of them."""
    return (one.limits, one.sensitivity, one.shared_floor) == (other.limits, other.sensitivity, other.shared_floor)


__all__ = ["Workbench"]
