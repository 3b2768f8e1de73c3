"""The runner on a kinematic robot: launch, pause, stop, hold, humans, and what is recorded before what moves."""

from __future__ import annotations

import itertools
import math
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.cell.display import sitting
from app.cell.journal import Journal, JournalUnavailable
from app.cell.latch import Latch
from app.cell.run import RETURNS_RADPS
from app.cell.runner import LOST, Runner, run_session
from app.governance.model import (
    Command,
    CoveredRecovery,
    Intervention,
    Observation,
    Outcome,
    RecoveryRule,
    Response,
    SkillReport,
    Strategy,
    Wish,
)
from app.governance.permit import SignedAuthorization, mint
from app.protocol import CHANNELS, ROW
from tests.cell.rig import (
    COVERED,
    DIGEST,
    HOME,
    KEEP_AWAY,
    KEY,
    NOW_S,
    PERMIT,
    PLAN,
    RECOVERY,
    RULES,
    STILL,
    FakeSkill,
    Rig,
    rule,
    signed,
)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    if made.journal.healthy:
        made.journal.close()


class BrokenDisk:
    """Makes every write of a journal fail until it is mended."""

    def __init__(self, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        self.broken = False
        append, sync, mark = rig.journal.append, rig.journal.sync, rig.journal.mark

        def failing(deed: object) -> object:
            def do(*args: object, **kwargs: object) -> object:
                if self.broken:
                    raise JournalUnavailable("cannot write journal: no space left on device")
                return deed(*args, **kwargs)  # type: ignore[operator]

            return do

        monkeypatch.setattr(rig.journal, "append", failing(append))
        monkeypatch.setattr(rig.journal, "sync", failing(sync))
        monkeypatch.setattr(rig.journal, "mark", failing(mark))


# -- launching -------------------------------------------------------------------------------------------------------


def test_a_session_runs_to_its_verified_end(rig: Rig) -> None:
    rig.launch()
    assert rig.runner.status is not None
    assert rig.finish()["outcome"] == "succeeded"
    assert rig.statuses() == ["running", "completed"]
    assert [body for body in rig.of("alert") if body["signal"] == "COMPLETION"]
    assert rig.cell.x_m > 2.05
    assert not rig.moving()


def test_run_session_needs_no_server(rig: Rig) -> None:
    outcome, told = run_session(rig.runner, signed())
    assert outcome is Outcome.SUCCEEDED
    assert [entry.kind for entry in told] == ["launch", "status", "alert", "status", "outcome"]
    refused, told = run_session(rig.runner, signed())
    assert refused is None
    assert [entry.kind for entry in told] == ["launch"]


def test_nothing_moves_without_a_session(rig: Rig) -> None:
    rig.ticks(50)
    assert not any(any(command.base_velocity) for command in rig.cell.commands)


@pytest.mark.parametrize(
    ("permit", "code"),
    [
        (signed(cell="elsewhere"), "wrong_cell"),
        (signed(policy_digest="sha256:other"), "wrong_policy"),
        (signed(expires_at_s=NOW_S), "expired"),
        (signed(issued_at_s=NOW_S + 60.0), "not_yet_valid"),
        (mint(PERMIT, Ed25519PrivateKey.generate()), "bad_signature"),
        (SignedAuthorization(b"", b""), "bad_signature"),
    ],
)
def test_a_bad_permit_is_refused_recorded_and_moves_nothing(rig: Rig, permit: SignedAuthorization, code: str) -> None:
    assert rig.runner.launch(permit) == code
    assert rig.last("launch")["refused"] == code
    assert rig.last("launch").get("permit") == (None if code == "bad_signature" else "auth-1")
    rig.ticks(20)
    assert rig.cell.bound == []
    assert not rig.moving()


def test_a_cell_without_a_policy_launches_nothing(rig: Rig, tmp_path: Path) -> None:
    bare = Runner(
        rig.cell,  # type: ignore[arg-type]
        plan_of=rig.plan_of,
        verify=lambda *_: (),
        journal=rig.journal,
        wall=lambda: NOW_S + 1.0,
    )
    assert bare.launch(signed()) == "wrong_policy"


def test_a_permit_is_good_once_even_after_a_restart(rig: Rig, tmp_path: Path) -> None:
    rig.launch()
    rig.finish()
    assert rig.runner.launch(signed()) == "used"
    rig.journal.close()
    rig.journal = Journal(tmp_path / "journal", boot="boot-2")
    rig.runner = rig.start()
    assert rig.runner.launch(signed()) == "used"
    rig.launch(id="auth-2")


def test_a_clock_that_ran_ahead_and_is_put_right_bars_no_launch(rig: Rig, tmp_path: Path) -> None:
    def launch(name: str) -> str | None:
        began = rig.runner.launch(signed(id=name, issued_at_s=rig.now_s, expires_at_s=rig.now_s + 10.0))
        rig.finish()
        rig.runner.acknowledged(rig.journal.last_seq)
        return began

    ahead_s = NOW_S + 3600.0
    for name in ("auth-1", "auth-2", "auth-3"):
        rig.now_s += 12.0 if name != "auth-1" else 3600.0
        assert launch(name) is None
    rig.now_s = NOW_S + 40.0
    assert launch("auth-4") is None
    rig.journal.close()
    rig.journal = Journal(tmp_path / "journal", boot="boot-2")
    rig.runner = rig.start()
    assert launch("auth-5") is None
    rig.now_s = ahead_s
    again = signed(id="auth-1", issued_at_s=ahead_s, expires_at_s=ahead_s + 10.0)
    assert rig.runner.launch(again) == "used", "what was used meanwhile is known"


def test_what_may_have_been_used_and_is_forgotten_says_that_the_clock_was_put_back(rig: Rig) -> None:
    rig.journal.mark({"forgotten_s": NOW_S + 3600.0})
    assert rig.runner.launch(signed()) == "clock_put_back"
    rig.ticks(20)
    assert rig.cell.bound == []


def test_a_permit_that_may_have_been_bound_before_the_journal_was_lost_is_good_no_more(
    rig: Rig, tmp_path: Path
) -> None:
    rig.launch()
    rig.finish()
    rig.journal.close()
    (tmp_path / "journal").unlink()
    rig.journal = Journal(tmp_path / "journal", boot="boot-2", now_s=rig.now_s)
    rig.runner = rig.start()
    assert rig.runner.launch(signed()) == "used"
    rig.launch(id="auth-2", issued_at_s=rig.now_s)


REFUSED: dict[str, tuple[Callable[[Rig], object], Callable[[Rig], object]]] = {
    "wrong_policy": (
        lambda rig: rig.runner.adopt(policy_digest="sha256:other", key=KEY.public_key()),
        lambda rig: rig.runner.adopt(policy_digest=DIGEST, key=KEY.public_key()),
    ),
    "not_yet_valid": (lambda rig: setattr(rig, "now_s", NOW_S - 10.0), lambda rig: setattr(rig, "now_s", NOW_S + 1.0)),
    "expired": (lambda rig: setattr(rig, "now_s", NOW_S + 90.0), lambda rig: setattr(rig, "now_s", NOW_S + 1.0)),
    "holding": (lambda rig: rig.runner.hold("link"), lambda rig: rig.runner.welcomed()),
    "estop_latched": (lambda rig: rig.runner.estop("anyone"), lambda rig: rig.runner.reset("operator")),
    "busy": (lambda rig: rig.launch(id="auth-0", invocation="inv-0"), Rig.finish),
    "no_such_session": (lambda _: None, lambda _: None),
}


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("code", REFUSED)
def test_an_authorization_that_was_refused_begins_nothing_when_it_is_said_again(
    rig: Rig, tmp_path: Path, code: str, restarted: bool
) -> None:
    before, after = REFUSED[code]
    before(rig)
    assert rig.runner.launch(signed(), anew=code == "no_such_session") == code
    after(rig)
    if restarted:
        rig.journal.close()
        rig.journal = Journal(tmp_path / "journal", boot="boot-2")
        rig.runner = rig.start()
    assert rig.runner.launch(signed()) == "used"
    assert rig.runner.invocation is None


def test_what_no_journal_took_of_a_refusal_counts_all_the_same(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    disk.broken = True
    assert rig.runner.launch(signed()) == "journal_unavailable"
    disk.broken = False
    assert rig.runner.launch(signed()) == "used"
    rig.launch(id="auth-2")


def test_a_second_launch_while_one_runs_is_refused(rig: Rig) -> None:
    rig.launch()
    assert rig.runner.launch(signed(id="auth-2", invocation="inv-2")) == "busy"
    assert rig.finish()["outcome"] == "succeeded"


def test_what_the_substrate_will_not_have_ends_as_a_fault_with_its_reason(rig: Rig) -> None:
    rig.cell.refuses["grasp_object"] = "wrong_cell"
    assert rig.runner.launch(signed()) == "wrong_cell"
    assert rig.last("outcome")["outcome"] == "fault"
    assert rig.last("outcome")["code"] == "wrong_cell"
    assert rig.runner.invocation is None


def test_what_cannot_be_prepared_is_recovered_from_by_its_row(rig: Rig) -> None:
    rig.cell.refuses["grasp_object"] = "object_lost"
    assert rig.runner.launch(signed()) is None
    rig.until(lambda: "release_and_retract" in rig.cell.runs)
    assert [body["failure"] for body in rig.of("recovery")] == ["object_lost"]
    assert rig.cell.bound[0][0] == "release_and_retract"
    rig.cell.refuses.clear()
    assert rig.finish()["outcome"] == "recovered"


def test_what_cannot_be_prepared_moves_nothing_until_somebody_says_so(rig: Rig) -> None:
    rig.cell.refuses["grasp_object"] = "unreachable"
    rig.launch()
    rig.until_status("escalated")
    assert rig.cell.bound == []
    assert rig.cell.x_m == 2.0
    assert rig.of("cell")[-1] == {"what": "unprepared", "detail": "unreachable: grasp_object"}


def test_what_a_human_has_tried_again_and_cannot_even_begin_ends_instead_of_asking_the_same(rig: Rig) -> None:
    rig.cell.refuses["grasp_object"] = "unreachable"
    rig.launch()
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    ended = rig.finish()
    assert (ended["outcome"], ended["code"], ended["failure"]) == ("terminated", "unreachable", "unreachable")
    assert (rig.last("recovery")["strategy"], rig.last("recovery")["reason"]) == ("TERMINATE", "unprepared")
    assert len(rig.of("escalation")) == 1
    assert rig.cell.bound == []


def test_what_cannot_begin_for_another_reason_than_a_human_was_asked_about_asks_anew(rig: Rig) -> None:
    rig.cell.refuses["grasp_object"] = "unreachable"
    rig.launch()
    rig.until_status("escalated")
    rig.cell.refuses["grasp_object"] = "placement_failed"
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    rig.ticks(5)
    rig.until_status("escalated")
    assert [body["failure"] for body in rig.of("escalation")] == ["unreachable", "placement_failed"]


def test_a_grant_policy_has_no_plan_for_does_not_run(rig: Rig) -> None:
    rig.plan = replace(PLAN, sensitivity=7.0)
    assert rig.runner.launch(signed()) == "no_plan"
    assert rig.cell.bound == []


def test_the_launch_is_on_the_disk_before_anything_is_bound(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    bind, sync = rig.cell.bind, rig.journal.sync
    monkeypatch.setattr(rig.cell, "bind", lambda *a, **k: (order.append("bind"), bind(*a, **k))[1])
    monkeypatch.setattr(rig.journal, "sync", lambda: (order.append("sync"), sync())[1])
    rig.launch()
    assert order == ["sync", "bind"]


# -- the loop --------------------------------------------------------------------------------------------------------


def test_telemetry_holds_every_tick(rig: Rig) -> None:
    rig.launch()
    rig.finish()
    rows = list(ROW.iter_unpack(bytes(rig.telemetry)))
    assert len(rows) == rig.last("outcome")["ticks"]
    rates = [row[CHANNELS.index("rate")] for row in rows]
    assert rates[0] < 0.1
    assert max(rates) == 1.0
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)
    with pytest.raises(struct.error):
        ROW.unpack(bytes(rig.telemetry)[:-1])


def test_a_skill_that_asks_too_much_is_clamped(rig: Rig) -> None:
    rig.cell.script.base_mps = 5.0
    rig.cell.script.grip_n = 500.0
    rig.launch()
    rig.ticks(60)
    assert max(math.hypot(*command.base_velocity[:2]) for command in rig.cell.commands) <= 0.3 + 1e-9
    assert max(command.grip_force_n for command in rig.cell.commands) <= 60.0


@pytest.mark.parametrize("error", [RuntimeError("boom"), ZeroDivisionError(), ValueError("x")])
def test_a_skill_that_raises_has_failed_and_the_watcher_lives_on(rig: Rig, error: Exception) -> None:
    rig.cell.script.raises = error
    rig.launch()
    rig.until_status("escalated")
    assert rig.last("recovery")["failure"] == "skill_error"
    assert "skill_error" in [body["what"] for body in rig.of("cell")]
    rig.ticks(100)
    assert not rig.moving()


def test_a_substrate_that_breaks_is_cut_off_and_latched(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.launch()
    rig.ticks(20)
    with monkeypatch.context() as broken:
        broken.setattr(rig.cell, "step", lambda _command: 1 / 0)
        rig.runner.tick()
    assert rig.cell.stops == [0]
    assert rig.runner.latched
    assert "broken" in [body["what"] for body in rig.of("cell")]
    assert [(body["outcome"], body["code"]) for body in rig.of("outcome")] == [("fault", "guard_broken")]
    assert "ZeroDivisionError" in rig.runner.view().broken
    assert rig.runner.launch(signed(id="auth-2")) == "estop_latched"
    broke = rig.runner.view().tick
    assert rig.runner.reset("operator", broke - 1) == "broken_since"
    assert (rig.runner.latched, rig.of("cell")[-1]["what"]) == (True, "reset_refused")
    assert rig.runner.reset("operator", broke) is None


@pytest.mark.parametrize("reading", [1e39, -1e39, math.inf, math.nan])
def test_a_reading_beyond_single_precision_is_for_the_watcher_to_judge(rig: Rig, reading: float) -> None:
    rig.launch()
    rig.ticks(40)
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=reading)
    rig.ticks(3)
    assert not rig.runner.latched
    assert rig.runner.broken == ""
    assert rig.of("alert")


def test_a_skill_that_cannot_say_where_it_is_fails_and_takes_nothing_along(rig: Rig) -> None:
    rig.launch()
    rig.ticks(40)
    session = rig.runner.session
    assert session is not None
    phase = session.run.skill.report().phase

    def broken() -> SkillReport:
        raise RuntimeError("nothing to say")

    session.run.skill.report = broken  # type: ignore[method-assign]
    rig.ticks(1)
    shown = sitting(session)
    assert shown is not None
    assert shown.phase in {phase, "failed"}
    rig.until(lambda: bool(rig.of("recovery")))
    assert not rig.runner.latched


# -- pause, resume, escalate -----------------------------------------------------------------------------------------


def walking_in(rig: Rig, *, from_s: float, until_s: float) -> None:
    rig.cell.script.base_mps = 0.0
    rig.cell.script.ticks = 300

    def walks(now_s: float) -> tuple[tuple[float, float], ...]:
        """As fast as the tracker can follow: who is elsewhere from one picture to the next is not believed."""
        gone_s = now_s - from_s if now_s < until_s else until_s + 0.2 - now_s
        return ((7.5 - min(4.6, max(0.0, gone_s * 23.0)), 2.0),)

    rig.cell.people = walks


def test_a_person_pauses_and_their_leaving_resumes(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=2.0)
    rig.launch()
    rig.until_status("paused")
    entered = rig.last("intervention")
    assert (entered["intervention"], entered["rule"]) == ("PAUSE", "separation_m")
    rig.until_status("running")
    assert rig.finish()["outcome"] == "succeeded"
    assert rig.statuses() == ["running", "paused", "running", "completed"]


def test_a_pause_ramps_down_as_declared_and_then_the_skill_is_not_asked_any_more(rig: Rig) -> None:
    rig.cell.script.ticks = 400
    rig.launch()
    rig.ticks(100)
    assert rig.cell.commands[-1].base_velocity[0] == pytest.approx(0.2)
    before = len(rig.cell.commands)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(60)
    speeds = [command.base_velocity[0] for command in rig.cell.commands[before:]]
    assert speeds[0] < 0.2
    assert all(later <= earlier for earlier, later in itertools.pairwise(speeds))
    steepest = max(earlier - later for earlier, later in zip([0.2, *speeds], speeds, strict=False)) / 0.01
    assert steepest <= 1.0 * 1.1  # base_deceleration_mps2
    assert speeds[-1] == 0.0
    assert speeds.index(0.0) <= 25
    assert not rig.moving()
    assert rig.runner.human("inv-1", "resume", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"


def test_power_is_cut_where_an_arm_moves_while_it_is_held(rig: Rig) -> None:
    rig.launch()
    rig.ticks(50)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(20)
    paused_s = rig.cell.observe().time_s

    def sags(seen: Observation) -> Observation:
        first, a, b, c, d, e = seen.joint_rad
        return seen._replace(joint_rad=(first - 0.3 * (seen.time_s - paused_s), a, b, c, d, e))

    rig.cell.lie = sags
    rig.ticks(60)
    assert rig.runner.status == "paused"
    assert rig.finish()["code"] == "not_held"
    assert rig.runner.latched
    assert rig.cell.stops == [0]
    assert "held" in rig.runner.view().broken


@pytest.mark.parametrize("first_mps", [0.2, math.nan])
def test_power_is_cut_where_a_hand_gains_speed_that_has_stood_however_fast_it_was(rig: Rig, first_mps: float) -> None:
    rig.cell.script.ticks = 300.0
    rig.launch()
    rig.ticks(50)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    session = rig.runner.session
    assert session is not None
    session.seen = session.seen._replace(tcp_speed_mps=first_mps)
    rig.ticks(100)
    assert rig.runner.status == "paused"
    rig.cell.lie = lambda seen: seen._replace(tcp_speed_mps=0.35)
    rig.ticks(2)
    assert rig.last("outcome")["code"] == "not_held"


def test_an_arm_that_gave_way_once_is_watched_anew_in_every_later_hold(rig: Rig) -> None:
    touches = rule("contact_force_n", name="touches", threshold=50.0, response=KEEP_AWAY)
    rig.plan = replace(PLAN, rules=(*RULES, touches))
    rig.cell.script.ticks = 300.0
    rig.launch()
    rig.ticks(50)
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=60.0 + seen.contact_force_n)
    rig.ticks(5)
    rig.cell.lie = lambda seen: seen
    rig.until_status("running")  # 0.2 s later: it need not give way for as long as it was to
    rig.ticks(50)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(20)
    paused_s = rig.cell.observe().time_s
    rig.cell.lie = lambda seen: seen._replace(
        joint_rad=(seen.joint_rad[0] - 0.3 * (seen.time_s - paused_s), *seen.joint_rad[1:])
    )
    rig.ticks(75)
    assert rig.last("outcome")["code"] == "not_held"


def test_an_arm_that_gave_way_is_led_back_slowly_to_where_its_skill_has_it(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    turning = itertools.count()

    def act(_: FakeSkill, seen: Observation, rate: float) -> Command:  # by a way of its own, wherever the arm is
        there = 0.0001 * next(turning)
        return Command((there, *HOME[1:]), (0.01, *STILL[1:]), (0.0, 0.0, 0.0), 0.0)

    monkeypatch.setattr(FakeSkill, "act", act)
    rig.launch()
    rig.ticks(50)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(20)
    session = rig.runner.session
    assert session is not None
    session.run.given = (-0.1, *HOME[1:])  # as contact would have it
    rig.ticks(30)
    before = len(rig.cell.commands) - 1
    assert rig.runner.human("inv-1", "resume", "operator") is None
    rig.ticks(60)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(20)
    assert rig.runner.human("inv-1", "resume", "operator") is None
    rig.ticks(120)
    turned = [command.joint_rad[0] for command in rig.cell.commands[before:]]
    assert turned[0] == -0.1
    steps = [later - earlier for earlier, later in itertools.pairwise(turned)]
    assert min(steps) >= 0.0
    assert max(steps) <= 0.01 * RETURNS_RADPS + 0.0001 + 1e-9
    assert turned[-1] == pytest.approx(0.0001 * (next(turning) - 1))


def test_a_reading_that_is_wrong_does_not_hold_up_a_stop(rig: Rig) -> None:
    rig.plan = replace(rig.plan, rules=())
    rig.cell.script.base_mps = 0.0
    rig.cell.lie = lambda seen: seen._replace(base_velocity=(5.0, 0.0, 0.0))  # while the arm moves alone
    rig.launch()
    rig.ticks(50)
    assert rig.moving()
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(6)
    assert not rig.moving()


def test_a_fix_that_leapt_while_nothing_ran_is_held_against_it_and_the_next_session_does_not_forget(rig: Rig) -> None:
    rig.cell.script.ticks = 2000
    rig.ticks(20)
    rig.cell.lie = lambda seen: seen if seen.fix is None else seen._replace(fix=seen.fix._replace(x_m=9.0))
    rig.ticks(200)
    for number in (1, 2):
        rig.launch(id=f"auth-{number}")
        rig.ticks(3)
        assert rig.runner.status == "escalated", rig.story()
        assert rig.last("escalation")["reason"] == "watch/implausible"
        rig.runner.human("inv-1", "resolve_terminate", "operator")
        rig.finish()
    rig.launch(id="auth-3")
    rig.ticks(550)
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    rig.ticks(60)
    assert rig.runner.status == "running", "whoever has looked may let it go on"
    rig.runner.human("inv-1", "cancel", "operator")
    rig.finish()
    rig.launch(id="auth-4")
    rig.ticks(60)
    assert rig.runner.status == "running", "and what was waited out is over"


def test_a_person_who_stays_ends_the_session_where_nobody_can_be_asked(rig: Rig) -> None:
    rig.recovery = replace(rig.recovery, can_ask=False)
    walking_in(rig, from_s=1.0, until_s=math.inf)
    rig.launch()
    ended = rig.finish()
    assert (ended["outcome"], ended["code"]) == ("terminated", "separation_m")
    assert "escalated" not in rig.statuses()
    assert rig.cell.stops == [1]


def test_a_person_who_stays_becomes_a_question_to_a_human(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=6.0)
    rig.launch()
    rig.until_status("escalated")
    assert rig.last("escalation")["reason"] == "separation_m"
    rig.until(lambda: rig.cell.observe().time_s > 8.0)
    assert rig.runner.status == "escalated"
    assert not rig.moving()
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"


def test_a_human_s_resume_does_not_overrule_a_person_who_still_stands_there(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=3.0)
    rig.launch()
    rig.until_status("paused")
    rig.ticks(50)
    at = rig.cell.x_m
    assert rig.runner.human("inv-1", "resume", "operator") is None
    rig.ticks(2)
    assert rig.runner.status == "paused"
    assert rig.cell.x_m == pytest.approx(at, abs=1e-3)


def test_an_operator_s_pause_outlasts_the_person(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=2.0)
    rig.launch()
    rig.until_status("paused")
    rig.runner.human("inv-1", "pause", "operator")
    rig.ticks(300)
    assert rig.runner.status == "paused"
    rig.runner.human("inv-1", "resume", "operator")
    assert rig.finish()["outcome"] == "succeeded"


def test_a_resume_that_comes_late_does_not_answer_what_is_asked_meanwhile(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=6.0)
    rig.launch()
    rig.until_status("escalated")
    rig.until(lambda: rig.cell.observe().time_s > 8.0)
    assert rig.runner.human("inv-1", "resume", "operator") == "not_paused"
    rig.ticks(50)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)


# -- violations and recovery -----------------------------------------------------------------------------------------


def test_what_pads_feel_while_the_hand_opens_says_nothing_of_how_it_grips(rig: Rig) -> None:
    warning = rule("grip_force_n", threshold=63.0, response=Response(enter=Intervention.CONTINUE))
    rig.plan = replace(rig.plan, rules=(warning,))
    rig.cell.script.grip_n = -12.0
    rig.cell.lie = lambda seen: seen._replace(grip_force_n=70.0 if seen.time_s < 0.2 else 1.0)
    rig.launch()
    rig.ticks(30)
    rig.cell.script.grip_n = 40.0
    rig.ticks(5)
    assert rig.of("alert")[0]["rule"] == "grip_force_n"
    assert rig.cell.commands[-1].grip_force_n == 40.0


def test_slip_is_released_retracted_and_grasped_again(rig: Rig) -> None:
    rig.cell.script.grip_n = 20.0
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 0.5 else 0.0
    )
    rig.launch()
    assert rig.finish()["outcome"] == "recovered"
    assert [name for name, _, _ in rig.cell.bound] == ["grasp_object", "release_and_retract", "grasp_object"]
    assert [body["strategy"] for body in rig.of("recovery")] == ["RECOVERY_CAPABILITY", "RETRY"]
    assert rig.statuses() == ["running", "recovering", "running", "completed"]
    assert rig.last("outcome")["retries"] == 1


@pytest.mark.parametrize("until_s", [0.56, 99.0])
def test_what_begins_while_a_recovery_waits_for_standstill_is_answered_at_once(rig: Rig, until_s: float) -> None:
    """A recovery has grace for what it was started for; a contact that came behind a slip is no such thing.

    Nor is one that is over by then: whoever was met has moved away, and the robot is not to move on as if nothing was.
    """
    rig.cell.script.grip_n = 20.0
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 0.5 else 0.0,
        contact_force_n=seen.contact_force_n + (300.0 if 0.53 < seen.time_s < until_s else 0.0),
    )
    rig.launch()
    rig.until(lambda: "release_and_retract" in rig.cell.runs)
    began = len(rig.cell.commands)
    rig.until_status("escalated")
    assert len(rig.cell.commands) - began <= 2
    assert [body["failure"] for body in rig.of("recovery")] == ["object_lost", "contact"]
    if until_s < 99.0:  # it was asked about, and is not asked about again
        assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
        assert rig.finish()["outcome"] == "recovered"


