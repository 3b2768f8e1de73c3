"""What runs goes on under another policy only where that policy says nothing stricter about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.governance import bundle
from app.governance.continuing import CONFORMS, GONE, Departure, departure, not_comparable
from app.governance.coverage import covered_recoveries
from app.governance.model import AuthorityMode, Context, CoveredRecovery, Mode, Proposal
from app.governance.policy import PolicySet
from app.governance.policy_model import Agent, Confirmation
from tests.governance.policy_world import context, files, proposal, shipped

HERE = "human-shared"
SHARED, ORGANIZATION = f"profiles/{HERE}.yaml", "organization.yaml"
GRASP = proposal("grasp_object", object_id="mug_1", force_n=40, speed_mps=0.2)


@cache
def edited(*edits: tuple[str, str, str]) -> PolicySet:
    changed = files()
    for name, before, after in edits:
        assert before in changed[name], f"`{before}` is not in `{name}`"
        changed[name] = changed[name].replace(before, after, 1)
    return bundle.load_files(changed)


def with_rule(text: str) -> PolicySet:
    return edited((ORGANIZATION, "rules:\n", f"rules:\n  - {{{text}}}\n"))


def with_profile(policy: PolicySet | None = None, **changes: Any) -> PolicySet:
    policy = policy or shipped()
    profile = replace(policy.profiles[HERE], **changes)
    gates = {pair: replace(gate, profile=profile) if pair[1] == HERE else gate for pair, gate in policy.gates.items()}
    return replace(policy, profiles={**policy.profiles, HERE: profile}, gates=gates)


def with_watch(row: str, **changes: Any) -> PolicySet:
    rows = shipped().profiles[HERE].watch
    assert any(found.id == row for found in rows)
    return with_profile(watch=tuple(replace(found, **changes) if found.id == row else found for found in rows))


def with_capability(**changes: Any) -> PolicySet:
    policy = shipped()
    return replace(
        policy,
        capabilities={**policy.capabilities, "grasp_object": replace(policy.capabilities["grasp_object"], **changes)},
    )


def between(
    old: PolicySet | None,
    new: PolicySet,
    what: Proposal = GRASP,
    now: Context | None = None,
    covered: tuple[CoveredRecovery, ...] | None = None,
    **named: Any,
) -> Departure:
    """Ask as the runtime does: the agent is the one that the new policy knows."""
    now = now or context(HERE)
    return departure(old, new, what, replace(now, agent=new.agent("planner")), covered, **named)


def codes(found: Departure) -> list[str]:
    return [reason.code for reason in found.reasons]


def test_under_the_same_policy_everything_goes_on_whatever_the_world_has_become() -> None:
    assert between(shipped(), shipped()) is CONFORMS
    assert not CONFORMS
    held = context(HERE, holding="mug_1", arm_ready=False)
    assert between(shipped(), shipped(), now=held) is CONFORMS, "a precondition of the launch need not hold any more"
    assert between(shipped(), shipped(), now=context(HERE, latched=True)) is CONFORMS, "both say so"


def test_a_session_whose_policy_nobody_knows_departs_from_any() -> None:
    found = between(None, shipped())
    assert found.reasons[-1] == GONE
    assert not found.askable
    unknown = replace(GRASP, params={**GRASP.params, "object_id": "ghost"})
    assert codes(between(None, shipped(), unknown)) == ["unknown_object", "its_policy_is_gone"]
    nowhere = replace(shipped(), gates={})
    assert codes(between(nowhere, shipped())) == ["its_policy_is_gone"]


RENAMED = tuple(
    ("capabilities/operate_tool.yaml", before, after)
    for before, after in (("[tool, action]", "[device, action]"), ("    tool: {", "    device: {"))
)
PULL = proposal("operate_tool", tool="lever", action="pull_down", force_n=60, speed_mps=0.1)


def test_departs_when_its_capability_takes_other_parameters_by_now() -> None:
    other = edited(*RENAMED)
    for old in (shipped(), None):
        found = between(old, other, PULL)
        assert set(codes(found)) == {"params_invalid"}
        assert not found.askable
        takes = "`operate_tool` takes other parameters now: "
        said = {reason.message.removeprefix(takes) for reason in found.reasons}
        assert said == {"`device` is missing", "`tool` is unknown"}
    slow = replace(GRASP, params={**GRASP.params, "speed_mps": 0.01})
    assert between(shipped(), with_profile(), slow) is CONFORMS, "policy has held it to less than its capability takes"


def test_departs_when_what_recovers_it_takes_other_parameters_by_now() -> None:
    other = edited(
        ("capabilities/release_and_retract.yaml", "    speed_mps: {", "    pace_mps: {"),
    )
    found = between(shipped(), other, covered=permitted(shipped()))
    assert set(codes(found)) == {"params_invalid"}
    assert "`release_and_retract` takes other parameters now" in found.reasons[0].message


@pytest.mark.parametrize(
    ("what", "part", "before", "after"),
    [
        (proposal("navigate_to", target="dock", clearance_m=0.3), "dock", "dock: {x_m: 0.8", "dock: {x_m: 1.0"),
        (proposal("navigate_to", x_m=2, y_m=2, yaw_rad=0, corridor="aisle"), "aisle", "[3.4, 3.6]", "[3.4, 3.7]"),
        (proposal("place_object", surface="bench_a"), "bench_a", "y_m: 5.4, z_m: 0.75", "y_m: 5.4, z_m: 0.7"),
        (proposal("inspect_area", area="bench_a_top"), "bench_a_top", "[2.3, 5.75]", "[2.3, 5.7]"),
        (PULL, "lever", "lever, x_m: 3.15", "lever, x_m: 3.2"),
    ],
    ids=["target", "corridor", "surface", "area", "tool"],
)
def test_departs_when_where_it_works_is_another_place_by_now(
    what: Proposal, part: str, before: str, after: str
) -> None:
    filled = shipped().validate_params(what.capability, what.params)
    assert not isinstance(filled, tuple)
    other = edited(("site.yaml", before, after))
    found = between(shipped(), other, replace(what, params=filled))
    assert ("place_changed" in codes(found), found.askable) == (True, False)
    assert f"`{part}`" in next(why.message for why in found.reasons if why.code == "place_changed")


WET = "zones:\n", "zones:\n  wet: {kind: restricted, polygon: [[1.0, 1.5], [4.0, 1.5], [4.0, 2.5], [1.0, 2.5]]}\n"


@pytest.mark.parametrize(
    ("what", "before", "after"),
    [
        ("bench_b", "bench_b: {x_m: 5.2, y_m: 5.4", "bench_b: {x_m: 5.2, y_m: 5.0"),
        ("lever", "lever, x_m: 3.15", "lever, x_m: 3.2"),
        ("wet", *WET),
        ("bounds_m", "bounds_m: [0.0, 0.0, 8.0", "bounds_m: [0.0, 0.0, 7.9"),
    ],
    ids=["furniture", "tool", "zone", "walls"],
)
def test_what_drives_departs_when_something_is_in_its_way_by_now_and_what_stands_still_does_not(
    what: str, before: str, after: str
) -> None:
    other = edited(("site.yaml", before, after))
    drive = shipped().validate_params("navigate_to", {"target": "dock", "clearance_m": 0.3})
    assert not isinstance(drive, tuple)
    found = between(shipped(), other, Proposal(capability="navigate_to", params=drive))
    assert what in {why.message.split("`")[1] for why in found.reasons if why.code == "place_changed"}
    assert not found.askable
    assert "place_changed" not in codes(between(shipped(), other))


def test_a_zone_that_is_called_as_what_stands_in_it_hides_nothing_that_was_moved() -> None:
    named = edited(("site.yaml", "  store: {kind: restricted", "  bench_b: {kind: restricted"))
    moved = edited(
        ("site.yaml", "  store: {kind: restricted", "  bench_b: {kind: restricted"),
        ("site.yaml", "bench_b: {x_m: 5.2, y_m: 5.4", "bench_b: {x_m: 5.2, y_m: 5.0"),
    )
    drive = named.validate_params("navigate_to", {"target": "dock", "clearance_m": 0.3})
    assert not isinstance(drive, tuple)
    found = between(named, moved, Proposal(capability="navigate_to", params=drive))
    assert "place_changed" in codes(found)


@pytest.mark.parametrize(
    ("what", "before", "after"),
    [
        ("bench_a", "bench_a: {x_m: 1.6, y_m: 5.4", "bench_a: {x_m: 1.6, y_m: 5.3"),
        ("bench_a_stand", "bench_a_stand: {x_m: 1.6, y_m: 4.6", "bench_a_stand: {x_m: 1.8, y_m: 4.6"),
        ("lever", "lever, x_m: 3.15, y_m: 0.64", "lever, x_m: 2.5, y_m: 4.6"),
        (
            "wet",
            "zones:\n",
            "zones:\n  wet: {kind: restricted, polygon: [[0.0, 3.0], [4.0, 3.0], [4.0, 3.5], [0.0, 3.5]]}\n",
        ),
        ("bounds_m", "bounds_m: [0.0, 0.0, 8.0, 6.0]", "bounds_m: [0.5, 0.0, 8.0, 6.0]"),
    ],
)
def test_what_stands_departs_when_something_is_in_the_way_of_what_recovers_it(
    what: str, before: str, after: str
) -> None:
    other = edited(("site.yaml", before, after))
    found = between(shipped(), other, covered=permitted(shipped()))
    assert what in {why.message.split("`")[1] for why in found.reasons if why.code == "place_changed"}
    assert not found.askable
    assert "place_changed" not in codes(between(shipped(), other, covered=())), "nothing recovers it by itself"
    here = context(HERE)
    assert here.cell.facts is not None
    far, unseen = (
        replace(here, cell=replace(here.cell, facts=facts))
        for facts in (replace(here.cell.facts, base=(5.5, 1.9, 0.0)), None)
    )
    assert "place_changed" not in codes(between(shipped(), other, now=far, covered=permitted(shipped())))
    assert "place_changed" in codes(between(shipped(), other, now=unseen, covered=permitted(shipped())))


@pytest.mark.parametrize("led", [False, True])
def test_what_a_hand_has_led_departs_when_something_is_anywhere_in_its_way_back(led: bool) -> None:
    found = between(shipped(), edited(("site.yaml", *WET)), covered=permitted(shipped()), led=led)
    assert ("place_changed" in codes(found)) is led
    assert not between(shipped(), edited(("site.yaml", *WET)), covered=(), led=led), "nothing undoes it by itself"


def test_another_name_of_the_stand_at_a_place_moves_nothing() -> None:
    renamed = files()
    renamed["site.yaml"] = renamed["site.yaml"].replace("bench_a_stand", "bench_a_front")
    place = shipped().validate_params("place_object", {"surface": "bench_a"})
    assert not isinstance(place, tuple)
    found = between(shipped(), bundle.load_files(renamed), Proposal(capability="place_object", params=place))
    assert "place_changed" not in codes(found)


@pytest.mark.parametrize(
    "runs", [GRASP, Proposal(capability="navigate_to", params={"target": "dock", "clearance_m": 0.3, "speed_mps": 0.3})]
)
def test_another_name_of_what_is_in_the_way_moves_nothing(runs: Proposal) -> None:
    wet, puddle = (
        (
            "site.yaml",
            "zones:\n",
            f"zones:\n  {name}: {{kind: restricted, polygon: [[0, 3], [4, 3], [4, 3.5], [0, 3.5]]}}\n",
        )
        for name in ("wet", "puddle")
    )
    assert "place_changed" in codes(between(shipped(), edited(wet), runs, covered=permitted(shipped())))
    assert "place_changed" not in codes(between(edited(wet), edited(puddle), runs, covered=permitted(shipped())))
    renamed = bundle.load_files(
        {name: text.replace("bench_a:", "bench_c:") for name, text in files().items()}
        | {"site.yaml": files()["site.yaml"].replace("bench_a:", "bench_c:").replace("bench_a,", "bench_c,")}
    )
    assert "place_changed" not in codes(between(shipped(), renamed, runs, covered=permitted(shipped())))


def test_another_name_of_what_is_forbidden_moves_nothing() -> None:
    renamed = edited(("site.yaml", "press_area: {kind: forbidden", "hot_area: {kind: forbidden"))
    assert between(shipped(), renamed, covered=permitted(shipped())) is CONFORMS


@pytest.mark.parametrize(("bounds", "holds"), [("0.0, 0.0, 9.0, 6.0", False), ("0.1, 0.0, 9.0, 6.0", True)])
def test_a_wall_that_stands_where_it_stood_is_in_nobodys_way(bounds: str, holds: bool) -> None:
    other = edited(("site.yaml", "bounds_m: [0.0, 0.0, 8.0, 6.0]", f"bounds_m: [{bounds}]"))
    here = context(HERE)
    assert here.cell.facts is not None
    at_dock = replace(here, cell=replace(here.cell, facts=replace(here.cell.facts, base=(0.8, 0.8, 0.0))))
    found = between(shipped(), other, now=at_dock, covered=permitted(shipped()))
    assert ("place_changed" in codes(found)) is holds


def test_what_else_can_be_done_with_a_tool_moves_nothing_and_another_end_of_the_same_does() -> None:
    drive = Proposal(capability="navigate_to", params={"target": "dock", "clearance_m": 0.3, "speed_mps": 0.3})
    further = edited(("site.yaml", "push_up: up", "push_up: up, lock: locked"))
    for runs in (PULL, drive):
        assert "place_changed" not in codes(between(shipped(), further, runs))
    other = edited(("site.yaml", "pull_down: down", "pull_down: locked"))
    found = between(shipped(), other, PULL)
    assert ("place_changed" in codes(found), found.askable) == (True, False)
    assert "place_changed" not in codes(between(shipped(), other, drive))


def test_goes_on_where_other_places_than_its_own_have_changed() -> None:
    other = edited(
        ("site.yaml", "dock: {x_m: 0.8", "dock: {x_m: 1.0"),
        ("site.yaml", "x_m: 1.45, y_m: 5.25", "x_m: 1.4, y_m: 5.25"),
    )
    assert between(shipped(), other) is CONFORMS


# -- admission ---------------------------------------------------------------------------------------------------------


def test_departs_when_its_agent_loses_the_permission() -> None:
    agents = {"planner": replace(shipped().agents["planner"], permissions=frozenset({"navigation"}))}
    found = between(shipped(), replace(shipped(), agents=agents))
    assert codes(found) == ["permission_missing"]
    assert not found.askable
    assert codes(between(shipped(), replace(shipped(), agents={}))) == ["permission_missing"]


def test_departs_when_its_agent_loses_a_permission_that_a_rule_asks_for() -> None:
    holds = Agent(permissions=shipped().agents["planner"].permissions | {"hazmat"})
    solvent = proposal("grasp_object", object_id="solvent_1", force_n=40, speed_mps=0.2)
    found = between(replace(shipped(), agents={"planner": holds}), shipped(), solvent)
    assert [reason.rule for reason in found.reasons] == ["organization/hazardous"]


def test_one_persons_word_lets_go_on_what_is_only_supervised_now() -> None:
    permissions = shipped().agents["planner"].permissions
    watched = Agent(permissions=permissions - {"manipulation"}, supervised=frozenset({"manipulation"}))
    found = between(shipped(), replace(shipped(), agents={"planner": watched}))
    assert codes(found) == ["permission_supervised"]
    assert found.askable


def test_departs_when_it_is_not_enabled_here_any_more() -> None:
    gates = {pair: gate for pair, gate in shipped().gates.items() if pair != ("grasp_object", HERE)}
    assert "not_in_profile" in codes(between(shipped(), replace(shipped(), gates=gates)))


def test_governance_keeps_its_own_permissions_under_both() -> None:
    now = replace(context(HERE, holding="mug_1"), agent=shipped().governance())
    retract = proposal("release_and_retract")
    assert departure(shipped(), shipped(), retract, now) is CONFORMS
    assert departure(shipped(), with_profile(sensitivity=1.0), retract, now)


# -- guard -------------------------------------------------------------------------------------------------------------


def test_departs_when_a_rule_denies_it_now_and_says_only_what_is_new() -> None:
    denying = with_rule("id: no, applies_to: [grasp_object], then: deny, because: No.")
    assert [reason.rule for reason in between(shipped(), denying).reasons] == ["organization/no"]
    assert between(denying, denying) is CONFORMS
    solvent = proposal("grasp_object", object_id="solvent_1", force_n=40, speed_mps=0.2)
    found = between(shipped(), denying, solvent)
    assert [reason.rule for reason in found.reasons] == ["organization/no"], "that it is hazardous is no news"


def test_departs_when_its_parameters_are_bound_tighter() -> None:
    tighter = edited((SHARED, "grip_force_n: {max: 60", "grip_force_n: {max: 30"))
    found = between(shipped(), tighter)
    assert f"{HERE}/grip_force_n" in {reason.rule for reason in found.reasons}
    assert not found.askable
    assert between(tighter, shipped()) is CONFORMS, "what is freer now touches only what starts later"
    glass = proposal("grasp_object", object_id="glass_1", force_n=40, speed_mps=0.2)
    assert between(shipped(), shipped(), glass) is CONFORMS, "both would bind it so"


# -- watching ----------------------------------------------------------------------------------------------------------

ROWS = {row.id: row for row in shipped().profiles[HERE].watch}
ZONE = next(zone for zone in shipped().site.zones.values() if zone.kind == "forbidden")
AGES = shipped().profiles[HERE].stale_after_ms
SEPARATION = shipped().profiles[HERE].separation
assert SEPARATION is not None

STRICTER = {
    "the watch rule `separation` is": lambda: with_watch("separation", above=True),
    "the watch rule `grip-force` is": lambda: with_watch("grip-force", times=0.5),
    "the watch rule `contact-force` is": lambda: with_watch("contact-force", limit=None, named=None, number=1.0),
    "sensitivity is": lambda: with_profile(sensitivity=0.95),
    "the bound `base_speed_mps` is": lambda: edited((SHARED, "base_speed_mps: {max: 0.3", "base_speed_mps: {max: 0.2")),
    "the time it may take is": lambda: with_capability(timeout_s=1.0),
    "separation is": lambda: with_profile(separation=replace(SEPARATION, intrusion_m=0.3)),
    "a forbidden zone is": lambda: replace(
        shipped(),
        site=replace(shipped().site, zones={**shipped().site.zones, "more": replace(ZONE, polygon=ZONE.polygon[:3])}),
    ),
    "the age of what sensors say is": lambda: with_profile(stale_after_ms={**AGES, "arm": AGES["arm"] - 1}),
    "what has to hold afterwards is": lambda: with_capability(postconditions=("object_secured", "arm_retracted")),
    "braking is": lambda: with_profile(base_deceleration_mps2=0.5),
    "the room it takes is": lambda: with_profile(base_radius_m=0.5),
}


@pytest.mark.parametrize("what", STRICTER)
def test_departs_when_it_would_be_watched_more_strictly(what: str) -> None:
    found = between(shipped(), STRICTER[what]())
    said = [reason.message for reason in found.reasons if reason.code == "watched_tighter"]
    assert f"{what} tighter now" in said
    assert not found.askable


WIDER = {
    "a rule less": lambda: with_profile(watch=shipped().profiles[HERE].watch[1:]),
    "a rule that comes later": lambda: with_watch("grip-force", times=2.0, for_ms=1000),
    "less sensitive": lambda: with_profile(sensitivity=0.5),
    "longer": lambda: with_capability(timeout_s=100.0),
    "no separation": lambda: with_profile(separation=None),
    "older": lambda: with_profile(stale_after_ms={"arm": AGES["arm"] + 1}),
    "nothing to hold afterwards": lambda: with_capability(postconditions=()),
    "no zones": lambda: replace(shipped(), site=replace(shipped().site, zones={})),
    "more retries": lambda: with_profile(retry_budget=5),
    "no rollback needed": lambda: with_profile(rollback="optional"),
}


@pytest.mark.parametrize("what", WIDER)
def test_goes_on_when_it_would_be_watched_less_and_departs_the_other_way_round(what: str) -> None:
    wider = WIDER[what]()
    assert between(shipped(), wider) is CONFORMS
    found = between(wider, shipped())
    assert found
    assert {"watched_tighter", "recovery_tighter"} & {*codes(found)}


@given(
    old=st.floats(0.01, 5), new=st.floats(0.01, 5), above=st.booleans(), was=st.integers(0, 99), now=st.integers(0, 99)
)
def test_a_watch_rule_that_answers_no_sooner_is_no_reason(
    old: float, new: float, above: bool, was: int, now: int
) -> None:
    def ruled(number: float, for_ms: int) -> PolicySet:
        row = replace(ROWS["contact-force"], limit=None, number=number, times=1.0, above=above, for_ms=for_ms)
        return with_profile(watch=(row,))

    sooner = now < was or (new < old if above else new > old)
    assert bool(between(ruled(old, was), ruled(new, now))) is sooner


# -- recovery and confirmation -----------------------------------------------------------------------------------------


def recovering(do: str, by: str = "release_and_retract", times: int = 1) -> PolicySet:
    """Have what follows a lost object in a grasp be something else: it is the last of its rows that holds."""
    before = (
        "  - on: object_lost\n    do: [recovery_capability, retry, ask_human]\n    capability: release_and_retract\n"
    )
    before += "    budget: {recovery_capability: 1, retry: 1}\n"
    moves = "recovery_capability" in do
    row = f"  - on: object_lost\n    do: [{do}]\n" + f"    capability: {by}\n" * moves
    return edited((SHARED, before, row + f"    budget: {{recovery_capability: {times}}}\n" * moves))


@pytest.mark.parametrize(
    "less",
    [
        lambda: recovering("ask_human"),
        lambda: recovering("retry, ask_human"),
        lambda: recovering("recovery_capability, ask_human"),
        lambda: recovering("retry, recovery_capability, ask_human"),
        lambda: recovering("recovery_capability, retry, terminate"),
        lambda: recovering("recovery_capability, retry, ask_human", by="safe_retreat"),
    ],
)
def test_departs_when_less_or_something_else_follows_a_failure(less: Callable[[], PolicySet]) -> None:
    found = between(shipped(), less())
    assert [(reason.code, reason.message) for reason in found.reasons] == [
        ("recovery_tighter", "what follows `object_lost` is bound tighter now")
    ]
    assert not found.askable
    drive = proposal("transport_object", target="bench_b_stand", speed_mps=0.3)
    assert between(shipped(), less(), drive, context(HERE, holding="mug_1")) is CONFORMS, "another row is its own"


def test_goes_on_when_more_follows_a_failure_and_departs_when_it_is_tried_less_often() -> None:
    asks, twice = recovering("ask_human"), recovering("recovery_capability, retry, ask_human", times=2)
    assert between(asks, shipped()) is CONFORMS
    assert between(shipped(), twice) is CONFORMS
    assert codes(between(twice, shipped())) == ["recovery_tighter"]


def test_departs_when_nothing_follows_a_failure_any_more() -> None:
    nothing = with_profile(recovery=())
    assert "what follows any other failure is bound tighter now" in [
        reason.message for reason in between(shipped(), nothing).reasons
    ]
    assert between(nothing, shipped()) is CONFORMS


def test_departs_when_it_is_undone_otherwise_or_not_at_all() -> None:
    for rollback in ("safe_retreat", None):
        assert "recovery_tighter" in codes(between(shipped(), with_capability(rollback=rollback)))
    assert between(with_capability(rollback=None), shipped()) is CONFORMS


def test_departs_when_what_is_tried_carefully_is_not_admitted_any_more() -> None:
    found = between(shipped(), with_profile(admits=frozenset({Mode.NORMAL})))
    assert codes(found).count("recovery_tighter") == len(found.reasons) > 1


@pytest.mark.parametrize("then", ["deny", "escalate", "modify, set: {speed_mps: {max: 0.05}}"])
def test_departs_when_what_recovers_it_is_refused_asked_about_or_bound_tighter(then: str) -> None:
    rule = f"id: gently, applies_to: [release_and_retract], then: {then}, because: It fell."
    found = between(shipped(), with_rule(rule))
    assert [reason.rule for reason in found.reasons] == ["organization/gently"]
    assert not found.askable
    assert between(with_rule(rule), shipped()) is CONFORMS, "it is freer by now, or was covered by nothing"


def near(then: str, because: str = "Somebody is there.") -> PolicySet:
    when = 'when: "world.people_count > 0"'
    return with_rule(f"id: gently, applies_to: [release_and_retract], {when}, then: {then}, because: {because}")


REFUSED = "id: never, applies_to: [release_and_retract], then: deny, because: It fell."
BESIDE = context(HERE, people_count=1)


def permitted(policy: PolicySet) -> tuple[CoveredRecovery, ...]:
    """Return what recovers a grasp that was launched with nobody near."""
    return covered_recoveries(policy, GRASP, context(HERE))


@pytest.mark.parametrize("before", ["escalate", "deny"])
def test_what_recovers_it_is_what_its_authorization_covers_whoever_has_come_near_since(before: str) -> None:
    old, new = near(before), with_rule(REFUSED)
    assert between(old, new, now=BESIDE) is CONFORMS, "nobody knows that it was covered"
    found = between(old, new, now=BESIDE, covered=permitted(old))
    assert [reason.rule for reason in found.reasons] == ["organization/never"]
    assert not found.askable
    uncovered = covered_recoveries(old, GRASP, BESIDE)
    assert "release_and_retract" not in {one.capability for one in uncovered}
    assert between(old, new, now=context(HERE), covered=uncovered) is CONFORMS, "it takes a human's word anyway"


@pytest.mark.parametrize("before", ["escalate", "deny", "modify, set: {speed_mps: {max: 0.05}}"])
def test_what_both_say_of_what_recovers_it_with_somebody_near_is_no_news(before: str) -> None:
    old = near(before)
    new = replace(old, digest="another")
    assert between(old, new, now=BESIDE, covered=permitted(old)) is CONFORMS
    other = near(before, because="They must not be met.")
    found = between(old, other, now=BESIDE, covered=permitted(old))
    assert bool(found) is not before.startswith("modify"), "it is for another reason now"


def test_departs_when_what_recovers_it_is_asked_about_under_the_reason_it_was_bound_for() -> None:
    old, new = near("modify, set: {speed_mps: {max: 0.05}}"), near("escalate")
    found = between(old, new, now=BESIDE, covered=permitted(old))
    assert [reason.rule for reason in found.reasons] == ["organization/gently"]


@pytest.mark.parametrize("known", [False, True], ids=["covered by what was in force", "covered by its authorization"])
def test_the_version_that_an_agent_asked_for_is_its_own_capabilitys_and_not_of_what_recovers_it(known: bool) -> None:
    pinned = replace(GRASP, version="1.0.0")
    capability = shipped().capabilities["release_and_retract"]
    later = replace(capability, version="1.0.1")
    new = replace(
        shipped(),
        capabilities={**shipped().capabilities, capability.name: later},
        gates={
            pair: replace(gate, capability=later) if gate.capability is capability else gate
            for pair, gate in shipped().gates.items()
        },
    )
    covered = permitted(shipped()) if known else None
    assert between(shipped(), new, pinned, covered=covered) is CONFORMS
    found = between(new, with_rule(REFUSED), pinned, covered=covered)
    assert [reason.rule for reason in found.reasons] == ["organization/never"]


EXTRA = "extra_m: {type: number, unit: m, minimum: 0, maximum: 5, default: 1.0}"
KEPT = "{id: kept, applies_to: [grasp_object, release_and_retract], then: modify, because: It does., set: {extra_m: "


def with_extra(capability: str, *edits: tuple[str, str, str]) -> PolicySet:
    return edited((f"capabilities/{capability}.yaml", "  properties:\n", f"  properties:\n    {EXTRA}\n"), *edits)


@pytest.mark.parametrize("capability", ["grasp_object", "release_and_retract"])
def test_goes_on_where_something_is_taken_besides_that_has_a_default(capability: str) -> None:
    now = context(HERE, holding="mug_1")
    assert between(shipped(), with_extra(capability), now=now) is CONFORMS
    least, most = (
        with_extra(capability, (ORGANIZATION, "rules:\n", f"rules:\n  - {KEPT}{{max: {most}}}}}}}\n"))
        for most in (0.5, 2)
    )
    assert codes(between(shipped(), least, now=now)) == ["kept"]
    assert between(shipped(), most, now=now) is CONFORMS


def test_another_version_than_its_agent_asked_for_says_that_and_nothing_of_parameters_that_are_another_versions() -> (
    None
):
    other = edited(
        ("capabilities/grasp_object.yaml", "version: 1.0.0", "version: 2.0.0"),
        ("capabilities/grasp_object.yaml", "  properties:\n", f"  properties:\n    {EXTRA}\n"),
        ("capabilities/grasp_object.yaml", "required: [object_id]", "required: [object_id, extra_m]"),
    )
    found = between(shipped(), other, replace(GRASP, version="^1.0.0"))
    assert (codes(found), found.askable) == (["capability_version"], False)


def test_departs_when_what_recovers_it_is_not_enabled_here_any_more() -> None:
    gates = {pair: gate for pair, gate in shipped().gates.items() if pair != ("release_and_retract", HERE)}
    assert codes(between(shipped(), replace(shipped(), gates=gates))) == ["not_in_profile", "not_covered"]


def test_departs_when_what_recovers_it_is_none_of_the_policy_it_is_said_to_be_bound_to() -> None:
    """A hand-back that was recorded and never sent leaves what recovers a session as it was before."""
    name = "release_and_retract"
    gates = {pair: gate for pair, gate in shipped().gates.items() if pair[0] != name}
    capabilities = {known: one for known, one in shipped().capabilities.items() if known != name}
    old = replace(shipped(), gates=gates, capabilities=capabilities)
    found = between(old, shipped(), covered=permitted(shipped()))
    assert codes(found) == ["its_policy_is_gone"]


def test_departs_when_what_recovers_it_would_be_watched_more_strictly() -> None:
    rows = shipped().profiles[HERE].watch
    slower = replace(rows[0], id="gently", applies_to=frozenset({"release_and_retract"}))
    found = between(shipped(), with_profile(watch=(*rows, slower)))
    assert [reason.message for reason in found.reasons] == ["the watch rule `gently` is tighter now"]


def test_departs_when_a_further_phase_has_to_be_confirmed() -> None:
    def confirming(*phases: str) -> PolicySet:
        entry = Confirmation(capability="grasp_object", profile=HERE, phases=phases)
        return replace(shipped(), authority=replace(shipped().authority, confirm_before=(entry,)))

    found = between(confirming("close"), confirming("close", "lift"))
    assert [(reason.code, reason.message) for reason in found.reasons] == [
        ("confirmation_added", "a human confirms `lift` now")
    ]
    assert between(confirming("close", "lift"), confirming("close")) is CONFORMS


# -- authority ---------------------------------------------------------------------------------------------------------


def test_a_rule_that_escalates_now_is_answered_by_as_many_people_as_it_wants() -> None:
    look = "id: look, applies_to: [grasp_object], then: escalate, because: Somebody looks."
    one, two = with_rule(look), with_rule(f"{look}, approvers: 2")
    assert ([reason.rule for reason in between(shipped(), one).reasons], between(shipped(), one).askable) == (
        ["organization/look"], True,
    )  # fmt: skip
    assert not between(shipped(), two).askable
    assert between(one, one) is CONFORMS
    more = between(one, two)
    assert more.reasons, "the reasons are the same, and more people have to look"
    assert not more.askable


def test_goes_on_where_nobody_is_asked_any_more_and_is_asked_about_where_somebody_is() -> None:
    silent = with_profile(authority=frozenset({AuthorityMode.INTERRUPT_ENABLED}))
    assert between(shipped(), silent) is CONFORMS
    found = between(silent, shipped())
    assert codes(found) == ["approval_required"]
    assert found.askable


def test_what_cannot_be_compared_departs_and_nobody_may_let_it_go_on():
    found = not_comparable(KeyError("device"))
    assert not found.askable
    assert [(why.code, "KeyError: 'device'" in why.message) for why in found.reasons] == [("not_comparable", True)]
