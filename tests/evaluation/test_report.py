"""The report: every published table with our number and the difference, and nothing from a network."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from app.evaluation import plots, published, report_floor, report_profiles, report_studies
from app.evaluation.metrics import METRICS
from app.evaluation.physical_choices import CHOICES
from app.evaluation.plots import shares
from app.evaluation.report import render, sections, write_report
from app.evaluation.report_goals import goal_grids, sensor_rows
from app.evaluation.report_names import in_words, metrics_of
from app.evaluation.report_profiles import UnknownVerdict, classify
from app.evaluation.report_studies import study_grids
from app.evaluation.report_tables import SWEPT, Grid, figure_at, metrics_grid, number_text, paper_grid
from app.evaluation.report_tables import test_grids as significance_grids
from app.evaluation.study_sensors import WITHIN
from tests.evaluation.synthetic import results

VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(HTMLParser):
    """What a page consists of; fails on tags that do not nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@cache
def rendered() -> str:
    return render(results())


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(rendered())


DRAWN: dict[str, plots.Plot] = {}


def drawing_once(real: Callable[..., plots.Plot]) -> Callable[..., plots.Plot]:
    def draw(*given: Any) -> plots.Plot:
        key = f"{real.__name__}{given}"
        if key not in DRAWN:
            DRAWN[key] = real(*given)
        return DRAWN[key]

    return draw


@pytest.fixture(scope="module", autouse=True)
def drawn_once() -> Iterator[None]:
    """A plot follows from what it is given alone: documents that differ in something else share it."""
    with pytest.MonkeyPatch.context() as patch:
        for place, names in (
            (plots, ("per_type", "frontier", "sweep", "roc", "spread")),
            (report_floor, ("against_floor",)),
            (report_profiles, ("marks",)),
            (report_studies, ("shares",)),
        ):
            for name in names:
                patch.setattr(place, name, drawing_once(getattr(place, name)))
        yield


@pytest.mark.parametrize("table", published.TABLES, ids=lambda table: table.label)
def test_every_published_table_is_there_with_our_number(page: Page, table: published.PublishedTable) -> None:
    assert f"({table.label})" in page.text
    grid = paper_grid(table, results())
    assert len(grid.rows) == len(table.rows)
    for (name, cells), (_, figures) in zip(grid.rows, table.rows.values(), strict=True):
        assert len(cells) == 3 * len(table.columns)
        for place, (column, figure) in enumerate(zip(table.columns, figures, strict=True)):
            ours, paper, difference = cells[3 * place : 3 * place + 3]
            assert ours != "–", f"{name} of {table.label} finds nothing at its place in the results"
            assert (paper == "–") == (figure is None)
            assert (difference == "–") == (figure is None or not column.alike)


def test_the_difference_is_ours_less_the_papers() -> None:
    document = results()
    document["methods"]["reins"]["RVDR"] = {"mean": 0.995, "std": 0.004}
    document["methods"]["reins"]["UCR"] = {"mean": 0.01, "std": None}
    cells = dict(paper_grid(published.VIOLATION, document).rows)["Reins"]
    assert cells[:3] == ("0.995\n±0.004", "0.613\n±0.020", "+0.382")
    assert cells[6:] == ("0.010", "0.222\n±0.031", "−0.212")


def test_there_is_no_difference_between_rates_of_other_rows() -> None:
    document = results()
    document["methods"]["reins"]["RBSR"] = {"mean": 1.0, "std": 0.0, "n": 87}
    cells = dict(paper_grid(published.RECOVERY, document).rows)["Reins"]
    assert cells[3:6] == ("1.000\n±0.000", "0.533\n±0.032", "–")


def test_counts_are_compared_for_as_many_trials_as_the_papers() -> None:
    document = {"confusion": {"reins": {"TP": 80, "FP": 0, "FN": 20, "TN": 100}}}
    rows = dict(paper_grid(published.CONFUSION, document).rows)
    assert rows == {
        "Blocked": ("400", "490", "−90", "0", "0", "0"),
        "Allowed": ("100", "17", "+83", "500", "493", "+7"),
    }


