"""What two profiles declare in the wrong order is named, with the place where the stricter one says it."""

from __future__ import annotations

from itertools import pairwise

import pytest

from app.governance import bundle
from app.proofs.declared import misplaced
from tests.governance.policy_world import files
from tests.proofs.planted import HUMAN, REAL, edited

ORDER = ("human-shared", "real-restricted", "test-audit", "sim-relaxed")

WRONG: dict[str, tuple[dict[str, str], tuple[str | int, ...], str]] = {
    "a limit": (
        edited(HUMAN, "payload_kg: {max: 3,", "payload_kg: {max: 4.2,"), ("limits", "payload_kg"),
        "`payload_kg` is 4.2 in human-shared and 4 in real-restricted"),
    "a longer deadline": (
        edited(HUMAN, "within_s: 120", "within_s: 301"), ("authority", "approval", "within_s"),
        "`within_s` is 301 in human-shared and 300 in real-restricted"),
    "older sensor data": (
        edited(HUMAN, "people: 400", "people: 401"), ("stale_after_ms", "people"),
        "`stale_after_ms.people` is 401 in human-shared and 400 in real-restricted"),
    "a base that stops sooner": (
        edited(HUMAN, "base_deceleration_mps2: 1.0", "base_deceleration_mps2: 1.1"), ("motion", "base_deceleration_mps2"),
        "`base_deceleration_mps2` is 1.1 in human-shared and 1 in real-restricted"),
    "a smaller base": (
        edited(HUMAN, "base_radius_m: 0.45", "base_radius_m: 0.44"), ("motion", "base_radius_m"),
        "`base_radius_m` is 0.44 in human-shared and 0.45 in real-restricted"),
    "no rollback": (
        edited(HUMAN, "rollback: required", "rollback: optional"), ("rollback",),
        "`rollback` is optional in human-shared and required in real-restricted"),
    "no interrupting": (
        edited(HUMAN, "interrupt-enabled, ", ""), ("authority", "modes"),
        "sessions can be interrupted in real-restricted, and cannot in human-shared"),
    "a later alarm": (
        edited(HUMAN, "above: 0.012", "above: 0.016"), ("watch", 9),
        "`slip_m` is watched above 0.015 for 20 ms by `slip` of real-restricted, and above 0.016 for 20 ms by `slip` of human-shared"),
    "a slower alarm": (
        edited(HUMAN, "above: 0.012\n    for_ms: 20", "above: 0.012\n    for_ms: 21"), ("watch", 9),
        "`slip_m` is watched above 0.015 for 20 ms by `slip` of real-restricted, and above 0.012 for 21 ms by `slip` of human-shared"),
    "an alarm at a larger part of the limit": (
        edited(HUMAN, "{limit: grip_force_n, times: 1.05}", "{limit: grip_force_n, times: 1.06}"), ("watch", 2),
        "`grip_force_n` is watched above 1.05 × grip_force_n by `grip-force` of real-restricted, and above 1.06 × grip_force_n "
        "by `grip-force` of human-shared"),
    "an alarm further down": (
        edited(HUMAN, "below: protective_separation_m ", "below: 0.9 "), ("watch", 0),
        "`separation_m` is watched below 1 by `people` of real-restricted, and below 0.9 by `separation` of human-shared"),
    "only a warning": (
        edited(HUMAN, "failure: zone\n    response: {enter: stop}", "failure: zone\n    response: {enter: continue}"), ("watch", 5),
        "`zone_margin_m` is watched below 0 by `zone` of real-restricted, and below 0 by `zone` of human-shared, where it only warns"),
    "an alarm about less": (
        edited(HUMAN, "operate_tool, retrace, safe_retreat, reposition_base]\n    signal: slip_m", "operate_tool]\n    signal: slip_m"),
        ("watch",),
        "`slip_m` is watched above 0.015 for 20 ms by `slip` of real-restricted, and by no rule of human-shared for as many capabilities"),
    "no alarm": (
        edited(HUMAN, "  - id: external-torque\n    signal: residual_nm\n    above: 25\n    failure: contact\n    response: {enter: stop}\n", ""),
        ("watch",),
        "`residual_nm` is watched above 25 by `external-torque` of real-restricted, and by no rule of human-shared for as many capabilities"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_declared_in_the_wrong_order_is_named(name: str) -> None:
    changed, path, message = WRONG[name]
    profiles = bundle.load_files({**files(), **changed}).profiles
    (found,) = misplaced(profiles["human-shared"], profiles["real-restricted"])
    assert (found.path, found.message) == (path, message)


def test_a_shorter_protective_separation_is_named() -> None:
    wide = bundle.load_files(files()).profiles["human-shared"]
    strict = bundle.load_files({**files(), **edited(HUMAN, "intrusion_m: 0.2", "intrusion_m: 0.1")}).profiles[wide.name]
    (found,) = misplaced(strict, wide)
    assert found.path == ("separation", "intrusion_m")
    assert found.message == "`separation.intrusion_m` is 0.1 in human-shared and 0.2 in human-shared"
    assert list(misplaced(wide, strict)) == []


RIGHT = {
    "as shipped": {},
    "a tighter limit": edited(HUMAN, "tcp_speed_mps: {max: 0.25", "tcp_speed_mps: {max: 0.2"),
    "an earlier alarm": edited(HUMAN, "above: 0.012", "above: 0.011"),
    "a computed distance beside a number": edited(REAL, "below: 1.0", "below: 9.0"),
    "an alarm about everything": edited(
        HUMAN, "    applies_to: [grasp_object, place_object, transport_object, operate_tool, retrace, safe_retreat, reposition_base]\n    signal: slip_m", "    signal: slip_m"),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_declared_in_the_right_order_passes(name: str) -> None:
    profiles = bundle.load_files({**files(), **RIGHT[name]}).profiles
    for strict, wide in pairwise(ORDER):
        assert list(misplaced(profiles[strict], profiles[wide])) == []
