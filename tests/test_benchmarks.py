"""What `make bench` measures still loads: a figure that nobody can print any more is none."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from app.governance.bundle import load_files

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
NAMES = sorted(path.stem for path in FOLDER.glob("bench_*.py"))


@pytest.fixture(autouse=True)
def _beside_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are run as scripts, and import each other as such."""
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_still_imports(name: str) -> None:
    assert importlib.import_module(name).__doc__, "what it measures, and how it is run"


def test_the_policy_of_the_decisions_benchmark_still_passes_every_check() -> None:
    decision = importlib.import_module("bench_decision")
    assert len(load_files(decision._files(10)).capabilities) == 2
