"""What may be asked for under a policy, and where: the situations that the paper's generator draws requests from.

A scene is a capability, a profile, the names it is asked with, and a cell that stands where that needs (in front of
the surface, with the object in its gripper, …). Its parameters are what policy makes of a request for the most: speeds
and forces at the limit that holds there, the clearance and the corridor that policy wants. Requests are drawn below
that, so that policy itself says what an authorized request is and nothing of it is written down twice.

A scene is *open* where policy lets the agent have it, if need be with a human's approval, and *restricted* where
policy denies it to the agent and would allow it to one that held every permission. Any other combination of names (an
object above the payload limit, say) is asked for by nobody.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

from app.evaluation.model import AGENT
from app.governance import cases
from app.governance.bundle_shapes import ContextShape
from app.governance.decision import decide
from app.governance.model import AgentFacts, Proposal, Status
from app.governance.vocabulary import properties, referring

if TYPE_CHECKING:
    from app.governance.model import Capability, Context, Json, Params, Site
    from app.governance.policy import PolicySet

SCALED: Final = ("speed_mps", "force_n")
_LAUNCHABLE: Final = frozenset({"allowed", Status.AWAITING_APPROVAL})


class Scene(NamedTuple):
    """One situation.

    Attributes:
        params: The most that policy allows here, complete.
        context: Γ_t with the agent that proposes.
        object: The object that is named or carried; empty without one.
        asks: Whether policy wants a human's approval.
    """

    params: Params
    context: Context
    object: str
    asks: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenes:
    """The scenes of one capability in one profile."""

    open: tuple[Scene, ...]
    restricted: tuple[Scene, ...]


class _Names(NamedTuple):
    params: Mapping[str, str]
    stand: str
    object: str


@cache
def scenes(policy: PolicySet, capability: str, profile: str) -> Scenes:
    """Return the scenes of a capability in a profile, in the order of the site's names."""
    package = policy.capabilities[capability]
    found: dict[str, list[Scene]] = {"open": [], "restricted": []}
    for names in _carrying(package, policy.site):
        for kind, scene in _classified(policy, package, profile, names):
            found[kind].append(scene)
    return Scenes(open=tuple(found["open"]), restricted=tuple(found["restricted"]))


def _carrying(capability: Capability, site: Site) -> Iterator[_Names]:
    """List the names a capability can be asked with, once for every object where it needs one in the gripper."""
    for names in _named(referring(capability), site):
        if "carrying" in capability.preconditions:
            for thing in site.objects:
                yield names._replace(object=thing)
        else:
            yield names


def _named(references: Mapping[str, str], site: Site) -> tuple[_Names, ...]:
    """List the names of the site that a capability takes, by the first kind of them that it refers to."""
    for kind, names in _NAMED.items():
        if kind in references:
            return tuple(names(references, site))
    return ()


_NAMED: Final[Mapping[str, Callable[[Mapping[str, str], Site], Iterator[_Names]]]] = {
    "object": lambda to, site: (
        _Names({to["object"]: name}, site.surfaces[thing.surface].target, name) for name, thing in site.objects.items()
    ),
    "tool": lambda to, site: (
        _Names({to["tool"]: name, to["action"]: action}, tool.target, "")
        for name, tool in site.tools.items()
        for action in tool.actions
    ),
    "surface": lambda to, site: (
        _Names({to["surface"]: name}, surface.target, "") for name, surface in site.surfaces.items()
    ),
    "area": lambda to, site: (_Names({to["area"]: name}, area.target, "") for name, area in site.areas.items()),
    "target": lambda to, site: (_Names({to["target"]: name}, site.start, "") for name in site.targets),
}


def _classified(policy: PolicySet, package: Capability, profile: str, names: _Names) -> Iterator[tuple[str, Scene]]:
    holding = names.object if "carrying" in package.preconditions else None
    context = cases.context(policy, profile, ContextShape(agent=AGENT, stand=names.stand, holding=holding))
    trusted = replace(context, agent=AgentFacts(name=AGENT, permissions=policy.permissions))
    most = Proposal(capability=package.name, params=complete(policy, package.name, {**names.params, **_most(package)}))
    allowed = decide(policy, most, trusted)
    if allowed.status not in _LAUNCHABLE or allowed.verdict is None:
        return
    conforming = replace(most, params=allowed.verdict.effective)
    decision = decide(policy, conforming, context)
    scene = Scene(conforming.params, context, names.object, decision.status is Status.AWAITING_APPROVAL)
    if decision.status in _LAUNCHABLE:
        yield "open", scene
    elif decision.status in (Status.DENIED, Status.REJECTED):
        yield "restricted", scene


def _most(package: Capability) -> dict[str, Json]:
    """Ask for the fastest, the firmest and the closest that the manifest has."""
    asked: dict[str, Json] = {}
    for name, spec in properties(package).items():
        if name in SCALED:
            asked[name] = spec["maximum"]
        elif name == "clearance_m":
            asked[name] = spec["minimum"]
    return asked


def complete(policy: PolicySet, capability: str, params: Params) -> Params:
    """Return validated parameters with defaults filled in.

    Raises:
        ValueError: They do not fit the capability's input schema.
    """
    filled = policy.validate_params(capability, params)
    if isinstance(filled, tuple):
        raise ValueError(f"`{capability}` does not take {dict(params)}: {'; '.join(one.message for one in filled)}")
    return filled