def test_what_policy_bears_for_a_while_is_borne_no_longer_because_something_else_was_tried_again(rig: Rig) -> None:
    bears = Response(enter=Intervention.CONTINUE, persist_ms=2500, otherwise=Intervention.STOP)
    borne = rule("contact_force_n", name="borne", threshold=50.0, failure="contact", response=bears)
    rig.plan = replace(PLAN, rules=(*RULES, borne))
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=60.0 + seen.contact_force_n)
    rig.cell.script.ticks = 300.0
    rig.cell.script.fails = {("grasp_object", 1): "grasp_failed"}
    rig.launch()
    rig.until_status("escalated")
    assert rig.cell.runs == {"grasp_object": 2}
    assert rig.last("escalation")["reason"] == "contact"
    assert rig.runner.view().tick < 300


def test_what_is_within_its_limit_by_too_little_holds_until_an_operator_lets_go_on(rig: Rig) -> None:
    near = replace(KEEP_AWAY, clear_beyond=10.0, persist_ms=None)
    rig.plan = replace(PLAN, rules=(*RULES, rule("contact_force_n", name="near", threshold=50.0, response=near)))
    rig.cell.script.ticks = 300.0
    rig.cell.lie = lambda seen: seen._replace(
        contact_force_n=(60.0 if 1.0 < seen.time_s < 1.2 else 45.0) + seen.contact_force_n
    )
    rig.launch()
    rig.until_status("paused")
    shown = sitting(rig.runner.session)
    assert shown is not None
    assert shown.violated == ["near"]
    rig.ticks(100)
    assert rig.runner.status == "paused"
    shown = sitting(rig.runner.session)
    assert shown is not None
    assert shown.violated == [], "told to go on it waits for nothing"
    assert rig.runner.human("inv-1", "resume", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"
    assert [body["status"] for body in rig.of("status")].count("paused") == 1
    assert [body["signal"] for body in rig.of("alert") if body["rule"] == "near"] == ["VIOLATION", "NORMAL"]


def test_what_is_within_its_limit_by_too_little_holds_no_rollback_that_an_operator_orders(rig: Rig) -> None:
    near = replace(KEEP_AWAY, clear_beyond=10.0, persist_ms=1000)
    rig.plan = replace(PLAN, rules=(*RULES, rule("contact_force_n", name="near", threshold=50.0, response=near)))
    rig.cell.script.ticks = 400.0
    rig.cell.lie = lambda seen: seen._replace(
        contact_force_n=(60.0 if 1.0 < seen.time_s < 2.2 else 45.0) + seen.contact_force_n
    )
    rig.launch()
    rig.until_status("escalated")
    rig.ticks(50)
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.ticks(200)
    assert rig.statuses() == ["running", "paused", "escalated", "recovering"]
    assert rig.cell.runs["retrace"] == 1


def test_a_recovery_waits_for_whoever_is_in_the_way(rig: Rig) -> None:
    rig.cell.script.grip_n = 20.0
    walking_in(rig, from_s=0.9, until_s=3.0)
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 1.0 else 0.0
    )
    rig.plan = replace(
        PLAN, rules=(replace(RULES[0], response=replace(RULES[0].response, persist_ms=None)), *RULES[1:])
    )
    rig.launch()
    rig.until(lambda: rig.cell.observe().time_s > 2.9)
    assert rig.cell.runs == {"grasp_object": 1}
    assert rig.runner.status == "paused"
    assert rig.finish()["outcome"] == "recovered"


