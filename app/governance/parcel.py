"""A compiled policy in parcels, from one process to another: compiling is work, binding what was compiled is little.

A server that compiled a thousand rules itself would keep its event loop waiting for the interpreter; another process
compiles, and the server takes the result parcel by parcel, doing other things in between. Parcels are Python's own
formats, so they go from a process to the one that started it, and nowhere else: whoever writes them can run anything.
"""

from __future__ import annotations

import marshal
import pickle
from typing import TYPE_CHECKING, Any, Final, cast

from app.governance.bundle import bind_gate, make_inputs
from app.governance.policy import PolicySet
from app.governance.policy_code import Compiled, Parts, bind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from types import CodeType

    from app.governance.model import Capability, Site
    from app.governance.policy_model import Profile

HEAD, SOME_RULES, A_GATE = "head", "rules", "gate"
RULES: Final = 100  # in one parcel
PLAIN: Final = ("digest", "capabilities", "profiles", "site", "agents", "authority", "permissions", "files")


def parcels(policy: PolicySet) -> Iterator[bytes]:
    """Yield a policy in parcels, each taken in about a millisecond."""
    yield pickle.dumps((HEAD, {name: getattr(policy, name) for name in PLAIN}))
    rules = list(policy.rules.values())
    for first in range(0, len(rules), RULES):
        yield pickle.dumps((SOME_RULES, rules[first : first + RULES]))
    for pair, gate in policy.gates.items():
        code, constants, again, whole = gate.parts
        yield pickle.dumps((A_GATE, (pair, gate.source, marshal.dumps(code), dict(constants), again, whole)))


def unpacked(taken: Iterable[bytes]) -> Iterator[PolicySet | None]:
    """Take parcels one at a time; yields None after each, and then the policy."""
    head: dict[str, Any] = {}
    rules: dict[str, Any] = {}
    gates: dict[tuple[str, str], Any] = {}
    for parcel in taken:
        kind, found = cast("tuple[str, Any]", pickle.loads(parcel))  # noqa: S301  # of the process this one started
        if kind == HEAD:
            head = found
        elif kind == SOME_RULES:
            rules |= {rule.id: rule for rule in found}
        else:
            pair, source, code, constants, again, whole = found
            parts = Parts(cast("CodeType", marshal.loads(code)), constants, again, whole)  # noqa: S302  # likewise
            gates[pair] = _gate(head, pair, source, parts)
        yield None
    inputs = {name: make_inputs(found) for name, found in head["capabilities"].items()}
    yield PolicySet(**head, rules=rules, gates=gates, inputs=inputs)


def _gate(head: dict[str, Any], pair: tuple[str, str], source: str, parts: Parts) -> object:
    capability: Capability = head["capabilities"][pair[0]]
    profile: Profile = head["profiles"][pair[1]]
    site: Site = head["site"]
    check = bind(capability, profile, site, parts)
    return bind_gate(capability, profile, site, Compiled(check=check, source=source, parts=parts))
