"""The runner on the simulated workcell under the shipped policy; the test plays the kernel."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from app.cell.journal import Entry, Journal
from app.cell.runner import Runner
from app.cell.substrate import Skill
from app.governance import bundle
from app.governance.conditions import unmet
from app.governance.model import (
    Authorization,
    Command,
    CoveredRecovery,
    Json,
    Mode,
    Observation,
    Params,
    RecoveryPlan,
    SkillReport,
    Strategy,
    WatchPlan,
    WorldFacts,
)
from app.governance.permit import Grant, mint
from app.governance.plans import recovery_plan, watch_plan
from app.governance.policy import PolicySet
from app.governance.recovery import RETRACE
from app.sim.faults import Fault
from app.sim.people import Walk
from app.sim.sensors import AS_MEASURED, Quality
from app.sim.workcell import Workcell
from tests.cell.rig import KEY, NOW_S

POLICIES = Path(__file__).parents[2] / "policies"


@functools.cache
def policy() -> PolicySet:
    return bundle.load(POLICIES)


class Hung:
    """A skill that hangs after so many ticks."""

    def __init__(self, cell: Workcell, skill: Skill, after_ticks: int) -> None:
        self._cell, self._skill, self._left = cell, skill, after_ticks

    def act(self, seen: Observation, rate: float) -> Command:
        self._left -= 1
        return self._skill.act(seen, rate) if self._left > 0 else self._cell.hold()

    def report(self) -> SkillReport:
        return self._skill.report()


class Workshop:
    """A workcell, its runner, and everything that was told."""

    def __init__(
        self,
        folder: Path,
        *,
        profile: str = "human-shared",
        seed: int = 0,
        faults: Sequence[Fault] = (),
        people: Sequence[Walk] = (),
        quality: Quality = AS_MEASURED,
    ) -> None:
        self.policy, self.profile = policy(), profile
        self.edit: Callable[[WatchPlan], WatchPlan] = lambda plan: plan
        self.edit_recovery: Callable[[RecoveryPlan], RecoveryPlan] = lambda plan: plan
        self.cell = Workcell(self.policy.site, seed=seed, faults=faults, people=people, quality=quality)
        self.entries: list[Entry] = []
        self.telemetry = bytearray()
        self.journal = Journal(folder / "journal", boot="boot-1")
        self.runner = Runner(
            self.cell,
            plan_of=self.plan_of,
            verify=self.unmet,
            journal=self.journal,
            wall=lambda: NOW_S + 1.0,
            emit=self.entries.append,
            on_telemetry=lambda _, rows: self.telemetry.extend(rows),
        )
        self.runner.adopt(policy_digest=self.policy.digest, key=KEY.public_key())

    def plan_of(self, grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        permit = grant.authorization
        what = recovery or permit
        plan = watch_plan(self.policy, what.capability, permit.profile, what.params, what.mode)
        return self.edit(plan), self.edit_recovery(recovery_plan(self.policy, permit.capability, permit.profile))

    def unmet(self, names: tuple[str, ...], params: Params, facts: WorldFacts) -> tuple[str, ...]:
        return tuple(found.condition for found in unmet(names, params, facts, self.policy.site))

    def launch(self, capability: str, number: int = 1, *, covered: bool = True, **params: Json) -> None:
        """Launch with parameters as policy would have constrained them; the test names the numbers."""
        permit = Authorization(
            id=f"auth-{number}",
            invocation=f"inv-{number}",
            cell=self.cell.id,
            capability=capability,
            version="1.0.0",
            params=self._filled(capability, params),
            mode=Mode.NORMAL,
            profile=self.profile,
            policy_digest=self.policy.digest,
            issued_at_s=NOW_S,
            expires_at_s=NOW_S + 30.0,
            recoveries=tuple(self._recoveries(capability, params)) if covered else (),
        )
        assert self.runner.launch(mint(permit, KEY)) is None, self.entries[-1]

    def _filled(self, capability: str, params: Params) -> dict[str, Json]:
        found = self.policy.validate_params(capability, params)
        assert isinstance(found, dict), found
        return found

    def _recoveries(self, capability: str, params: Params) -> list[CoveredRecovery]:
        plan = recovery_plan(self.policy, capability, self.profile)
        again = self._filled(capability, params)
        found = [
            CoveredRecovery(strategy=Strategy.RETRY, capability=capability, params=again),
            CoveredRecovery(strategy=Strategy.SAFER_MODE, capability=capability, params=again, mode=Mode.CAREFUL),
        ]
        for name in sorted({row.capability for row in plan.rules if row.capability}):
            found.append(
                CoveredRecovery(strategy=Strategy.RECOVERY_CAPABILITY, capability=name, params=self._filled(name, {}))
            )
        if plan.rollback_capability is not None:
            for back in dict.fromkeys((plan.rollback_capability, RETRACE)):
                found.append(
                    CoveredRecovery(strategy=Strategy.ROLLBACK, capability=back, params=self._filled(back, {}))
                )
        return found

    def hang(self, *, runs: int, after_ticks: int = 150) -> None:
        """Let the next skills that are bound hang after a while: they move nothing and say only that they run."""
        bind, left = self.cell.bind, [runs]

        def bound(*args: Any, **kwargs: Any) -> Any:
            left[0] -= 1
            skill = bind(*args, **kwargs)
            return skill if left[0] < 0 else Hung(self.cell, skill, after_ticks)

        self.cell.bind = bound  # type: ignore[method-assign]

    def finish(self, within: int = 12_000) -> dict[str, Json]:
        for _ in range(within):
            self.runner.tick()
            if self.runner.invocation is None:
                return self.last("outcome")
        raise AssertionError(f"not over within {within} ticks; told: {self.story()}")

    def until(self, status: str, within: int = 6000) -> None:
        for _ in range(within):
            self.runner.tick()
            if self.runner.status is None or self.runner.status.value == status:
                break
        assert self.runner.status is not None, self.story()
        assert self.runner.status.value == status, self.story()

    def of(self, kind: str) -> list[dict[str, Json]]:
        return [entry.body for entry in self.entries if entry.kind == kind]

    def last(self, kind: str) -> dict[str, Json]:
        return self.of(kind)[-1]

    def rules(self) -> list[Json]:
        return [body["rule"] for body in self.of("alert") if body["signal"] not in ("NORMAL", "COMPLETION")]

    def strategies(self) -> list[Json]:
        return [body["strategy"] for body in self.of("recovery")]

    def story(self) -> str:
        return "\n".join(f"{entry.tick} {entry.kind} {entry.body}" for entry in self.entries)
