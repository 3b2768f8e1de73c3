"""A plugin for `reins evaluate`: one method, one task and one fault of its own.

reins evaluate --methods reins,watch-only --tasks tool_and_back --plugin docs/examples/evaluation_plugin.py

In the workcell, the task step by step and trials of the fault:

reins evaluate --protocol physical --methods direct,reins,watch-only --tasks tool_and_back,fault-worn_drives \
    --plugin docs/examples/evaluation_plugin.py --out try
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from app.evaluation.extensions import ExtraFault, Registry
from app.evaluation.methods import Method, Recovering, Watching
from app.evaluation.model import Task, Violation

if TYPE_CHECKING:
    import numpy as np

    from app.governance.model import Json


def register(registry: Registry) -> None:
    """Add what this file has; called once in every process of a campaign."""
    registry.add_method(WATCH_ONLY)
    registry.add_task(TOOL_AND_BACK)
    registry.add_fault(WORN_DRIVES)


# A method is data: which parts of governance there are. This one lets everything start, and watches it.
WATCH_ONLY = Method(
    name="watch-only", title="Watch only", tier=3, watch=Watching.GOVERNED, recovery=Recovering.GOVERNED
)

# A task is the capabilities it consists of, and the parameters it fixes; everything else is drawn.
TOOL_AND_BACK = Task(
    "tool_and_back",
    "composite",
    ("operate_tool", "navigate_to"),
    {"navigate_to": {"target": "dock"}},
)


def _too_fast(rng: np.random.Generator, size: float) -> Mapping[str, Json]:
    """Draw a fault as plain data, the way `app.sim.faults.Fault.read` takes it; it may depend on `rng` alone.

    `size` is in units of the limit, 1.15 to 1.85; a time in `at` counts from the launch, in seconds.
    """
    return {"kind": "speed_scaling", "at": float(rng.uniform(0.5, 2.0)), "gain": size}


# A fault says which violation it provokes, so that truth is judged by that one's measure, and what it can befall.
# Its trials are asked for as `--tasks fault-worn_drives`.
WORN_DRIVES = ExtraFault("worn_drives", Violation.SPEED, _too_fast, ("navigate_to", "transport_object"))