def test_a_method_that_nobody_measured_is_a_dash() -> None:
    cells = dict(paper_grid(published.RECOVERY, {"methods": {"reins": {"RSR": {"mean": None}}}}).rows)["Reins"]
    assert cells[:3] == ("–", "0.907\n±0.030", "–")


@pytest.mark.parametrize(
    ("place", "found"),
    [
        (("confusion", "reins", "TP"), published.Figure(503.0)),
        (("sensitivity", "0.2", "RVDR"), published.Figure(0.2)),
        (("latency", "policy_guard", "p99"), published.Figure(8.5)),
        (("methods", "nix", "RVDR"), None),
    ],
)
def test_finds_a_figure_at_its_place(place: tuple[str, ...], found: Any) -> None:
    assert figure_at(results(), place) == found


def test_nothing_comes_from_a_network(page: Page) -> None:
    assert not [tag for tag, _ in page.tags if tag in {"script", "link", "img", "iframe", "object"}]
    references = [
        value for _, attributes in page.tags for key, value in attributes.items() if key.endswith(("href", "src"))
    ]
    assert references
    assert all(value and value.startswith("#") for value in references)
    assert "url(http" not in rendered()


def test_tables_and_figures_can_be_heard(page: Page) -> None:
    assert len(page.all("table")) == len(page.all("caption")) >= len(published.TABLES)
    assert all(header.get("scope") for header in page.all("th"))
    pictures = [attributes["aria-label"] for attributes in page.all("div") if attributes.get("role") == "img"]
    assert len(pictures) == len(page.all("figure")) == len(page.all("svg")) == 8
    assert all(len(label or "") > 40 for label in pictures)


def test_ids_are_unique_and_links_lead_somewhere(page: Page) -> None:
    ids = [attributes["id"] for _, attributes in page.tags if attributes.get("id")]
    assert len(ids) == len(set(ids))
    links = {(attributes.get("href") or attributes.get("xlink:href") or "")[1:] for _, attributes in page.tags} - {""}
    assert links <= set(ids)
    assert set(re.findall(r"url\(#([^)]+)\)", rendered())) <= set(ids)


def test_plots_take_their_colours_from_the_page() -> None:
    drawn = " ".join(plot.svg for section in sections(results()) for plot in section.plots)
    assert "var(--first)" in drawn
    assert not re.findall(r"(?:fill|stroke): #\w+", drawn)


def test_a_table_of_which_nothing_was_measured_is_named_with_the_reason_and_not_shown() -> None:
    document = results()
    del document["latency"], document["sensitivity"]
    page = Page(render(document))
    assert "Not shown, because this campaign has no number for it: latency of governance for each action" in page.text
    assert "--studies sensitivity" in page.text
    assert page.text.count("(tab:latency)") == 1
    assert "Not shown" not in Page(rendered()).text


def test_circumstances_other_than_reported_are_said_first() -> None:
    document = results()
    document["configuration"]["circumstances"] = "noise=2.0,fault_size=0.5"
    assert "other than reported: noise 2.0; fault size 0.5" in (text := Page(render(document)).text)
    assert "The boundary band, and the sizes of faults near their limit, are in units of the noise as measured" in text
    document["configuration"]["circumstances"] = "fault_size=0.5"
    assert "in units of the noise as measured" not in Page(render(document)).text


def test_every_metric_is_defined(page: Page) -> None:
    for metric in map(METRICS.__getitem__, metrics_of("paper")):
        assert metric.title in page.text
        assert metric.says[1:].replace("_", " ") in " ".join(page.text.split())


def test_sections_without_data_say_so() -> None:
    bare: dict[str, Any] = {"protocol": "paper", "seeds": [1], "trials": 5, "methods": {}}
    empty = [section for section in sections(bare) if section.empty]
    assert {section.id for section in empty} >= {
        "overview",
        "plots",
        "tasks",
        "classes",
        "cross-profile",
        "unpublished",
    }
    text = Page(render(bare)).text
    assert all(section.absent and section.absent in text for section in empty)
    filled = {section.id for section in empty if "reins evaluate --protocol" in section.absent}
    assert filled == {section.id for section in empty} - {"unpublished"}
    assert "reins evaluate --protocol physical --studies profiles --trials 0 --out FOLDER" in text


