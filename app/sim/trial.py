"""One skill run on a workcell, outside any server: for soak runs and tests.

What it binds is a real grant from a throw-away key.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.cell.substrate import SubstrateError
from app.governance.model import Authorization, CoveredRecovery, Mode, SkillState, Strategy
from app.governance.permit import mint, verify

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.model import Json, Observation, SkillReport
    from app.governance.permit import Grant
    from app.sim.workcell import Workcell

_KEY = Ed25519PrivateKey.generate()
_POLICY = "trial"


class Ran(NamedTuple):
    """How a run ended, and the worst that was true meanwhile."""

    state: SkillState
    failure: str
    detail: str
    seconds: float
    phases: tuple[str, ...]
    tcp_speed_mps: float
    base_speed_mps: float
    contact_force_n: float
    peak_force_n: float

    @property
    def done(self) -> bool:
        """Whether the skill says that it succeeded."""
        return self.state is SkillState.SUCCEEDED


def grant_for(
    cell: str,
    capability: str,
    params: Mapping[str, Json],
    *,
    invocation: str = "trial",
    recoveries: Mapping[str, Mapping[str, Json]] | None = None,
) -> Grant:
    """Mint and verify a permit for one capability, with the recoveries it covers."""
    permit = Authorization(
        id=f"permit-{invocation}",
        invocation=invocation,
        cell=cell,
        capability=capability,
        version="1.0.0",
        params=params,
        mode=Mode.NORMAL,
        profile="sim-relaxed",
        policy_digest=_POLICY,
        issued_at_s=0.0,
        expires_at_s=60.0,
        recoveries=tuple(
            CoveredRecovery(strategy=Strategy.RECOVERY_CAPABILITY, capability=name, params=known)
            for name, known in (recoveries or {}).items()
        ),
    )
    return verify(
        mint(permit, _KEY), key=_KEY.public_key(), cell=cell, policy_digest=_POLICY, now_s=1.0, used=frozenset()
    )


def run_skill(
    cell: Workcell,
    capability: str,
    params: Mapping[str, Json],
    *,
    grant: Grant | None = None,
    careful: bool = False,
    limit_s: float = 120.0,
    each: Callable[[Observation, SkillReport], float | None] | None = None,
) -> Ran:
    """Bind a skill, run it to its end and unbind.

    Args:
        cell: where.
        capability: which skill.
        params: its parameters.
        grant: what to bind with; a fresh one for exactly this by default.
        careful: half speed, longer looks.
        limit_s: give up after so long.
        each: called after every tick; may return the rate for the next one, or raise to end the run.
    """
    cell.unbind()
    tick = cell.observe().tick
    grant = grant or grant_for(cell.id, capability, params, invocation=f"trial-{tick}")
    try:
        skill = cell.bind(grant, capability, params, careful=careful)
    except SubstrateError as error:
        return Ran(SkillState.FAILED, error.failure, error.detail, 0.0, (), 0.0, 0.0, 0.0, 0.0)
    seen, rate, phases = cell.observe(), 1.0, [skill.report().phase]
    worst = (0.0, 0.0, 0.0, 0.0)
    report = skill.report()
    while report.state is SkillState.RUNNING and (seen.tick - tick) * cell.period_s < limit_s:
        seen = cell.step(skill.act(seen, rate))
        report = skill.report()
        now = cell.glance()
        worst = tuple(map(max, worst, now))
        if report.phase != phases[-1]:
            phases.append(report.phase)
        asked = each(seen, report) if each else None
        rate = 1.0 if asked is None else asked
    cell.unbind()
    return Ran(report.state, report.failure, skill.detail, (seen.tick - tick) * cell.period_s, tuple(phases), *worst)
