"""Who has the controls of a cell: one lease, exclusive, and what becomes of it (paper, Human Override Interface).

```
                 take              keep    returning   refused   lapse, end
free ──────────▶ held
held             `TAKING`, below   held    returning   –         free
returning        refused           heard   –           held      free
```

Who hands back is still heard; nothing they send moves anything.

Who takes what somebody holds is decided by where the two stand:

| taker | the holder is the same person | holder remote | holder local |
|---|---|---|---|
| remote | renewed | refused | refused |
| local | renewed | pre-empted | refused |

Local is who stands at the cell: their token names it as its station. Whoever sees the robot outranks whoever sees a
picture of it; among equals the first one has it. A renewed lease bears another name, so that of two windows of one
person only the newer one drives.

Nothing here waits or knows a clock; times are seconds of a monotonic clock and arrive as arguments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, NamedTuple

from app.governance.errors import GovernanceError

TAKEOVER: Final = "takeover"
"""The capability that a human drives under; policy holds its limits like any other's."""

GOING_ON: Final = frozenset({"resume", "rollback", "confirm", "resolve_continue"})
"""The words on which a session moves; every other one only holds or ends it."""

LAPSE_S: Final = 3.0
"""A lease whose holder was not heard for so long is over; a hidden browser window still speaks once a second."""

LATE_S: Final = 0.3
"""A command that took longer than a link may be silent moves nothing: whoever sent it may have let go since."""

UNHEARD_S: Final = 0.4
"""Who hears the server in time hears it twice as often; whoever does not is no better off than who is heard late."""


class Where(StrEnum):
    """From where somebody drives."""

    LOCAL = "local"
    REMOTE = "remote"


class Phase(StrEnum):
    """What a lease is in: its holder drives, or gives the cell back."""

    HELD = "held"
    RETURNING = "returning"


class Taking(StrEnum):
    """What becomes of somebody's wish for the controls."""

    GRANTED = "granted"
    RENEWED = "renewed"
    PREEMPTED = "preempted"
    REFUSED = "refused"


TAKING: Final[dict[tuple[Where, Where], Taking]] = {
    (Where.REMOTE, Where.REMOTE): Taking.REFUSED,
    (Where.REMOTE, Where.LOCAL): Taking.REFUSED,
    (Where.LOCAL, Where.REMOTE): Taking.PREEMPTED,
    (Where.LOCAL, Where.LOCAL): Taking.REFUSED,
}
"""(taker, holder) → what becomes of it, where the two are not the same person."""


class ControlError(GovernanceError):
    """A step a lease cannot take from the phase it is in: a bug of whoever asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Somebody wants the controls: the name of the new lease, who, from where, of which invocation, and when."""

    lease: str
    holder: str
    where: Where
    invocation: str
    at_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """A lease under way. `heard_s` is when its holder was last heard, `newest` the number of their last command."""

    lease: str
    holder: str
    where: Where
    invocation: str
    since_s: float
    heard_s: float
    newest: int = -1
    phase: Phase = Phase.HELD

    def lapsed(self, now_s: float) -> bool:
        """Say whether its holder has been silent for too long. A clock that reads NaN lapses everything."""
        return not now_s - self.heard_s <= LAPSE_S


class Taken(NamedTuple):
    """What became of a claim, and who has the controls now."""

    how: Taking
    control: Control


def take(present: Control | None, claim: Claim) -> Taken:
    """Return who has the controls after somebody wanted them; a lease that has lapsed holds nobody off.

    Args:
        present: Who has them.
        claim: Who wants them.
    """
    granted = Control(
        lease=claim.lease,
        holder=claim.holder,
        where=claim.where,
        invocation=claim.invocation,
        since_s=claim.at_s,
        heard_s=claim.at_s,
    )
    if present is None or present.lapsed(claim.at_s):
        return Taken(Taking.GRANTED, granted)
    if present.phase is Phase.RETURNING:
        return Taken(Taking.REFUSED, present)
    how = Taking.RENEWED if present.holder == claim.holder else TAKING[claim.where, present.where]
    if how is Taking.REFUSED:
        return Taken(how, present)
    return Taken(how, granted if how is Taking.PREEMPTED else replace(granted, since_s=present.since_s))


def keep(control: Control, now_s: float) -> Control:
    """Return the lease after its holder was heard."""
    return replace(control, heard_s=max(control.heard_s, now_s))


def lateness(said_s: float, heard_s: float) -> float:
    """Return how late a command comes, at most: its own way, and that of the word its sender had heard last. Seconds.

    The two sides' clocks are never compared. That word is the server's, and so is the clock it is timed by; how long
    before the command it was heard is the sender's to say, and counts for no more than `UNHEARD_S`.

    Args:
        said_s: How long ago the word was said.
        heard_s: How long before the command it was heard.
    """
    return said_s - min(heard_s, UNHEARD_S)


def command(
    control: Control, *, lease: str, holder: str, number: int, now_s: float, late_s: float = 0.0
) -> tuple[Control, str | None]:
    """Return the lease after a jog command, and why the command may not be passed on: a code, or None.

    `not_holder`: another lease, or another person's. `lease_lapsed`: it came after that. `returning`: the cell is being
    handed back. `out_of_order`: a newer command came before it. `too_late`: it was on its way for longer than
    `LATE_S`; NaN is.
    """
    if lease != control.lease or holder != control.holder:
        return control, "not_holder"
    if control.lapsed(now_s):
        return control, "lease_lapsed"
    heard = keep(control, now_s)
    if control.phase is Phase.RETURNING:
        return heard, "returning"
    if number <= control.newest:
        return heard, "out_of_order"
    return replace(heard, newest=number), None if late_s <= LATE_S else "too_late"


def returning(control: Control) -> Control:
    """Return the lease of somebody who has begun to hand back.

    Raises:
        ControlError: they have begun already.
    """
    if control.phase is not Phase.HELD:
        raise ControlError(f"the lease `{control.lease}` is `{control.phase}`; valid: `{Phase.HELD}`")
    return replace(control, phase=Phase.RETURNING)


def refused(control: Control, now_s: float) -> Control:
    """Return the lease after the cell would not be handed back: its holder drives on.

    Raises:
        ControlError: nobody was handing it back.
    """
    if control.phase is not Phase.RETURNING:
        raise ControlError(f"the lease `{control.lease}` is `{control.phase}`; valid: `{Phase.RETURNING}`")
    return keep(replace(control, phase=Phase.HELD), now_s)
