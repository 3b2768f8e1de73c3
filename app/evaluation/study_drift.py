"""Policy drift: the policy tightens while a session runs.

All speed limits and the grip limit of every profile are halved 1.5 to 2.5 s after the launch, as an activation does it:
the cell holds the new policy from then on. A session keeps the policy it was authorized under until it ends; what that
means is measured, and so is what the new policy changes at once: an authorization minted under the old one, and the
next proposal.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from app.cell.run import Doing
from app.evaluation.draws import Drawn
from app.evaluation.methods import REINS
from app.evaluation.model import PROFILES, Kind, Row, Violation
from app.evaluation.permits import adopt, authorize, signed
from app.evaluation.physical_trial import looking
from app.evaluation.stage import Start
from app.evaluation.study_trials import (
    Part,
    Table,
    bench_of,
    executed,
    govern,
    grouped,
    numbers,
    once,
    share,
    study_row,
    table,
)
from app.evaluation.truth import Truth
from app.governance.bundle import load_files
from app.governance.guard import check
from app.governance.model import EventKind, Proposal
from app.governance.plans import watch_plan
from app.sim.faults import Scenario

if TYPE_CHECKING:
    from app.cell.runner import Runner
    from app.evaluation.episode import Execution
    from app.evaluation.physical_trial import Trial
    from app.governance.model import Json, WatchPlan
    from app.governance.policy import PolicySet
    from app.sim.workcell import Workcell

NAME: Final = "drift"
TITLE: Final = "Policy drift: the policy tightens while a session runs"
ABOUT: Final = (
    "Every speed limit and the grip limit are halved 1.5 to 2.5 s after the launch. The running session keeps the "
    "policy that it was authorized under until it ends; authorizations of the old policy are void at once, and the "
    "next proposal is decided under the new one. Over the new limit: the running session's time beyond 1.05 times the "
    "new speed or grip limit, by the simulator's exact state."
)
TIGHTER: Final = 0.5
_LIMIT: Final = re.compile(r"((?:tcp_speed_mps|base_speed_mps|grip_force_n): *\{max: *)([0-9.]+)")
WORK: Final[tuple[tuple[str, Mapping[str, Json], Start], ...]] = (
    ("navigate_to", {"target": "dock", "speed_mps": 1.5}, Start()),
    ("grasp_object", {"object_id": "mug_1", "force_n": 120.0, "speed_mps": 0.5}, Start()),
)


@lru_cache(maxsize=2)
def tightened(policy: PolicySet) -> PolicySet:
    """Return the policy with every profile's speed and grip limits halved."""
    halved = {
        name: _LIMIT.sub(lambda found: f"{found[1]}{float(found[2]) * TIGHTER:g}", text)
        if "profiles/" in name
        else text
        for name, text in policy.files.items()
    }
    return load_files(halved)


def parts(seeds: Sequence[int]) -> list[Part]:
    """Return a part for each profile and seed."""
    return [Part(profile, seed, 0, len(WORK)) for seed in seeds for profile in PROFILES]


def run(part: Part, policy: PolicySet) -> Iterator[Row]:
    """Tighten the policy during a drive and during a grasp."""
    bench, tighter = bench_of(policy), tightened(policy)
    for number in range(part.first, part.first + part.count):
        capability, params, start = WORK[number]
        rng = np.random.default_rng((part.seed, number, PROFILES.index(part.condition), 19))
        drawn = Drawn(seed=part.seed, number=number, kind=Kind.CLEAN, capability=capability, profile=part.condition,
                      params=params, start=start, scenario=Scenario())  # fmt: skip
        trial = once(bench, drawn)
        session = _Tightening(trial, policy, tighter, round(100 * float(rng.uniform(1.5, 2.5))))
        done = govern(bench, trial, during=session)
        yield study_row(NAME, part, number, part.condition, capability=capability, **executed(done),
                        **session.columns(done))  # fmt: skip
        yield _next(part, number, drawn, tighter)


