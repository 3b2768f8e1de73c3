"""The runner as the link speaks to it: orders in the link's words, the state for displays, and the policies it holds.

A session is watched by the policy it was authorized under, even if others come into force meanwhile: that one is kept
as long as the session lasts. Beside it the cell holds the newest policy and the one before, and binds authorizations of
these: one that was minted right before a change still counts, one of a version that is not held here does not.

The site is part of the policy, and the robot works by the one it was built with: it drives to that one's stands, and
knows what stands where from it. Under a policy that says otherwise nothing is launched: what was decided about one
place would be done at another.
"""

from __future__ import annotations

import base64
import binascii
from functools import partial
from math import inf, isfinite
from typing import TYPE_CHECKING, Final, assert_never

import orjson
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from app.cell.display import describe, look, sensed, sitting
from app.cell.loop import NewPolicy, Shutdown, Welcomed
from app.cell.moment import Sight
from app.cell.run import LINK
from app.cell.runner import Runner
from app.cell.sighting import things
from app.governance.conditions import unmet
from app.governance.control import TAKEOVER
from app.governance.model import Wish
from app.governance.permit import SignedAuthorization
from app.governance.plans import closes, recovery_plan, watch_plan
from app.protocol import (
    Ack,
    Ended,
    Estop,
    Human,
    Jog,
    Jogged,
    Launch,
    Reset,
    SetProfile,
    State,
    Unrecorded,
    UpEvent,
    pack_batch,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.cell.journal import Entry, Journal
    from app.cell.latch import Latch
    from app.cell.loop import Order, Outbox
    from app.cell.moment import Moment
    from app.cell.runner import View
    from app.cell.substrate import Substrate
    from app.governance.model import Authorization, CoveredRecovery, Params, RecoveryPlan, WatchPlan, WorldFacts
    from app.governance.permit import Grant
    from app.governance.policy import PolicySet

KEPT_POLICIES: Final = 2
EMPTY_TICKS: Final = 30  # a hand whose pads felt something until just now may hold it still


class GovernedCell:
    """One runner, its journal and its policies. Owned by the loop's thread."""

    def __init__(
        self,
        substrate: Substrate,
        policies: PolicySet,
        *,
        kernel_key: str,
        journal: Journal,
        outbox: Outbox,
        wall: Callable[[], float],
        latch: Latch | None = None,
    ) -> None:
        """Put a runner on a substrate; it holds until it is welcomed.

        Args:
            substrate: what moves.
            policies: the policy to begin with, whose site the substrate was built with.
            kernel_key: what authorizations are signed with, base64 of the raw public key.
            journal: the cell's; what it still holds goes up first.
            outbox: where reports, telemetry and states go.
            wall: wall time, seconds since the epoch.
            latch: where a latched stop is kept that the journal does not take.

        Raises:
            ValueError: the key is none.
        """
        self._key = Ed25519PublicKey.from_public_bytes(base64.b64decode(kernel_key, validate=True))
        self._policies: dict[str, PolicySet] = {}
        self._site = policies.site
        self._policies_digest = ""
        self._profile: str | None = None
        self._reset = ""
        self._held_n = inf  # how firmly policy let be taken what is in the hand
        self._empty_ticks = 0  # for how long the pads have felt nothing
        self._outbox, self._wall = outbox, wall
        for entry in journal.unacknowledged():
            self._tell(entry)
        self._runner = Runner(
            substrate,
            plan_of=self._plan_of,
            verify=self._unmet,
            journal=journal,
            wall=wall,
            emit=self._tell,
            on_telemetry=self._show,
            latch=latch,
        )
        outbox.scene = describe(substrate)
        outbox.things = things(outbox.scene, policies.site)
        self._runner.hold(LINK)
        self._adopt(policies)

    @property
    def period_s(self) -> float:
        """Return the control period."""
        return self._runner.period_s

    def tick(self) -> None:
        """Do one control period."""
        self._runner.tick()
        self._empty_ticks = 0 if self._runner.observation.pads_loaded else self._empty_ticks + 1

    def hold(self, reason: str) -> None:
        """Hold in place and launch nothing until welcomed; `shutdown` ends the session."""
        self._runner.hold(reason)

    def break_off(self, error: Exception) -> None:
        """Stop by category 0, and stay latched: nobody ticks any more."""
        self._runner.break_off(error)

    def write_behind(self) -> None:
        """Have a thread of its own write the journal from here on."""
        self._runner.write_behind()

    def when_written(self, then: Callable[[], None]) -> None:
        """Do something once everything said so far is written, or at once where that cannot be."""
        self._runner.when_written(then)

    def settle(self) -> None:
        """Return once everything that can be written is."""
        self._runner.settle()

    def standing(self) -> bool:
        """Say whether nothing moves and nothing is about to."""
        return self._runner.standing()

    def obey(self, order: Order) -> None:
        """Do what was ordered; what cannot be done is reported upward by the runner."""
        match order:
            case Launch():
                self._runner.launch(_signed(order), anew=order.anew)
            case Human():
                self._runner.human(order.invocation, order.op, order.actor, expired=order.expired)
            case Jog():
                wish = Wish(order.base, order.tool, order.grip)
                self._runner.jog(order.invocation, order.lease, order.n, wish, order.actor)
            case Estop():
                self._runner.estop(order.actor)
            case Reset():
                self._runner.reset(order.actor, order.seen)
                self._reset = order.id
            case Shutdown():
                self._runner.hold("shutdown")
            case news:
                self._learn(news)

    def _learn(self, news: SetProfile | Ack | Welcomed | NewPolicy) -> None:
        match news:
            case SetProfile():
                self._profile = news.profile
            case Ack():
                self._runner.acknowledged(news.seq)
            case Welcomed():
                self._profile = news.profile
                self._runner.welcomed()
            case NewPolicy():
                self._adopt(news.policies)
            case _:
                assert_never(news)

    def state(self, overruns: int) -> State:
        """Return the newest state, with its facts and the watcher's signals; without a session, what sensors say."""
        view = self._runner.view()
        measured = sensed(self._runner.observation) if view.invocation is None else view.signals._asdict()
        gauges = {name: value for name, value in measured.items() if isfinite(value)}
        # Through JSON, which has no NaN: it becomes null, and the server says that the facts are malformed.
        facts = orjson.loads(orjson.dumps(self._runner.substrate.facts()))
        return State(
            at_s=self._wall(),
            tick=view.tick,
            invocation=view.invocation,
            status=view.status,
            latched=view.latched,
            reset=self._reset,
            holding=bool(view.holding),
            policy_digest=self._policies_digest,
            profile=self._profile,
            facts=facts,
            gauges={**gauges, "late_ticks": float(overruns)},
            session=sitting(self._runner.session),
            jog=None if view.jogged is None else Jogged(n=view.jogged[0], refused=view.jogged[1] or None),
            fault=_unrecorded(view) if view.fault else None,
            broken=view.broken,
            elsewhere="" if view.invocation else self._elsewhere(self._policies_digest),
        )

    def look(self) -> Moment:
        """Return what there is to be seen at this moment."""
        runner = self._runner
        return look(runner.substrate, runner.observation, runner.session, self._wall())

    def sight(self) -> Sight | None:
        """Return where people and things are during a session; None without one."""
        runner = self._runner
        invocation, seen = runner.invocation, runner.observation
        if invocation is None:
            return None
        return Sight(invocation, seen.time_s, seen.people, runner.substrate.poses())

    def _adopt(self, policies: PolicySet) -> None:
        self._policies.pop(policies.digest, None)  # one that comes back is the newest again
        self._policies[policies.digest] = policies
        self._policies_digest = policies.digest
        session = self._runner.session
        needed = "" if session is None else session.run.grant.authorization.policy_digest
        for digest in tuple(self._policies)[:-KEPT_POLICIES]:
            if digest != needed:
                del self._policies[digest]
        self._runner.adopt(
            policy_digest=policies.digest,
            key=self._key,
            former=frozenset(self._policies) - {policies.digest},
            elsewhere={digest: why for digest in self._policies if (why := self._elsewhere(digest))},
        )

    def _elsewhere(self, digest: str) -> str:
        """Say why nothing is launched under a policy of another site; empty where its site is the robot's."""
        if self._policies[digest].site == self._site:
            return ""
        return f"the robot works by another site than that of the policy `{digest}`; valid: restart the cell"

    def _plan_of(self, grant: Grant, recovery: CoveredRecovery | None = None) -> tuple[WatchPlan, RecoveryPlan]:
        permit = grant.authorization
        policy = self._policies.get(permit.policy_digest)
        if policy is None:
            raise ValueError(f"the policy `{permit.policy_digest}` is not held here any more")
        try:
            then = recovery_plan(policy, permit.capability, permit.profile)
            return self._watched(policy, permit, recovery), then
        except KeyError as error:
            raise ValueError(f"policy knows no {error}") from error

    def _watched(self, policy: PolicySet, permit: Authorization, recovery: CoveredRecovery | None) -> WatchPlan:
        """Return by what something is watched; what is in the hand stays held no more firmly than it might be taken."""
        what = recovery or permit
        make = partial(watch_plan, policy, what.capability, permit.profile, what.params, what.mode)
        takes = closes(policy, what.capability, permit.profile)
        empty = self._runner.substrate.facts().gripper_empty and self._empty_ticks >= EMPTY_TICKS
        if not empty and (what.capability == TAKEOVER or not takes):
            return make(held_n=self._held_n)
        plan = make()
        if takes or recovery is None:
            self._held_n = plan.bounds.grip_force_n if takes else inf
        return plan

    def _unmet(self, postconditions: tuple[str, ...], params: Params, facts: WorldFacts) -> tuple[str, ...]:
        # Whatever policy has come meanwhile: every session is launched under one of this site.
        return tuple(found.condition for found in unmet(postconditions, params, facts, self._site))

    def _tell(self, entry: Entry) -> None:
        self._outbox.event(UpEvent.model_construct(**entry._asdict()))

    def _show(self, invocation: str, rows: bytes) -> None:
        self._outbox.batch(pack_batch(invocation, rows))


def _unrecorded(view: View) -> Unrecorded:
    ended = [{"invocation": name, "outcome": outcome, "code": code} for name, (outcome, code) in view.unsaid.items()]
    return Unrecorded(why=view.fault, ended=[Ended.model_validate(end) for end in ended])


def _signed(order: Launch) -> SignedAuthorization:
    """Return what was signed; text that is no base64 becomes a signature that cannot hold, and is refused as such."""
    try:
        return SignedAuthorization(
            base64.b64decode(order.body, validate=True), base64.b64decode(order.signature, validate=True)
        )
    except binascii.Error:
        return SignedAuthorization(b"", b"")
