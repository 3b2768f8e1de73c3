"""`intervene`: what follows from what the watcher says (paper, Stage 6: i_t = Intervene(w_t, Π, Γ, H)).

Every watch rule declares a `Response`. This module runs those responses side by side, one small life for each rule:

    idle ──alert──▶ engaged: `enter` holds ──quiet for clear_after_ms, then: resume──▶ idle
                       │    └──quiet, then: stay──▶ engaged until a human resumes
                       └──still violated persist_ms after it began──▶ `otherwise`, until a human decides

and answers with the most severe intervention of all that are engaged: stop > rollback > escalate > pause > continue.

A rule *ends the attempt* when it enters with STOP or ROLLBACK, when its `otherwise` is one of them, or when it enters
with a PAUSE that has no way out by itself (`then: stay`, no `persist_ms`) and names a failure: then holding is only
the first half of the answer, and recovery is the other.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, assert_never

from app.governance.model import Intervention

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from app.governance.model import Alert, WatchRule

SEVERITY: Final = {
    Intervention.CONTINUE: 0,
    Intervention.PAUSE: 1,
    Intervention.ESCALATE: 2,
    Intervention.ROLLBACK: 3,
    Intervention.STOP: 4,
}
NEARNESS: Final = "separation_m"
CONTACT: Final = frozenset({"contact_force_n", "residual_nm"})
GRACE_MS: Final = 1000
"""How long a recovery may find the violation still there that it was started for."""
GROWTH: Final = {"zone_margin_m": 0.04, "residual_nm": 5.0}
"""By how much it may grow meanwhile, where growing is worse than staying: a robot that goes deeper does not leave.

