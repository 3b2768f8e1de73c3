"""A decision's circumstances as the log keeps them, and back: what was proposed, and Γ_t.

`circumstances` is written beside the decision; `read` makes of it what `decide` takes. What policy knows of an agent is
not kept: it is asked of the policy that decides again. A decision that was recorded before circumstances were is not
made again, and whoever reads it says so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

from app.governance.model import CellFacts, Context, Grant, GrantScope, Mode, ObjectFact, Proposal, WorldFacts
from app.governance.policy_model import GOVERNANCE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from app.governance.decision import Decision
    from app.governance.model import AgentFacts
    from app.governance.policy import PolicySet

KEY: Final = "context"
ANEW: Final = "anew"  # beside a decision on what was approved, where the verdict shown leads there from the request
_MODES: Final = {mode.value: mode for mode in Mode}
_NOTHING: Final[Mapping[str, Any]] = {}

Body = dict[str, Any]


def circumstances(proposal: Proposal, context: Context, policy: PolicySet, decision: Decision) -> Body:
    """Return what a decision was made on, for the record; JSON but for the dataclasses, which the log writes as JSON.

    Args:
        proposal: with its parameters filled in.
        context: Γ_t; only policy tells the agent's permissions, so its name is enough.
        policy: what it was decided under.
        decision: what came of it; its status alone is kept, the rest stands beside it.
    """
    cell = context.cell
    return {
        "decided": decision.status,
        "policy_version": policy.digest,
        "time_s": context.time_s,
        "agent": context.agent.name,
        "on_duty": context.operator_on_duty,
        "proposal": {
            "capability": proposal.capability,
            "params": proposal.params,
            **({"metadata": proposal.metadata} if proposal.metadata else _NOTHING),
            **({"mode": proposal.mode} if proposal.mode is not Mode.NORMAL else _NOTHING),
            **({"preconditions": proposal.preconditions} if proposal.preconditions else _NOTHING),
            **({"capability_version": proposal.version} if proposal.version is not None else _NOTHING),
        },
        "cell": {
            "id": cell.id,
            "online": cell.online,
            "latched": cell.latched,
            "busy": cell.busy,
            "holding_link": cell.holding_link,
            **(_NOTHING if cell.recording else {"recording": False}),
            "facts": cell.facts,
        },
        **({"grants": context.grants} if context.grants else _NOTHING),
    }


class Agents:
    """Who proposed, as one policy knows them; each is looked up once."""

    def __init__(self, policy: PolicySet) -> None:
        """Take the policy that decides again."""
        self._policy = policy
        self._known: dict[str, AgentFacts] = {GOVERNANCE: policy.governance()}

    def __call__(self, name: str) -> AgentFacts:
        """Return what policy permits an agent."""
        found = self._known.get(name)
        if found is None:
            found = self._known[name] = self._policy.agent(name)
        return found


def read(kept: Body, profile: str, policy: PolicySet, agents: Agents) -> tuple[Proposal, Context]:
    """Return the proposal and the context of a recorded decision, for `policy` to decide on.

    A standing grant holds under the policy it was given under; where another one decides, it is taken to have been
    given under that one.

    Raises:
        KeyError, TypeError, ValueError: this is no record of a decision's circumstances.
    """
    said, cell = kept["proposal"], kept["cell"]
    facts = cell["facts"]
    proposal = Proposal(
        capability=said["capability"],
        params=said["params"],
        metadata=said.get("metadata", _NOTHING),
        mode=_MODES[said["mode"]] if "mode" in said else Mode.NORMAL,
        preconditions=tuple(said.get("preconditions", ())),
        version=said.get("capability_version"),
    )
    context = Context(
        time_s=kept["time_s"],
        profile=profile,
        agent=agents(kept["agent"]),
        cell=CellFacts(
            id=cell["id"],
            online=cell["online"],
            latched=cell["latched"],
            busy=cell["busy"],
            holding_link=cell["holding_link"],
            recording=cell.get("recording", True),
            facts=None if facts is None else _world(facts),
        ),
        operator_on_duty=kept["on_duty"],
        grants=_grants(kept["grants"], kept["policy_version"], policy) if "grants" in kept else (),
    )
    return proposal, context


def _world(facts: Body) -> WorldFacts:
    seen = cast("Mapping[str, Body]", facts["objects"])
    x_m, y_m, yaw_rad = facts["base"]
    whole: Body = {
        **facts,
        "base": (x_m, y_m, yaw_rad),
        "objects": {name: ObjectFact(**one) for name, one in seen.items()},
    }
    return WorldFacts(**whole)


def _grants(given: list[Body], version: str, policy: PolicySet) -> tuple[Grant, ...]:
    return tuple(
        _grant(one, policy.digest if one["policy_digest"] == version else one["policy_digest"]) for one in given
    )


def _grant(one: Body, digest: str) -> Grant:
    whole: Body = {**one, "scope": GrantScope(one["scope"]), "policy_digest": digest}
    return Grant(**whole)
