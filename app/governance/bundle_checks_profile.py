"""What a profile has to mean: signals and thresholds that exist, failures that are covered, people to ask."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from app.governance.bundle_checks import needed, repeated
from app.governance.bundle_checks_dead import dead_rows, dead_steps
from app.governance.bundle_checks_values import unproposable
from app.governance.model import Strategy
from app.governance.policy_model import FAILURES, LIMIT_UNITS, NAMED_THRESHOLDS, SENSORS, SIGNAL_UNITS, WALKING_MPS
from app.governance.recovery import NEW_ATTEMPTS
from app.governance.vocabulary import always_there, properties

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from app.governance import bundle_shapes as shapes
    from app.governance.bundle_checks import Known
    from app.governance.bundle_yaml import Path, Reader
    from app.governance.errors import PolicyError
    from app.governance.model import Capability, Json

ASKING: Final = frozenset({"approval-required", "approval-on-escalation"})
HUMANS: Final = ASKING | {"takeover-enabled"}
MANIPULATION: Final = "manipulation"
RESERVED: Final = frozenset({"admission", "authority", "guard", "organization"})


def profile(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    """Check a profile: watch rules, recovery table, authority, and that limits leave every capability room."""
    if f"{shape.profile}.yaml" != reader.document.file.rpartition("/")[2]:
        message = f"`{shape.profile}` stands in `{reader.document.file}`"
        yield reader.problem(("profile",), message, [f"{shape.profile}.yaml"])
    if shape.profile in RESERVED:
        message = f"`{shape.profile}` is reserved: rules of another origin go by that name"
        yield reader.problem(("profile",), message, [f"a name that is none of {', '.join(sorted(RESERVED))}"])
    for name in shape.stale_after_ms:
        yield from reader.unknown(("stale_after_ms", name), "sensor", name, SENSORS)
    if unlimited := [name for name in SENSORS if name not in shape.stale_after_ms]:
        message = f"nothing says when {', '.join(f'`{name}`' for name in unlimited)} would count as silent"
        yield reader.problem(("stale_after_ms",), message, ["an age in milliseconds for each sensor"])
    yield from _watch(reader, shape, known)
    yield from _shared(reader, shape, known)
    yield from _recovery(reader, shape, known)
    yield from _authority(reader, shape, known)
    yield from _room(reader, shape, known)


def _watch(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    yield from repeated(reader, "watch", "watch rule", [row.id for row in shape.watch])
    for index, row in enumerate(shape.watch):
        path: Path = ("watch", index)
        for at, name in enumerate(row.applies_to or ()):
            yield from reader.unknown((*path, "applies_to", at), "capability", name, known.named)
        yield from reader.unknown((*path, "signal"), "signal", row.signal, SIGNAL_UNITS)
        if row.failure:
            yield from reader.unknown((*path, "failure"), "failure", row.failure, FAILURES)
        yield from _threshold(reader, path, row, shape)
        yield from _response(reader, path, row, shape)


def _shared(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    """Where people work on the same floor, the distance to them is watched, whatever the robot is allowed to do."""
    if not shape.shared_floor:
        return
    if shape.separation is not None and shape.separation.human_speed_mps < WALKING_MPS:
        path = ("separation", "human_speed_mps")
        message = f"people who share the floor walk faster than {shape.separation.human_speed_mps:g} m/s (ISO 13855)"
        yield reader.problem(path, message, [f"{WALKING_MPS:g} or more"])
    watched: set[str] = set()
    for row in shape.watch:
        if row.signal == "separation_m" and row.below is not None:
            watched.update(known.capabilities if row.applies_to is None else row.applies_to)
    enabled = {
        name for name, found in known.capabilities.items() if found.env_profile.get(shape.profile) != "forbidden"
    }
    left_out = sorted(enabled - watched)
    if left_out:
        of = "" if not watched else " of " + ", ".join(f"`{name}`" for name in left_out)
        message = f"people share the floor, and no watch rule holds `separation_m`{of} from below"
        yield reader.problem(("shared_floor",), message, ["a watch rule with `signal: separation_m` and `below`"])


def _threshold(reader: Reader, path: Path, row: shapes.WatchShape, shape: shapes.ProfileShape) -> Iterator[PolicyError]:
    if (row.above is None) == (row.below is None):
        yield reader.problem(path, "a watch rule has one threshold", ["above", "below"])
        return
    side = "below" if row.above is None else "above"
    threshold = row.below if row.above is None else row.above
    unit = SIGNAL_UNITS.get(row.signal)
    if isinstance(threshold, str):
        fitting = [name for name, signal in NAMED_THRESHOLDS.items() if signal == row.signal]
        yield from reader.unknown((*path, side), f"threshold for `{row.signal}` called", threshold, fitting)
        if threshold == "protective_separation_m" and shape.separation is None:
            message = "the profile declares no `separation` to compute it from"
            yield reader.problem((*path, side), message, ["separation", "a number in m"])
    elif threshold is not None and not isinstance(threshold, (int, float)) and LIMIT_UNITS[threshold.limit] != unit:
        message = (
            f"unit mismatch: `{row.signal}` is in `{unit}`, `{threshold.limit}` in `{LIMIT_UNITS[threshold.limit]}`"
        )
        fitting = [f"a limit in {unit}: {name}" for name, has in LIMIT_UNITS.items() if has == unit]
        yield reader.problem((*path, side), message, [*fitting, f"a number in {unit}"])


def _response(reader: Reader, path: Path, row: shapes.WatchShape, shape: shapes.ProfileShape) -> Iterator[PolicyError]:
    response, here = row.response, (*path, "response")
    if response.otherwise is not None and response.persist_ms is None:
        yield reader.problem((*here, "else"), "`else` follows `persist_ms`, which is missing", ["persist_ms"])
    if response.then == "resume" and response.enter != "pause":
        yield reader.problem((*here, "then"), "only a pause can resume", ["stay"])
    if response.clear_beyond > 0.0:
        yield from _clearing(reader, (*here, "clear_beyond"), row)
    asks = "escalate" in (response.enter, response.otherwise) or (
        response.persist_ms is not None and response.otherwise is None
    )
    if asks and HUMANS.isdisjoint(shape.authority.modes):
        yield reader.problem(here, "nobody could answer an escalation in this profile", sorted(HUMANS))


def _clearing(reader: Reader, path: Path, row: shapes.WatchShape) -> Iterator[PolicyError]:
    """What never clears by itself needs no distance to clear by, and one that cannot be reached never clears."""
    if row.method == "cusum":
        yield reader.problem(path, "a sum falls by itself; only a threshold is cleared by a distance", ["left out"])
    elif row.response.then != "resume" and row.response.enter != "continue":
        yield reader.problem(path, "it does not clear by itself: it stays until a human resumes", ["then: resume"])
    elif isinstance(row.above, (int, float)) and row.response.clear_beyond >= row.above:
        message = f"`{row.signal}` would have to fall to {row.above - row.response.clear_beyond:g} to be clear"
        yield reader.problem(path, message, [f"less than {row.above:g}"])


def _recovery(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    for index, row in enumerate(shape.recovery):
        path: Path = ("recovery", index)
        yield from reader.unknown((*path, "on"), "failure", row.on, FAILURES | {"any"})
        for at, name in enumerate(row.applies_to or ()):
            yield from reader.unknown((*path, "applies_to", at), "capability", name, known.named)
        yield from _recovered(reader, path, row, shape, known)
        yield from _budget(reader, path, row, shape)
        yield from _steps(reader, path, row, shape)
        yield from dead_steps(reader, index, row)
    yield from dead_rows(reader, shape, known)
    if not any(row.on == "any" and row.applies_to is None and row.risks is None for row in shape.recovery):
        yield reader.problem(("recovery",), "failures are left uncovered: the table needs a last row", ["on: any"])


def _budget(reader: Reader, path: Path, row: shapes.RecoveryShape, shape: shapes.ProfileShape) -> Iterator[PolicyError]:
    """A row's budget is for its own steps, and no more than the whole session has: the rest could never be used up."""
    for step, count in row.budget.items():
        if step not in row.do:
            yield reader.problem((*path, "budget", step), f"`{step}` is no step of this row", row.do)
            continue
        if Strategy(step.upper()) in NEW_ATTEMPTS:
            most = shape.retry_budget
            why = f"`retry_budget` leaves a session `{most}` new attempts in all"
        else:
            most, why = (1, "a session is rolled back once") if step == "rollback" else (count, "")
        if count > most:
            message = f"a dead budget: `{step}` is `{count}`, and {why}"
            yield reader.problem((*path, "budget", step), message, [f"up to {most}"])


