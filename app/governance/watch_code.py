"""Turns what a plan watches into one Python function: its detectors (`fusing`), then the test that a tick is quiet.

```
def watch(state, seen, report, command, rate, retried, unmet):
    base, people, before, … = state.remembered
    <the detectors that some rule or telemetry needs>
    if <every rule's signal is within its limit, and nothing adds up>:
        return the next state, no alerts                      a quiet tick ends here
    return judge(state, remembered, measured)                 the rules one by one (`watcher`)
```

Its text depends on which signals are bounded in which direction alone; numbers are constants of the function's
namespace. So plans that differ in numbers share their code, and a recovery is bound without compiling anything.
"""

from __future__ import annotations

import functools
from types import FunctionType
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, TypeAlias, cast

from app.governance import detectors
from app.governance.fusing import fuse, needed
from app.governance.model import Command, Observation, SensorStamps, SkillReport
from app.governance.signals import SHOWN, Constants, Senses, Signals, WatchState

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import CodeType

    from app.governance.model import Alert

Judge: TypeAlias = "Callable[[WatchState, tuple[object, ...], tuple[float, ...]], tuple[WatchState, tuple[Alert, ...]]]"

_UNPACKED: Final = {
    "seen": Observation._fields,
    "before": Observation._fields,  # whole: to look up one by one what is needed takes half a µs longer
    "report": SkillReport._fields,
    "stamps": SensorStamps._fields,
    "command": Command._fields,
}
_CONSTANT: Final = {"plan": Constants._fields}
_NUMBERS: Final = {name: value for name, value in vars(detectors).items() if type(value) in (int, float)}

_FRAME: Final = """
def watch(state, seen, report, command, rate, retried, unmet):
    remembered, _, lasting, sums = state
    {senses} = remembered
    if before is None:
        before = seen
    stamps = seen.stamps_s
    ...
    before = seen
    remembered = ({senses})
    measured = ({signals})
    if {quiet}:
        return new(WatchState, (remembered, measured, QUIET, sums)), QUIET
    return judge(state, remembered, measured)
"""


class Watch(Protocol):
    """`watch` of one plan."""

    def __call__(
        self,
        state: WatchState,
        seen: Observation,
        report: SkillReport,
        command: Command,
        rate: float = 1.0,
        retried: int = 0,
        unmet: int = 0,
    ) -> tuple[WatchState, tuple[Alert, ...]]:
        """Return the next state and an alert for every rule that has been violated for long enough.

        Args:
            state: What the tick before left.
            seen: What the sensors say now.
            report: What the skill says of itself.
            command: What the actuators were told, after the clamp.
            rate: How fast the skill was let run; at 0 neither timeout nor stall goes on.
            retried: Recoveries of kind retry so far, counted by governance.
            unmet: How many postconditions were found unmet when the skill said it was done.
        """
        ...


class Bound(NamedTuple):
    """What a rule asks: at most `limit` where `above` is the violation, else at least. `reports` is what it shows."""

    signal: str
    above: bool
    limit: float
    reports: str


def generate(
    plan: Constants, bounds: tuple[Bound, ...], holds_on: bool, none: tuple[float, ...], judge: Judge
) -> Watch:
    """Generate the function of one plan.

    Args:
        plan: What detectors take from it.
        bounds: What a quiet tick satisfies.
        holds_on: Whether a rule is not over yet where its bound is satisfied again: no tick after it is quiet then.
        none: The sums when nothing has added up.
        judge: Called for every tick that is not quiet.
    """
    shape = tuple((bound.signal, bound.above, bound.reports) for bound in bounds)
    namespace: dict[str, object] = {
        **vars(detectors),
        **Signals._field_defaults,  # what nobody measures
        **{f"plan_{name}": value for name, value in plan._asdict().items()},
        **{f"LIMIT_{number}": bound.limit for number, bound in enumerate(bounds)},
        **_SUPPORT,
        "NO_SUMS": none,
        "judge": judge,
    }
    return cast("Watch", FunctionType(_code(shape, bool(none), holds_on), namespace, argdefs=(1.0, 0, 0)))


@functools.lru_cache(maxsize=64)
def _code(shape: tuple[tuple[str, bool, str], ...], adds_up: bool, holds_on: bool) -> CodeType:
    wanted = SHOWN.union(*({signal, reports} for signal, _, reports in shape))
    # `not` a violation and not its opposite: what cannot be compared is not quiet.
    quiet = [f"{signal} {'<=' if above else '>='} LIMIT_{number}" for number, (signal, above, _) in enumerate(shape)]
    if adds_up:
        quiet.append("sums == NO_SUMS")
    if holds_on:
        quiet.append("lasting == QUIET")
    frame = _FRAME.format(
        senses=", ".join(Senses._fields), signals=", ".join(Signals._fields), quiet=" and ".join(quiet) or "True"
    )
    return fuse(frame, needed(detectors.DETECTORS, wanted), _UNPACKED, _CONSTANT, _NUMBERS, detectors.__file__)


_SUPPORT: Final[dict[str, object]] = {  # pyright: ignore[reportUnknownVariableType]  # tuple.__new__
    "WatchState": WatchState,
    "QUIET": (),
    "new": tuple.__new__,  # pyright: ignore[reportUnknownMemberType]
}