def test_a_recovery_interrupted_before_it_began_begins_once_the_way_is_clear(rig: Rig) -> None:
    rig.cell.script.grip_n = 20.0
    walking_in(rig, from_s=0.90, until_s=2.0)
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 1.0 else 0.0
    )
    rig.launch()
    rig.until_status("paused")
    assert rig.cell.runs == {"grasp_object": 1}
    assert [body["strategy"] for body in rig.of("recovery")] == ["RECOVERY_CAPABILITY"]
    assert rig.finish()["outcome"] == "recovered"


def test_the_recovery_is_on_the_disk_before_it_is_bound(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.cell.script.fails[("grasp_object", 1)] = "grasp_failed"
    rig.launch()
    order: list[str] = []
    bind, sync = rig.cell.bind, rig.journal.sync
    monkeypatch.setattr(rig.cell, "bind", lambda *a, **k: (order.append("bind"), bind(*a, **k))[1])
    monkeypatch.setattr(rig.journal, "sync", lambda: (order.append("sync"), sync())[1])
    assert rig.finish()["outcome"] == "recovered"
    assert order == ["sync", "bind"]


@pytest.mark.parametrize("why", ["a failure", "a human", "another attempt"])
def test_nothing_moves_while_the_disk_is_waited_for(rig: Rig, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    rig.cell.script.ticks = 400
    rig.launch()
    rig.ticks(60)
    assert rig.moving()
    order: list[object] = []
    bind, sync = rig.cell.bind, rig.journal.sync
    monkeypatch.setattr(rig.cell, "bind", lambda *a, **k: (order.append("bind"), bind(*a, **k))[1])
    monkeypatch.setattr(rig.journal, "sync", lambda: (order.append(rig.moving()), sync())[1])
    if why == "a human":
        assert rig.runner.launch(signed(id="auth-2", capability="takeover")) is None
    else:
        rig.cell.script.fails["grasp_object", 1] = "grasp_failed" if why == "a failure" else "blocked"
    if why == "another attempt":
        rig.until_status("escalated")
        assert rig.moving()
        assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    rig.until(lambda: "bind" in order)
    assert order == [False, "bind"]


def test_safer_mode_runs_carefully(rig: Rig) -> None:
    rig.cell.lie = lambda seen: seen._replace(tcp_speed_mps=0.6) if seen.tick == 60 else seen
    rig.launch()
    assert rig.finish()["outcome"] == "recovered"
    assert [careful for _, _, careful in rig.cell.bound] == [False, True]


def test_what_is_not_covered_asks_a_human_and_his_word_tries_again(rig: Rig) -> None:
    rig.cell.script.fails[("grasp_object", 1)] = "grasp_failed"
    rig.launch(recoveries=COVERED[2:])
    rig.until_status("escalated")
    assert rig.last("recovery")["reason"] == "not_covered"
    rig.ticks(200)
    assert not rig.moving()
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    assert rig.finish()["outcome"] == "recovered"


def test_what_is_not_covered_ends_where_nobody_can_be_asked(rig: Rig) -> None:
    rig.recovery = replace(rig.recovery, can_ask=False)
    rig.cell.script.fails[("grasp_object", 1)] = "grasp_failed"
    rig.launch(recoveries=())
    assert rig.finish()["outcome"] == "terminated"
    assert (rig.last("recovery")["strategy"], rig.last("recovery")["reason"]) == ("TERMINATE", "nobody_to_ask")
    assert not rig.of("escalation")


def test_a_human_may_let_it_end_instead(rig: Rig) -> None:
    rig.cell.script.fails[("grasp_object", 1)] = "grasp_failed"
    rig.launch(recoveries=())
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", "resolve_terminate", "operator") is None
    assert rig.finish()["outcome"] == "terminated"


def test_a_claim_that_sensors_do_not_confirm_is_a_failure(rig: Rig) -> None:
    rig.cell.unmet = ("object_secured",)
    rig.launch()
    rig.until(lambda: len(rig.of("recovery")) >= 2)
    assert [body["strategy"] for body in rig.of("recovery")][:2] == ["RETRY", "ROLLBACK"]
    assert rig.of("recovery")[0]["unmet"] == ["object_secured"]
    rig.until_status("escalated")
    assert rig.of("outcome") == []


def test_a_rollback_that_sensors_confirm_ends_as_rolled_back(rig: Rig) -> None:
    rig.cell.script.base_mps = 0.0
    rig.launch()
    rig.ticks(40)
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    assert rig.finish()["outcome"] == "rolled_back"
    assert [name for name, _, _ in rig.cell.bound] == ["grasp_object", "retrace"]
    assert rig.statuses()[-1] == "failed"


def test_a_rollback_that_did_not_bring_the_base_back_is_a_failure(rig: Rig) -> None:
    rig.cell.script.base_mps = 0.25
    rig.launch()
    rig.ticks(90)
    rig.runner.human("inv-1", "rollback", "operator")
    rig.until_status("escalated")
    assert "base_pose" in rig.last("recovery")["unmet"]
    assert rig.last("recovery")["failure"] == "rollback_failed"
    assert rig.of("outcome") == []


@pytest.mark.parametrize("steps", [(Strategy.RETRY,), (Strategy.RECOVERY_CAPABILITY, Strategy.RETRY)])
def test_no_new_attempt_is_made_of_a_rollback_that_failed(rig: Rig, steps: tuple[Strategy, ...]) -> None:
    table = (RecoveryRule(on="any", do=(*steps, Strategy.ASK_HUMAN), capability="release_and_retract"),)
    rig.recovery, rig.cell.script.fails = replace(RECOVERY, rules=table), {("retrace", 1): "no_path"}
    rig.launch()
    rig.ticks(40)
    rig.runner.human("inv-1", "rollback", "operator")
    rig.until_status("escalated")
    assert rig.runs("grasp_object") == 1
    assert rig.last("escalation")["failure"] == "rollback_failed"


RETREATING = replace(RECOVERY, rollback_capability="safe_retreat")
RETREAT = CoveredRecovery(strategy=Strategy.ROLLBACK, capability="safe_retreat", params={})


def roll_back_elsewhere(rig: Rig) -> None:
    """Roll back by a retreat, which leaves the base where the attempt had driven it."""
    rig.recovery, rig.cell.script.base_mps = RETREATING, 0.25
    rig.launch(recoveries=(RETREAT, *COVERED))
    rig.ticks(90)
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.until(lambda: rig.cell.bound[-1][0] == "safe_retreat")
    rig.cell.script.base_mps = 0.0


def test_a_rollback_that_ends_elsewhere_is_led_back_along_the_path_and_verified_there(rig: Rig) -> None:
    roll_back_elsewhere(rig)
    away_m = rig.cell.x_m - 2.0
    assert away_m > 0.15
    rig.until(lambda: rig.cell.bound[-1][0] == "retrace")
    rig.cell.script.base_mps = -away_m  # over the second that a skill takes here
    assert rig.finish()["outcome"] == "rolled_back"
    assert rig.cell.x_m == pytest.approx(2.0, abs=0.02)
    assert [(body["strategy"], body["reason"]) for body in rig.of("recovery")] == [
        ("ROLLBACK", "asked"),
        ("ROLLBACK", "elsewhere"),
    ]
    assert rig.last("recovery")["unmet"] == ["base_pose"]


def test_a_rollback_that_is_led_back_and_does_not_arrive_has_failed(rig: Rig) -> None:
    roll_back_elsewhere(rig)
    rig.until_status("escalated")
    assert [name for name, _, _ in rig.cell.bound] == ["grasp_object", "safe_retreat", "retrace"]
    assert rig.last("recovery")["failure"] == "rollback_failed"


def test_a_rollback_that_left_more_undone_than_where_the_base_stands_is_not_driven_anywhere(rig: Rig) -> None:
    rig.cell.unmet = ("arm_retracted",)
    roll_back_elsewhere(rig)
    rig.until_status("escalated")
    assert [name for name, _, _ in rig.cell.bound] == ["grasp_object", "safe_retreat"]
    assert rig.last("recovery")["failure"] == "rollback_failed"


def test_a_rollback_that_is_not_covered_holds_and_asks(rig: Rig) -> None:
    rig.launch(recoveries=())
    rig.ticks(40)
    assert rig.runner.human("inv-1", "rollback", "operator") == "rollback_unavailable"
    rig.ticks(60)
    assert rig.runner.status == "escalated"
    assert not rig.moving()


def rolling_back(rig: Rig, **launched: object) -> None:
    rig.cell.script.base_mps = 0.0
    rig.launch(**launched)
    rig.ticks(40)
    assert rig.runner.human("inv-1", "rollback", "operator") is None


def rolled_back_once(rig: Rig) -> bool:
    """Say whether the session ends as undone, with one rollback, and nobody asked."""
    ended = rig.finish()["outcome"]
    tried = [body["strategy"] for body in rig.of("recovery")]
    return (ended, tried, rig.runs("retrace")) == ("rolled_back", ["ROLLBACK"], 1)


@pytest.mark.parametrize("ticks", [0, 1, 60], ids=["at once", "while it brakes", "while it moves"])
def test_a_rollback_that_is_ordered_twice_is_under_way_already(rig: Rig, ticks: int) -> None:
    rolling_back(rig)
    rig.ticks(ticks)
    assert rig.runner.human("inv-1", "rollback", "another") is None
    assert rig.runner.status == "recovering"
    assert rolled_back_once(rig)
    assert rig.of("escalation") == []


@pytest.mark.parametrize("word", ["rollback", "resume"])
@pytest.mark.parametrize("ticks", [0, 60], ids=["before it is bound", "while it moves"])
def test_a_rollback_that_somebody_paused_is_carried_on(rig: Rig, ticks: int, word: str) -> None:
    rolling_back(rig)
    rig.ticks(ticks)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.ticks(100)
    assert (rig.runner.status, rig.moving()) == ("paused", False)
    assert rig.runner.human("inv-1", word, "operator") is None
    assert rig.statuses()[-1] == "recovering"
    assert rolled_back_once(rig)
    assert rig.of("escalation") == []


def test_a_rollback_that_was_paused_when_the_link_was_lost_is_carried_on_as_one(rig: Rig) -> None:
    rig.cell.script.fails = {("grasp_object", 1): "blocked"}
    rig.cell.script.base_mps = 0.0
    rig.launch()
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.runner.human("inv-1", "pause", "operator")
    rig.runner.hold("link")
    assert (rig.last("escalation")["reason"], rig.last("escalation")["failure"]) == ("link", None)
    assert rig.runner.human("inv-1", "rollback", "operator") == "holding"
    rig.runner.welcomed()
    rig.ticks(60)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    assert rig.finish()["outcome"] == "rolled_back"
    assert rig.runs("grasp_object") == 1


def test_a_denied_phase_that_is_undone_may_be_ordered_undone_once_more(rig: Rig) -> None:
    rig.cell.script.releases, rig.cell.script.base_mps = True, 0.0
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    for who in ("olivia", "oscar"):
        assert rig.runner.human("inv-1", "rollback", who) is None
    assert rolled_back_once(rig)
    assert len(rig.of("escalation")) == 1


def test_a_rollback_that_failed_is_not_had_again_and_asks(rig: Rig) -> None:
    rolling_back(rig)
    rig.cell.script.fails = {("retrace", 1): "blocked"}
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", "rollback", "operator") == "rollback_unavailable"
    rig.ticks(60)
    assert (rig.runner.status, rig.moving(), rig.runs("retrace")) == ("escalated", False, 1)


@pytest.mark.parametrize("when", ["bound", "run"])
def test_a_rollback_that_cannot_begin_has_failed_like_one_that_began(rig: Rig, when: str) -> None:
    if when == "bound":
        rig.cell.refuses["retrace"] = "grasp_failed"  # a failure whose row would try the capability anew
    else:
        rig.cell.script.fails[("retrace", 1)] = "grasp_failed"
    rig.launch()
    rig.ticks(30)
    assert rig.runner.human("inv-1", "rollback", "olivia") is None
    rig.until_status("escalated")
    assert [body["failure"] for body in rig.of("recovery")] == ["operator", "rollback_failed"]
    assert rig.runs("grasp_object") == 1


@pytest.mark.parametrize("when", ["bound", "run"])
def test_a_recovery_that_cannot_begin_is_not_skipped(rig: Rig, when: str) -> None:
    rig.cell.script.fails[("grasp_object", 1)] = "object_lost"
    if when == "bound":
        rig.cell.refuses["release_and_retract"] = "grasp_failed"
    else:
        rig.cell.script.fails[("release_and_retract", 1)] = "grasp_failed"
    rig.launch()
    rig.until(lambda: len(rig.of("recovery")) == 2)
    rig.ticks(60)
    assert rig.runs("grasp_object") == 1, "what was to be restored first is not restored"


def test_a_rollback_that_is_ordered_again_leaves_alone_what_mends_the_first(rig: Rig) -> None:
    mending = RecoveryRule(
        on="any", do=(Strategy.RECOVERY_CAPABILITY, Strategy.ASK_HUMAN), capability="release_and_retract"
    )
    rig.recovery = replace(RECOVERY, rules=(mending,))
    rolling_back(rig)
    rig.cell.script.fails = {("retrace", 1): "blocked"}
    rig.until(lambda: rig.runs("release_and_retract"))
    assert rig.runner.human("inv-1", "rollback", "operator") == "rollback_unavailable"
    assert rig.of("escalation") == []
    rig.ticks(40)
    assert rig.runner.status == "recovering"


def test_a_rollback_of_what_a_human_drove_is_carried_on_as_any(rig: Rig) -> None:
    rig.cell.script.base_mps = 0.0
    rig.launch()
    rig.ticks(20)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover")) is None
    rig.ticks(60)
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    assert rig.runner.human("inv-1", "rollback", "another") is None
    rig.runner.human("inv-1", "pause", "operator")
    rig.ticks(60)
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    assert rolled_back_once(rig)


@pytest.mark.parametrize("failed", [False, True], ids=["under way", "failed"])
@pytest.mark.parametrize("asked_by", ["operator", "table"])
def test_a_rollback_that_a_human_took_over_from_may_be_had_again_unless_it_had_failed(
    rig: Rig, asked_by: str, failed: bool
) -> None:
    rig.recovery = replace(RECOVERY, rules=(RecoveryRule(on="any", do=(Strategy.ROLLBACK, Strategy.ASK_HUMAN)),))
    rig.cell.script.base_mps = 0.0
    rig.cell.script.fails = {("retrace", 1): "blocked"} if failed else {}
    if asked_by == "table":
        rig.cell.script.fails["grasp_object", 1] = "blocked"
    rig.launch()
    rig.ticks(20)
    if asked_by == "operator":
        assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.until(lambda: rig.runs("retrace"))
    rig.until_status("escalated" if failed else "recovering")
    rig.ticks(20)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover")) is None
    refused = rig.runner.human("inv-1", "rollback", "operator")
    assert refused == ("rollback_unavailable" if failed else None)
    if not failed:
        assert rig.finish()["outcome"] == "rolled_back"
        assert rig.runs("retrace") == 2


def test_a_violation_while_a_rollback_is_paused_has_ended_it_all_the_same(rig: Rig) -> None:
    rolling_back(rig)
    rig.until(lambda: rig.runs("retrace"))
    rig.ticks(40)
    rig.runner.human("inv-1", "pause", "operator")
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=250.0)
    rig.ticks(30)
    rig.cell.lie = lambda seen: seen
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.until_status("escalated")
    assert rig.last("recovery")["failure"] == "rollback_failed"


def test_a_timeout_terminates(rig: Rig) -> None:
    rig.plan = replace(PLAN, timeout_s=0.5)
    rig.launch()
    assert rig.finish()["outcome"] == "terminated"
    assert rig.last("recovery")["failure"] == "timeout"


def test_a_stop_without_a_failure_ends_by_category_1(rig: Rig) -> None:
    rig.plan = replace(PLAN, rules=(rule("contact_force_n", threshold=100.0),))
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=400.0 + seen.time_s) if seen.tick > 50 else seen
    rig.launch()
    assert rig.finish()["outcome"] == "stopped"
    assert rig.cell.stops == [1]
    rig.cell.lie = lambda seen: seen
    rig.launch(id="auth-2", invocation="inv-2")  # power comes back with a new launch, not by itself
    assert rig.finish()["outcome"] == "succeeded"


