"""The README's table comes from results, into its place and nowhere else."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.evaluation.readme import ReadmeError, refresh

RESULTS = {
    "protocol": "physical",
    "seeds": [42, 123],
    "trials": 200,
    "methods": {
        "reins": {
            "UAIR": {"mean": 1.0, "std": 0.0, "low": 0.998, "high": 1.0},
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
        "# A\n<!-- evaluate:physical -->\nProtocol `physical`, seeds 42, 123, 200 trials for each seed:\n"
    )
    assert text.endswith("<!-- /evaluate:physical -->\nafter\n")
    assert "| Recovery success rate (RSR) | 0.907 ± 0.030 | 0.955 | ≥ 0.95 |" in text
    assert "(UAIR) | 0.962 ± 0.027 | 1.000 ± 0.000 (0.998–1.000) | 1.000 |" in text
    assert "UCR" not in text
    assert "old" not in text
    refresh(file, RESULTS)
    assert file.read_text(encoding="utf-8") == text


def test_a_file_without_a_place_stays_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text("<!-- evaluate:paper -->\n<!-- /evaluate:paper -->\n", encoding="utf-8")
    with pytest.raises(ReadmeError, match="no place for the table"):
        refresh(file, RESULTS)
    assert file.read_text(encoding="utf-8") == "<!-- evaluate:paper -->\n<!-- /evaluate:paper -->\n"
