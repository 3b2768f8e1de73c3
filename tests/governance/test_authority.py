"""The five modes of authority: what each leaves to humans, and what is refused without it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.governance.authority import allows, refusal
from app.governance.model import AuthorityMode
from app.governance.policy import PolicySet
from tests.governance.policy_world import PROFILES, shipped

INTERRUPT, TAKEOVER, REVIEW = (
    AuthorityMode.INTERRUPT_ENABLED,
    AuthorityMode.TAKEOVER_ENABLED,
    AuthorityMode.REVIEW_ONLY,
)


def under(profile: str, *modes: AuthorityMode) -> PolicySet:
    """Return the shipped policy with other modes in one profile."""
    policy = shipped()
    changed = replace(policy.profiles[profile], authority=frozenset(modes))
    return replace(policy, profiles={**policy.profiles, profile: changed})


def test_every_shipped_profile_may_be_interrupted():
    assert all(allows(shipped(), profile, INTERRUPT) for profile in PROFILES)


def test_the_controls_are_taken_only_where_people_are_on_duty():
    assert [allows(shipped(), profile, TAKEOVER) for profile in PROFILES] == [False, False, True, True]
    assert [allows(shipped(), profile, REVIEW) for profile in PROFILES] == [True, True, False, False]


@pytest.mark.parametrize(
    ("mode", "code"),
    [
        (INTERRUPT, "interrupt_not_enabled"),
        (TAKEOVER, "takeover_not_enabled"),
        (REVIEW, "review_not_enabled"),
        (AuthorityMode.APPROVAL_REQUIRED, "approval_not_enabled"),
        (AuthorityMode.APPROVAL_ON_ESCALATION, "approval_not_enabled"),
    ],
)
def test_a_mode_that_is_missing_refuses_by_its_own_code(mode, code):
    others = [other for other in AuthorityMode if other is not mode]
    refused = refusal(under("human-shared", *others), "human-shared", mode)
    assert refused is not None
    assert (refused.rule, refused.code) == ("human-shared/authority", code)
    assert "`human-shared`" in refused.message
    assert refusal(under("human-shared", mode), "human-shared", mode) is None


def test_a_profile_that_policy_does_not_know_has_no_mode():
    assert not any(allows(shipped(), "long-gone", mode) for mode in AuthorityMode)