def test_a_sensor_that_says_nan_holds_and_asks(rig: Rig) -> None:
    rig.cell.lie = lambda seen: seen._replace(residual_nm=(math.nan,) * 6) if seen.tick > 50 else seen
    rig.launch()
    rig.until_status("escalated")
    assert rig.last("escalation")["reason"] == "watch/implausible"
    rig.ticks(100)
    assert not rig.moving()


@pytest.mark.parametrize(
    "lie",
    [{"contact_force_n": 400.0}, {"base_velocity": (0.6, 0.0, 0.0)}, {"tcp_speed_mps": 0.9}],
    ids=["force", "base speed", "tcp speed"],
)
def test_the_command_changes_in_the_tick_after_a_violation_is_seen(rig: Rig, lie: dict[str, object]) -> None:
    rig.cell.script.ticks = 500
    rig.launch()
    rig.ticks(100)
    steady = rig.cell.commands[-1].base_velocity[0]
    start = len(rig.cell.commands)
    rig.cell.lie = lambda seen: seen._replace(**lie)  # type: ignore[arg-type]
    rig.ticks(3)
    changed = [number for number, c in enumerate(rig.cell.commands[start:]) if c.base_velocity[0] < steady - 1e-6]
    assert changed[0] <= 2  # the first tick still sees it


