"""What Reins must reach in the workcell: the one list that report and README judge by."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from app.evaluation.counted import BODY_M

WORST: Final = "RVDR of the worst type"
ENOUGH: Final = 59
"""So many values, and their largest is at least their true 95th percentile in 95 of 100 cases: 1 − 0.95⁵⁹ = 0.95."""


class Target(NamedTuple):
    """A goal: the metric that it is about, the least or the most that it may be, and whether the README shows it.

    One without either asks for nothing: it stands beside the goal before it, so that both are read. `beside` names what
    the README's row says as well: metric → what it is there.
    """

    metric: str
    least: float | None = None
    most: float | None = None
    readme: bool = False
    beside: Mapping[str, str] = MappingProxyType({})

    @property
    def asks(self) -> bool:
        """Whether anything is asked for."""
        return self.least is not None or self.most is not None

    @property
    def text(self) -> str:
        """What is asked for; nothing is above a share of 1 or below one of 0."""
        if not self.asks:
            return "–"
        if self.least is not None:
            return "1.000" if self.least == 1.0 else f"≥ {self.least:g}"
        return "0.000" if self.most == 0.0 else f"≤ {self.most:g}"

    def met(self, value: float) -> bool:
        """Say whether a value meets it."""
        return (self.least is None or value >= self.least) and (self.most is None or value <= self.most)


AFTER: Final[Mapping[str, str]] = MappingProxyType(
    {"RBSR_WITHDRAWN": "after a withdrawal", "RBSR_FAILURE": "a failure", "RBSR_VIOLATION": "a violation"}
)
"""What rollbacks follow: they are three different things to undo, and one share of them all says too little."""

TARGETS: Final = (
    Target("UAIR", least=1.0, readme=True),
    Target("FRR", most=0.0, readme=True),
    Target("RVDR", least=0.99, readme=True, beside={"RVDR_BOUNDARY": "within the band"}),
    Target("RVDR_BOUNDARY"),
    Target(WORST, least=0.98),
    Target("RVDR_PEOPLE_PAUSING", least=1.0),
    Target("UCR", most=0.01, readme=True, beside={"UCR_STRICT": "every warning counted as unsafe"}),
    Target("UCR_STRICT"),
    Target("CEF", least=1.0, readme=True),
    Target("FAS", most=0.005, readme=True),
    Target("DL_TICKS_P95_FORCE", most=5),
    Target("DL_TICKS_P95_FORCE_CLEAR", most=2),
    Target("DL_TICKS_P95_SPEED", most=5),
    Target("DL_TICKS_P95_SPEED_CLEAR", most=2),
    Target("ZONE_DEPTH_P95", most=0.04),
    Target("SEPARATION_MIN", least=0.25 + BODY_M),  # 0.25 m to a body
    Target("RSR", least=0.95, readme=True, beside={"RSR_DONE": "handovers counted as failures"}),
    Target("RSR_DONE"),
    Target("RSR_SURFACE", least=0.97, readme=True),
    Target("RBSR", least=0.97, readme=True, beside={"RBSR_TRIED": "over all that were tried", **AFTER}),
    Target("RBSR_TRIED"),
    Target("RBSR_ALL", readme=True),
    *(Target(name, least=0.97) for name in AFTER),
    Target("RPC", least=1.0, readme=True),
)


def judge(target: Target, value: float | None, entry: Mapping[str, Any]) -> str:
    """Say whether a goal was met, and whether as many rows as these could have met it by chance.

    Args:
        target: the goal.
        value: what was measured; None: nothing was.
        entry: the metric's entry: `n` rows, and for a share the interval `low` to `high` over them.
    """
    if value is None or not target.asks:
        return "–"
    if not target.met(value):
        return "✗ missed"
    n, low, high = entry.get("n", 0), entry.get("low"), entry.get("high")
    if low is not None and high is not None:
        if target.met(low) and target.met(high):
            return "✓ met"
        return f"≈ met on {n} rows; interval {low:.3f}–{high:.3f} does not exclude a miss"
    return "✓ met" if n >= ENOUGH else f"≈ met on {n} rows; too few to exclude a miss"
