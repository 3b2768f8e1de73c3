"""One story of an ordeal: a workcell with faults and people, and what operators, server and disk say to it."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Final, NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.cell.runner import Runner
from app.cell.steering import asks
from app.governance.conditions import unmet
from app.governance.control import TAKEOVER
from app.governance.coverage import covered_recoveries
from app.governance.guard import check
from app.governance.model import Authorization, CellFacts, Context, Mode, PolicyOutcome, Proposal, Wish
from app.governance.permit import mint
from app.governance.plans import recovery_plan, watch_plan
from app.ordeal.instruments import Disk, Witness
from app.ordeal.invariants import END_TICKS, BrokenInvariant, Invariants

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from app.cell.handover import Session
    from app.cell.journal import Entry
    from app.governance.model import (
        CoveredRecovery,
        Json,
        Params,
        RecoveryPlan,
        WatchPlan,
        WorldFacts,
    )
    from app.governance.permit import Grant, SignedAuthorization
    from app.governance.policy import PolicySet
    from app.sim.faults import Fault
    from app.sim.people import Walk

WALL_S: Final = 1.0e9
TICKS: Final = 2500
_KEY: Final = Ed25519PrivateKey.generate()


class Scene(NamedTuple):
    """Under which profile a story is played, what breaks, and who walks about."""

    profile: str
    faults: tuple[Fault, ...]
    people: tuple[Walk, ...]


class Word(NamedTuple):
    """What somebody says, or what happens, at a tick; the rest follows from a seed of its own."""

    tick: int
    kind: str
    seed: int


class Finding(NamedTuple):
    """An invariant that did not hold: in which story, when, and what was said and told until then."""

    seed: int
    scene: Scene
    tick: int
    invariant: str
    detail: str
    words: tuple[Word, ...]
    told: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return it as text: what did not hold, the scene, and the story."""
        scene = self.scene
        broken = [
            f"  {one.kind} {dict(one.sizes)} from {one.at.time_s:.2f} s for {one.for_s} s" for one in scene.faults
        ]
        walks = [f"  a person by {one.points} from {one.start.time_s:.2f} s" for one in scene.people]
        return [
            f"seed {self.seed}, tick {self.tick}: {self.invariant} ({self.detail})",
            f"profile {scene.profile}",
            *broken,
            *walks,
            *self.told,
        ]