def _recovered(
    reader: Reader, path: Path, row: shapes.RecoveryShape, shape: shapes.ProfileShape, known: Known
) -> Iterator[PolicyError]:
    """A recovery by a capability names one that is there, and enabled in this profile."""
    needs = "recovery_capability" in row.do
    if needs and row.capability is None:
        yield reader.problem(path, "`recovery_capability` needs `capability`", sorted(known.recoveries))
    if row.capability is not None:
        yield from reader.unknown((*path, "capability"), "recovery capability", row.capability, known.recoveries)
        if needs and _forbidden(row.capability, shape, known):
            message = f"`{row.capability}` is forbidden in this profile: the step could never be taken"
            enabled = [name for name in sorted(known.recoveries) if not _forbidden(name, shape, known)]
            yield reader.problem((*path, "capability"), message, enabled)


def _forbidden(name: str, shape: shapes.ProfileShape, known: Known) -> bool:
    found = known.capabilities.get(name)
    return found is not None and found.env_profile.get(shape.profile) == "forbidden"


def _steps(reader: Reader, path: Path, row: shapes.RecoveryShape, shape: shapes.ProfileShape) -> Iterator[PolicyError]:
    if "ask_human" in row.do and HUMANS.isdisjoint(shape.authority.modes):
        yield reader.problem((*path, "do"), "nobody could be asked in this profile", sorted(HUMANS))
    if "safer_mode" in row.do and "careful" not in shape.modes:
        yield reader.problem((*path, "do"), "`safer_mode` needs the mode `careful`", ["modes: [normal, careful]"])