Of a zone: three sigma of the difference of two estimates of where it stands: each has 9.3 mm at rest, with fixes of
2 cm. Within a second the noise alone moves the estimate by 13 mm in half of all cases, and by 30 mm in one of twenty.
Of the residual: as much as a sound run may show. An arm that comes free of what it pressed on crosses the limit more
than once.
"""
WAY_OUT: Final = {
    "zone_margin_m": 0.02,
    "contact_force_n": 10.0,
    "residual_nm": 5.0,
    "tracking_error_rad": 0.02,
    "grip_force_n": 2.0,
}
"""What a human at the controls may move out of, and by how much it may grow on the way."""


class Engaged(NamedTuple):
    """One rule's response under way; ticks are the session's. `quiet_since` is None while the violation lasts."""

    rule: str
    alert: Alert
    since: int
    quiet_since: int | None
    persisted: bool


class Decision(NamedTuple):
    """The intervention of this tick and the alert behind it; `ends_attempt` when recovery has to be asked.

    `holding` is the most severe of the responses that only hold (pause, escalate): where a person stands in the way,
    even a recovery waits until they have left. `gave_up` says that a hold lasted for longer than its rule waits, and
    that this rule ends the attempt: a recovery that waited for the hold to clear may not begin.
    """

    intervention: Intervention
    alert: Alert | None = None
    ends_attempt: bool = False
    holding: Decision | None = None
    gave_up: bool = False


class Grace(NamedTuple):
    """A rule a recovery was started for: the tick its grace ends, and how far it was violated when the grace began.

    `growth` is by how much it may grow; None leaves that to `GROWTH`.
    """

    rule: str
    until: int
    excess: float | None = None
    growth: float | None = None


class InterventionState(NamedTuple):
    """All responses under way, and the rules that have grace."""

    engaged: tuple[Engaged, ...] = ()
    grace: tuple[Grace, ...] = ()


GO_ON: Final = Decision(Intervention.CONTINUE)
NOTHING: Final = InterventionState()


class Responses:
    """The responses of one plan's rules by identifier, in ticks."""

    __slots__ = ("_period_ms", "_rules")

    def __init__(self, rules: tuple[WatchRule, ...], period_s: float) -> None:
        """Take the rules of a compiled watcher."""
        self._rules = {rule.id: rule for rule in rules}
        self._period_ms = 1000.0 * period_s

    def intervene(
        self, state: InterventionState, alerts: tuple[Alert, ...], tick: int
    ) -> tuple[InterventionState, Decision]:
        """Return what is under way after this tick's alerts, and what has to be done now."""
        if not alerts and state is NOTHING:
            return NOTHING, GO_ON
        speaking = {alert.rule: alert for alert in alerts}
        grace = tuple(
            kept
            for one in state.grace
            if tick < one.until and (kept := self._spare(one, speaking.get(one.rule))) is not None
        )
        for one in grace:
            speaking.pop(one.rule, None)
        engaged: list[Engaged] = []
        for one in state.engaged:
            if (kept := self._advance(one, speaking.pop(one.rule, None), tick)) is not None:
                engaged.append(kept)
        engaged += [Engaged(alert.rule, alert, tick, None, False) for alert in speaking.values()]
        decisions = [self._decide(one) for one in engaged]
        decision = max(decisions, key=_severity, default=GO_ON)
        holds = [one for one in decisions if not one.ends_attempt and one.intervention is not Intervention.CONTINUE]
        if holds:
            decision = decision._replace(holding=max(holds, key=_severity))
        elif any(one.gave_up for one in decisions):
            decision = decision._replace(gave_up=True)
        if not engaged and not grace:
            return NOTHING, decision
        return InterventionState(tuple(engaged), grace), decision

    def let_go(self, state: InterventionState) -> InterventionState:
        """Return the state after a human let go on: responses start anew, and what is still violated speaks again.

        Only what ended the attempt has ended it: a violation while the session was held is not undone by a word that
        lets it go on.
        """
        ended = tuple(one for one in state.engaged if self._decide(one).ends_attempt)
        return InterventionState(ended, state.grace) if ended or state.grace else NOTHING

    def borne(self, state: InterventionState) -> tuple[Engaged, ...]:
        """Return the responses that only warn so far: for how long a rule is borne goes on, whatever begins anew."""
        known = (one for one in state.engaged if one.rule in self._rules)
        return tuple(one for one in known if self._decide(one).intervention is Intervention.CONTINUE)

    def met(self, state: InterventionState, failure: str, tick: int) -> tuple[Engaged, ...]:
        """Return the contacts that ended the attempt while the robot came to rest for another failure.

        That was decided at `tick`. Each is answered once that is over, however short it was: what is tried for the
        other failure is none for it.
        """
        late = (one for one in state.engaged if one.since > tick and one.alert.failure != failure)
        known = (one for one in late if one.rule in self._rules)
        return tuple(one for one in known if self._rules[one.rule].signal in CONTACT and self._decide(one).ends_attempt)

    def barred(self, state: InterventionState, tick: int) -> str:
        """Return a rule that has to end by itself before a human may move anything, however long it lasts; else "".

        It does more than warn, moving mends nothing of it (`WAY_OUT`), and it was not quiet for as long as it takes to
        clear.
        """
        for one in state.engaged:
            rule = self._rules[one.rule]
            if rule.signal in WAY_OUT or self._decide(one).intervention is Intervention.CONTINUE:
                continue
            if one.quiet_since is None or (tick - one.quiet_since + 1) * self._period_ms < rule.response.clear_after_ms:
                return one.rule
        return ""

    def keeps_off(self, speaking: Iterable[str]) -> bool:
        """Say whether one of these rules is about somebody who is too near, and does more than warn of it.

        Whatever such a rule answers by, nothing begins to move before they have left: no motion mends that.
        """
        rules = (self._rules[name] for name in speaking if name in self._rules)
        return any(
            rule.signal == NEARNESS
            and not (rule.response.enter is Intervention.CONTINUE and rule.response.persist_ms is None)
            for rule in rules
        )

    def _spare(self, grace: Grace, alert: Alert | None) -> Grace | None:
        """Return the grace that is left; none where what should end grows instead.

        Grace ends with the violation, and one that comes back is a new one: except where its growth is bounded anyway.
        """
        rule = self._rules.get(grace.rule)
        growth = math.inf if rule is None else GROWTH.get(rule.signal, math.inf)
        if alert is None:
            return grace._replace(excess=grace.excess or 0.0) if growth < math.inf else None
        excess = alert.excess
        if grace.excess is None:
            return grace._replace(excess=excess)
        growth = growth if grace.growth is None else grace.growth
        return grace if excess <= grace.excess + growth else None

    def _advance(self, one: Engaged, alert: Alert | None, tick: int) -> Engaged | None:
        response = self._rules[one.rule].response
        if alert is not None:
            persist_ms = response.persist_ms
            over = persist_ms is not None and (tick - one.since) * self._period_ms >= persist_ms
            return Engaged(one.rule, alert, one.since, None, one.persisted or over)
        quiet_since = tick if one.quiet_since is None else one.quiet_since
        quiet_ms = (tick - quiet_since + 1) * self._period_ms
        waits = response.then == "stay" and response.enter is not Intervention.CONTINUE
        if not waits and not one.persisted and quiet_ms >= response.clear_after_ms:
            return None
        return one._replace(quiet_since=quiet_since)

    def _decide(self, one: Engaged) -> Decision:
        rule = self._rules[one.rule]
        response = rule.response
        if one.persisted:
            otherwise = response.otherwise
            ends = otherwise in (Intervention.STOP, Intervention.ROLLBACK)
            return Decision(otherwise, one.alert, ends, gave_up=ends)
        return Decision(response.enter, one.alert, ends_attempt(rule))