# -- what happens while somebody holds it -----------------------------------------------------------------------------


@pytest.mark.parametrize("held", ["paused", "asked"])
def test_what_ends_the_attempt_while_it_is_held_has_ended_it(rig: Rig, held: str) -> None:
    hits = {"on": False}
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=180.0 + (seen.tick % 7) * 0.1) if hits["on"] else seen
    rig.cell.script.releases = held == "asked"
    rig.launch(confirm_before=("release",) if held == "asked" else ())
    if held == "asked":
        rig.until_status("escalated")
    else:
        rig.ticks(40)
        assert rig.runner.human("inv-1", "pause", "operator") is None
        rig.ticks(3)
    hits["on"] = True
    rig.ticks(20)
    hits["on"] = False
    rig.ticks(100)
    assert not rig.of("intervention")  # whoever holds it is asked first
    assert rig.runner.human("inv-1", "confirm" if held == "asked" else "resume", "operator") is None
    rig.until(lambda: bool(rig.of("recovery")))
    assert rig.last("intervention")["rule"] == "contact_force_n"
    assert rig.last("recovery")["failure"] == "contact"


def test_a_hold_that_a_recovery_was_to_end_in_is_over_once_a_human_has_taken_over(rig: Rig) -> None:
    rig.cell.script.fails = {("grasp_object", 1): "object_lost"}
    rig.launch()
    rig.until_status("recovering")
    rig.runner.hold("link")
    rig.runner.welcomed()
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.ticks(100)
    assert rig.runner.launch(signed(id="auth-3"), anew=True) is None
    assert rig.finish()["outcome"] == "recovered"
    assert not rig.of("escalation")


@pytest.mark.parametrize("left", [False, True], ids=["handed back", "let go of"])
def test_what_is_taken_over_and_given_back_before_it_stands_is_bound_anew(rig: Rig, left: bool) -> None:
    rig.cell.script.ticks = 500
    rig.launch()
    rig.ticks(100)
    assert rig.moving()
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.ticks(2)
    if left:
        assert rig.runner.human("inv-1", "let_go", "server") is None
        rig.ticks(100)
        assert rig.runner.status == "escalated"
    assert rig.runner.launch(signed(id="auth-3"), anew=True) is None
    assert rig.finish()["outcome"] == "recovered"
    assert [capability for capability, *_ in rig.cell.bound] == ["grasp_object", "grasp_object"]
    assert not [body for body in rig.of("launch") if "refused" in body]


# -- confirmations ---------------------------------------------------------------------------------------------------


def test_a_phase_that_needs_a_confirmation_does_not_begin_without(rig: Rig) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    assert rig.last("escalation")["reason"] == "confirm:release"
    assert not rig.moving()
    rig.ticks(200)
    assert not rig.moving()
    assert rig.runner.human("inv-1", "confirm", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"
    assert len(rig.of("escalation")) == 1


@pytest.mark.parametrize(("op", "refused"), [("resume", "not_paused"), ("resolve_continue", "needs_confirmation")])
def test_a_word_about_something_else_does_not_confirm_a_phase_that_waits_meanwhile(
    rig: Rig, op: str, refused: str
) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", op, "operator") == refused
    rig.ticks(50)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)


def test_a_phase_is_confirmed_anew_in_every_attempt(rig: Rig) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", "confirm", "operator") is None
    rig.ticks(3)
    rig.cell.script.fails = {("grasp_object", 1): "grasp_failed"}
    rig.until(lambda: len(rig.of("escalation")) == 2)
    assert rig.last("escalation")["reason"] == "confirm:release"