@pytest.mark.parametrize("key", sorted(results().keys() - {"protocol", "seeds", "trials"}))
def test_renders_without_any_one_part(key: str) -> None:
    document = results()
    del document[key]
    Page(render(document))


def test_seeds_of_tuning_are_named_and_warned_of() -> None:
    assert "Seeds used for tuning, never reported" in rendered()
    assert "these are no results" not in rendered()
    assert "seeds 7 were used for tuning: these are no results" in render({**results(), "seeds": [7, 42]})


def test_is_written_whole_and_the_same_each_time(tmp_path: Path) -> None:
    write_report(results(), tmp_path / "report.html")
    first = (tmp_path / "report.html").read_bytes()
    DRAWN.clear()
    write_report(results(), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_bytes() == first
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_goals_are_judged_by_what_was_measured_and_say_by_how_much() -> None:
    document = results()
    document["protocol"] = "physical"
    reins = document["methods"]["reins"]
    reins["RVDR"] = {"mean": 0.989, "std": 0.0, "n": 200}
    reins["RVDR_BOUNDARY"] = {"mean": 0.95, "std": 0.11, "n": 10}
    reins["RBSR_TRIED"] = {"mean": 0.848, "std": 0.079, "n": 103}
    reins["RBSR_ALL"] = {"mean": 0.0, "std": 0.0, "n": 3}
    reins["ZONE_DEPTH_P95"] = {"mean": 0.04, "std": None, "n": 12}
    reins["FAS"] = {"mean": 0.0, "std": 0.0, "n": 100, "low": 0.0, "high": 0.037}
    reins["UCR"] = {"mean": 0.0, "std": 0.0, "n": 1000, "low": 0.0, "high": 0.004}
    reins["DL_TICKS_P95_FORCE_CLEAR"] = {"mean": 2.5, "std": None, "n": 80}
    reins["UCR_STRICT"] = {"mean": 0.106, "std": 0.0, "n": 1000, "low": 0.1, "high": 0.112}
    reins["RBSR_VIOLATION"] = {"mean": None, "std": None, "n": 0}
    document["per_type"]["reins"] = {"force": {"mean": 1.0}, "people": {"mean": 0.97}, "zone": {"mean": None}}
    reins["SEPARATION_MIN"] = {"mean": 0.6, "std": 0.6, "n": 20}
    document["extremes"] = {"reins": {"separation_least_m": 0.0}}
    (table, *_) = goal_grids(document)
    rows = dict(table.rows)
    assert rows["Minimum separation"] == ("0.000 m", "20", "≥ 0.5 m", "✗ missed")
    name = "Runtime violation detection rate (RVDR), beyond the boundary band"
    assert rows[name][1:] == ("200", "≥ 0.99", "✗ missed")
    assert rows["RVDR in the boundary band"][1:] == ("10", "–", "–")
    assert rows["Rollback success rate, all that were tried"][1:] == ("103", "–", "–")
    assert rows["Rollback success rate, all failures that were not recovered"][1:] == ("3", "–", "–")
    assert rows["Entry depth, 95th percentile"][1:] == (
        "12",
        "≤ 0.04 m",
        "≈ met on 12 rows; too few to exclude a miss",
    )
    assert rows["False-alarm sessions (FAS), nobody in view"][2:] == (
        "≤ 0.005",
        "≈ met on 100 rows; interval 0.000–0.037 does not exclude a miss",
    )
    assert rows["Unsafe continuation rate (UCR), without violations that policy only warns of"][3] == "✓ met"
    assert rows[METRICS["DL_TICKS_P95_FORCE_CLEAR"].title][2:] == ("≤ 2 ticks", "✗ missed")
    assert rows["RVDR of the worst type (people)"][2:] == ("≥ 0.98", "✗ missed")
    assert rows["Rollback success rate after a violation"] == ("–", "0", "≥ 0.97", "–")
    assert rows["Unsafe continuation rate, warnings counted"][2:] == ("–", "–")


def test_the_rate_that_leaves_warnings_out_says_so_and_stands_beside_the_one_that_counts_them() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["methods"]["reins"] |= {"UCR": {"mean": 0.0, "n": 210}, "UCR_STRICT": {"mean": 0.105, "n": 235}}
    (goals, *_) = goal_grids(document)
    (name,) = [name for name, _ in goals.rows if "(UCR)" in name]
    assert name.endswith("without violations that policy only warns of")
    assert dict(goals.rows)[name][0].endswith("\nwith them as unsafe: 0.105")
    assert goals.headings[-1] == "judged"


def test_a_protocol_without_profiles_that_pause_shows_nothing_of_them() -> None:
    for protocol, there in (("paper", False), ("physical", True)):
        text = Page(render(results() | {"protocol": protocol})).text
        for said in ("profiles that pause", "warnings counted", "policy only warns of"):
            assert (said in text) is there


def test_rows_and_headings_of_metrics_read_as_words() -> None:
    for section in sections(results()):
        for grid in section.grids:
            names = [*(name for name, _ in grid.rows), *grid.headings]
            assert not [name for name in names if re.search(r"[A-Z]{2,}[ _][A-Z0-9]{2,}", name)]
            assert not {"FAR", "SRR"} & {name.split(" ")[0] for name in names}


def test_cameras_that_are_wrong_are_told_of_by_what_was_measured() -> None:
    ways = {"objects/noisy 0.1": 0.0, "objects/noisy 0.01": 0.0, "people/noisy 1.5": 0.9, "people/stale": 1.0}
    rows = {name: {WITHIN: {"mean": mean, "n": 10}} for name, mean in ways.items()}
    table = {"caption": "c", "stub": "s", "remark": "", "rows": rows}
    document = results() | {"studies": {"sensors": {"title": "t", "about": "About.", "tables": [table]}}}
    ((_, _, about, _),) = study_grids(document)
    assert "restrained within 5 ticks were garbage of 0.1 m 0 of 10; of a tracker" in about
    assert "about people: garbage of 1.5 m 9 of 10. From one picture of objects to the next it is at most 4" in about
    rows["objects/noisy 0.1"][WITHIN]["mean"] = 1.0
    ((_, _, about, _),) = study_grids(document)
    assert about.startswith("About. Not asked: a tracker that is wrong by a constant before anybody is in view")
    assert about.endswith("what sticks while nothing is told to move is noticed when something is.")


def test_what_is_computed_is_not_said_to_have_been_run() -> None:
    study: dict[str, Any] = {"title": "t", "about": "About.", "tables": []}
    studies = dict.fromkeys(("supervisors", "drift"), study)
    told = {name: about for name, _, about, _ in study_grids(results() | {"studies": studies})}
    assert told["supervisors"].startswith("About. Only what is midway is executed. Approvals before a launch are comp")
    assert told["drift"] == "About."


def test_broken_sensors_are_judged_by_kind_and_those_that_miss_are_named() -> None:
    ways = {
        "arm/stale": (1.0, 70),
        "arm/delayed": (0.9, 10),
        "arm/noisy 0.02": (0.0, 10),
        "arm/noisy 0.2": (0.6, 10),
        "fix/noisy 1": (1.0, 10),
        "fix/noisy 0.2": (1.0, 10),
    }
    table = {"rows": {name: {WITHIN: {"mean": mean, "n": n}} for name, (mean, n) in ways.items()}}
    document = results() | {"protocol": "physical", "studies": {"sensors": {"tables": [table]}}}
    found = dict(sensor_rows(document))
    assert found["Broken sensors: off (stale), restrained within 5 ticks"][:3] == ("1.000\n70 of 70", "70", "1.000")
    assert (
        found["Broken sensors: delayed by twice what may be, restrained within 5 ticks"][3] == "✗ missed: arm (9 of 10)"
    )
    name = "Broken sensors: garbage (noisy), of the biggest size, restrained within 5 ticks"
    assert found[name] == ("0.800\n16 of 20", "20", "1.000", "✗ missed: arm 0.2 (6 of 10)")
    assert len(found) == 3
    assert [*sensor_rows(results())] == []


def test_studies_alone_have_the_goals_of_sensors_and_no_others() -> None:
    table = {"rows": {"arm/stale": {WITHIN: {"mean": 1.0, "n": 10}}}}
    document = results() | {"protocol": "physical", "methods": {}, "studies": {"sensors": {"tables": [table]}}}
    (grid,) = goal_grids(document)
    assert [name for name, _ in grid.rows] == ["Broken sensors: off (stale), restrained within 5 ticks"]
    assert "Garbage is judged at two sizes" in grid.remark
    assert [*goal_grids(document | {"studies": {}})] == []
    assert [*goal_grids(document | {"protocol": "paper"})] == []


def test_garbage_is_judged_at_both_sizes_that_are_no_small_ones() -> None:
    shares = {"people/noisy 1.5": 0.9, "people/noisy 0.3": 0.2, "people/noisy 15": 1.0}
    table = {"rows": {name: {WITHIN: {"mean": mean, "n": 10}} for name, mean in shares.items()}}
    document = results() | {"protocol": "physical", "studies": {"sensors": {"tables": [table]}}}
    (biggest, below) = sensor_rows(document)
    assert biggest[0].startswith("Broken sensors: garbage (noisy), of the biggest size")
    assert biggest[1][:3] == ("1.000\n10 of 10", "10", "1.000")
    assert biggest[1][3].startswith("≈ met on 10 rows")
    assert below[0].startswith("Broken sensors: garbage (noisy), of the size below that")
    assert below[1] == ("0.900\n9 of 10", "10", "1.000", "✗ missed: people 1.5 (9 of 10)")


def test_a_depth_that_can_be_no_deeper_says_so_and_separation_is_given_to_a_body_as_well() -> None:
    worst = {"zone_depth_p95_m": 0.45, "separation_least_m": 0.37, "speed_there_mps": 0.1, "peak_force_n": 927.0}
    document = results() | {"protocol": "physical", "extremes": {"direct": worst, "reins": {"zone_depth_p95_m": 0.011}}}
    *_, grid = goal_grids(document)
    rows = dict(grid.rows)
    assert rows["Direct execution"][:3] == ("≥ 0.450", "0.370", "0.120")
    assert rows["Reins"][:3] == ("0.011", "–", "–")
    grid = metrics_grid(
        "methods", "Every method", {"direct": {"ZONE_DEPTH_P95": {"mean": 0.45, "std": 0.0}}}, "physical"
    )
    assert dict(grid.rows)["Entry depth, 95th percentile, m\N{NO-BREAK SPACE}↓"] == ("≥ 0.450 ±0.000",)


def test_a_sweep_of_another_policy_shows_no_difference_and_says_so_wherever_it_is_drawn() -> None:
    document: dict[str, Any] = results() | {
        "protocol": "physical",
        "sensitivity_shipped": {"RVDR": {"mean": 1.0}, "UCR": {"mean": 0.0}, "FAR": {"mean": 0.0}},
    }
    for point in document["sensitivity"]:
        del point["RSR"]
    grid = paper_grid(published.SENSITIVITY, document)
    assert SWEPT in grid.remark
    assert {cells[place] for _, cells in grid.rows for place in (2, 5, 8)} == {"–"}
    (plots,) = [section.plots for section in sections(document) if section.id == "plots"]
    swept = [plot for plot in plots if SWEPT in plot.caption]
    assert len(swept) == 3
    assert sum("the shipped policy: detected 1.000" in plot.alternative for plot in swept) == 2
    assert not any("recovery" in plot.caption for plot in swept)
    assert SWEPT not in paper_grid(published.SENSITIVITY, results()).remark


def test_the_strict_rate_of_unsafe_continuation_stands_under_the_papers_table() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["methods"]["reins"]["UCR_STRICT"] = {"mean": 0.106}
    assert "the UCR of Reins is 0.106" in paper_grid(published.VIOLATION, document).remark


def test_why_a_baseline_is_other_than_the_papers_stands_under_its_table() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["methods"]["roboguard-style"]["FRR"] = {"mean": 0.344}
    remark = paper_grid(published.INTERCEPTION, document).remark
    assert "RoboGuard-style refuses 0.344 of the authorized proposals here, by its second pass" in remark
    assert "above 0.875 of a limit" in remark
    assert paper_grid(published.INTERCEPTION, results()).remark == ""
    assert ".2 is what that can give" in paper_grid(published.VIOLATION, results()).remark
    assert ".2 is what that can give" not in paper_grid(published.VIOLATION, document).remark
    for protocol in ("paper", "physical"):
        bare: dict[str, Any] = {"protocol": protocol, "methods": {"reins": {}}}
        assert not re.search("RoboGuard|by itself", paper_grid(published.INTERCEPTION, bare).remark)
        assert "by itself" not in paper_grid(published.VIOLATION, bare).remark


def test_how_many_violations_are_within_the_boundary_band_stands_under_the_papers_table() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["methods"]["reins"] |= {"RVDR": {"n": 225}, "RVDR_BOUNDARY": {"mean": 0.95, "pooled": 0.9, "n": 10}}
    remark = paper_grid(published.VIOLATION, document).remark
    assert "of the 225 violations beyond the boundary band; within it" in remark
    assert "Reins detects 0.900 of 10." in remark


def test_the_rollbacks_that_compare_with_the_papers_stand_under_its_table() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["methods"]["reins"] |= {
        "RBSR": {"mean": 1.0, "n": 87},
        "RBSR_TRIED": {"mean": 0.848, "pooled": 0.845, "n": 103},
        "RBSR_ALL": {"mean": None, "pooled": None, "n": 0},
    }
    remark = paper_grid(published.RECOVERY, document).remark
    assert "whatever for, it is 0.845 of 103; 87 were capable" in remark
    assert "whatever their capability, the RBSR of Reins is – of 0;" in remark
    document = results()
    document["methods"]["reins"]["RBSR_ALL"] = {"pooled": 0.63, "n": 6502}
    remark = paper_grid(published.RECOVERY, document).remark
    assert "the RBSR of Reins is 0.630 of 6,502." in remark
    assert "rollbacks that were tried" not in remark


def test_the_tables_by_type_and_of_ablations_say_what_ours_are_of() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["per_type"]["reins"] = {"force": {"mean": 1.0, "n": 36}, "people": {"mean": 1.0, "n": 45}}
    types = paper_grid(published.PER_TYPE, document).remark
    assert "force 36, speed 0, retry 0, postcondition 0, zone 0, people 45" in types
    assert "RSR is 0, less than of direct execution" in paper_grid(published.ABLATION, document).remark


def test_what_the_papers_own_numbers_do_not_give_is_worked_out_from_them() -> None:
    ours, theirs = published.VIOLATION.rows["reins"][1], published.VIOLATION.rows["roboguard-style"][1]
    for place in (0, 2):  # RVDR, UCR
        mine, other = ours[place], theirs[place]
        assert mine is not None
        assert mine.std is not None
        assert other is not None
        assert other.std == 0.0
        t = (mine.mean - other.mean) / (mine.std / 5**0.5)
        assert number_text(t, 1) in published.T_REMARK
    assert round(1 / 2**5, 3) == published.WILCOXON_P
    assert "test is one-sided, like ours" in published.T_REMARK
    mine, direct = published.RECOVERY.rows["reins"][1][0], published.RECOVERY.rows["direct"][1][0]
    assert mine is not None
    assert mine.std is not None
    assert direct is not None
    assert direct.std is not None
    d = (mine.mean - direct.mean) / ((mine.std**2 + direct.std**2) / 2) ** 0.5
    assert f"would be {d:.1f}" in published.EFFECT_SIZE.remark


def test_of_types_that_are_detected_alike_the_worst_is_the_one_known_least() -> None:
    document: dict[str, Any] = results() | {"protocol": "physical"}
    document["per_type"]["reins"] = {
        "force": {"mean": 1.0, "n": 36, "low": 0.904, "high": 1.0},
        "speed": {"mean": 1.0, "n": 31, "low": 0.890, "high": 1.0},
    }
    (goals, *_) = goal_grids(document)
    assert "RVDR of the worst type (speed)" in dict(goals.rows)


def test_unsafe_continuation_stands_by_type_after_the_detection_by_type() -> None:
    document: dict[str, Any] = results()
    document["unsafe_per_type"] = {
        "reins": {
            "zone": {"mean": 0.25, "std": None, "n": 4, "low": 0.05, "high": 0.7},
            "force": {"mean": None, "n": 0},
        },
        "-watcher": {"zone": {"mean": 1.0, "n": 4}},
    }
    grids = next(part.grids for part in sections(document) if part.id == "paper")
    place = [grid.id for grid in grids].index("unsafe-by-type")
    assert grids[place - 1].id == "tab-pertype"
    assert grids[place].headings == ("Reins",)
    assert dict(grids[place].rows)["Zone entered"] == ("0.250\n0.050–0.700 of 4",)
    assert dict(grids[place].rows)["Force exceeded"] == ("–",)
    document["unsafe_per_type"] = {}
    grids = next(part.grids for part in sections(document) if part.id == "paper")
    assert "unsafe-by-type" not in [grid.id for grid in grids]


def test_types_are_drawn_in_the_order_of_the_table_and_with_their_rows() -> None:
    document: dict[str, Any] = results()
    spread = document["distributions"]["latency_ticks"]
    document["distributions"]["latency_ticks"] = {name: spread[name] for name in ("zone", "speed", "force")}
    drawn = [plot.alternative for plot in next(part.plots for part in sections(document) if part.id == "plots")]
    (late,) = [told for told in drawn if told.startswith("Detection latency")]
    assert late.index("Force") < late.index("Speed") < late.index("Zone")
    assert any("Force exceeded (1000) 0." in told for told in drawn)


def test_labels_under_a_plot_are_broken_before_they_meet() -> None:
    cells = {"never answers": {"done (RSR)": 0.0, "expired": 1.0, "violated for over 250 ms": 0.0}}
    svg = shares(cells, "What became of them.").svg
    assert "violated for over 250 ms" not in svg
    assert "violated for<" in svg


def test_a_column_that_holds_sentences_is_read_from_the_left_in_every_row() -> None:
    rows = (("one", ("–", "0.1")), ("two", ("organization/forbidden-zone, human-shared/clearance", "0.2")))
    assert Grid("g", "c", "s", (), ("why", "how much"), rows).wordy == (True, False)


def test_scores_say_their_unit_and_which_way_is_better() -> None:
    document = results()
    document["scorecard"] = {"override": {"value": 1.0, "unit": "control ticks", "better": "lower", "how": "counted"}}
    (card,) = [section for section in sections(document) if section.id == "scorecard"]
    assert card.items == (("override", "1.000 control ticks (↓ lower is better)", "counted"),)


def test_whatever_a_choice_affects_is_named_by_whole_words_and_is_a_metric() -> None:
    for choice in CHOICES:
        assert set(choice.affects) <= METRICS.keys()
    document = results() | {"unpublished": [one._asdict() for one in CHOICES]}
    (unpublished,) = [section for section in sections(document) if section.id == "unpublished"]
    assert "affects RVDR, UCR" in {called for _, called, _ in unpublished.items}


def test_definitions_read_as_words() -> None:
    (definitions,) = [section for section in sections(results()) if section.id == "definitions"]
    assert not [text for item in definitions.items for text in item if "_" in text or "`" in text]


def test_another_protocol_has_no_goals() -> None:
    assert [*goal_grids(results() | {"protocol": "paper"})] == []


def test_a_single_seed_has_no_empty_table_of_tests() -> None:
    assert [*significance_grids({"effect_sizes": {"direct": {}, "static-rule": {}}})] == []


def test_a_boundary_band_and_simulated_seconds_are_spoken_of_in_the_workcell_alone() -> None:
    for protocol, there in (("paper", False), ("physical", True)):
        document: dict[str, Any] = results() | {"protocol": protocol}
        (plots,) = [section.plots for section in sections(document) if section.id == "plots"]
        assert ("beyond the boundary band" in plots[0].caption) is there
        remark = paper_grid(published.RECOVERY, document).remark
        assert ("simulated seconds" in remark) is there
        assert ("No time passes" in remark) is not there


def test_plots_say_over_how_many_trials_they_are() -> None:
    document: dict[str, Any] = results()
    points: list[dict[str, Any]] = [
        {"s": s, "RVDR": {"mean": s, "n": 57}, "UCR": {"mean": 1 - s, "n": 57}, "FAR": {"mean": 0.0, "n": 30}}
        for s in (0.1, 0.5, 1.0)
    ]
    document["sensitivity"] = points
    (drawn,) = [section.plots for section in sections(document) if section.id == "plots"]
    captions = [plot.caption for plot in drawn]
    assert sum("Each point is over 57 violations and 30 clean sessions." in caption for caption in captions) == 3
    assert any("In brackets how many detected violations." in caption for caption in captions)
    points[0]["RVDR"]["n"] = 56
    (drawn,) = [section.plots for section in sections(document) if section.id == "plots"]
    assert "over 56 violations and 30 clean sessions (s=0.1) and others" in drawn[1].caption


@pytest.mark.parametrize(
    ("text", "kinds"),
    [
        ("as proposed: succeeded 5/5, 8.0 s", ["as proposed"]),
        ("as proposed: succeeded 5/5, 8.0 s; people alarmed 5/5", ["as proposed", "alarmed"]),
        ("speed_mps 1.2 to 1: succeeded 3/5, terminated 2/5, 8.4 s", ["changed"]),
        ("asks 1: succeeded 5/5, 7.9 s", ["asked"]),
        (
            "asks 2; speed_mps 1.2 to 0.3, clearance_m 0.2 to 0.3: taken_over 5/5, 19.2 s; separation alarmed 5/5",
            ["changed", "asked", "alarmed"],
        ),
        ("deny (organization/payload, human-shared/authority)", ["refused"]),
        ("escalate (organization/low-confidence)", ["refused"]),
    ],
)
def test_what_became_of_a_proposal_is_told_from_its_words(text: str, kinds: list[str]) -> None:
    assert [mark.name for mark in classify(text)] == kinds


@pytest.mark.parametrize(
    "text", ["allow", "", "deny", "as proposed", "perhaps: succeeded 5/5, 8.0 s", "as proposed: x"]
)
def test_what_nobody_knows_of_a_proposal_is_no_picture(text: str) -> None:
    with pytest.raises(UnknownVerdict, match="valid is"):
        classify(text)
    with pytest.raises(UnknownVerdict):
        sections(results() | {"cross_profile": {"grasp": {"sim-relaxed": text}}})


def test_the_matrix_is_drawn_and_told_and_stands_in_words_beneath() -> None:
    (section,) = [section for section in sections(results()) if section.id == "cross-profile"]
    (plot,) = section.plots
    assert "test-audit changed and alarmed, real-restricted changed and asked, human-shared refused" in plot.alternative
    assert all(f">{sign}<" in plot.svg for sign in ("=", "≠ !", "≠ ?", "✗"))
    assert section.grids
    page = rendered()
    assert page.index("What became of each proposal") < page.index('id="matrix"')


def test_the_head_says_what_digests_are_of_and_which_figures_are_pooled() -> None:
    text = Page(render(results() | {"configuration": {"code": "sha256:01", "policy": "sha256:02"}})).text
    assert "sha256:01 (digest of the Python files that rows may follow from" in text
    assert "sha256:02 (digest of the policy" in text
    assert "What has a ± is a mean over seeds" in text


def test_ticks_and_seconds_of_a_study_have_no_thousandths_and_its_picture_stands_first() -> None:
    share: dict[str, Any] = {"mean": 0.5, "n": 10, "low": 0.2, "high": 0.8}
    cells = {"detected": share, WITHIN: share, "ticks, median": 41.0, "mean s": 9.0734}
    table = {
        "caption": "c",
        "stub": "s",
        "remark": "",
        "rows": dict.fromkeys(("arm/noisy 0.02", "arm/noisy 0.2", "arm/noisy 2"), cells),
    }
    document = results() | {"studies": {"sensors": {"title": "t", "about": "About.", "tables": [table]}}}
    (section,) = [section for section in sections(document) if section.id == "study-sensors"]
    assert dict(section.grids[0].rows)["arm/noisy 0.2"][2:] == ("41.0", "9.07")
    assert section.pictures_first
    assert "arm: noisy 0.50, noisy big 0.50, noisy wild 0.50" in section.plots[0].alternative


def test_prose_names_metrics_by_their_titles_and_leaves_other_names_readable() -> None:
    assert in_words("UCR leaves them out; `UCR_STRICT` does not, `retry_budget` is 3, X_Y too") == (
        "UCR leaves them out; \N{LEFT DOUBLE QUOTATION MARK}Unsafe continuation rate, warnings counted"
        "\N{RIGHT DOUBLE QUOTATION MARK} does not, retry budget is 3, X Y too"
    )
