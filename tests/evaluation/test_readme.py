"""The README's table comes from results, into its place and nowhere else."""

from __future__ import annotations

from pathlib import Path
from resource import RLIMIT_FSIZE, getrlimit, setrlimit

import pytest

from app.evaluation.readme import ReadmeError, refresh

RESULTS = {
    "protocol": "physical",
    "seeds": [42, 123],
    "trials": 200,
    "methods": {
        "reins": {
            "UAIR": {"mean": 1.0, "std": 0.0, "low": 0.998, "high": 1.0, "n": 2500},
            "RSR": {"mean": 0.955, "std": None},
            "UCR": {"mean": None},
        }
    },
}


def test_replaces_what_stands_between_its_comments(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text("# A\n<!-- evaluate:physical -->\nold\n<!-- /evaluate:physical -->\nafter\n", encoding="utf-8")
    refresh(file, RESULTS)
    text = file.read_text(encoding="utf-8")
    assert text.startswith(
        "# A\n<!-- evaluate:physical -->\nProtocol `physical`, seeds 42, 123, 200 trials for each seed; mean ± "
    )
    assert text.endswith("<!-- /evaluate:physical -->\nafter\n")
    assert "| Recovery success rate (RSR) | 0.907 ± 0.030 | 0.955 | ≥ 0.95 |" in text
    assert "(UAIR) | 0.962 ± 0.027 | 1.000 ± 0.000 (0.998–1.000) of 2,500 | 1.000 |" in text
    assert "UCR" not in text
    assert "old" not in text
    refresh(file, RESULTS)
    assert file.read_text(encoding="utf-8") == text


def test_a_file_that_cannot_be_written_stays_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text(f"{'words ' * 2000}\n<!-- evaluate:physical -->\n<!-- /evaluate:physical -->\n", encoding="utf-8")
    before = file.read_bytes()
    usual = getrlimit(RLIMIT_FSIZE)
    setrlimit(RLIMIT_FSIZE, (4096, usual[1]))  # as on a disk without room
    try:
        with pytest.raises(OSError, match="File too large"):
            refresh(file, RESULTS)
    finally:
        setrlimit(RLIMIT_FSIZE, usual)
    assert file.read_bytes() == before
    assert [*tmp_path.iterdir()] == [file]


def test_a_link_stays_a_link_and_a_file_keeps_its_mode(tmp_path: Path) -> None:
    file, link = tmp_path / "real.md", tmp_path / "README.md"
    file.write_text("<!-- evaluate:physical -->\n<!-- /evaluate:physical -->\n", encoding="utf-8")
    file.chmod(0o640)
    link.symlink_to(file.name)
    refresh(link, RESULTS)
    assert link.is_symlink()
    assert "UAIR" in file.read_text(encoding="utf-8")
    assert file.stat().st_mode & 0o777 == 0o640


def test_a_rate_says_what_it_is_made_of_and_over_how_many_rows(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text("<!-- evaluate:physical -->\n<!-- /evaluate:physical -->\n", encoding="utf-8")
    entries = {
        "UCR": {"mean": 0.0, "std": 0.0},
        "UCR_STRICT": {"mean": 0.105, "pooled": 0.106, "n": 235},
        "RVDR": {"mean": 1.0, "std": 0.0},
        "RVDR_BOUNDARY": {"mean": 0.95, "pooled": 0.9, "n": 10},
        "RBSR": {"mean": 0.984, "std": 0.0},
        "RBSR_TRIED": {"mean": 0.821, "pooled": 0.822, "n": 908},
        "RBSR_ALL": {"mean": 0.0, "std": 0.0, "low": 0.0, "high": 0.092, "n": 38},
        "RBSR_WITHDRAWN": {"mean": 1.0, "pooled": 1.0, "n": 250},
        "RBSR_FAILURE": {"mean": None, "pooled": None, "n": 0},
        "RBSR_VIOLATION": {"mean": 0.987, "pooled": 0.986, "n": 1497},
    }
    refresh(file, RESULTS | {"methods": {"reins": entries}})
    text = file.read_text(encoding="utf-8")
    assert "| 0.000 ± 0.000; every warning counted as unsafe 0.106 of 235 | ≤ 0.01 |" in text
    assert "(RVDR), beyond the boundary band | 0.613 ± 0.020 | 1.000 ± 0.000; within the band 0.900 of 10 |" in text
    assert (
        "| Rollback success rate, rollback-capable (RBSR) | – | 0.984 ± 0.000; over all that were tried 0.822 of 908, "
        "after a withdrawal 1.000 of 250, a failure –, a violation 0.986 of 1,497 | ≥ 0.97 |"
    ) in text


def test_the_papers_rate_of_rollbacks_stands_beside_ours_over_all(tmp_path: Path) -> None:
    for protocol, goal in (("physical", " – |"), ("paper", "")):
        file = tmp_path / "README.md"
        file.write_text(f"<!-- evaluate:{protocol} -->\n<!-- /evaluate:{protocol} -->\n", encoding="utf-8")
        entries = {"RBSR_ALL": {"mean": 0.63, "std": 0.014, "low": 0.618, "high": 0.641, "n": 6502}}
        refresh(file, RESULTS | {"protocol": protocol, "methods": {"reins": entries}})
        assert f"(RBSR_ALL) | 0.533 ± 0.032 | 0.630 ± 0.014 (0.618–0.641) of 6,502 |{goal}\n" in file.read_text("utf-8")


def test_results_without_a_figure_leave_the_table_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text("<!-- evaluate:physical -->\nkept\n<!-- /evaluate:physical -->\n", encoding="utf-8")
    with pytest.raises(ReadmeError, match="stays as it is"):
        refresh(file, RESULTS | {"methods": {"direct": RESULTS["methods"]}})
    assert "kept" in file.read_text(encoding="utf-8")


def test_a_file_that_is_no_text_stays_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(ReadmeError, match="no text in UTF-8"):
        refresh(file, RESULTS)
    assert file.read_bytes() == b"\xff\xfe"


def test_a_file_without_a_place_stays_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text("<!-- evaluate:paper -->\n<!-- /evaluate:paper -->\n", encoding="utf-8")
    with pytest.raises(ReadmeError, match="no place for the table"):
        refresh(file, RESULTS)
    assert file.read_text(encoding="utf-8") == "<!-- evaluate:paper -->\n<!-- /evaluate:paper -->\n"
