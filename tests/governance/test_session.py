from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from app.governance.model import SESSION, TERMINAL, Outcome, Status
from app.governance.session import TABLE, Event, SessionError, accepts, final_status, refused_launch, step

R, P, E, V, C, F = (
    Status.RUNNING,
    Status.PAUSED,
    Status.ESCALATED,
    Status.RECOVERING,
    Status.COMPLETED,
    Status.FAILED,
)
X = None
# The whole table once more, as the readers would draw it: rows are events, columns R P E V.
CELLS = {
    Event.PAUSE: (P, P, E, P),
    Event.RESUME: (X, R, X, X),
    Event.RESUME_RECOVERY: (X, V, X, X),
    Event.ESCALATE: (E, E, E, E),
    Event.CONTINUE: (X, X, R, X),
    Event.CONTINUE_RECOVERY: (X, X, V, X),
    Event.RECOVER: (V, V, V, V),
    Event.RECOVERED: (X, X, X, R),
    Event.TAKE_OVER: (R, R, R, R),
    Event.COMPLETE: (C, X, X, X),
    Event.STOP: (F, F, F, F),
    Event.FAIL: (F, F, F, F),
}
ALL = [(status, event, row[column]) for event, row in CELLS.items() for column, status in enumerate((R, P, E, V))]


def test_every_event_stands_in_the_drawing() -> None:
    assert set(CELLS) == set(Event)


@pytest.mark.parametrize(("status", "event", "after"), [cell for cell in ALL if cell[2] is not None])
def test_a_legal_cell_leads_where_the_table_says(status: Status, event: Event, after: Status) -> None:
    assert accepts(status, event)
    assert step(status, event) is after


@pytest.mark.parametrize(("status", "event"), [(status, event) for status, event, after in ALL if after is None])
def test_a_missing_cell_raises_and_lists_what_would_be_valid(status: Status, event: Event) -> None:
    assert not accepts(status, event)
    with pytest.raises(SessionError, match="cannot take") as caught:
        step(status, event)
    assert caught.value.status is status
    assert caught.value.event is event
    assert all(f"`{valid}`" in str(caught.value) for valid in TABLE[status])


@pytest.mark.parametrize("status", [C, F])
@pytest.mark.parametrize("event", list(Event))
def test_a_terminal_status_absorbs_everything(status: Status, event: Event) -> None:
    assert step(status, event) is status


@pytest.mark.parametrize("status", sorted(set(Status) - SESSION - {C, F}))
def test_what_comes_before_launch_is_no_session(status: Status) -> None:
    with pytest.raises(SessionError, match="no status of a session"):
        step(status, Event.PAUSE)


@pytest.mark.parametrize("outcome", list(Outcome))
def test_only_success_and_recovery_complete(outcome: Outcome) -> None:
    expected = C if outcome in (Outcome.SUCCEEDED, Outcome.RECOVERED) else F
    assert final_status(outcome) is expected


def test_a_launch_that_a_stop_came_before_was_stopped_and_any_other_that_is_refused_a_fault() -> None:
    assert refused_launch("estop_latched") is Outcome.STOPPED
    assert refused_launch("used") is Outcome.FAULT


@given(
    st.lists(st.sampled_from([Event.PAUSE, Event.ESCALATE, Event.STOP, Event.FAIL])), st.sampled_from(sorted(SESSION))
)
def test_restraint_is_never_refused(events: list[Event], status: Status) -> None:
    for event in events:
        status = step(status, event)
    assert status in SESSION | TERMINAL


class Sessions(RuleBasedStateMachine):
    """Whatever happens in whatever order: only a human's word leaves ESCALATED alive, and the dead stay dead."""

    def __init__(self) -> None:
        super().__init__()
        self.status = Status.RUNNING
        self.ended: Status | None = None

    @rule(event=st.sampled_from(list(Event)))
    def happen(self, event: Event) -> None:
        before = self.status
        if not accepts(before, event):
            with pytest.raises(SessionError):
                step(before, event)
            return
        self.status = step(before, event)
        if before is Status.ESCALATED and self.status in (Status.RUNNING, Status.RECOVERING):
            assert event in (Event.CONTINUE, Event.CONTINUE_RECOVERY, Event.RECOVER, Event.TAKE_OVER)
        if self.status is Status.COMPLETED and self.ended is None:
            assert before is Status.RUNNING
        if self.ended is None and self.status in TERMINAL:
            self.ended = self.status

    @precondition(lambda self: self.ended is None)
    @rule()
    def stop_is_always_possible(self) -> None:
        assert step(self.status, Event.STOP) is Status.FAILED

    @invariant()
    def the_dead_stay_dead(self) -> None:
        assert self.ended is None or self.status is self.ended


TestSessions = Sessions.TestCase