class Story:
    """One story as it is played."""

    def __init__(self, policy: PolicySet, seed: int, scene: Scene, words: Sequence[Word], folder: Path) -> None:
        """Build the cell of a seed; its words may be fewer than were drawn."""
        self.policy, self.seed, self.scene, self.words = policy, seed, scene, tuple(words)
        self.cell = Witness(policy.site, cell_id="ordeal", seed=seed, faults=scene.faults, people=scene.people)
        self.disk = Disk(folder / "journal", boot="ordeal")
        self.told: list[str] = []
        self.runner = Runner(
            self.cell, plan_of=self._plan_of, verify=self._unmet, journal=self.disk, wall=self._wall, emit=self._tell
        )
        self.runner.adopt(policy_digest=policy.digest, key=_KEY.public_key())
        self.watch = Invariants(self.cell, self.disk, self.runner, scene.faults)
        self.permits: list[tuple[SignedAuthorization, bool]] = []  # and whether it changes the hands a session is in
        self.number = 0
        self.wish = Wish()

    @property
    def tick(self) -> int:
        """Return the cell's tick."""
        return self.cell.observe().tick

    def play(self) -> Finding | None:
        """Play it to its end; return what did not hold, if anything."""
        try:
            for word in self.words:
                while self.tick < word.tick:
                    self._tick()
                self._say(word)
            self._settle()
        except BrokenInvariant as broken:
            return Finding(
                self.seed, self.scene, self.tick, broken.invariant, broken.detail, self.words, tuple(self.told)
            )
        finally:
            self.disk.close()
        return None

    def _tick(self) -> None:
        session = self.runner.session
        if session is not None and session.steering is not None and self.tick % 5 == 0:
            self._jog(session.run.id, self.wish)
        try:
            self.runner.tick()
        except Exception as error:
            raise BrokenInvariant("nothing raises", repr(error)) from error
        self.watch.after_tick()

    def _settle(self) -> None:
        """Have everybody stop: whatever ran comes to its end, and every launch has one outcome."""
        self.disk.full, self.wish = False, Wish()
        if self.runner.session is not None:
            self._human("stop")
        for _ in range(END_TICKS):
            self._tick()
        self.watch.at_the_end()

    # -- words ---------------------------------------------------------------------------------------------------------

    def _say(self, word: Word) -> None:
        self.told.append(f"{self.tick:6} > {word.kind}")
        draw = random.Random(word.seed)  # noqa: S311  # repeatable, no secret
        session = self.runner.session
        if word.kind in _DEEDS:
            _DEEDS[word.kind](self, draw)
        elif word.kind in _ON_SESSION and session is not None:
            _ON_SESSION[word.kind](self, draw, session)
        elif word.kind not in _ON_SESSION:
            self._human(word.kind)

    def propose(self, draw: random.Random) -> None:
        """Launch something that can be done in this workshop, or can not."""
        self._launch(*_task(draw, self.cell.facts().holding), draw)

    def repeat(self, draw: random.Random) -> None:
        """Launch by a permit that was used, or refused, before."""
        if self.permits:
            signed, anew = draw.choice(self.permits)
            if self.runner.launch(signed, anew=anew) is None:
                raise BrokenInvariant("a permit is good once", "it began something when it was said again")

    def fill(self, _: random.Random) -> None:
        """Have the journal's disk full, or not any more."""
        self.disk.full = not self.disk.full

    def take_over(self, draw: random.Random, session: Session) -> None:
        """Take the controls of what runs."""
        self._launch(TAKEOVER, {}, draw, invocation=session.run.id)

    def hand_back(self, draw: random.Random, session: Session) -> None:
        """Have what ran bound anew."""
        permit = session.run.grant.authorization
        self._launch(permit.capability, permit.params, draw, invocation=session.run.id)

    def drive(self, draw: random.Random, session: Session) -> None:
        """Let go of the keys, and press others."""
        self._jog(session.run.id, Wish())
        self.wish = _wish(draw)

    def _human(self, op: str) -> None:
        session = self.runner.session
        refused = self.runner.human(f"inv-{self.number}" if session is None else session.run.id, op, "operator")
        if session is not None:
            self.watch.after_word(session, op, refused)

    def _jog(self, invocation: str, wish: Wish) -> None:
        if self.runner.jog(invocation, "lease", self.tick, wish, "operator") is None and asks(wish):
            self.watch.may_move()

    def _launch(self, capability: str, params: Params, draw: random.Random, invocation: str | None = None) -> None:
        """Launch as policy constrains it, with the recoveries it covers; what policy denies is not launched."""
        filled, at_s = self.policy.validate_params(capability, dict(params)), self._wall()
        facts = CellFacts(id=self.cell.id, online=True, facts=self.cell.facts())
        agent = self.policy.agent("planner")
        context = Context(time_s=at_s, profile=self.scene.profile, agent=agent, cell=facts, operator_on_duty=True)
        if not isinstance(filled, dict):
            return
        mode = Mode.CAREFUL if draw.random() < 0.15 else Mode.NORMAL
        verdict = check(self.policy, Proposal(capability=capability, params=filled, mode=mode), context)
        if verdict.outcome is PolicyOutcome.DENY:
            return
        proposal = Proposal(capability=capability, params=dict(verdict.effective), mode=mode)
        known = self.policy.capabilities[capability]
        self.number += 1
        permit = Authorization(
            id=f"permit-{self.number}",
            invocation=invocation or f"inv-{self.number}",
            cell=self.cell.id,
            capability=capability,
            version=known.version,
            params=proposal.params,
            mode=mode,
            profile=self.scene.profile,
            policy_digest=self.policy.digest,
            issued_at_s=at_s,
            expires_at_s=at_s + 30.0,
            recoveries=() if capability == TAKEOVER else covered_recoveries(self.policy, proposal, context),
            confirm_before=(draw.choice(known.phases),) if draw.random() < 0.2 and capability != TAKEOVER else (),
        )
        signed, anew = mint(permit, _KEY), invocation is not None
        self.permits.append((signed, anew))
        if self.runner.launch(signed, anew=anew) is None:
            self.watch.may_move()

    # -- ports ---------------------------------------------------------------------------------------------------------

    def _wall(self) -> float:
        return WALL_S + self.cell.observe().time_s

    def _plan_of(self, grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        permit = grant.authorization
        what = recovery or permit
        plan = watch_plan(self.policy, what.capability, permit.profile, what.params, what.mode)
        return plan, recovery_plan(self.policy, permit.capability, permit.profile)

    def _unmet(self, names: tuple[str, ...], params: Params, facts: WorldFacts) -> tuple[str, ...]:
        return tuple(found.condition for found in unmet(names, params, facts, self.policy.site))

    def _tell(self, entry: Entry) -> None:
        if entry.body.get("op") != "jog":
            self.told.append(f"{entry.tick:6} {entry.kind} {entry.invocation or ''} {entry.body}")
        self.watch.after_entry(entry)


_DEEDS: Final[Mapping[str, Callable[[Story, random.Random], object]]] = {
    "launch": Story.propose,
    "again": Story.repeat,
    "disk": Story.fill,
    "estop": lambda story, _: story.runner.estop("operator"),
    "break": lambda story, _: story.runner.break_off(RuntimeError("nobody ticks any more")),
    "reset": lambda story, draw: story.runner.reset("operator", draw.choice((None, 0, story.tick))),
    "lose": lambda story, _: story.runner.hold("link"),
    "welcome": lambda story, _: story.runner.welcomed(),
    "stranger": lambda story, draw: story.runner.human("inv-of-another", draw.choice(("resume", "stop")), "operator"),
}
_ON_SESSION: Final[Mapping[str, Callable[[Story, random.Random, Session], object]]] = {
    "hand": Story.take_over,
    "back": Story.hand_back,
    "jog": Story.drive,
}


def _task(draw: random.Random, holding: str | None) -> tuple[str, dict[str, Json]]:
    speed_mps = draw.choice((0.1, 0.25, 0.5, 1.5))
    target = draw.choice(("dock", "bench_a_stand", "bench_b_stand", "tool_stand"))
    drive: dict[str, Json] = {"target": target, "speed_mps": speed_mps}
    if holding is not None and draw.random() < 0.7:
        placing: dict[str, Json] = {"surface": "bench_a", "speed_mps": speed_mps}
        return ("place_object", placing) if draw.random() < 0.5 else ("transport_object", drive)
    thing = draw.choice(("mug_1", "glass_1", "driver_1"))
    grasp: dict[str, Json] = {"object_id": thing, "force_n": draw.choice((10.0, 40.0, 120.0)), "speed_mps": speed_mps}
    return draw.choice((("grasp_object", grasp), ("navigate_to", drive)))


def _wish(draw: random.Random) -> Wish:
    x, y, turn = (draw.choice((-1.0, 0.0, 0.0, 1.0)) for _ in range(3))
    ahead, aside, up = (draw.choice((-0.3, 0.0, 0.0, 0.3)) for _ in range(3))
    return Wish((x, y, turn), (ahead, aside, up), draw.choice((None, None, "open", "close")))
