"""The shipped policy, loaded once, and contexts made the way cases make them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from app.governance import bundle, cases
from app.governance.bundle_shapes import ContextShape
from app.governance.model import Context, Mode, Proposal
from app.governance.policy import PolicySet

POLICIES = Path(__file__).parents[2] / "policies"
PROFILES = ("sim-relaxed", "test-audit", "real-restricted", "human-shared")  # from the widest to the strictest


@cache
def shipped() -> PolicySet:
    return bundle.load(POLICIES)


def files() -> dict[str, str]:
    return bundle.read_files(POLICIES)


def context(profile: str, **differs: object) -> Context:
    return cases.context(shipped(), profile, ContextShape(**differs))


def proposal(capability: str, *, metadata=None, mode=Mode.NORMAL, preconditions=(), **params: object) -> Proposal:
    filled = shipped().validate_params(capability, params)
    assert not isinstance(filled, tuple), filled
    return Proposal(
        capability=capability, params=filled, metadata=metadata or {}, mode=mode, preconditions=tuple(preconditions)
    )
