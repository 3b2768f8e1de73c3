"""The runner as the link speaks to it, on the fake cell under the shipped policy."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import pytest

from app.cell.governed import GovernedCell
from app.cell.journal import Journal
from app.cell.loop import Outbox, Welcomed
from app.governance.permit import mint
from app.protocol import Human, Launch
from tests.cell.rig import KEY, NOW_S, PERMIT, FakeCell
from tests.cell.workshop import policy


class Governed:
    """A governed fake cell that was welcomed."""

    def __init__(self, folder: Path) -> None:
        self.substrate = FakeCell()
        self.cell = GovernedCell(
            self.substrate,  # type: ignore[arg-type]
            policy(),
            kernel_key=base64.b64encode(KEY.public_key().public_bytes_raw()).decode(),
            journal=Journal(folder / "journal", boot="boot-1"),
            outbox=Outbox(),
            wall=lambda: NOW_S + 1.0,
        )
        self.cell.obey(Welcomed(profile="human-shared"))

    def drive(self) -> None:
        permit = replace(
            PERMIT,
            capability="navigate_to",
            params={"target": "dock", "speed_mps": 0.3, "clearance_m": 0.3},
            policy_digest=policy().digest,
            recoveries=(),
        )
        made = mint(permit, KEY)
        self.cell.obey(
            Launch(body=base64.b64encode(made.body).decode(), signature=base64.b64encode(made.signature).decode())
        )


@pytest.fixture
def governed(tmp_path: Path) -> Governed:
    return Governed(tmp_path)


def test_the_gauges_of_a_session_end_with_it_and_those_of_sensors_go_on(governed: Governed) -> None:
    governed.drive()
    for _ in range(50):
        governed.cell.tick()
    running = governed.cell.state(overruns=0)
    assert running.invocation == "inv-1"
    assert running.gauges["elapsed_s"] > 0.3
    assert running.gauges["base_speed_mps"] > 0.1
    governed.cell.obey(Human(invocation="inv-1", op="stop", actor="operator"))
    for _ in range(300):
        governed.cell.tick()
    assert governed.cell.state(overruns=0).invocation is None
    governed.substrate.lie = lambda seen: seen._replace(contact_force_n=17.0, base_velocity=(0.0, 0.0, 0.0))
    governed.cell.tick()
    over = governed.cell.state(overruns=3)
    assert set(over.gauges) == {"tcp_speed_mps", "base_speed_mps", "grip_force_n", "contact_force_n", "late_ticks"}
    assert (over.gauges["contact_force_n"], over.gauges["base_speed_mps"]) == (17.0, 0.0)
