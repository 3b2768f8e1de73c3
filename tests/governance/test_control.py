"""Who has the controls: the whole table of taking, every step of a lease, and what holds whatever happens."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from app.governance.control import (
    LAPSE_S,
    LATE_S,
    TAKING,
    Claim,
    Control,
    ControlError,
    Phase,
    Taking,
    Where,
    command,
    keep,
    lateness,
    refused,
    returning,
    take,
)

LOCAL, REMOTE = Where.LOCAL, Where.REMOTE


def claim(holder: str, where: Where = REMOTE, lease: str = "lease-2", at_s: float = 1.0) -> Claim:
    return Claim(lease=lease, holder=holder, where=where, invocation="inv-1", at_s=at_s)


def held(holder: str = "ann", where: Where = REMOTE) -> Control:
    return take(None, claim(holder, where, "lease-1", 0.0)).control


def test_a_free_cell_is_had_by_whoever_comes() -> None:
    taken = take(None, claim("ann", LOCAL))
    assert taken.how is Taking.GRANTED
    assert (taken.control.holder, taken.control.where, taken.control.since_s) == ("ann", LOCAL, 1.0)


@pytest.mark.parametrize(
    ("taker", "holder", "how"),
    [
        (REMOTE, REMOTE, Taking.REFUSED),
        (REMOTE, LOCAL, Taking.REFUSED),
        (LOCAL, REMOTE, Taking.PREEMPTED),
        (LOCAL, LOCAL, Taking.REFUSED),
    ],
)
def test_only_who_stands_at_the_cell_takes_it_from_who_does_not(taker: Where, holder: Where, how: Taking) -> None:
    assert TAKING[taker, holder] is how
    taken = take(held("ann", holder), claim("ben", taker))
    assert taken.how is how
    assert taken.control.holder == ("ben" if how is Taking.PREEMPTED else "ann")
    assert taken.control.lease == ("lease-2" if how is Taking.PREEMPTED else "lease-1")


@pytest.mark.parametrize("where", list(Where))
def test_the_same_person_gets_another_lease_and_keeps_the_moment_it_began(where: Where) -> None:
    taken = take(held("ann"), claim("ann", where))
    assert taken.how is Taking.RENEWED
    assert (taken.control.lease, taken.control.since_s, taken.control.newest) == ("lease-2", 0.0, -1)


def test_nobody_takes_what_is_being_handed_back() -> None:
    assert take(returning(held("ann")), claim("ben", LOCAL)).how is Taking.REFUSED
    assert take(returning(held("ann")), claim("ann")).how is Taking.REFUSED


def test_a_lease_that_lapsed_holds_nobody_off() -> None:
    late = claim("ben", at_s=LAPSE_S + 0.1)
    assert take(held("ann", LOCAL), late).how is Taking.GRANTED


def test_a_lease_lapses_when_its_holder_is_silent_and_not_before() -> None:
    control = held()
    assert not control.lapsed(LAPSE_S)
    assert control.lapsed(LAPSE_S + 1e-6)
    assert not keep(control, 2.0).lapsed(2.0 + LAPSE_S)
    assert control.lapsed(math.nan)


def test_being_heard_never_shortens_a_lease() -> None:
    assert keep(keep(held(), 2.0), 1.0).heard_s == 2.0


def test_only_the_newest_command_of_the_holder_passes() -> None:
    control, why = command(held(), lease="lease-1", holder="ann", number=4, now_s=1.0)
    assert (why, control.newest, control.heard_s) == (None, 4, 1.0)
    for lease, holder in (("lease-0", "ann"), ("lease-1", "ben")):
        after, why = command(control, lease=lease, holder=holder, number=5, now_s=2.0)
        assert (after, why) == (control, "not_holder")
    heard, why = command(control, lease="lease-1", holder="ann", number=4, now_s=2.0)
    assert (why, heard.newest, heard.heard_s) == ("out_of_order", 4, 2.0)
    late, why = command(control, lease="lease-1", holder="ann", number=5, now_s=2.0 + LAPSE_S)
    assert (late, why) == (control, "lease_lapsed")


@pytest.mark.parametrize(
    ("said_s", "heard_s", "late_s"),
    [
        (0.05, 0.02, 0.03),
        (0.45, 0.20, 0.25),
        (0.45, 0.00, 0.45),
        (1.00, 0.90, 0.60),  # in time, but of one who has heard nothing for that long
        (1.00, math.inf, 0.60),
        (math.inf, 0.0, math.inf),  # no word that was ever said
        (math.inf, math.inf, math.inf),
    ],
)
def test_a_command_is_as_late_as_its_way_and_that_of_what_was_heard(
    said_s: float, heard_s: float, late_s: float
) -> None:
    assert lateness(said_s, heard_s) == pytest.approx(late_s)


@pytest.mark.parametrize(
    ("late_s", "why"),
    [(LATE_S, None), (-1.0, None), (LATE_S + 1e-6, "too_late"), (math.inf, "too_late"), (math.nan, "too_late")],
)
def test_what_was_on_its_way_for_too_long_moves_nothing_and_is_heard(late_s: float, why: str | None) -> None:
    control, said = command(held(), lease="lease-1", holder="ann", number=4, now_s=1.0, late_s=late_s)
    assert (said, control.newest, control.heard_s) == (why, 4, 1.0)


def test_whoever_hands_back_is_heard_and_moves_nothing() -> None:
    control, why = command(returning(held()), lease="lease-1", holder="ann", number=1, now_s=1.0)
    assert (why, control.heard_s, control.newest) == ("returning", 1.0, -1)


def test_a_lease_is_handed_back_once_and_may_come_back_to_its_holder() -> None:
    on_its_way = returning(held())
    assert on_its_way.phase is Phase.RETURNING
    with pytest.raises(ControlError, match="`returning`; valid: `held`"):
        returning(on_its_way)
    assert refused(on_its_way, 2.0).phase is Phase.HELD
    assert refused(on_its_way, 2.0).heard_s == 2.0
    with pytest.raises(ControlError, match="`held`; valid: `returning`"):
        refused(held(), 2.0)


@given(st.sampled_from(list(Where)), st.sampled_from(list(Where)), st.floats(0.0, 2.9))
def test_a_remote_hand_never_displaces_anybody(holder: Where, taker: Where, at_s: float) -> None:
    taken = take(held("ann", holder), claim("ben", taker, at_s=at_s))
    assert taken.control.holder == "ann" or (taker is LOCAL and holder is REMOTE)


class Leases(RuleBasedStateMachine):
    """Two at the cell, two far away, one set of controls, and a clock."""

    people = st.sampled_from([("ann", LOCAL), ("bob", LOCAL), ("cat", REMOTE), ("dan", REMOTE)])

    @initialize()
    def begin(self) -> None:
        self.now_s, self.number, self.control = 0.0, 0, None
        self.known: dict[str, str] = {}

    @rule(who=people)
    def wants(self, who: tuple[str, Where]) -> None:
        self.number += 1
        before = self.control
        lease = f"lease-{self.number}"
        how, self.control = take(before, claim(who[0], who[1], lease, self.now_s))
        if how is Taking.REFUSED:
            assert self.control is before
        else:
            self.known[lease] = who[0]
            assert (self.control.lease, self.control.holder) == (lease, who[0])

    @rule(lease=st.integers(1, 12), number=st.integers(0, 5))
    def commands(self, lease: int, number: int) -> None:
        name = f"lease-{lease}"
        if self.control is None:
            return
        present = self.control
        holder = self.known.get(name, "nobody")
        self.control, why = command(present, lease=name, holder=holder, number=number, now_s=self.now_s)
        if why is None:
            assert name == present.lease
            assert number > present.newest
            assert not present.lapsed(self.now_s)
            assert present.phase is Phase.HELD

    @rule(seconds=st.floats(0.0, 4.0))
    def passes(self, seconds: float) -> None:
        self.now_s += seconds

    @rule()
    def hands_back(self) -> None:
        if self.control is not None and self.control.phase is Phase.HELD:
            self.control = returning(self.control)

    @rule(works=st.booleans())
    def cell_answers(self, works: bool) -> None:
        if self.control is not None and self.control.phase is Phase.RETURNING:
            self.control = None if works else refused(self.control, self.now_s)

    @invariant()
    def one_lease_of_one_person(self) -> None:
        if self.control is not None:
            assert self.known[self.control.lease] == self.control.holder
            assert self.control.heard_s <= self.now_s


TestLeases = Leases.TestCase
