"""What sensors prove of a session: nothing by an old look, and of a rollback only what is as it was."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from app.governance.model import ObjectFact, Params, WorldFacts


def seen_since(facts: WorldFacts, stamp_s: float) -> WorldFacts:
    """Leave out what was seen before a moment of cell time: an old look proves nothing about a new session."""
    return replace(
        facts,
        objects={name: seen for name, seen in facts.objects.items() if seen.stamp_s >= stamp_s},
        inspected={area: seen_s for area, seen_s in facts.inspected.items() if seen_s >= stamp_s},
    )


def not_restored(began: WorldFacts, ended: WorldFacts, params: Params) -> tuple[str, ...]:
    """Name what a rollback did not bring back, judged by sensors; empty when it is verified.

    Compared are the pose of the base, what the gripper holds, the object that was handled (where it is, how high, and
    whether it stands or lies as it did), and what the tool that was worked says of itself. What cannot be seen is not
    verified.
    """
    x, y, yaw = ended.base
    x0, y0, yaw0 = began.base
    missing: list[str] = []
    if not (math.hypot(x - x0, y - y0) <= 0.15 and abs(math.remainder(yaw - yaw0, math.tau)) <= 0.15):
        missing.append("base_pose")
    if ended.holding != began.holding:
        missing.append("holding")
    handled = params.get("object_id")
    if isinstance(handled, str) and began.holding is None and (was := began.objects.get(handled)) is not None:
        now = ended.objects.get(handled)
        if now is None or not now.visible or not _as_it_was(was, now):
            missing.append("object_pose")
    worked = params.get("tool")
    if isinstance(worked, str) and ended.tools.get(worked) != began.tools.get(worked):
        missing.append("tool_state")
    return tuple(missing)


def _as_it_was(was: ObjectFact, now: ObjectFact) -> bool:
    beside_m = math.hypot(now.x_m - was.x_m, now.y_m - was.y_m)
    return beside_m <= 0.1 and abs(now.z_m - was.z_m) <= 0.05 and now.upright == was.upright