def _authority(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    modes, approval = shape.authority.modes, shape.authority.approval
    asks = not ASKING.isdisjoint(modes)
    if asks and approval is None:
        yield reader.problem(("authority",), "modes that ask for approval need `approval`", ["approval"])
    if not asks and approval is not None:
        yield reader.problem(("authority", "approval"), "no mode of this profile asks for approval", sorted(ASKING))
    if "approval-required" in modes and approval is not None and not approval.risk:
        message = (
            "`approval-required` asks by risk, and no risk is named: no proposal would be asked about for its risk"
        )
        valid = ["risk: [high, critical]", "approval-on-escalation"]
        yield reader.problem(("authority", "approval", "risk"), message, valid)
    yield from _review(reader, shape)
    for name, found in known.capabilities.items():
        if found.env_profile.get(shape.profile) == "approval-required" and not asks:
            message = f"`{name}` requires approval here, but no mode of this profile asks for it"
            yield reader.problem(("authority", "modes"), message, sorted(ASKING))
        yield from _rolls_back(reader, shape, known, found)


def _rolls_back(reader: Reader, shape: shapes.ProfileShape, known: Known, found: Capability) -> Iterator[PolicyError]:
    """What is to be undone has something that undoes it, and that is enabled here."""
    if shape.rollback == "required" and MANIPULATION in found.permissions and found.rollback is None:
        message = f"rollback is required for manipulation, and `{found.name}` has none"
        yield reader.problem(("rollback",), message, ["optional", "always"])
    enabled = found.env_profile.get(shape.profile) != "forbidden"
    if shape.rollback != "optional" and enabled and found.rollback and _forbidden(found.rollback, shape, known):
        message = f"`{found.name}` is rolled back by `{found.rollback}`, which is forbidden in this profile"
        yield reader.problem(("rollback",), message, ["optional"])


def _review(reader: Reader, shape: shapes.ProfileShape) -> Iterator[PolicyError]:
    review = shape.authority.review
    if review is None:
        return
    if "review-only" not in shape.authority.modes:
        message = "no mode of this profile reviews what is finished"
        yield reader.problem(("authority", "review"), message, ["review-only"])
    if not review.risk and not review.outcomes:
        message = "neither a risk nor an outcome is named: no session would wait for a verdict"
        yield reader.problem(("authority", "review"), message, ["risk: [high, critical]", "outcomes: [fault]"])


def _room(reader: Reader, shape: shapes.ProfileShape, known: Known) -> Iterator[PolicyError]:
    """Every limit leaves what it holds some room, is always there to be held, and holds something at all."""
    limits = {name: (LIMIT_UNITS[name], cast("float", getattr(shape.limits, name).max)) for name in LIMIT_UNITS}
    highest: dict[str, float] = {}  # by limit, the most that any parameter it holds may be by its own schema
    for name, found in known.capabilities.items():
        for param, spec in properties(found).items():
            value, key = _limited(spec, limits)
            if value is None:
                continue
            low = spec.get("minimum")
            if isinstance(low, (int, float)) and low > value:
                message = f"`{value}` leaves `{param}` of `{name}` no room: its minimum is `{low}`"
                yield reader.problem(("limits", key, "max"), message, [f"{low:g} or more"])
            yield from unproposable(reader, ("limits", key), f"`{param}` of `{name}`", {"max": value}, spec)
            if param not in always_there(found):
                message = f"`{param}` of `{name}` is limited by `{key}` but may be left out: give it a default"
                yield reader.problem(("limits", key), message, needed(param))
            highest[key] = max(highest.get(key, 0.0), cast("float", spec["maximum"]))
    for key, most in highest.items():
        if limits[key][1] > most and not known.unread:
            message = f"a dead limit: `{limits[key][1]:g}` is above `{most:g}`, the most any parameter it holds may be"
            yield reader.problem(("limits", key, "max"), message, [f"up to {most:g}"])


def _limited(spec: Mapping[str, Json], limits: Mapping[str, tuple[str, float]]) -> tuple[float, str] | tuple[None, str]:
    """Return the limit that holds a parameter, and its name: the one it names, else the least of its unit."""
    named = str(spec.get("x-limit"))
    same = [(value, key) for key, (unit, value) in limits.items() if unit == spec.get("unit")]
    return (limits[named][1], named) if named in limits else min(same, default=(None, ""))
