"""The shipped policy, loaded once, and contexts made the way cases make them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

from app.governance import bundle, cases
from app.governance.bundle_shapes import ContextShape
from app.governance.model import Context, Mode, Proposal
from app.governance.policy import PolicySet
from app.governance.policy_code import Generator
from app.governance.policy_model import Effect, Rule, Setting
from app.governance.vocabulary import Vocabulary

POLICIES = Path(__file__).parents[2] / "policies"
PROFILES = ("sim-relaxed", "test-audit", "real-restricted", "human-shared")  # from the widest to the strictest


@cache
def shipped() -> PolicySet:
    return bundle.load(POLICIES)


@cache
def _read() -> dict[str, str]:
    return bundle.read_files(POLICIES)


def files() -> dict[str, str]:
    """Return the shipped files: read once, for hundreds of tests that each change one of them."""
    return dict(_read())


def decided_by(capability: str, *more: Rule) -> PolicySet:
    """Return the shipped policy with further rules about a capability, unchecked: what must hold even of such rules."""
    policy = shipped()
    vocabulary = Vocabulary(policy.capabilities)
    gates = dict(policy.gates)
    for (name, profile), gate in policy.gates.items():
        if name == capability:
            rules = [
                rule
                for rule in (*policy.rules.values(), *more)
                if (rule.applies_to is None or name in rule.applies_to)
                and (rule.profiles is None or profile in rule.profiles)
            ]
            made = Generator(gate.capability, gate.profile, gate.site, vocabulary).compile(rules)
            gates[name, profile] = replace(gate, check=made.check, source=made.source)
    return replace(policy, gates=gates)


def modify(name: str, *settings: Setting, when: str | None = None) -> Rule:
    """Return a rule of the organization that modifies."""
    return Rule(
        id=f"organization/{name}", applies_to=None, profiles=None, when=when, then=Effect.MODIFY, settings=settings,
        approvers=0, because="So.", remedy="",
    )  # fmt: skip


def context(profile: str, **differs: object) -> Context:
    return cases.context(shipped(), profile, ContextShape(**differs))


def proposal(capability: str, *, metadata=None, mode=Mode.NORMAL, preconditions=(), **params: object) -> Proposal:
    filled = shipped().validate_params(capability, params)
    assert not isinstance(filled, tuple), filled
    return Proposal(
        capability=capability, params=filled, metadata=metadata or {}, mode=mode, preconditions=tuple(preconditions)
    )
