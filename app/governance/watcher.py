"""`watch`: does this tick remain within what policy allows (paper, Stage 5: w_t = Watch(Ω, Π, Γ)).

`compile_watch` turns a `WatchPlan` into a `Watcher`: the constants of `detectors.Measure`, and a table with one row per
rule. Per tick the watcher measures all signals and runs down the table. A row is violated unless its signal is
*known* to be within the threshold, so a NaN violates every rule it meets.

How long a violation must last is where sensitivity s enters. A rule's `for_ms` is its debounce at s = 0.5; the watcher
waits `for_ms · 2 (1 − s)`, and at s = 1 not at all. A CUSUM rule alarms once the excess over the threshold, summed over
ticks, passes 2 % of the threshold times the ticks it would be debounced for. Both shrink as s rises and nothing else
depends on s: raising it never detects less, nor later.

A rule that has spoken is over once its signal is within the threshold; where its response names `clear_beyond`, once
it is so by that much, and has been for `clear_after_ms`. Else a signal with noise that stays at a threshold would
cross it again and again.

A plan that forgets to watch plausibility or postconditions gets a built-in rule for each: what cannot be believed, or
was not achieved, never counts as well.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from app.governance.estimation import BaseEstimate, cusum
from app.governance.model import CONTROL_PERIOD_S, Alert, Intervention, Response, Signal, WatchRule
from app.governance.signals import SIGNAL_NAMES, Constants, Senses, Signals, WatchState, holds_off
from app.governance.watch_code import Bound, generate

if TYPE_CHECKING:
    from collections.abc import Iterator

    from app.governance.model import Observation, WatchPlan

HEADROOM: Final = 1.05
"""A violation is more than this times the limit: the truth overshoots a command on the limit by a few percent."""

CUSUM_SHARE: Final = 0.02

NOWHERE: Final = BaseEstimate()

IMPLAUSIBLE = WatchRule(
    id="watch/implausible",
    signal="implausible",
    emits=Signal.INSTABILITY,
    response=Response(enter=Intervention.ESCALATE),
    above=True,
    threshold=0.5,
    failure="sensor_implausible",
)
UNMET = WatchRule(
    id="watch/postcondition",
    signal="postcondition",
    emits=Signal.VIOLATION,
    response=Response(enter=Intervention.STOP),
    above=True,
    threshold=0.5,
    failure="postcondition_failed",
)
_ALWAYS: Final = (IMPLAUSIBLE, UNMET)


class _Row(NamedTuple):
    """One rule, compiled: violated unless sign · signal ≤ limit, for `ticks` in a row; then unless ≤ limit − beyond."""

    place: int
    sign: float
    limit: float
    ticks: int
    rule: WatchRule
    shown: int  # the signal an alert reports
    computed: int | None  # the signal that is the threshold, where it is computed each tick
    beyond: float  # by how much the signal has to be within the limit to be clear
    clearing: int  # for how many ticks

    def violated(self, signals: Signals, by: float = 0.0) -> bool:
        """Say whether the rule is violated, or is not clear of its limit by as much as given."""
        return not self.sign * signals[self.place] <= self.limit - by  # `not … <=`, so that a NaN is a violation

    def lasts(self, signals: Signals, ticks: int) -> int:
        """Return for how long the rule has been violated now, from how long it had been the tick before.

        Less than 0 is for how long it has been clear, as long as that is not for long enough.
        """
        if ticks < 0 or ticks >= self.ticks:  # it has spoken
            if self.violated(signals, self.beyond):
                return max(ticks, self.ticks - 1) + 1
            clear = 1 - min(ticks, 0)
            return -clear if self.beyond > 0.0 and clear < self.clearing else 0
        return ticks + 1 if self.violated(signals) else 0

    def bound(self) -> Bound:
        """Return what a quiet tick satisfies."""
        return Bound(Signals._fields[self.place], self.sign > 0.0, self.sign * self.limit, Signals._fields[self.shown])


class _Sum(NamedTuple):
    place: int
    sign: float
    reference: float
    limit: float
    row: int


class Watcher:
    """Watches one session. Immutable: all that changes is in the `WatchState` that goes in and comes out.

    `watch` is the function generated for the plan (`watch_code.Watch`). The alerts it returns repeat as long as the
    violation lasts; which of them are news is for the caller to tell.
    """

    __slots__ = ("_constants", "_none", "_plain", "_rows", "_signals", "_sums", "plan", "rules", "watch")

    def __init__(self, plan: WatchPlan, rows: tuple[_Row, ...], period_s: float) -> None:
        """Arrange compiled rows; use `compile_watch`."""
        self.plan = plan
        self.rules = tuple(row.rule for row in rows)
        self._rows = rows
        self._signals = {row.rule.id: row.rule.signal for row in rows}
        plain = [(number, row) for number, row in enumerate(rows) if row.rule.method == "threshold"]
        self._plain = sorted(plain, key=lambda numbered: not numbered[1].rule.above)
        self._sums = tuple(
            _Sum(row.place, row.sign, row.limit, _sum_limit(row), number)
            for number, row in enumerate(rows)
            if row.rule.method == "cusum"
        )
        self._constants = Constants.of(plan, period_s)
        self._none = (0.0,) * len(self._sums)
        bounds, holds_on = tuple(row.bound() for row in rows), any(row.beyond > 0.0 for row in rows)
        self.watch: Final = generate(self._constants, bounds, holds_on, self._none, self._judge)

    def begin(
        self, before: WatchState | None = None, *, base: BaseEstimate = NOWHERE, doubted_until_s: float = 0.0
    ) -> WatchState:
        """Return the state an attempt begins with: estimates and doubts live on, all else starts afresh.

        Args:
            before: What watching the same session left; None at its launch.
            base: Where the base was found to be by then, for a launch. Fixes come every fifth tick at best, and until
                the first one odometry alone would tell.
            doubted_until_s: Until when what leapt before a launch is held against its sensor.
        """
        fresh = WatchState(sums=self._none)
        if before is None:
            return fresh._replace(remembered=tuple(Senses(base=base, doubted_until_s=doubted_until_s)))
        kept = before.senses
        lives_on = Senses(
            base=kept.base,
            people=kept.people,
            before=kept.before,
            scatter_m2=kept.scatter_m2,
            doubted_until_s=kept.doubted_until_s,
        )
        return fresh._replace(remembered=tuple(lives_on))

    def let_go(self, state: WatchState) -> WatchState:
        """Return the state after a human let go on: what is within its limit is clear, by however little."""
        return state._replace(lasting=self._violated(state))

    def violated(self, state: WatchState) -> list[str]:
        """Name the rules that are violated now: none that only waits for its signal to be clear by more."""
        return [self.rules[number].id for number, _ in self._violated(state)]

    def _violated(self, state: WatchState) -> tuple[tuple[int, int], ...]:
        signals = state.signals
        lasting = ((self._rows[number], number, ticks) for number, ticks in state.lasting)
        return tuple((number, ticks) for row, number, ticks in lasting if row.beyond == 0.0 or row.violated(signals))

    def signal_of(self, rule: str) -> str:
        """Return the signal that a rule watches; empty where the plan has no such rule."""
        return self._signals.get(rule, "")

    def stale_sensors(self, seen: Observation) -> tuple[str, ...]:
        """Name the sensors whose newest sample is too old; for the record, not for the loop."""
        return self._constants.stale(seen)

    def _judge(
        self, state: WatchState, remembered: tuple[object, ...], measured: tuple[float, ...]
    ) -> tuple[WatchState, tuple[Alert, ...]]:
        """Judge a tick in which something is out of bounds, or adds up."""
        signals = Signals._make(measured)
        sums = tuple(
            [
                cusum(total, row.sign * signals[row.place], row.reference, row.limit)
                for total, row in zip(state.sums, self._sums, strict=True)
            ]
        )
        before = dict(state.lasting)
        lasting = [(number, row.lasts(signals, before.get(number, 0))) for number, row in self._plain]
        added = [row.row for total, row in zip(sums, self._sums, strict=True) if not total <= row.limit]
        lasting += [(number, before.get(number, 0) + 1) for number in added]
        kept = tuple([one for one in lasting if one[1] != 0])
        return WatchState(remembered, measured, kept, sums), tuple(self._alerts(kept, signals))

    def _alerts(self, lasting: tuple[tuple[int, int], ...], signals: Signals) -> Iterator[Alert]:
        for number, ticks in lasting:
            row = self._rows[number]
            if ticks >= row.ticks or row.rule.method == "cusum":  # a sum that has passed its limit has lasted
                limit = _threshold(row, signals)
                lingers = row.beyond > 0.0 and not row.violated(signals)
                if lingers:  # it says what it waits for
                    limit -= row.sign * row.beyond
                yield Alert(row.rule.emits, row.rule.id, signals[row.shown], limit, row.rule.failure, lingers)


def compile_watch(plan: WatchPlan, period_s: float = CONTROL_PERIOD_S) -> Watcher:
    """Compile a plan.

    Raises:
        ValueError: a rule names no signal, has a method or threshold that cannot be watched, or an identifier repeats;
            sensitivity lies outside 0…1.
    """
    if not 0.0 <= plan.sensitivity <= 1.0:
        raise ValueError(f"sensitivity `{plan.sensitivity}`; valid: 0 to 1")
    watched = {rule.signal for rule in plan.rules} | plan.unwatched
    rules = plan.rules + tuple(rule for rule in _ALWAYS if rule.signal not in watched)
    names = [rule.id for rule in rules]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"watch rules {', '.join(f'`{name}`' for name in sorted(twice))} appear twice; ids are unique")
    return Watcher(plan, tuple(_compile(rule, plan, period_s) for rule in rules), period_s)


def without(plan: WatchPlan, *signals: str) -> WatchPlan:
    """Return the plan without every rule about some signals, the built-in ones included: to see what they are good for.

    Policy cannot ask for this; it is for evaluation, which asks of each detector whether anything would be missed.

    Raises:
        ValueError: No rule could be about one of them.
    """
    for signal in signals:
        if signal not in SIGNAL_NAMES:
            raise ValueError(f"unknown signal `{signal}`; valid: {', '.join(f'`{name}`' for name in SIGNAL_NAMES)}")
    rules = tuple(rule for rule in plan.rules if rule.signal not in signals)
    return replace(plan, rules=rules, unwatched=plan.unwatched | set(signals))


def _compile(rule: WatchRule, plan: WatchPlan, period_s: float) -> _Row:
    if rule.signal not in SIGNAL_NAMES:
        valid = ", ".join(f"`{name}`" for name in SIGNAL_NAMES)
        raise ValueError(f"`{rule.id}` watches unknown signal `{rule.signal}`; valid: {valid}")
    if rule.method not in ("threshold", "cusum"):
        raise ValueError(f"`{rule.id}` uses unknown method `{rule.method}`; valid: `threshold`, `cusum`")
    ticks = max(1, math.ceil(rule.for_ms * 2.0 * (1.0 - plan.sensitivity) / (1000.0 * period_s) - 1e-9))
    clear = _clearing(rule, period_s)
    shown = SIGNAL_NAMES.index(rule.signal)
    sign = 1.0 if rule.above else -1.0
    if rule.threshold is not None:
        if not math.isfinite(rule.threshold):
            raise ValueError(f"`{rule.id}` has threshold `{rule.threshold}`; valid: a finite number")
        if holds_off(rule):
            shown = Signals._fields.index("separation_ahead_m")
        return _Row(shown, sign, sign * rule.threshold, ticks, rule, shown, None, *clear)
    computed = _computed(rule, plan)
    if isinstance(computed, tuple):
        margin, threshold = computed
        return _Row(margin, sign, 0.0, ticks, rule, shown, threshold, *clear)
    return _Row(shown, sign, sign * computed, ticks, rule, shown, None, *clear)


def _clearing(rule: WatchRule, period_s: float) -> tuple[float, int]:
    """Return by how much its signal has to be within the threshold to be clear, and for how many ticks."""
    beyond = rule.response.clear_beyond
    if not 0.0 <= beyond < math.inf:
        raise ValueError(f"`{rule.id}` is clear beyond `{beyond}`; valid: 0 or more")
    if rule.method == "cusum" and beyond > 0.0:
        raise ValueError(f"`{rule.id}` has `clear_beyond` and is a sum; only a threshold is cleared by a distance")
    return beyond, math.ceil(rule.response.clear_after_ms / (1000.0 * period_s) - 1e-9)


def _computed(rule: WatchRule, plan: WatchPlan) -> float | tuple[int, int]:
    """Return what stands in for a threshold left to the watcher: a number, or the (margin, threshold) signals."""
    place = Signals._fields.index
    if rule.signal == "separation_m" and plan.separation is not None:
        return place("separation_margin_m"), place("protective_separation_m")
    if rule.signal == "sensor_age_ms":
        return place("sensor_margin_ms"), place("sensor_age_ms")
    numbers = {
        "elapsed_s": plan.timeout_s,
        "zone_margin_m": 0.0,
        "contact_force_n": plan.bounds.contact_force_n,
        "tcp_speed_mps": plan.bounds.tcp_speed_mps * HEADROOM,
        "base_speed_mps": plan.bounds.base_speed_mps * HEADROOM,
        "grip_lost": 0.5,
        "implausible": 0.5,
        "postcondition": 0.5,
    }
    if rule.signal not in numbers:
        raise ValueError(f"`{rule.id}` needs a threshold: nothing computes one for `{rule.signal}` in this profile")
    return float(numbers[rule.signal])


def _threshold(row: _Row, signals: Signals) -> float:
    if row.computed is None:
        return row.sign * row.limit
    if row.rule.signal == "sensor_age_ms":
        return signals.sensor_age_ms - signals.sensor_margin_ms
    return signals[row.computed]


def _sum_limit(row: _Row) -> float:
    return CUSUM_SHARE * max(abs(row.limit), 1e-3) * row.ticks
