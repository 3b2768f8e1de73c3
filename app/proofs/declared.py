"""What two profiles declare in the wrong order, though one is said to be the stricter: numbers, watching, people.

Decisions are compared by proof (`promises.order_holds`). Here is what no decision shows, but what a session is held to.

| part | the stricter has |
|---|---|
| limits, retry budget, age of sensor data, deadline of an approval, deceleration of the base | no more |
| sensitivity, radius of the base, constants of the protective separation | no less |
| rollback | one, where the wider one has |
| `interrupt-enabled` | it, where the wider one has |
| watching | for every signal that the wider one watches, a rule about as much that comes no later and does as much |

Thresholds of another kind (a number beside a computed distance) are not compared: which comes first, nobody can say.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, NamedTuple

from app.governance.model import AuthorityMode, Intervention

if TYPE_CHECKING:
    from collections.abc import Iterator

    from app.governance.bundle_yaml import Path
    from app.governance.policy_model import Profile, WatchRow


class Misplaced(NamedTuple):
    """Something the stricter profile declares wider: where it stands in that profile, and what is wrong."""

    path: Path
    message: str
    limit: str = ""


def misplaced(strict: Profile, wide: Profile) -> Iterator[Misplaced]:
    """Yield what two profiles declare in the wrong order."""
    yield from _numbers(strict, wide)
    yield from _times(strict, wide)
    yield from _distances(strict, wide)
    if strict.rollback == "optional" != wide.rollback:
        yield Misplaced(("rollback",), f"`rollback` is optional in {strict.name} and {wide.rollback} in {wide.name}")
    if AuthorityMode.INTERRUPT_ENABLED in wide.authority - strict.authority:
        message = f"sessions can be interrupted in {wide.name}, and cannot in {strict.name}"
        yield Misplaced(("authority", "modes"), message)
    for row in wide.watch:
        yield from _unwatched(strict, wide, row)


def _numbers(strict: Profile, wide: Profile) -> Iterator[Misplaced]:
    for name, limit in strict.limits.items():
        if limit.maximum > wide.limits[name].maximum:
            message = _said(name, (strict, wide), limit.maximum, wide.limits[name].maximum)
            yield Misplaced(("limits", name), message, f"{strict.name}/{name}")
    if strict.sensitivity < wide.sensitivity:
        yield Misplaced(("sensitivity",), _said("sensitivity", (strict, wide), strict.sensitivity, wide.sensitivity))
    if strict.retry_budget > wide.retry_budget:
        message = _said("retry_budget", (strict, wide), strict.retry_budget, wide.retry_budget)
        yield Misplaced(("retry_budget",), message)


def _times(strict: Profile, wide: Profile) -> Iterator[Misplaced]:
    for name, age_ms in sorted(strict.stale_after_ms.items()):
        if age_ms > wide.stale_after_ms[name]:
            message = _said(f"stale_after_ms.{name}", (strict, wide), age_ms, wide.stale_after_ms[name])
            yield Misplaced(("stale_after_ms", name), message)
    mine, theirs = strict.approval, wide.approval
    if mine is not None and theirs is not None and mine.within_s > theirs.within_s:
        message = _said("within_s", (strict, wide), mine.within_s, theirs.within_s)
        yield Misplaced(("authority", "approval", "within_s"), message)


def _distances(strict: Profile, wide: Profile) -> Iterator[Misplaced]:
    """Yield what has the stricter profile keep less of a distance at the same speeds."""
    both = strict, wide
    if strict.base_deceleration_mps2 > wide.base_deceleration_mps2:
        said = _said("base_deceleration_mps2", both, strict.base_deceleration_mps2, wide.base_deceleration_mps2)
        yield Misplaced(("motion", "base_deceleration_mps2"), said)
    if strict.base_radius_m < wide.base_radius_m:
        said = _said("base_radius_m", both, strict.base_radius_m, wide.base_radius_m)
        yield Misplaced(("motion", "base_radius_m"), said)
    if strict.separation is None or wide.separation is None:
        return
    for part in fields(strict.separation):
        mine, theirs = (getattr(one, part.name) for one in (strict.separation, wide.separation))
        if mine < theirs:
            yield Misplaced(("separation", part.name), _said(f"separation.{part.name}", both, mine, theirs))


def _said(name: str, profiles: tuple[Profile, Profile], strict: float, wide: float) -> str:
    return f"`{name}` is {strict:g} in {profiles[0].name} and {wide:g} in {profiles[1].name}"


# Watching ------------------------------------------------------------------------------------------------------------


def _unwatched(strict: Profile, wide: Profile, row: WatchRow) -> Iterator[Misplaced]:
    """Yield that nothing in the stricter profile watches as much as a rule of the wider one."""
    same = [
        (place, other)
        for place, other in enumerate(strict.watch)
        if (other.signal, other.above) == (row.signal, row.above) and _covers(other, row)
    ]
    if any(_no_later(other, row) and _does_as_much(other, row) for _, other in same):
        return
    what = f"`{row.signal}` is watched {_threshold(row)} by `{row.id}` of {wide.name}"
    if not same:
        yield Misplaced(("watch",), f"{what}, and by no rule of {strict.name} for as many capabilities")
        return
    place, other = same[0]
    does = "" if _does_as_much(other, row) else ", where it only warns"
    yield Misplaced(("watch", place), f"{what}, and {_threshold(other)} by `{other.id}` of {strict.name}{does}")


def _covers(one: WatchRow, other: WatchRow) -> bool:
    return one.applies_to is None or (other.applies_to is not None and one.applies_to >= other.applies_to)


def _no_later(one: WatchRow, other: WatchRow) -> bool:
    """Say whether one rule comes no later than another about the same signal, as far as that can be said."""
    if one.for_ms > other.for_ms:
        return False
    if (one.named, one.limit) != (other.named, other.limit):
        return True
    mine, theirs = (row.times if row.number is None else row.number for row in (one, other))
    return mine <= theirs if one.above else mine >= theirs


def _does_as_much(one: WatchRow, other: WatchRow) -> bool:
    return one.response.enter is not Intervention.CONTINUE or other.response.enter is Intervention.CONTINUE


def _threshold(row: WatchRow) -> str:
    at = row.named or (f"{row.times:g} × {row.limit}" if row.limit is not None else f"{row.number:g}")
    lasting = f" for {row.for_ms} ms" if row.for_ms else ""
    return f"{'above' if row.above else 'below'} {at}{lasting}"


__all__ = ["Misplaced", "misplaced"]
