"""Studies beyond the paper: jobs of their own, deterministic, and able to tell a fault from none."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from app.cli import app
from app.evaluation import study_drift, study_profiles, study_sensors
from app.evaluation.model import TUNING_SEEDS, Row
from app.evaluation.physical_protocol import COLUMNS, STUDIES, STUDY_COLUMNS, jobs, results, run, study_jobs
from app.evaluation.report import render
from app.evaluation.study_trials import Part
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


def test_the_command_line_names_the_studies_there_are(tmp_path: Path) -> None:
    words = ["evaluate", "--protocol", "physical", "--studies", "nix", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "no study `nix`: valid are" in " ".join(result.output.split())
    result = CliRunner().invoke(app, ["evaluate", "--trials", "0", "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "no studies" in " ".join(result.output.split())


def sensors(*conditions: str, count: int = 1) -> list[Row]:
    return [row for condition in conditions for row in study_sensors.run(Part(condition, SEED, 0, count), policy())]


@pytest.mark.physics
def test_a_stale_wrist_is_noticed_at_once_and_a_stuck_tracker_of_people_by_nothing() -> None:
    stale, stuck = sensors("wrist/stale", "people/stuck")
    assert (stale["detected"], stale["held"], stale["told"]) == (True, True, "stale")
    assert float(stale["ticks"] or 0) <= study_sensors.PROMPT_TICKS
    assert (stuck["detected"], stuck["told"]) == (False, None)
    table = told([stale, stuck])["studies"]["sensors"]["tables"][0]["rows"]
    assert table["wrist/stale"]["prompt"]["mean"] == 1.0
    assert table["people/stuck"]["detected"]["mean"] == 0.0


@pytest.mark.physics
def test_a_part_of_a_study_is_a_plain_function_of_its_job() -> None:
    job = next(job for job in study_jobs(["sensors"], [SEED]) if "odometry.stale" in job.name)
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
