"""A scenario is checked where it is read: what it says is refused before anything starts, not when its moment comes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from app.config import ConfigError
from app.governance.model import Json
from app.sim.faults import Scenario
from app.workcell import check_names, read_scenario
from tests.governance.policy_world import shipped


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("faults: [{kind: slippery, at: 2.0}]", "fault `slippery` needs `object`"),
        ("faults: [{kind: slippery, object: [mug_1]}]", "`object` is `['mug_1']`: valid is a name"),
        ("faults: [{kind: fade, strength: x}]", "fault `fade`: `strength` is `x`: valid is a number from 0"),
        ("faults: [{kind: fade, strength: true}]", "`strength` is `True`: valid is a number"),
        ("faults: [{kind: fade, strength: .nan}]", "`.nan` is not a finite number"),
        (f"faults: [{{kind: fade, strength: {'9' * 400}}}]", "number out of range"),
        ("faults: [{kind: payload_shift, object: mug_1, factor: 0}]", "`factor` is `0`: valid is a number from 0.001"),
        ("faults: [{kind: fade, for_s: []}]", "`for_s` is `[]`: valid is a number"),
        ("faults: [{kind: fade, at: {time_s: x}}]", "trigger `time_s` is `x`: valid is a number"),
        ("faults: [{kind: fade, at: {after_s: 1}}]", "valid is either `time_s`, or `capability` and `phase`"),
        ("faults: [{kind: fade, at: {time_s: 1, run: 2}}]", "valid is either `time_s`, or `capability` and `phase`"),
        ("faults: [{kind: fade, at: {capability: a, phase: b, run: 0}}]", "trigger `run` is `0`: valid is a whole"),
        ("faults: [{kind: fade, at: {capability: a, phase: 1}}]", "trigger `phase` is `1`: valid is a name"),
        ("faults: [{1: 2, kind: fade, z: 3}]", "fault `fade` has no size `1`"),
        ("people: [{points: [[1]]}]", "a walk's point is `[1]`: valid is [x_m, y_m]"),
        ("people: [{points: [5]}]", "a walk's point is `5`"),
        ("people: [{points: [[1, x]]}]", "a walk's `y_m` is `x`"),
        ("people: [{points: [[1, 2]], speed_mps: [1]}]", "a walk's `speed_mps` is `[1]`: valid is a number"),
        ("people: [{points: [[1, 2]], speed_mps: 0}]", "a speed above 0"),
        ("people: [{points: [[1, 2]], stay_s: {1: 2.0}}]", "stays at the point `1`: valid is 0 to 0"),
        ("people: [{points: [[1, 2]], stay_s: {x: 2.0}}]", "stays at the point `x`"),
        ("people: [{points: [[1, 2]], leaves: no}]", "`leaves` is `no`: valid is true or false"),
        (f"a: {'[' * 5000}", "nested deeper than 40 levels"),
        ("a: [", "not readable as YAML"),
        ("a: \x00", "not readable as YAML"),
    ],
)
def test_a_value_that_means_nothing_is_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(said)):
        read_scenario(str(path))


def test_a_scenario_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_bytes(b"faults: [\xff]")
    with pytest.raises(ConfigError, match="scenario"):
        read_scenario(str(path))


@pytest.mark.parametrize(
    ("strange", "said"),
    [
        ({"faults": [{"kind": "slippery", "object": "cup_9"}]}, "the site's objects: .*mug_1.*not `cup_9`"),
        ({"faults": [{"kind": "fade", "at": {"capability": "fly", "phase": "lift"}}]}, "grasp_object.*not `fly`"),
        (
            {"people": [{"points": [[1, 2]], "start": {"capability": "grasp_object", "phase": "drive"}}]},
            "the phases of `grasp_object`: approach.*not `drive`",
        ),
    ],
)
def test_what_the_policy_does_not_know_is_refused(strange: dict[str, Json], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_names("here", Scenario.read(strange), shipped())


def test_the_scenarios_that_come_with_reins_are_read() -> None:
    check_names("fetch_shared", read_scenario("fetch_shared"), shipped())