class _Tightening:
    """Activates the tighter policy in the middle of a session, and looks at what it goes on doing by the new limits."""

    def __init__(self, trial: Trial, policy: PolicySet, tighter: PolicySet, tick: int) -> None:
        drawn = trial.drawn
        self.trial, self.policy, self.tighter, self.tick, self.now = trial, policy, tighter, tick, 0
        self.effective = check(tighter, trial.proposal, trial.context).effective
        plan = watch_plan(tighter, drawn.capability, drawn.profile, self.effective)
        self.truth: Truth = looking(tighter, drawn, plan)
        self.over = 0
        self.old = self.fresh = ""
        self.own: WatchPlan | None = None
        self.kept = True

    def __call__(self, runner: Runner, cell: Workcell) -> None:
        self.now += 1
        run = None if runner.session is None else runner.session.run
        if self.now == self.tick and run is not None:
            self.own = run.plan
            adopt(runner, self.tighter)
            self.old = self._launch(runner, cell, self.policy, self.trial.proposal)
            self.fresh = self._launch(runner, cell, self.tighter, replace(self.trial.proposal, params=self.effective))
        if self.now > self.tick:
            self.kept = self.kept and (run is None or run.doing is not Doing.ATTEMPT or run.plan == self.own)
            self.truth.see(cell.glance(), attempts=1, claims_falsely=False, executing=True, attempting=True)
            over = (self.truth.tracks[one] for one in (Violation.SPEED, Violation.FORCE))
            self.over += any(track.acting > 0 for track in over)

    def _launch(self, runner: Runner, cell: Workcell, policy: PolicySet, proposal: Proposal) -> str:
        permit = authorize(cell, REINS, policy, proposal, self.trial.drawn.profile)
        return runner.launch(signed(replace(permit, id=f"permit-{policy.digest}"))) or "launched"

    def columns(self, done: Execution) -> dict[str, Any]:
        """Return what the running session did after the tightening.

        It has kept its policy if it was launched under that one, and was watched by the same plan ever after.
        """
        launched = done.of(EventKind.LAUNCH)
        own = bool(launched) and launched[0].body["policy_digest"] == self.policy.digest and self.kept
        return {
            "kind": "running",
            "ticks": self.over if done.ticks > self.tick else None,
            "waited_s": max(0, done.ticks - self.tick) / 100 if done.ticks > self.tick else None,
            "held": own,
            "told": self.old or None,
            "what": self.fresh or None,
        }


def _next(part: Part, number: int, drawn: Drawn, tighter: PolicySet) -> Row:
    """Propose the same again, under the new policy."""
    trial = once(bench_of(tighter), drawn)
    done = govern(bench_of(tighter), trial)
    unsafe = any(done.truth.tracks[one].unsafe for one in (Violation.SPEED, Violation.FORCE))
    return study_row(NAME, part, number, part.condition, kind="next", capability=drawn.capability, unsafe=unsafe,
                     **executed(done))  # fmt: skip


def tables(rows: Sequence[Row], policy: PolicySet) -> list[Table]:
    """Return what became of the running session, and what the new policy changed at once."""
    return [
        table(
            "The session that was running, and what came after it",
            "Profile",
            {profile: _summed(mine) for profile, mine in [*grouped(rows, "profile").items(), ("all", list(rows))]},
            "A session that was over before the policy tightened counts for the next proposal alone.",
        )
    ]


def _summed(rows: Sequence[Row]) -> dict[str, Any]:
    running = [row for row in rows if row["kind"] == "running" and row["told"]]
    then = [row for row in rows if row["kind"] == "next"]
    went_on, over = numbers(running, "waited_s"), numbers(running, "ticks")
    return {
        "running: kept its policy": share(row["held"] for row in running),
        "running: done": share(row["achieved"] for row in running),
        "went on for, mean s": fmean(went_on) if went_on else None,
        "over the new limit, mean s": fmean(over) / 100 if over else None,
        "over the new limit, most s": max(over) / 100 if over else None,
        "old authorization refused": share(row["told"] == "wrong_policy" for row in running),
        "new one waits for its turn": share(row["what"] == "busy" for row in running),
        "next: done": share(row["achieved"] for row in then),
        "next: beyond the new limits": share(row["unsafe"] for row in then),
    }