@pytest.mark.parametrize("before", [(), ("release",)], ids=["nothing to confirm before", "confirmed before"])
def test_a_hand_back_asks_what_its_own_authorization_has_confirmed(rig: Rig, before: tuple[str, ...]) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=before)
    if before:
        rig.until_status("escalated")
        assert rig.runner.human("inv-1", "confirm", "operator") is None
    rig.ticks(2)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.ticks(60)
    asked = len(rig.of("escalation"))
    assert rig.runner.launch(signed(id="auth-3", confirm_before=("release",)), anew=True) is None
    rig.until(lambda: len(rig.of("escalation")) > asked)
    assert rig.last("escalation")["reason"] == "confirm:release"


def test_a_phase_waits_on_over_a_lost_link_and_goes_on_by_its_own_word_alone(rig: Rig) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    for _ in range(2):
        rig.runner.hold("link")
        assert rig.runner.human("inv-1", "confirm", "operator") == "holding"
        rig.runner.welcomed()
    assert [body["reason"] for body in rig.of("escalation")] == ["confirm:release", "link", "link"]
    assert rig.runner.human("inv-1", "resolve_continue", "operator") == "needs_confirmation"
    rig.ticks(50)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)
    assert rig.runner.human("inv-1", "confirm", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"
    assert len(rig.of("escalation")) == 3


def test_a_session_that_its_link_held_asks_once_it_comes_to_a_phase(rig: Rig) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=("release",))
    rig.ticks(20)
    rig.runner.hold("link")
    rig.runner.welcomed()
    rig.ticks(50)
    assert rig.runner.human("inv-1", "confirm", "operator") == "nothing_to_confirm"
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    rig.until_status("escalated")
    assert rig.last("escalation")["reason"] == "confirm:release"
    assert rig.runner.human("inv-1", "confirm", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"


@pytest.mark.parametrize(("held_by", "word"), [("link", "resolve_continue"), ("pause", "resume")])
def test_no_phase_begins_unconfirmed_while_a_session_comes_to_rest(rig: Rig, held_by: str, word: str) -> None:
    rig.cell.script.releases = True
    rig.launch(confirm_before=("release",))
    session = rig.runner.session
    assert session is not None
    rig.until(lambda: session.run.report.progress > 0.49)
    if held_by == "link":
        rig.runner.hold("link")
        rig.runner.welcomed()
    else:
        assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.until(lambda: session.run.report.phase == "release")
    assert not rig.moving()
    rig.ticks(50)
    assert rig.runner.human("inv-1", word, "operator") is None
    rig.until(lambda: bool(rig.of("escalation")) and rig.last("escalation")["reason"] == "confirm:release")
    assert rig.runner.human("inv-1", "confirm", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"


def test_what_is_undone_instead_waits_for_nobody(rig: Rig) -> None:
    rig.cell.script.releases, rig.cell.script.base_mps = True, 0.0
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    assert rig.runner.session is not None
    shown = sitting(rig.runner.session)
    assert shown is not None
    assert shown.waits_for == "confirm:release"
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    shown = sitting(rig.runner.session)
    assert shown is not None
    assert (rig.runner.status, shown.waits_for) == ("recovering", "")


def test_a_rollback_that_is_held_has_nothing_to_confirm(rig: Rig) -> None:
    rig.cell.script.releases, rig.cell.script.base_mps = True, 0.0
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.until(lambda: rig.runs("retrace") == 1)
    assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.runner.hold("link")
    rig.runner.welcomed()
    assert rig.runner.human("inv-1", "confirm", "operator") == "nothing_to_confirm"
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    assert rig.finish()["outcome"] == "rolled_back"


def test_there_is_nothing_to_confirm_where_nothing_waits(rig: Rig) -> None:
    rig.launch()
    rig.ticks(20)
    assert rig.runner.human("inv-1", "confirm", "operator") == "nothing_to_confirm"


# -- silence ---------------------------------------------------------------------------------------------------------


def waiting_for_release(rig: Rig) -> None:
    rig.cell.script.releases, rig.cell.script.base_mps = True, 0.0
    rig.launch(confirm_before=("release",))
    rig.until_status("escalated")


def test_silence_ends_a_session_as_expired_and_no_operator(rig: Rig) -> None:
    waiting_for_release(rig)
    assert rig.runner.human("inv-1", "resolve_terminate", "server", expired=True) is None
    ended = rig.finish()
    assert (ended["outcome"], ended["code"], ended["failure"]) == ("terminated", "expired", None)
    assert rig.last("human") == {"op": "resolve_terminate", "done": True, "refused": None, "expired": True}


def test_silence_undoes_a_session_as_expired(rig: Rig) -> None:
    waiting_for_release(rig)
    assert rig.runner.human("inv-1", "rollback", "server", expired=True) is None
    ended = rig.finish()
    assert (ended["outcome"], ended["code"], ended["failure"]) == ("rolled_back", "verified", "expired")
    assert rig.last("recovery")["failure"] == "expired"


def test_an_operator_who_ends_what_silence_could_not_undo_is_named(rig: Rig) -> None:
    rig.recovery = replace(RECOVERY, rollback_capability=None)
    waiting_for_release(rig)
    assert rig.runner.human("inv-1", "rollback", "server", expired=True) == "rollback_unavailable"
    assert rig.last("escalation")["reason"] == "rollback_unavailable"
    assert rig.runner.human("inv-1", "resolve_terminate", "olivia") is None
    ended = rig.finish()
    assert (ended["outcome"], ended["code"], ended["failure"]) == ("terminated", "operator", None)


def test_an_operators_stop_takes_the_place_of_silence(rig: Rig) -> None:
    waiting_for_release(rig)
    assert rig.runner.human("inv-1", "rollback", "server", expired=True) is None
    assert rig.runner.human("inv-1", "stop", "olivia") is None
    ended = rig.finish()
    assert (ended["outcome"], ended["code"]) == ("stopped", "operator")


def test_silence_lets_nothing_go_on(rig: Rig) -> None:
    waiting_for_release(rig)
    for word in ("confirm", "resolve_continue", "resume"):
        assert rig.runner.human("inv-1", word, "server", expired=True) == "unknown_op"
    assert (rig.runner.status, rig.moving()) == ("escalated", False)


# -- orders ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("op", "outcome", "stops"), [("stop", "stopped", [1]), ("cancel", "cancelled", [])])
def test_stop_and_cancel_come_to_rest_first(rig: Rig, op: str, outcome: str, stops: list[int]) -> None:
    rig.launch()
    rig.ticks(60)
    assert rig.runner.human("inv-1", op, "operator") is None
    assert rig.finish()["outcome"] == outcome
    assert rig.cell.stops == stops
    assert rig.last("human") == {"op": op, "done": True, "refused": None}
    human = next(entry for entry in rig.entries if entry.kind == "human")
    assert human.actor == "operator"


@pytest.mark.parametrize(
    ("op", "refused"), [("resume", "not_paused"), ("resolve_continue", "not_escalated"), ("dance", "unknown_op")]
)
def test_a_word_that_does_not_fit_is_refused_and_recorded(rig: Rig, op: str, refused: str) -> None:
    rig.launch()
    rig.ticks(20)
    assert rig.runner.human("inv-1", op, "operator") == refused
    assert rig.last("human")["refused"] == refused
    assert rig.runner.human("inv-9", op, "operator") == "no_such_session"


def test_nothing_takes_back_a_stop(rig: Rig) -> None:
    rig.launch()
    rig.ticks(60)
    rig.runner.human("inv-1", "stop", "operator")
    for op in ("resume", "resolve_continue", "rollback", "cancel"):
        assert rig.runner.human("inv-1", op, "operator") == "ending"
    assert rig.finish()["outcome"] == "stopped"


@pytest.mark.parametrize("milder", ["cancel", "resolve_terminate"])
@pytest.mark.parametrize("ticks", [0, 1, 5], ids=["at once", "a tick later", "while it brakes"])
def test_a_stop_takes_the_place_of_every_milder_end(rig: Rig, milder: str, ticks: int) -> None:
    rig.launch()
    rig.ticks(60)
    assert rig.runner.human("inv-1", milder, "planner") is None
    rig.ticks(ticks)
    assert rig.moving()
    assert rig.runner.human("inv-1", "stop", "operator") is None
    for op in ("cancel", "resolve_terminate", "resume", "rollback", "stop"):
        assert rig.runner.human("inv-1", op, "operator") == "ending"
    ended = rig.finish()
    assert (ended["outcome"], ended["code"], rig.cell.stops) == ("stopped", "operator", [1])
    assert len(rig.of("outcome")) == 1


def test_a_stop_makes_a_session_that_ends_come_to_rest_no_later(tmp_path: Path) -> None:
    took: list[object] = []
    for words in (("cancel",), ("cancel", "stop")):
        folder = tmp_path / words[-1]
        folder.mkdir()
        rig = Rig(folder)
        rig.launch()
        rig.ticks(60)
        for op in words:
            rig.runner.human("inv-1", op, "operator")
            rig.ticks(2)
        took.append(rig.finish()["ticks"])
        rig.journal.close()
    assert took[0] == took[1]


def test_a_stop_takes_the_place_of_the_end_that_a_rule_began(rig: Rig) -> None:
    rig.recovery = replace(RECOVERY, can_ask=False)
    walking_in(rig, from_s=1.0, until_s=math.inf)
    rig.launch()
    rig.until(lambda: rig.of("intervention") and rig.last("intervention")["intervention"] == "ESCALATE")
    assert rig.runner.human("inv-1", "stop", "operator") is None
    assert rig.finish()["outcome"] == "stopped"


@pytest.mark.parametrize(
    ("how", "failure"), [("estop", None), ("stop", None), ("resolve_terminate", None), ("end_takeover", "taken_over")]
)
def test_what_ends_a_session_after_its_driver_left_is_not_that_it_was_driven(
    rig: Rig, how: str, failure: str | None
) -> None:
    rig.launch()
    rig.ticks(60)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover")) is None
    rig.until(lambda: rig.runner.session is not None and rig.runner.session.run.doing == "takeover")
    assert rig.runner.human("inv-1", "let_go", "server") is None
    if how == "estop":
        rig.runner.estop("anyone")
    else:
        assert rig.runner.human("inv-1", how, "operator") is None
    assert rig.finish()["failure"] == failure


def test_a_stop_takes_the_place_of_the_end_of_a_takeover(rig: Rig) -> None:
    rig.launch()
    rig.ticks(20)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover")) is None
    rig.ticks(60)
    assert rig.runner.human("inv-1", "end_takeover", "operator") is None
    assert rig.runner.human("inv-1", "stop", "another") is None
    assert (rig.finish()["outcome"], rig.cell.stops) == ("stopped", [1])


def test_a_stop_does_not_hide_the_fault_that_a_session_ends_by(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.launch()
    rig.ticks(60)
    disk.broken = True
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=250.0)
    rig.until(lambda: rig.runner.human("inv-1", "pause", "operator") == "ending")
    assert rig.runner.human("inv-1", "stop", "operator") == "ending"
    disk.broken = False
    assert (rig.finish()["outcome"], rig.cell.stops) == ("fault", [1])


def test_an_emergency_stop_is_at_once_latched_and_its_reset_moves_nothing(rig: Rig, tmp_path: Path) -> None:
    rig.launch()
    rig.ticks(60)
    rig.runner.estop("anyone")
    assert rig.cell.stops == [0]
    assert rig.last("outcome")["code"] == "estop"
    assert rig.runner.invocation is None
    assert rig.runner.launch(signed(id="auth-2")) == "estop_latched"
    rig.journal.close()
    rig.journal = Journal(tmp_path / "journal", boot="boot-2")
    rig.runner = rig.start()
    assert rig.runner.latched
    assert rig.runner.launch(signed(id="auth-3")) == "estop_latched"
    assert rig.runner.reset("operator") is None
    at = rig.cell.x_m
    rig.ticks(50)
    assert rig.cell.x_m == at
    assert rig.runner.reset("operator") == "not_latched"
    rig.launch(id="auth-4", invocation="inv-4")
    assert rig.finish()["outcome"] == "succeeded"


@pytest.mark.parametrize("written", [True, False], ids=["in the journal", "beside a journal that takes nothing"])
@pytest.mark.parametrize("running", [True, False])
def test_a_loop_that_breaks_leaves_the_cell_latched_whatever_starts_it_again(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: bool, running: bool
) -> None:
    def again(boot: str) -> None:
        rig.journal.close()
        rig.journal = Journal(tmp_path / "journal", boot=boot)
        rig.runner = rig.start(Latch(tmp_path / "latch"))

    again("boot-2")
    if running:
        rig.launch()
        rig.ticks(60)
    with monkeypatch.context() as broken:
        BrokenDisk(rig, broken).broken = not written
        rig.runner.break_off(RuntimeError("no such tick"))
    assert rig.cell.stops == [0]
    again("boot-3")
    assert rig.runner.latched
    assert ("no such tick" if written else LOST) in rig.runner.view().broken
    assert rig.runner.launch(signed(id="auth-2", invocation="inv-2")) == "estop_latched"
    assert ("estop", "cell") in [(entry.body.get("what"), entry.actor) for entry in rig.entries]
    ends = [(entry.invocation, entry.body["code"]) for entry in rig.entries if entry.kind == "outcome"]
    assert ends == ([("inv-1", "loop_broken" if written else "cell_restarted")] if running else [])
    again("boot-4")
    assert rig.runner.reset("operator", 0) == "broken_since", "nobody has been told yet by this run what broke"
    rig.ticks(1)
    assert rig.runner.reset("operator", rig.runner.view().tick) is None
    again("boot-5")
    assert (rig.runner.latched, rig.runner.view().broken) == (False, "")


def test_an_emergency_stop_that_no_journal_takes_is_kept_beside_it(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.runner = rig.start(Latch(tmp_path / "latch"))
    with monkeypatch.context() as broken:
        BrokenDisk(rig, broken).broken = True
        rig.runner.estop("anyone")
    assert Latch(tmp_path / "latch").found
    assert rig.runner.reset("operator") is None
    assert not Latch(tmp_path / "latch").found


def test_power_that_cannot_be_cut_keeps_no_latch_from_being_set(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(rig.cell, "stop", lambda _category: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            rig.runner.break_off(RuntimeError("no such tick"))
    assert rig.journal.marks["latched"] is True


def test_a_reset_that_comes_when_the_server_is_lost_leaves_the_stop_as_whoever_said_it_was_told(rig: Rig) -> None:
    rig.runner.estop("anyone")
    rig.runner.hold("link")
    assert rig.runner.reset("operator") == "holding"
    assert (rig.runner.latched, rig.of("cell")[-1]["what"]) == (True, "reset_refused")
    rig.runner.welcomed()
    assert rig.runner.reset("operator") is None


# -- the link --------------------------------------------------------------------------------------------------------


def test_a_lost_link_holds_and_only_a_human_lets_it_go_on(rig: Rig) -> None:
    rig.launch()
    rig.ticks(60)
    rig.runner.hold("link")
    rig.ticks(60)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)
    assert rig.runner.view().holding == "link"
    assert rig.runner.standing()
    assert rig.runner.human("inv-1", "resolve_continue", "operator") == "holding"
    rig.runner.welcomed()
    rig.ticks(200)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    assert rig.finish()["outcome"] == "succeeded"


def test_nothing_launches_while_the_cell_holds(rig: Rig) -> None:
    rig.runner.hold("link")
    assert rig.runner.launch(signed()) == "holding"
    rig.runner.welcomed()
    rig.launch(id="auth-2")


def test_a_pause_does_not_end_by_itself_while_the_link_is_lost(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=2.0)
    rig.launch()
    rig.until_status("paused")
    rig.runner.hold("link")
    rig.ticks(400)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)
    assert "paused" not in rig.last("escalation")


def test_what_waits_for_a_human_says_that_an_operator_had_paused_it(rig: Rig) -> None:
    rig.launch()
    rig.ticks(20)
    rig.runner.human("inv-1", "pause", "operator")
    rig.until_status("paused")
    rig.runner.hold("link")
    rig.until_status("escalated")
    assert rig.last("escalation")["paused"] is True
    rig.runner.welcomed()
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    rig.ticks(20)
    rig.runner.hold("link")
    rig.until_status("escalated")
    assert "paused" not in rig.last("escalation")


@pytest.mark.parametrize(
    ("held", "reason", "failure"),
    [
        (lambda rig: rig.runner.hold("link"), "link", "link_lost"),
        (lambda rig: rig.runner.human("inv-1", "escalate", "server"), "policy_changed", "object_lost"),
    ],
    ids=["link", "policy"],
)
def test_a_recovery_under_way_is_finished_when_the_session_has_to_wait_but_no_new_attempt_begins(
    rig: Rig, held: Callable[[Rig], object], reason: str, failure: str
) -> None:
    rig.cell.script.grip_n = 20.0
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 0.5 else 0.0
    )
    rig.launch()
    rig.until(lambda: "release_and_retract" in rig.cell.runs)
    held(rig)
    rig.until_status("escalated")
    assert [name for name, _, _ in rig.cell.bound] == ["grasp_object", "release_and_retract"]
    assert (rig.last("escalation")["reason"], rig.last("escalation")["failure"]) == (reason, failure)
    rig.ticks(100)
    assert not rig.moving()


def test_who_answers_before_the_recovery_has_ended_is_not_asked_again(rig: Rig) -> None:
    rig.cell.script.grip_n = 20.0
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 0.5 else 0.0
    )
    rig.launch()
    rig.until(lambda: "release_and_retract" in rig.cell.runs)
    assert rig.runner.human("inv-1", "resolve_continue", "operator") == "not_escalated"
    rig.runner.hold("link")
    assert rig.runner.human("inv-1", "resolve_continue", "operator") == "holding"
    rig.runner.welcomed()
    assert rig.runner.human("inv-1", "resolve_continue", "operator") is None
    assert rig.last("status")["status"] == "recovering"
    assert rig.finish()["outcome"] == "recovered"
    assert rig.of("escalation") == []


def test_who_answered_for_a_lost_link_has_not_answered_for_another_policy(rig: Rig) -> None:
    rig.cell.script.grip_n = 20.0
    rig.cell.lie = lambda seen: seen._replace(
        slip_m=0.02 if rig.cell.runs == {"grasp_object": 1} and seen.time_s > 0.5 else 0.0
    )
    rig.launch()
    rig.until(lambda: "release_and_retract" in rig.cell.runs)
    rig.runner.human("inv-1", "escalate", "server")
    rig.runner.hold("link")
    rig.runner.welcomed()
    assert rig.runner.human("inv-1", "resolve_continue", "operator") == "not_escalated"
    rig.until_status("escalated")
    assert rig.last("escalation")["reason"] == "policy_changed"


def test_a_shutdown_brings_the_session_to_its_end(rig: Rig) -> None:
    rig.launch()
    rig.ticks(60)
    assert not rig.runner.standing()
    rig.runner.hold("shutdown")
    rig.until(rig.runner.standing)
    assert rig.last("outcome")["code"] == "shutdown"


# -- the journal -----------------------------------------------------------------------------------------------------


def test_what_was_open_when_the_cell_died_is_told_as_a_fault_and_stays_over(rig: Rig, tmp_path: Path) -> None:
    rig.launch()
    rig.ticks(60)
    rig.journal.close()
    for boot in ("boot-2", "boot-3"):
        rig.journal = Journal(tmp_path / "journal", boot=boot)
        rig.runner = rig.start()
        rig.ticks(20)
        rig.journal.close()
    ends = [entry for entry in rig.entries if entry.kind == "outcome"]
    assert [(entry.invocation, entry.body["outcome"], entry.body["code"]) for entry in ends] == [
        ("inv-1", "fault", "cell_restarted")
    ]


def test_without_a_journal_nothing_launches(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    disk.broken = True
    assert rig.runner.launch(signed()) == "journal_unavailable"
    assert "no space" in rig.runner.fault
    assert rig.cell.bound == []


def test_a_session_stops_when_its_record_fails_and_says_so_once_it_can(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.cell.script.fails[("grasp_object", 1)] = "grasp_failed"
    rig.launch()
    rig.ticks(20)
    disk.broken = True
    rig.until(lambda: rig.runner.invocation is None)
    assert not rig.moving()
    assert rig.cell.bound == [("grasp_object", {"object_id": "mug_1"}, False)]
    assert rig.cell.stops == [1]
    assert "no space" in rig.runner.view().fault
    disk.broken = False
    rig.ticks(200)
    assert rig.runner.fault == ""
    assert rig.last("outcome")["code"] == "journal_unavailable"


def test_a_rule_that_speaks_in_every_tick_does_not_keep_an_unrecorded_session_from_its_end(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.plan = replace(PLAN, rules=(rule("contact_force_n", threshold=100.0),))
    rig.launch()
    rig.ticks(20)
    disk.broken = True
    rig.cell.lie = lambda seen: seen._replace(contact_force_n=400.0)
    rig.until(lambda: rig.runner.invocation is None)
    assert not rig.moving()
    assert rig.runner.view().unsaid == {"inv-1": ("fault", "journal_unavailable")}


def test_what_ended_without_a_record_is_said_until_the_record_has_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.launch()
    rig.ticks(20)
    disk.broken = True
    rig.runner.human("inv-1", "stop", "operator")
    assert rig.runner.view().unsaid == {}, "it comes to rest first"
    rig.until(lambda: rig.runner.invocation is None)
    assert rig.runner.launch(signed(id="auth-2", invocation="inv-2")) == "journal_unavailable"
    assert rig.runner.view().unsaid == {"inv-1": ("stopped", "operator"), "inv-2": ("fault", "journal_unavailable")}
    disk.broken = False
    rig.ticks(200)
    assert rig.runner.view().fault == ""
    assert rig.runner.view().unsaid == {}
    assert rig.last("outcome")["outcome"] == "stopped"


@pytest.mark.parametrize("why", ["a failure", "a human"])
def test_what_the_disk_does_not_have_at_standstill_is_not_bound(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    def full() -> None:
        raise JournalUnavailable("cannot write journal: no space left on device")

    rig.launch()
    rig.ticks(20)
    if why == "a failure":
        rig.cell.script.fails["grasp_object", 1] = "grasp_failed"
    with monkeypatch.context() as patched:
        patched.setattr(rig.journal, "sync", full)
        if why == "a human":
            assert rig.runner.launch(signed(id="auth-2", capability="takeover")) is None
        assert rig.finish()["code"] == "journal_unavailable"
    assert not rig.moving()
    assert len(rig.cell.bound) == 1


@pytest.mark.parametrize("capability", ["takeover", "navigate_to"])
def test_a_change_of_hands_begins_nothing_once_the_session_is_over(rig: Rig, capability: str) -> None:
    rig.launch()
    assert rig.finish()["outcome"] == "succeeded"
    late = signed(id="auth-2", capability=capability)
    assert rig.runner.launch(late, anew=True) == "no_such_session"
    assert (rig.last("launch")["permit"], rig.last("launch")["refused"]) == ("auth-2", "no_such_session")
    assert rig.runner.invocation is None


def test_a_human_who_is_let_go_of_while_the_session_is_handed_back_leaves_it_waiting(rig: Rig) -> None:
    rig.launch()
    rig.ticks(60)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.ticks(5)
    assert rig.runner.human("inv-1", "let_go", "server") is None
    assert rig.runner.launch(signed(id="auth-3"), anew=True) is None  # ordered before that
    assert rig.runner.human("inv-1", "let_go", "server") is None
    rig.ticks(300)
    assert (rig.runner.status, rig.moving()) == ("escalated", False)
    assert rig.runner.launch(signed(id="auth-4"), anew=True) is None
    assert rig.finish()["outcome"] in {"succeeded", "recovered"}


def test_nobody_drives_while_somebody_is_too_near_however_long_they_stay(rig: Rig) -> None:
    ahead, presses = Wish(base=(0.1, 0.0, 0.0)), itertools.count(1)

    def press() -> str | None:
        for wish in (Wish(), ahead):
            why = rig.runner.jog("inv-1", "lease", next(presses), wish, "operator")
        return why

    walking_in(rig, from_s=1.0, until_s=5.0)
    rig.cell.script.base_mps = 0.2  # whoever may drive does
    rig.launch(capability="takeover")
    rig.until_status("paused")
    rig.ticks(50)
    for _ in range(30):  # for three seconds, one longer than is waited for before a human is asked
        assert press() == "separation_m"
        rig.ticks(10)
        assert not rig.moving()
    rig.until(lambda: press() is None)
    assert rig.runner.observation.time_s > 5.0
    rig.ticks(10)
    assert rig.moving()


def test_what_the_watcher_still_stops_is_paused_once_more_where_it_could_not_be_handed_back(rig: Rig) -> None:
    walking_in(rig, from_s=1.0, until_s=math.inf)
    rig.launch()
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.until_status("paused")
    assert rig.runner.launch(signed(id="auth-3"), anew=True) is None
    rig.ticks(20)
    assert rig.last("launch")["refused"] == "separation_m"
    assert rig.statuses()[-3:] == ["recovering", "running", "paused"]
    assert rig.runner.jog("inv-1", "lease", 1, Wish(), "operator") is None
    assert rig.runner.jog("inv-1", "lease", 2, Wish(base=(0.1, 0.0, 0.0)), "operator") == "separation_m"


def test_a_human_who_takes_over_from_a_way_back_has_the_controls(rig: Rig) -> None:
    rig.launch()
    rig.ticks(60)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.ticks(5)
    assert rig.runner.human("inv-1", "let_go", "server") is None
    assert rig.runner.launch(signed(id="auth-3"), anew=True) is None
    assert rig.runner.launch(signed(id="auth-4", capability="takeover"), anew=True) is None
    rig.until(lambda: rig.runner.jog("inv-1", "lease", 1, Wish(grip="open"), "operator") != "coming_to_rest")
    assert rig.runner.jog("inv-1", "lease", 2, Wish(), "operator") is None
    assert rig.runner.jog("inv-1", "lease", 3, Wish(base=(0.1, 0.0, 0.0)), "operator") is None


def test_a_rollback_takes_the_place_of_a_way_back_to_the_plan(rig: Rig) -> None:
    rig.cell.script.fails = {("retrace", 1): "no_path"}
    rig.launch()
    rig.ticks(60)
    assert rig.runner.launch(signed(id="auth-2", capability="takeover"), anew=True) is None
    rig.ticks(5)
    assert rig.runner.human("inv-1", "let_go", "server") is None
    assert rig.runner.launch(signed(id="auth-3"), anew=True) is None
    assert rig.runner.human("inv-1", "rollback", "operator") is None
    rig.ticks(5)
    assert rig.runner.human("inv-1", "let_go", "server") == "not_taken_over"
    rig.until_status("escalated")
    assert rig.last("escalation")["failure"] == "rollback_failed"


@pytest.mark.parametrize("held_by", ["paused", "separation_m"])
def test_a_key_pressed_while_the_robot_is_held_does_not_move_it_once_it_is_not(rig: Rig, held_by: str) -> None:
    ahead, presses = Wish(base=(0.1, 0.0, 0.0)), itertools.count(1)

    def say(wish: Wish) -> str | None:
        return rig.runner.jog("inv-1", "lease", next(presses), wish, "operator")

    walking_in(rig, from_s=1.0 if held_by == "separation_m" else math.inf, until_s=2.0)
    rig.launch(capability="takeover")
    rig.ticks(20)
    if held_by == "paused":
        assert rig.runner.human("inv-1", "pause", "operator") is None
    rig.until_status("paused")
    assert say(Wish()) is None
    assert say(ahead) == held_by
    if held_by == "paused":
        assert rig.runner.human("inv-1", "resume", "operator") is None
    rig.until_status("running")
    assert say(ahead) == "release_first"
    assert say(Wish()) is None
    assert say(ahead) is None


def test_a_change_of_hands_that_cannot_be_recorded_does_not_pass_for_the_end_of_what_still_moves(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.launch()
    rig.ticks(20)
    disk.broken = True
    assert rig.runner.launch(signed(id="auth-2", capability="takeover")) == "journal_unavailable"
    assert rig.runner.invocation == "inv-1"
    assert rig.runner.view().unsaid == {}
    rig.until(lambda: rig.runner.invocation is None)
    assert rig.runner.view().unsaid == {"inv-1": ("fault", "journal_unavailable")}


def test_an_idle_cell_notices_a_full_disk_before_it_is_asked_for_anything(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = os.statvfs("/")
    full = os.statvfs_result((*room[:3], 0, 0, *room[5:]))
    with monkeypatch.context() as patched:
        patched.setattr(os, "statvfs", lambda _: full)
        rig.ticks(101)
        assert "`0` bytes are free" in rig.runner.view().fault
        assert rig.runner.launch(signed()) == "journal_unavailable"
        assert rig.cell.bound == []
    rig.ticks(100)
    assert rig.runner.view().fault == ""


@pytest.mark.parametrize("op", ["pause", "stop", "cancel"])
def test_restraint_does_not_wait_for_the_record(rig: Rig, monkeypatch: pytest.MonkeyPatch, op: str) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.launch()
    rig.ticks(60)
    disk.broken = True
    rig.runner.human("inv-1", op, "operator")
    rig.ticks(80)
    assert not rig.moving()


def test_an_emergency_stop_does_not_wait_for_the_record_and_cannot_be_left_without_one(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = BrokenDisk(rig, monkeypatch)
    rig.launch()
    rig.ticks(60)
    disk.broken = True
    rig.runner.estop("anyone")
    assert rig.cell.stops == [0]
    assert rig.runner.reset("operator") == "journal_unavailable"
    assert rig.runner.latched
    disk.broken = False
    rig.ticks(200)
    assert "estop" in [body["what"] for body in rig.of("cell")]


def test_acknowledged_entries_are_forgotten(rig: Rig) -> None:
    rig.launch()
    rig.finish()
    rig.runner.acknowledged(3)
    assert [entry.seq for entry in rig.journal.unacknowledged()] == [4, 5]


def test_the_digest_a_test_signs_is_the_one_the_cell_believes() -> None:
    assert PERMIT.policy_digest == DIGEST
    assert KEY.public_key() is not None
