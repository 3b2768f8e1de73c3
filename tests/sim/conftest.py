from __future__ import annotations

from pathlib import Path

import pytest

from app.governance.bundle import load
from app.governance.model import Site

POLICIES = Path(__file__).parents[2] / "policies"


@pytest.fixture(scope="session")
def site() -> Site:
    return load(POLICIES).site
