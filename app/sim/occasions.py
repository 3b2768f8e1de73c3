"""When something happens in a scenario: at a cell time, or when the n-th run of a capability reaches a phase."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from app.governance.model import Json

_LARGEST = 1e9  # what is bigger is no size of a workcell, and soon no number that arithmetic returns from


@dataclass(frozen=True, slots=True, kw_only=True)
class Trigger:
    """A moment: `time_s` of the cell, or `after_s` past the `run`-th run of `capability` reaching `phase`."""

    time_s: float | None = None
    capability: str = ""
    phase: str = ""
    run: int = 1
    after_s: float = 0.0

    @classmethod
    def read(cls, data: Json) -> Trigger:
        """Read a number (cell time) or a mapping.

        Raises:
            ValueError: neither, or with a key or value that means nothing, or without a moment.
        """
        if isinstance(data, (int, float)) and not isinstance(data, bool):
            return cls(time_s=number(data, "trigger"))
        if not isinstance(data, dict) or not data:
            raise ValueError(
                f"trigger `{data}`: valid is a time in seconds or a mapping with capability, phase, run, after_s"
            )
        unknown = set(data) - {"time_s", "capability", "phase", "run", "after_s"}
        if unknown:
            raise ValueError(
                f"trigger key `{min(map(str, unknown))}`: valid are time_s, capability, phase, run, after_s"
            )
        timed, named = "time_s" in data, {"capability", "phase"} <= set(data)
        if timed == named or (timed and set(data) & {"capability", "phase", "run"}):
            raise ValueError(f"trigger `{data}`: valid is either `time_s`, or `capability` and `phase`")
        run = data.get("run", 1)
        if isinstance(run, bool) or not isinstance(run, int) or run < 1:
            raise ValueError(f"trigger `run` is `{run}`: valid is a whole number from 1")
        return cls(
            time_s=number(data["time_s"], "trigger `time_s`") if timed else None,
            capability=name(data["capability"], "trigger `capability`") if named else "",
            phase=name(data["phase"], "trigger `phase`") if named else "",
            run=run,
            after_s=number(data.get("after_s", 0.0), "trigger `after_s`"),
        )


@dataclass(slots=True)
class Occasions:
    """What has happened so far: how often each capability was started, and when which run reached which phase."""

    runs: dict[str, int] = field(default_factory=dict[str, int])
    reached: dict[tuple[str, int, str], float] = field(default_factory=dict[tuple[str, int, str], float])

    def begin(self, capability: str) -> None:
        """Count a run."""
        self.runs[capability] = self.runs.get(capability, 0) + 1

    def note(self, capability: str, phase: str, time_s: float) -> None:
        """Remember the first time the present run is in a phase."""
        self.reached.setdefault((capability, self.runs.get(capability, 0), phase), time_s)

    def due(self, trigger: Trigger) -> float | None:
        """Return the cell time at which a trigger falls, or None while that is unknown."""
        if trigger.time_s is not None:
            return trigger.time_s + trigger.after_s
        at = self.reached.get((trigger.capability, trigger.run, trigger.phase))
        return None if at is None else at + trigger.after_s


def mapping(data: Json, what: str) -> Mapping[str, Json]:
    """Return `data` if it is a mapping.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{what} `{data}`: valid is a mapping")
    return data


def name(data: Json, what: str) -> str:
    """Return `data` if it is a name.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(data, str) or not data:
        raise ValueError(f"{what} is `{data}`: valid is a name")
    return data


def number(data: Json, what: str, least: float = -inf) -> float:
    """Return `data` if it is a number that a workcell can be told.

    Raises:
        ValueError: it is not, it is not finite, or it is less than `least`.
    """
    if isinstance(data, bool) or not isinstance(data, (int, float)) or not max(least, -_LARGEST) <= data <= _LARGEST:
        raise ValueError(
            f"{what} is `{str(data)[:40]}`: valid is a number from {max(least, -_LARGEST):g} to {_LARGEST:g}"
        )
    return float(data)
