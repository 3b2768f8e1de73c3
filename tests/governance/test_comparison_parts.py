"""Which way every part of a policy goes, forwards and backwards; what is not known to be stricter counts as looser."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance import bundle
from app.governance.changes import LOOSENS, MAX_SHOWN, SAME, TIGHTENS, Comparison, Direction, Transition, summed
from app.governance.comparison import compare
from app.governance.model import AuthorityMode, Risk
from app.governance.policy import PolicySet
from app.governance.policy_model import Agent, Confirmation, Denial, Effect, Rule, Setting
from tests.governance.policy_world import files, modify, shipped

HERE = "human-shared"
RULE = modify("slow", Setting(param="speed_mps", maximum=0.2), when=None)
PLAIN = replace(shipped(), rules={RULE.id: RULE})  # no condition, so that each part speaks for itself
PROFILE, GRASP = PLAIN.profiles[HERE], PLAIN.capabilities["grasp_object"]
ASKS, GRANTS = PROFILE.approval, PLAIN.authority.grants
assert ASKS is not None
assert GRANTS is not None
BELOW = next(row for row in PROFILE.watch if not row.above)
ABOVE = next(row for row in PROFILE.watch if row.above)


def rule(**changes: Any) -> PolicySet:
    return rules(replace(RULE, **changes))


def rules(*given: Rule) -> PolicySet:
    return replace(PLAIN, rules={found.id: found for found in given})


def profile(**changes: Any) -> PolicySet:
    return replace(PLAIN, profiles={**PLAIN.profiles, HERE: replace(PROFILE, **changes)})


def grasp(**changes: Any) -> PolicySet:
    return replace(PLAIN, capabilities={**PLAIN.capabilities, "grasp_object": replace(GRASP, **changes)})


def approval(**changes: Any) -> PolicySet:
    return profile(approval=replace(ASKS, **changes))


def watch(row: Any, **changes: Any) -> PolicySet:
    changed = replace(row, **changes)
    return profile(watch=tuple(changed if found.id == row.id else found for found in PROFILE.watch))


def limit(name: str, **changes: Any) -> PolicySet:
    return profile(limits={**PROFILE.limits, name: replace(PROFILE.limits[name], **changes)})


def authority(**changes: Any) -> PolicySet:
    return replace(PLAIN, authority=replace(PLAIN.authority, **changes))


def agent(*permissions: str, supervised: frozenset[str] = frozenset()) -> PolicySet:
    return replace(PLAIN, agents={"planner": Agent(permissions=frozenset(permissions), supervised=supervised)})


def site(**changes: Any) -> PolicySet:
    return replace(PLAIN, site=replace(PLAIN.site, **changes))


def zones(kind: str) -> PolicySet:
    return site(zones={name: zone for name, zone in PLAIN.site.zones.items() if zone.kind != kind})


CONFIRM = (Confirmation(capability="grasp_object", profile=HERE, phases=("close",)),)
PHASE = f"profiles/{HERE}"
DARK = (replace(BELOW, id="dark"),)

# part, old, new, which way it goes, which way back
TABLE: list[tuple[str, PolicySet, PolicySet, Direction, Direction]] = [
    ("capabilities/grasp_object/risk", PLAIN, grasp(risk=Risk.HIGH), TIGHTENS, LOOSENS),
    ("capabilities/grasp_object/summary", PLAIN, grasp(summary="Take it."), SAME, SAME),
    ("capabilities/grasp_object/inputs", PLAIN, grasp(inputs={}), LOOSENS, LOOSENS),
    ("capabilities/grasp_object/timeout_s", PLAIN, grasp(timeout_s=1.0), TIGHTENS, LOOSENS),
    ("capabilities/grasp_object/preconditions", PLAIN, grasp(preconditions=()), LOOSENS, TIGHTENS),
    ("capabilities/grasp_object/permissions", PLAIN, grasp(permissions=frozenset({"hazmat"})), LOOSENS, LOOSENS),
    (f"capabilities/grasp_object/env_profile/{HERE}", PLAIN, grasp(env_profile={**GRASP.env_profile, HERE: "allowed"}), LOOSENS, TIGHTENS),
    ("capabilities/grasp_object/env_profile/sim-relaxed", PLAIN,
     grasp(env_profile={name: how for name, how in GRASP.env_profile.items() if name != "sim-relaxed"}), TIGHTENS, LOOSENS),
    ("capabilities/grasp_object", replace(PLAIN, capabilities={}), replace(PLAIN, capabilities={"grasp_object": GRASP}), LOOSENS, TIGHTENS),
    (PHASE, replace(PLAIN, profiles={}), replace(PLAIN, profiles={HERE: PROFILE}), LOOSENS, TIGHTENS),
    (f"{PHASE}/sensitivity", PLAIN, profile(sensitivity=0.95), TIGHTENS, LOOSENS),
    (f"{PHASE}/retry_budget", PLAIN, profile(retry_budget=2), LOOSENS, TIGHTENS),
    (f"{PHASE}/keep_every_tick", PLAIN, profile(keep_every_tick=True), TIGHTENS, LOOSENS),
    (f"{PHASE}/admits", PLAIN, profile(admits=frozenset()), TIGHTENS, LOOSENS),
    (f"{PHASE}/rollback", PLAIN, profile(rollback="optional"), LOOSENS, TIGHTENS),
    (f"{PHASE}/separation", PLAIN, profile(separation=None), LOOSENS, LOOSENS),
    (f"{PHASE}/limits/grip_force_n", profile(limits={}), profile(limits={"grip_force_n": PROFILE.limits["grip_force_n"]}), TIGHTENS, LOOSENS),
    (f"{PHASE}/limits/grip_force_n/maximum", PLAIN, limit("grip_force_n", maximum=10.0), TIGHTENS, LOOSENS),
    (f"{PHASE}/limits/grip_force_n/source", PLAIN, limit("grip_force_n", source="a book"), SAME, SAME),
    (f"{PHASE}/limits/grip_force_n/unit", PLAIN, limit("grip_force_n", unit="kN"), LOOSENS, LOOSENS),
    (f"{PHASE}/stale_after_ms/arm", PLAIN, profile(stale_after_ms={**PROFILE.stale_after_ms, "arm": 1}), TIGHTENS, LOOSENS),
    (f"{PHASE}/watch/dark", PLAIN, profile(watch=PROFILE.watch + DARK), TIGHTENS, LOOSENS),
    (f"{PHASE}/watch/{ABOVE.id}/times", PLAIN, watch(ABOVE, times=0.1), TIGHTENS, LOOSENS),
    (f"{PHASE}/watch/{BELOW.id}/times", PLAIN, watch(BELOW, times=0.1), LOOSENS, TIGHTENS),
    (f"{PHASE}/watch/{ABOVE.id}/for_ms", PLAIN, watch(ABOVE, for_ms=ABOVE.for_ms + 1), LOOSENS, TIGHTENS),
    (f"{PHASE}/watch/{ABOVE.id}/number", watch(ABOVE, number=2.0), watch(ABOVE, number=1.0), TIGHTENS, LOOSENS),
    (f"{PHASE}/watch/{ABOVE.id}/number", watch(ABOVE, number=None), watch(ABOVE, number=1.0), LOOSENS, LOOSENS),
    (f"{PHASE}/watch/{ABOVE.id}/applies_to", watch(ABOVE, applies_to=frozenset({"a"})), watch(ABOVE, applies_to=None), TIGHTENS, LOOSENS),
    (f"{PHASE}/approval", profile(approval=None), PLAIN, TIGHTENS, LOOSENS),
    (f"{PHASE}/approval/risks", PLAIN, approval(risks=frozenset(Risk)), TIGHTENS, LOOSENS),
    (f"{PHASE}/approval/approvers", PLAIN, approval(approvers={Risk.CRITICAL: 3}), TIGHTENS, LOOSENS),
    (f"{PHASE}/approval/on_timeout", PLAIN, approval(on_timeout="allow"), LOOSENS, LOOSENS),
    ("rules/organization/slow", rules(), PLAIN, TIGHTENS, LOOSENS),
    ("rules/organization/slow/then", PLAIN, rule(then=Effect.DENY, settings=()), TIGHTENS, LOOSENS),
    ("rules/organization/slow/when", rule(when="target.fragile"), PLAIN, TIGHTENS, LOOSENS),
    ("rules/organization/slow/because", PLAIN, rule(because="Else."), SAME, SAME),
    ("rules/organization/slow/approvers", PLAIN, rule(approvers=2), TIGHTENS, LOOSENS),
    ("rules/organization/slow/profiles", rule(profiles=frozenset({"a"})), rule(profiles=frozenset({"a", "b"})), TIGHTENS, LOOSENS),
    ("rules/organization/slow/profiles", rule(profiles=frozenset({"a"})), rule(profiles=frozenset({"b"})), LOOSENS, LOOSENS),
    ("rules/organization/slow/set/speed_mps/maximum", PLAIN, rule(settings=(Setting(param="speed_mps", maximum=0.1),)), TIGHTENS, LOOSENS),
    ("rules/organization/slow/set/speed_mps/minimum", PLAIN, rule(settings=(Setting(param="speed_mps", maximum=0.2, minimum=0.1),)), TIGHTENS, LOOSENS),
    ("rules/organization/slow/set/speed_mps/to", PLAIN, rule(settings=(Setting(param="speed_mps", maximum=0.2, to="x"),)), LOOSENS, LOOSENS),
    ("rules/organization/slow/set/force_n", PLAIN, rule(settings=(*RULE.settings, Setting(param="force_n", maximum=1.0))), TIGHTENS, LOOSENS),
    ("agents/planner", replace(PLAIN, agents={}), agent("navigation"), LOOSENS, TIGHTENS),
    ("agents/planner/permissions", agent("a", "b"), agent("a"), TIGHTENS, LOOSENS),
    ("agents/planner/permissions", agent("a"), agent("b"), LOOSENS, LOOSENS),
    ("agents/planner/supervised", agent("a"), agent("a", supervised=frozenset({"b"})), LOOSENS, TIGHTENS),
    ("authority/within_s", PLAIN, authority(within_s=1.0), TIGHTENS, LOOSENS),
    ("authority/confirm_before", PLAIN, authority(confirm_before=CONFIRM), TIGHTENS, LOOSENS),
    ("authority/denials", PLAIN, authority(denials=(Denial(code="x", says="x", remedy="x"),)), SAME, SAME),
    ("authority/on_timeout", PLAIN, authority(on_timeout="rollback"), LOOSENS, LOOSENS),
    ("authority/grants", PLAIN, authority(grants=None), TIGHTENS, LOOSENS),
    ("authority/grants/up_to_s", PLAIN, authority(grants=replace(GRANTS, up_to_s=1.0)), TIGHTENS, LOOSENS),
    ("authority/grants/risks", PLAIN, authority(grants=replace(GRANTS, risks=frozenset())), TIGHTENS, LOOSENS),
    ("site/zones/press_area", zones("forbidden"), PLAIN, TIGHTENS, LOOSENS),
    ("site/zones/aisle", zones("shared"), PLAIN, LOOSENS, TIGHTENS),
    ("site/targets/dock", site(targets={}), site(targets={"dock": PLAIN.site.targets["dock"]}), LOOSENS, TIGHTENS),
    ("site/targets/dock", PLAIN, site(targets={**PLAIN.site.targets, "dock": replace(PLAIN.site.targets["dock"], x_m=9.0)}), LOOSENS, LOOSENS),
    ("capabilities/grasp_object/preconditions", PLAIN, grasp(preconditions=GRASP.preconditions[::-1]), SAME, SAME),
    (f"{PHASE}/admits", PLAIN, profile(admits=tuple(PROFILE.admits)), SAME, SAME),
    ("permissions", PLAIN, replace(PLAIN, permissions=frozenset({"a"})), SAME, SAME),
    ("site/start", PLAIN, site(start="dock"), LOOSENS, LOOSENS),
]  # fmt: skip


@pytest.mark.parametrize(("part", "old", "new", "way", "back"), TABLE, ids=[f"{row[0]}-{row[3]}" for row in TABLE])
def test_a_part_goes_the_way_it_does_and_another_way_back(
    part: str, old: PolicySet, new: PolicySet, way: Direction, back: Direction
) -> None:
    for before, after, expected in ((old, new, way), (new, old, back)):
        found = compare(before, after)
        assert {known.part: known.direction for known in found.differences}.get(part) is expected
        assert found.loosens is (found.direction in (LOOSENS, Direction.BOTH))
        assert found.tightens is (found.direction is not SAME)


def test_authority_that_comes_or_goes_with_nothing_before_and_after_is_the_same() -> None:
    nobody = profile(approval=None)
    assert compare(nobody, replace(nobody, digest="other")).direction is SAME
    ungranted = authority(grants=None)
    assert compare(ungranted, replace(ungranted, authority=replace(ungranted.authority))).differences == ()
    silent = replace(nobody.profiles[HERE], sensitivity=1.0)
    (only,) = compare(nobody, replace(nobody, profiles={**nobody.profiles, HERE: silent})).differences
    assert only.part == f"{PHASE}/sensitivity"


CONDITIONED = [
    ("limits.grip_force_n > 20.0", limit("grip_force_n", maximum=10.0), LOOSENS),
    ("limits.grip_force_newton > 20.0", limit("grip_force_n", maximum=10.0), TIGHTENS),
    ("profile.sensitivity > 0.5", profile(sensitivity=0.95), LOOSENS),
    ('capability.risk == "low"', grasp(risk=Risk.HIGH), LOOSENS),
    ("target.fragile", grasp(risk=Risk.HIGH), TIGHTENS),
    ('"manipulation" in agent.permissions', agent("navigation"), LOOSENS),
    ('"hazmat" in agent.permissions', agent("navigation"), TIGHTENS),
    ("size(agent.permissions) > 2", agent("navigation"), LOOSENS),
]


@pytest.mark.parametrize(("when", "new", "way"), CONDITIONED)
def test_what_a_condition_reads_is_not_known_to_tighten(when: str, new: PolicySet, way: Direction) -> None:
    asking = {RULE.id: replace(RULE, when=when)}
    assert compare(replace(PLAIN, rules=asking), replace(new, rules=asking)).direction is way


MODES = st.frozensets(st.sampled_from(AuthorityMode))


@given(before=MODES, after=MODES)
def test_modes_tighten_only_where_nobody_gains_a_say_or_loses_the_pause(
    before: frozenset[AuthorityMode], after: frozenset[AuthorityMode]
) -> None:
    way = compare(profile(authority=before), profile(authority=after)).direction
    asked = {AuthorityMode.APPROVAL_REQUIRED, AuthorityMode.APPROVAL_ON_ESCALATION}
    if before == after:
        assert way is SAME
        return
    safe = (
        AuthorityMode.APPROVAL_ON_ESCALATION not in after - before
        and AuthorityMode.TAKEOVER_ENABLED not in after - before
        and not (before.isdisjoint(asked) and not after.isdisjoint(asked))
        and before - after <= {AuthorityMode.TAKEOVER_ENABLED}
    )
    assert way is (TIGHTENS if safe else LOOSENS)


LIMITS = st.floats(1, 100)


@given(grip=st.tuples(LIMITS, LIMITS), contact=st.tuples(LIMITS, LIMITS))
def test_two_limits_come_to_one_direction_and_the_other_way_round_to_its_opposite(
    grip: tuple[float, float], contact: tuple[float, float]
) -> None:
    def held(place: int) -> PolicySet:
        numbers = {"grip_force_n": grip[place], "contact_force_n": contact[place]}
        return profile(limits={name: replace(PROFILE.limits[name], maximum=value) for name, value in numbers.items()})

    lower = {after < before for before, after in (grip, contact) if before != after}
    expected = {frozenset(): SAME, frozenset({True}): TIGHTENS, frozenset({False}): LOOSENS}.get(
        frozenset(lower), Direction.BOTH
    )
    opposite = {TIGHTENS: LOOSENS, LOOSENS: TIGHTENS}
    assert compare(held(0), held(1)).direction is expected
    assert compare(held(1), held(0)).direction is opposite.get(expected, expected)


def test_shows_values_as_people_read_them_and_no_longer_than_a_line() -> None:
    found = compare(agent("b", "a"), agent(*(f"permission_{number:03}" for number in range(99))))
    (only,) = found.differences
    assert only.before == "a, b"
    assert len(only.after) == MAX_SHOWN
    assert only.after.endswith("…")
    (tuples,) = compare(PLAIN, grasp(preconditions=("gripper_empty", "arm_ready"))).differences
    assert tuples.after == "gripper_empty, arm_ready"
    said = {"direction": "loosens", "proved": False, "differences": [only._asdict()], "decisions": []}
    assert found.document() == said
    (gone,) = compare(PLAIN, authority(grants=None)).differences
    assert gone.after == ""
    assert gone.before == "up_to_s: 900.0, risks: [high, medium]"


SEPARATION = "  reaction_s: 0.1\n"
ROWS = "  - on: contact\n    do: [ask_human]\n", "  - on: contact\n    do: [retry, ask_human]\n"
NEW_ROW = "  - on: retries_exhausted\n    do: [ask_human]\n"


@pytest.mark.parametrize(
    ("old", "new", "before", "after"),
    [
        (SEPARATION, "  reaction_s: 0.09\n", "reaction_s: 0.1", "reaction_s: 0.09"),
        (*ROWS, "rule: {on: contact, do: [ASK_HUMAN]", "rule: {on: contact, do: [RETRY, ASK_HUMAN]"),
        (ROWS[0], "", "rule: {on: contact, do: [ASK_HUMAN]", "no row"),
        ("  - on: any\n", f"{NEW_ROW}  - on: any\n", "no row", "rule: {on: retries_exhausted, do: [ASK_HUMAN]"),
        ("critical: 2}}", "high: 2, critical: 2}}", "critical: 2", "high: 2, critical: 2"),
    ],
)
def test_of_many_parts_shows_the_one_that_is_another(old: str, new: str, before: str, after: str) -> None:
    text = files()["profiles/human-shared.yaml"]
    assert text.count(old) == 1
    changed = bundle.load_files({**files(), "profiles/human-shared.yaml": text.replace(old, new)})
    (only,) = compare(bundle.load_files(files()), changed).differences
    assert only.before.startswith(before)
    assert only.after.startswith(after)
    assert max(len(only.before), len(only.after)) < MAX_SHOWN


def test_a_decision_that_comes_out_otherwise_counts_like_a_part_and_survives_being_written_down() -> None:
    more = Transition("grasp_object", HERE, "deny -> allow", LOOSENS, True, "it is", "cases: []", {"params": {}})
    found = summed(iter([("a", 1, 2, TIGHTENS)]), (more,), proved=True)
    assert (found.direction, found.proved, found.decisions) == (Direction.BOTH, True, (more,))
    assert Comparison.read(found.document()) == found


def test_the_record_of_a_comparison_leaves_out_its_examples_and_nothing_else() -> None:
    more = Transition("grasp_object", HERE, "deny -> allow", LOOSENS, True, "it is", "cases: []", {"params": {}})
    found = summed(iter([("a", 1, 2, TIGHTENS)]), (more,), proved=True)
    (kept,) = found.brief()["decisions"]
    assert kept == {**more._asdict(), "example": "", "body": {}}
    assert {**found.brief(), "decisions": []} == {**found.document(), "decisions": []}