def ends_attempt(rule: WatchRule) -> bool:
    """Say whether a rule's way in already ends the attempt."""
    response = rule.response
    match response.enter:
        case Intervention.STOP | Intervention.ROLLBACK:
            return True
        case Intervention.PAUSE:
            return response.then == "stay" and response.persist_ms is None and bool(rule.failure)
        case Intervention.ESCALATE | Intervention.CONTINUE:
            return False
        case _:
            assert_never(response.enter)


def released(state: InterventionState) -> InterventionState:
    """Return the state after a human had it undone: whatever spoke, this is the answer to it."""
    return InterventionState(grace=state.grace) if state.grace else NOTHING


def recovering(rules: tuple[str, ...], tick: int, period_s: float, kept: tuple[Engaged, ...] = ()) -> InterventionState:
    """Return the state a recovery begins with: the violations it was started for get `GRACE_MS` to end.

    The responses that are `kept` (`borne`, `met`) need no grace, and go on as they were.
    """
    until, named = tick + round(GRACE_MS / (1000.0 * period_s)), {one.rule for one in kept}
    return InterventionState(kept, tuple(Grace(rule, until) for rule in rules if rule not in named))


def leaving(
    blocked: Mapping[str, tuple[str, float]], tick: int, period_s: float, borne: tuple[Engaged, ...] = ()
) -> InterventionState:
    """Return the state a human begins to move out of violations with: each may last `GRACE_MS` and hardly grow.

    Only what moving can mend is spared (`WAY_OUT`). Whoever is too near has to go, and what cannot be believed has to
    be believable again, before anything moves.

    Args:
        blocked: By rule, its signal, and how far it was violated when it stopped the motion first.
        tick: The session's.
        period_s: The control period.
        borne: What is only warned of so far; it goes on as it was.
    """
    until = tick + round(GRACE_MS / (1000.0 * period_s))
    spared = tuple(
        Grace(rule, until, excess, WAY_OUT[signal]) for rule, (signal, excess) in blocked.items() if signal in WAY_OUT
    )
    return InterventionState(borne, spared) if spared or borne else NOTHING


def _severity(decision: Decision) -> tuple[int, bool, bool]:
    return SEVERITY[decision.intervention], decision.ends_attempt, decision.gave_up
