"""What the documentation says of scenarios is what the simulation takes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from app.sim.faults import _KINDS, HABITS, SENSOR_FAULTS
from app.sim.sensors import SENSORS
from app.workcell import check_names, read_scenario
from tests.governance.policy_world import shipped

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "scenarios.md").read_text()


def test_the_scenario_of_the_documentation_can_be_run(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", DOCUMENT, re.DOTALL)
    (path := tmp_path / "late-visitor.yaml").write_text(text)
    scenario = read_scenario(str(path))
    assert scenario is not None
    check_names(str(path), scenario, shipped())
    assert [fault.kind for fault in scenario.faults] == ["sensor", "payload_shift"]
    assert [len(walk.points) for walk in scenario.people] == [3]


def test_every_fault_stands_in_the_table_with_its_sizes() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (`.*?) \|", DOCUMENT, re.MULTILINE)
    assert {kind: tuple(re.findall(r"`(\w+)`", sizes)) for kind, sizes in rows} == {
        kind: sizes for kind, (_, sizes) in _KINDS.items()
    }


@pytest.mark.parametrize("names", [SENSORS, SENSOR_FAULTS, HABITS])
def test_every_name_is_explained(names: tuple[str, ...]) -> None:
    assert [name for name in names if f"`{name}`" not in DOCUMENT] == []
