"""The shipped policy with something planted in it, and what proofs say of it."""

from __future__ import annotations

from functools import cache

from app.governance import bundle
from app.governance.policy import PolicySet
from app.proofs.prove import Report, prove
from tests.governance.policy_world import POLICIES, files

ORGANIZATION, HUMAN, REAL = "organization.yaml", "profiles/human-shared.yaml", "profiles/real-restricted.yaml"
SIM = "profiles/sim-relaxed.yaml"


def standing() -> float:
    """Tell the same time for ever: what a test asks is bounded by effort alone, however busy the machine is."""
    return 0.0


@cache
def promises() -> str:
    text = bundle.read_properties(POLICIES)
    assert text is not None
    return text


def proved(changed: dict[str, str], properties: str | None = None) -> Report:
    return proved_of(bundle.load_files({**files(), **changed}), properties)


def proved_of(policy: PolicySet, properties: str | None = None) -> Report:
    return prove(policy, promises() if properties is None else properties, now=standing)


def with_rules(rules: str, file: str = ORGANIZATION) -> dict[str, str]:
    """Put further rules at the head of a file's rules."""
    text = files()[file]
    assert "\nrules:" in text
    text = text.replace("\nrules: []", "\nrules:")
    return {file: text.replace("\nrules:\n", f"\nrules:\n{rules.strip(chr(10))}\n", 1)}


def edited(file: str, old: str, new: str) -> dict[str, str]:
    text = files()[file]
    assert old in text, (file, old)
    return {file: text.replace(old, new)}
