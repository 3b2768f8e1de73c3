"""Protocol `paper` through the whole harness: what it measures stands in the report, beside the paper's number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from app.evaluation import published
from app.evaluation.campaign import Request, run_campaign
from app.evaluation.methods import ABLATIONS, METHODS
from app.evaluation.model import TUNING_SEEDS
from app.evaluation.report import sections
from app.evaluation.report_tables import figure_at

UNMEASURED = {("tab:recovery", "MRT"), ("tab:recovery", "RBSR"), ("tab:violation", "CEF"), ("tab:effectsize", "")}
"""No time passes in this protocol; a method that never rolls back or never detects has no such share, nor a spread."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Any:
    request = Request(
        protocol="paper",
        methods=(*METHODS, *ABLATIONS),
        seeds=TUNING_SEEDS[:2],
        trials=20,
        tasks=("sorting", "waypoint_reaching"),
        policies=Path("policies"),
    )
    out = tmp_path_factory.mktemp("paper")
    return run_campaign(request, out, workers=2, progress=lambda done, total: None)


@pytest.mark.parametrize("table", published.TABLES, ids=lambda table: table.label)
def test_every_table_of_the_paper_has_our_number(results: Any, table: published.PublishedTable) -> None:
    missing = {
        (table.label, "" if table is published.EFFECT_SIZE else column.key)
        for row in table.rows
        for column in table.columns
        if figure_at(results, *published.places_of(table, row, column.key)) is None
    }
    assert missing <= UNMEASURED


def test_every_class_that_occurs_is_explained_and_shares_add_up(results: Any) -> None:
    for kinds in results["classes"].values():
        for classes in kinds.values():
            assert classes.keys() <= results["class_meanings"].keys()
            assert sum(classes.values()) == pytest.approx(1.0)


def test_nothing_that_this_protocol_measures_is_left_out_of_the_report(results: Any) -> None:
    empty = {section.id for section in sections(results) if section.empty}
    assert empty == {"cross-profile", "scorecard"}
