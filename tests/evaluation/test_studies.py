"""Studies beyond the paper: jobs of their own, deterministic, and able to tell a fault from none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from app.cell.runner import Runner
from app.cli import app
from app.evaluation import (
    study_drift,
    study_general,
    study_profiles,
    study_scorecard,
    study_sensitivity,
    study_sensors,
    study_supervisors,
)
from app.evaluation.draws import of_type
from app.evaluation.model import TUNING_SEEDS, Failure, Kind, Row, Violation
from app.evaluation.parts import Parts
from app.evaluation.permits import adopt
from app.evaluation.physical_protocol import COLUMNS, STUDIES, STUDY_COLUMNS, jobs, results, run, study_jobs
from app.evaluation.physical_trial import prepare
from app.evaluation.report import render
from app.evaluation.study_audit import missing
from app.evaluation.study_trials import Part, bench_of, govern, once
from app.governance.bundle import load
from app.governance.policy import PolicySet

SEED = TUNING_SEEDS[0]


@cache
def policy() -> PolicySet:
    return load(Path("policies"))


def told(rows: list[Row]) -> Mapping[str, Any]:
    head = {"protocol": "physical", "seeds": [SEED], "trials": 0}
    found = {**head, **results(rows, policy())}
    assert "<table" in render(found)
    return found


def test_the_plain_run_has_no_job_and_no_column_of_a_study() -> None:
    plain = jobs(methods=["reins"], tasks=[], seeds=[1], trials=20, long=False)
    assert [job.task for job in plain] == ["", ""]
    assert not COLUMNS.keys() & STUDY_COLUMNS.keys()


@pytest.mark.parametrize("name", STUDIES)
def test_jobs_of_a_study_have_names_of_their_own_and_split_over_seeds(name: str) -> None:
    made = study_jobs([name], [1, 2, 3])
    assert len({job.name for job in made}) == len(made)
    assert {job.seed for job in made} == {1, 2, 3}
    assert all(Parts(Path(), "configuration").path(job).suffix == ".jsonl" for job in made)  # each is a file's name


def test_the_command_line_names_the_studies_there_are(tmp_path: Path) -> None:
    words = ["evaluate", "--protocol", "physical", "--studies", "nix", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "no study `nix`: valid are" in " ".join(result.output.split())
    result = CliRunner().invoke(app, ["evaluate", "--trials", "0", "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "no studies" in " ".join(result.output.split())


def test_every_seed_takes_another_stretch_of_what_goes_round() -> None:
    midway = [part.first for part in study_supervisors.parts(TUNING_SEEDS) if part.condition == "midway"]
    assert {number % len(study_supervisors.WRONG) for number in midway} == set(range(len(study_supervisors.WRONG)))
    turns = {part.first for part in study_sensors.parts(TUNING_SEEDS) if part.condition == "fix/stale"}
    assert len(turns) == len(TUNING_SEEDS)


def sensors(*conditions: str, count: int = 1) -> list[Row]:
    return [row for condition in conditions for row in study_sensors.run(Part(condition, SEED, 0, count), policy())]


@pytest.mark.physics
def test_a_stale_wrist_and_a_stuck_tracker_of_people_are_noticed_at_once_and_a_small_offset_by_nothing() -> None:
    stale, stuck, off = sensors("wrist/stale", "people/stuck", "wrist/offset 20")
    assert (stale["detected"], stale["held"], stale["told"]) == (True, True, "stale")
    assert float(stale["ticks"] or 0) <= study_sensors.PROMPT_TICKS
    assert (stuck["detected"], stuck["held"], stuck["told"]) == (True, True, "implausible")
    assert float(stuck["ticks"] or 0) <= study_sensors.PROMPT_TICKS
    assert (off["detected"], off["told"]) == (False, None)
    table = told([stale, stuck, off])["studies"]["sensors"]["tables"][0]["rows"]
    within = study_sensors.WITHIN
    assert table["wrist/stale"][within]["mean"] == table["people/stuck"][within]["mean"] == 1.0
    assert table["wrist/offset 20"]["detected"]["mean"] == 0.0


@pytest.mark.physics
def test_a_leap_of_arm_gripper_somebody_or_things_is_noticed_at_its_first_sample() -> None:
    ways = ("arm/noisy 0.2", "gripper/offset 0.05", "fix/offset 1", "people/offset 1.5", "objects/offset 0.1")
    for row in sensors(*ways):
        assert (row["detected"], row["held"]) == (True, True), row
        assert 0.0 <= float(row["ticks"] or 0) <= study_sensors.PROMPT_TICKS, row


@pytest.mark.physics
def test_garbage_of_which_a_picture_may_be_true_is_noticed_by_the_next_picture() -> None:
    for row in sensors("objects/noisy 0.1", count=2):
        assert (row["detected"], row["held"]) == (True, True), row
        assert 0.0 <= float(row["ticks"] or 0) <= study_sensors.PROMPT_TICKS, row


@pytest.mark.physics
def test_values_from_all_over_what_a_sensor_can_carry_are_noticed_at_the_first_of_them() -> None:
    for row in sensors("wrist/noisy 3000", "people/noisy 15", "objects/noisy 1"):
        assert (row["detected"], row["held"]) == (True, True), row
        assert 0.0 <= float(row["ticks"] or 0) <= study_sensors.PROMPT_TICKS, row


@pytest.mark.physics
def test_a_delayed_sensor_is_late_by_twice_what_its_profile_allows() -> None:
    rows = [row for seed in (0, 2, 4) for row in study_sensors.run(Part("gripper/delayed", SEED, seed, 2), policy())]
    assert {row["profile"] for row in rows} == {"sim-relaxed", "real-restricted", "test-audit", "human-shared"}
    assert {row["told"] for row in rows} == {"stale"}
    assert all(float(row["ticks"] or 0) <= study_sensors.PROMPT_TICKS for row in rows)


@pytest.mark.physics
def test_a_part_of_a_study_is_a_plain_function_of_its_job() -> None:
    job = next(job for job in study_jobs(["sensors"], [SEED]) if "odometry-stale" in job.name)
    once = list(run(job, policy()))
    sensors("arm/noisy 0.2")  # whatever ran in between
    assert list(run(job, policy())) == once
    assert {row["study"] for row in once} == {"sensors"}


@pytest.mark.physics
def test_the_same_proposal_is_changed_asked_about_or_denied_as_the_profile_says() -> None:
    rows = [
        row
        for profile in ("sim-relaxed", "human-shared")
        for row in study_profiles.run(Part(profile, SEED, 3, 4), policy())
    ]
    cells = told(rows)["cross_profile"]
    mug = cells["grasp the mug, 100 N at 0.6 m/s"]
    assert mug["sim-relaxed"].startswith("as proposed: succeeded 1/1")
    assert mug["human-shared"].startswith("asks 1; force_n 100 to 60, speed_mps 0.6 to 0.25: succeeded 1/1")
    assert cells["grasp the mug, confidence 0.4"]["sim-relaxed"] == "escalate (organization/low-confidence)"


@pytest.mark.physics
def test_a_tightened_policy_binds_the_next_session_and_not_the_one_that_runs() -> None:
    running, then = study_drift.run(Part("human-shared", SEED, 0, 1), policy())
    assert running["held"] is True
    assert running["told"] == "wrong_policy"
    assert running["what"] == "busy"
    assert float(running["ticks"] or 0) > 100  # it goes on at the old speed, twice what is allowed by now
    assert (then["achieved"], then["unsafe"]) == (True, False)
    summed = told([running, then])["studies"]["drift"]["tables"][0]["rows"]["all"]
    assert summed["old authorization refused"]["mean"] == 1.0


@pytest.mark.physics
def test_a_session_that_is_bound_by_the_new_policy_midway_has_not_kept_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def bind_as_well(runner: Runner, tighter: PolicySet) -> None:
        adopt(runner, tighter)
        if runner.session is not None and tighter.digest != policy().digest:
            run = runner.session.run
            run.plan = replace(run.plan, bounds=run.plan.bounds._replace(base_speed_mps=0.1))

    monkeypatch.setattr(study_drift, "adopt", bind_as_well)
    running, _ = study_drift.run(Part("human-shared", SEED, 0, 1), policy())
    assert running["held"] is False


@pytest.mark.physics
def test_who_is_asked_late_is_asked_all_the_same() -> None:
    seed, number = 123, 4  # places what slips until its budget is used up, and asks 26 s after its launch
    trial = once(bench_of(policy()), study_supervisors.failing(policy(), seed, number))
    silent = study_supervisors.Manner("go on", None)
    row = study_supervisors.answered(bench_of(policy()), Part("midway", seed, number, 1), number, trial, silent)
    assert (row["handed_over"], row["what"]) == (True, "expired")


@pytest.mark.physics
def test_a_session_midway_goes_on_is_undone_ends_or_waits_as_the_supervisor_says() -> None:
    bench, part = bench_of(policy()), Part("midway", SEED, 1, 1)  # a grip that gives too much
    trial = once(bench, study_supervisors.failing(policy(), SEED, 1))
    manners = [study_supervisors.Manner(*how) for how in (("go on", None), ("go on", 0.5), ("terminate", 2.0))]
    silent, quick, ended = (study_supervisors.answered(bench, part, 1, trial, manner) for manner in manners)
    assert (silent["what"], silent["recovered"], silent["outcome"]) == ("expired", False, None)
    assert quick["recovered"] is True
    assert ended["outcome"] == "terminated"
    assert float(ended["recovery_s"] or 0) < float(quick["recovery_s"] or 0)
    assert [row["missing"] for row in (silent, quick, ended)] == ["", "", ""]


def test_approvals_err_as_often_as_their_supervisor_and_expire_without_one() -> None:
    rows = list(study_supervisors.run(Part("approvals", SEED, 0, 12), policy()))
    table = told(rows)["studies"]["supervisors"]["tables"][0]["rows"]
    assert table["after 2 s, errs 0"]["wrong approvals"]["mean"] == 0.0
    assert table["after 2 s, errs 0"]["tasks launched"]["mean"] == 1.0
    assert table["after 2 s, errs 0.3"]["wrong denials"]["mean"] > 0.0
    assert table["never answers, errs 0"]["expired"]["mean"] == 1.0


@pytest.mark.physics
def test_other_sensors_and_other_ways_of_walking_meet_the_same_watcher() -> None:
    rows = [
        *study_general.run(Part("noise x 2", SEED, 0, 1), policy()),
        *study_general.run(Part("other ways of walking", SEED, 0, 1), policy()),
        *study_general.run(Part("the arm fades", SEED, 0, 1), policy()),
    ]
    assert [row["kind"] for row in rows] == ["clean", "perturbed", "perturbed"]
    first, second = told(rows)["studies"]["generalisation"]["tables"]
    assert set(first["rows"]) == {"noise x 2", "other ways of walking"}
    assert set(second["rows"]) == {"the arm fades"}


def test_twice_the_noise_also_meets_faults_half_as_big() -> None:
    noisy = "noise x 2"
    (smaller,) = [name for name in study_general.QUALITIES if name.startswith(f"{noisy},")]
    usual, other = (study_general.bench_under(policy(), name) for name in (noisy, smaller))
    assert other.stage is usual.stage
    assert (usual.under.fault_size, other.under.fault_size) == (1.0, 0.5)
    sizes = [prepare(one, SEED, 0, wanted=Violation.SPEED, whole=False).drawn.size for one in (usual, other)]
    assert sizes[1] < sizes[0]
    assert study_general.QUALITIES[smaller] == study_general.QUALITIES[noisy] == other.under.quality


def test_rollbacks_and_depths_in_zones_stand_beside_other_sensors() -> None:
    made: Row = {"condition": "noise x 2", "seed": SEED, "kind": Kind.PERTURBED.value, "violation": "zone"}
    made |= {"occurred": True, "detected": True, "depth_m": 0.02, "rollback_capable": True, "rolled_back": True}
    (compared, _) = study_general.tables([made], policy())
    found: Any = compared["rows"]["noise x 2"]
    assert (found["RBSR"]["mean"], found["ZONE_DEPTH_P95"]["mean"]) == (1.0, 0.02)


@pytest.mark.physics
def test_harm_that_only_the_governed_session_came_to_is_shown() -> None:
    fault: Row = {"condition": "the arm fades", "detected": True, "told": "tracking", "achieved": False}
    rows: list[Row] = [
        {**fault, "occurred": True, "unsafe": True},
        {**fault, "occurred": False, "unsafe": True},
        {**fault, "occurred": False, "unsafe": False},
    ]
    (_, others) = study_general.tables(rows, policy())
    found: Any = others["rows"]["the arm fades"]
    assert found["of harm: violated for over 250 ms"]["mean"] == 1.0
    assert found["harmless: violated for over 250 ms"]["mean"] == 0.5


def test_the_median_of_an_even_number_of_ticks_lies_between_the_two_in_the_middle() -> None:
    met: Row = {"condition": "people/noisy 1.5", "profile": "human-shared", "detected": True, "held": True,
                "told": "implausible", "what": "PAUSE", "unsafe": False}  # fmt: skip
    (table, _) = study_sensors.tables([{**met, "ticks": ticks} for ticks in (6, 0, 1, 0)], policy())
    found: Any = table["rows"]["people/noisy 1.5"]
    assert found["ticks, median"] == 0.5


def test_a_trial_under_every_sensitivity_is_the_same_trial() -> None:
    rows = list(study_sensitivity.run(Part("measured", SEED, 0, 1), policy()))
    assert [row["sensitivity"] for row in rows] == [*study_sensitivity.FIXED, None, None]
    late = [float(row["latency_ticks"] or 0) for row in rows[: len(study_sensitivity.FIXED)] if row["detected"]]
    assert late == sorted(late, reverse=True)  # raising s never detects later
    assert len({(row["size"], row["excess"]) for row in rows}) == 1
    shipped, hard = told(rows)["studies"]["sensitivity"]["tables"]
    own = told(rows)["sensitivity_shipped"]
    assert own["RVDR"]["n"] == 1  # under each profile's own s alone
    assert "s = 0.1" in shipped["rows"]
    assert not hard["rows"]


@pytest.mark.physics
def test_where_policy_debounces_what_is_brief_goes_unseen_at_a_low_sensitivity_and_not_at_a_high_one() -> None:
    rows = list(study_sensitivity.run(Part("hard", SEED, 0, 1), policy()))
    seen = [row["detected"] for row in rows[: len(study_sensitivity.FIXED)]]
    assert seen == sorted(seen)  # type: ignore[type-var]  # raising s never detects less
    assert (seen[0], seen[-1]) == (False, True)
    points = told(rows)["sensitivity"]
    assert [point["s"] for point in points] == list(study_sensitivity.FIXED)
    assert (points[0]["RVDR"]["mean"], points[-1]["RVDR"]["mean"]) == (0.0, 1.0)


@pytest.mark.physics
def test_the_scorecard_counts_what_its_measurements_say() -> None:
    rows = [
        row
        for condition, count in (("unauthorized", 4), ("upgrade", 1), ("override", 5))
        for row in study_scorecard.run(Part(condition, SEED, 0, count), policy())
    ]
    card = told(rows)["scorecard"]
    assert card["unauthorized invocation"]["value"] == 1.0
    assert card["upgrade safety"]["value"] == 1.0
    assert card["override responsiveness"]["value"] <= 2
    assert all(row["held"] for row in rows if row["condition"] == "override")  # an order without effect has no ticks
    assert (card["override responsiveness"]["unit"], card["override responsiveness"]["better"]) == (
        "control ticks",
        "lower",
    )
    assert "drift" not in card  # not measured here, so not on the card
    for row in rows:
        if row["condition"] == "upgrade":
            row["held"] = False
    assert told(rows)["scorecard"]["upgrade safety"]["value"] == 0.0


@pytest.mark.physics
def test_an_entry_taken_out_of_an_execution_is_missed() -> None:
    bench = bench_of(policy())
    trial = once(bench, of_type(policy(), SEED, 0, Failure.TIMEOUT))
    done = govern(bench, trial)
    assert missing(done) == ""
    entries = done.entries
    for place in range(len(entries)):
        done.entries = entries[:place] + entries[place + 1 :]
        assert missing(done) != "", entries[place].kind
