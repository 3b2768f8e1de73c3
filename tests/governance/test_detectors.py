"""The fused watcher against its detectors called one by one, and plans that leave detectors out."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.governance.detectors import DETECTORS
from app.governance.model import Command, Fix, Observation, PersonTrack, SensorStamps, SkillReport, WatchPlan, Zone
from app.governance.policy_model import SENSORS
from app.governance.signals import SHOWN, SIGNAL_NAMES, Constants, Senses, Signals
from app.governance.watcher import compile_watch, without
from tests.governance.test_watcher import GRIPPING, MOVING, PLAN, PRESS, first_alert, rule, seen, watching

PERIOD_S = 0.01
EVERY = watching(
    *[
        rule(signal, above=signal not in ("zone_margin_m", "separation_m"), threshold=0.0)
        for signal in SIGNAL_NAMES
        if signal != "sensor_age_ms"
    ],
    rule("sensor_age_ms"),
    zones=(PRESS, Zone(name="pit", kind="forbidden", polygon=((-3.0, -3.0), (-2.0, -3.0), (-2.5, -2.0)))),
)


def one_by_one(
    plan: WatchPlan, senses: Senses, seen: Observation, report: SkillReport, command: Command, rate: float
) -> tuple[Senses, Signals]:
    """Do what the generated function does, by plain calls."""
    known: dict[str, object] = {
        **Signals()._asdict(),
        **senses._asdict(),
        "before": senses.before or seen,
        "seen": seen,
        "stamps": seen.stamps_s,
        "report": report,
        "command": command,
        "rate": rate,
        "retried": 1,
        "unmet": 2,
        "plan": Constants.of(plan, PERIOD_S),
    }
    for part in DETECTORS:
        given_ = part.do(*[known[name] for name in part.takes])
        known.update(zip(part.gives, given_ if isinstance(given_, tuple) and len(part.gives) > 1 else (given_,)))  # noqa: B905
    known["before"] = seen
    return Senses(*[known[name] for name in Senses._fields]), Signals(*[known[name] for name in Signals._fields])  # type: ignore[arg-type]


numbers = st.floats(-20.0, 20.0) | st.sampled_from([0.0, math.nan, math.inf, -math.inf])
six = st.tuples(*[numbers] * 6)
changes = st.fixed_dictionaries(
    {},
    optional={
        "contact_force_n": numbers,
        "tcp_speed_mps": numbers,
        "base_velocity": st.tuples(numbers, numbers, numbers),
        "odometry": st.tuples(numbers, numbers, numbers),
        "residual_nm": six,
        "joint_rad": six,
        "joint_speed_radps": six,
        "joint_torque_nm": six,
        "fix": st.none() | st.builds(Fix, numbers, numbers, numbers, numbers),
        "people": st.lists(st.builds(PersonTrack, st.integers(1, 3), numbers, numbers, numbers), max_size=3).map(tuple),
        "slip_m": numbers,
        "pads_loaded": st.booleans(),
        "grip_width_m": numbers,
        "time_s": numbers,
    },
)


Stream = list[tuple[Observation, SkillReport, Command, float]]


def said_alike(plan: WatchPlan, stream: Stream) -> list[Signals]:
    """Hold the fused watcher against the detectors, tick by tick."""
    watcher = compile_watch(plan, PERIOD_S)
    state, senses, told = watcher.begin(), Senses(), []
    for now, word, command, rate in stream:
        state, _ = watcher.watch(state, now, word, command, rate, 1, 2)
        senses, signals = one_by_one(plan, senses, now, word, command, rate)
        assert repr(state.signals) == repr(signals)  # by text, because NaN is not equal to itself
        assert repr(state.senses) == repr(senses)
        told.append(signals)
    return told


@settings(max_examples=150, deadline=None)
@given(
    stream=st.lists(st.tuples(changes, st.sampled_from([GRIPPING, MOVING]), st.sampled_from([0.0, 1.0])), max_size=12)
)
def test_fused_the_detectors_say_what_they_say_one_by_one(
    stream: list[tuple[dict[str, object], Command, float]],
) -> None:
    said_alike(
        EVERY,
        [
            (seen(tick, **changed), SkillReport("move", 0.01 * tick), command, rate)
            for tick, (changed, command, rate) in enumerate(stream)
        ],
    )


def told(*given_: dict[str, object], progress: tuple[float, ...] = (), command: Command = MOVING) -> Stream:
    """Return a stream of a healthy robot, but for what is given of each tick."""
    return [
        (seen(tick, **one), SkillReport("move", progress[tick] if progress else 0.01 * tick), command, 1.0)
        for tick, one in enumerate(given_)
    ]


NOW = SensorStamps(*(0.0,) * 7)
SAME = {"grip_width_m": 0.05}


@pytest.mark.parametrize(
    ("stream", "signal", "values"),
    [
        *((told({"stamps_s": NOW._replace(**{sensor: -0.25})}), "sensor_age_ms", (250.0,)) for sensor in SENSORS),
        # nobody, somebody a metre from the middle of the base, and out of sight: they are where they were seen last
        (told({"people": ()}, {"people": (PersonTrack(1, 0.01, 3.0, 2.0),)}, {"people": ()}),
         "separation_m", (99.0, 0.55, 0.55)),
        # a skill that falls back in its own progress has begun again: one retry of governance's own, one of its own
        (told({}, {}, {}, progress=(0.1, 0.9, 0.1)), "retries", (1.0, 1.0, 2.0)),
        (told({}, {"frames": None}, {}), "implausible", (0.0, 0.0, 0.0)),
        (told(SAME, SAME, SAME, {"grip_width_m": 0.04}), "implausible", (0.0, 0.0, 0.0, 0.0)),
    ],
    ids=[*SENSORS, "a person", "a restart", "no frames", "a width that repeats"],
)  # fmt: skip
def test_fused_and_one_by_one_tell_the_same_of_what_chance_does_not_bring(
    stream: Stream, signal: str, values: tuple[float, ...]
) -> None:
    plan = replace(EVERY, stale_after_ms=dict.fromkeys(SENSORS, 50))
    found = [getattr(signals, signal) for signals in said_alike(plan, stream)]
    assert found == pytest.approx(values, abs=0.01)


# -- leaving detectors out -------------------------------------------------------------------------------------------


def test_a_plan_without_a_detector_is_quiet_about_what_only_it_sees() -> None:
    plan = watching(rule("tracking_error_rad", threshold=0.05), rule("residual_nm", threshold=40.0))
    off = GRIPPING._replace(joint_rad=tuple(joint + 0.1 for joint in GRIPPING.joint_rad))  # type: ignore[arg-type]
    assert first_alert(plan, [seen(0)], command=off)[0] == 0
    assert first_alert(without(plan, "tracking_error_rad"), [seen(0)], command=off) == (None, None)
    pushed = seen(0, residual_nm=(50.0,) * 6)
    assert first_alert(without(plan, "tracking_error_rad"), [pushed], command=off)[0] == 0


@pytest.mark.parametrize(("signal", "sick"), [("implausible", {"peak_force_n": math.nan}), ("postcondition", {})])
def test_the_built_in_rules_can_be_left_out_and_only_on_purpose(signal: str, sick: dict[str, object]) -> None:
    assert first_alert(PLAN, [seen(0, **sick)], unmet=1)[0] == 0
    assert first_alert(without(PLAN, "implausible", "postcondition"), [seen(0, **sick)], unmet=1) == (None, None)
    assert signal not in {one.signal for one in compile_watch(without(PLAN, signal)).rules}
    assert signal in {one.signal for one in compile_watch(PLAN).rules}


def test_what_nobody_watches_and_nobody_shows_is_not_measured() -> None:
    stream = [seen(tick, contact_force_n=3.0 + tick, tcp_speed_mps=0.2) for tick in range(3)]
    bare = compile_watch(without(PLAN, *SIGNAL_NAMES))
    state = bare.begin()
    for one in stream:
        state, alerts = bare.watch(state, one, SkillReport("move", 0.5), MOVING)
        assert alerts == ()
    measured = state.signals._asdict()
    assert measured["tracking_error_rad"] == measured["elapsed_s"] == 0.0
    full, _ = compile_watch(EVERY).watch(compile_watch(EVERY).begin(), stream[0], SkillReport("move", 0.5), MOVING)
    first, _ = bare.watch(bare.begin(), stream[0], SkillReport("move", 0.5), MOVING)
    assert [getattr(first.signals, name) for name in SHOWN] == [getattr(full.signals, name) for name in SHOWN]


@pytest.mark.parametrize("signal", SIGNAL_NAMES)
def test_leaving_one_detector_out_changes_nothing_the_others_say(signal: str) -> None:
    stream = [seen(tick, tcp_speed_mps=0.3, people=(PersonTrack(1, tick * 0.01, 3.0, 2.0),)) for tick in range(5)]
    whole, part = compile_watch(EVERY), compile_watch(without(EVERY, signal))
    state, other = whole.begin(), part.begin()
    for one in stream:
        state, alerts = whole.watch(state, one, SkillReport("move", 0.5), MOVING)
        other, fewer = part.watch(other, one, SkillReport("move", 0.5), MOVING)
        assert fewer == tuple(alert for alert in alerts if alert.rule != signal)


def test_only_signals_can_be_left_out() -> None:
    with pytest.raises(ValueError, match="unknown signal `mood`"):
        without(PLAN, "mood")


def test_plans_that_differ_in_numbers_alone_share_their_code() -> None:
    one = compile_watch(watching(rule("slip_m", threshold=0.1)))
    other = compile_watch(replace(watching(rule("slip_m", threshold=0.2)), sensitivity=0.9, timeout_s=9.0))
    below = compile_watch(watching(rule("slip_m", threshold=0.2, above=False)))
    codes = [made.watch.__code__ for made in (one, other, below)]  # type: ignore[attr-defined]
    assert codes[0] is codes[1]
    assert codes[0] is not codes[2]
