"""Studies beyond the paper, as extra jobs of protocol `physical`.

A study is a module with

- `TITLE` and `ABOUT`, for the report;
- `parts(seeds)`: its work, cut into stretches of one condition and one seed;
- `run(part, policy)`: the rows of one stretch, a plain function of its arguments;
- `tables(rows, policy)`: what its rows come to.

The scorecard is one as well, and reads the rows of all the others besides its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

from app.evaluation import (
    study_drift,
    study_general,
    study_profiles,
    study_scorecard,
    study_sensitivity,
    study_sensors,
    study_supervisors,
)
from app.evaluation.study_trials import STUDY_COLUMNS, TASK, Part, Table

if TYPE_CHECKING:
    from app.evaluation.jobs import Job
    from app.evaluation.model import Row
    from app.governance.policy import PolicySet

__all__ = ["STUDIES", "STUDY_COLUMNS", "is_study", "run_study", "study_jobs", "study_results"]


class Study(Protocol):
    """What a module of a study offers."""

    TITLE: str
    ABOUT: str

    def parts(self, seeds: Sequence[int]) -> Sequence[Part]:
        """Cut the study into stretches, in the canonical order."""
        ...

    def run(self, part: Part, policy: PolicySet) -> Iterator[Row]:
        """Run a stretch."""
        ...

    def tables(self, rows: Sequence[Row], policy: PolicySet) -> list[Table]:
        """Sum up the study's rows."""
        ...


STUDIES: Final[Mapping[str, Study]] = {
    "profiles": cast("Study", study_profiles),
    "supervisors": cast("Study", study_supervisors),
    "sensors": cast("Study", study_sensors),
    "generalisation": cast("Study", study_general),
    "drift": cast("Study", study_drift),
    "sensitivity": cast("Study", study_sensitivity),
    "scorecard": cast("Study", study_scorecard),
}
"""Name → study, in the order of the report."""


def is_study(job: Job) -> bool:
    """Say whether a job belongs to a study."""
    return job.task.startswith(TASK)


def study_jobs(names: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """Cut some studies into jobs."""
    return [part.job(name) for name in names for part in STUDIES[name].parts(seeds)]


def run_study(job: Job, policy: PolicySet) -> Iterator[Row]:
    """Run one job of a study."""
    name, part = Part.of(job)
    yield from STUDIES[name].run(part, policy)


def study_results(rows: Sequence[Row], policy: PolicySet) -> dict[str, Any]:
    """Sum up what studies have measured: the key `studies` of results, and whatever else a study adds to them."""
    by_study: dict[str, list[Row]] = {}
    for row in rows:
        by_study.setdefault(str(row["study"]), []).append(row)
    found: dict[str, Any] = {}
    told: dict[str, Any] = {}
    for name, study in STUDIES.items():
        if name not in by_study:
            continue
        told[name] = {"title": study.TITLE, "about": study.ABOUT, "tables": study.tables(by_study[name], policy)}
    if told:
        found["studies"] = told
    if "profiles" in by_study:
        found["cross_profile"] = study_profiles.cross_profile(by_study["profiles"])
    if "sensitivity" in by_study:
        found["sensitivity"] = study_sensitivity.sweep(by_study["sensitivity"])
        found["sensitivity_shipped"] = study_sensitivity.shipped(by_study["sensitivity"])
    if "scorecard" in by_study:
        found["scorecard"] = study_scorecard.scorecard(by_study)
    return found
