"""Trials of a plugin's faults: single physical trials as any other, with what goes wrong drawn by the plugin.

A trial of the fault `NAME` belongs to the task `fault-NAME`. It is a request that policy allows, in a capability that
the fault can befall; truth is the ungoverned twin, judged by the violation that the fault says it provokes.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from app.evaluation.draws import FAR_SHARE, Drawing
from app.evaluation.extensions import find_fault, find_method
from app.evaluation.model import Kind
from app.evaluation.physical_rows import row
from app.evaluation.physical_trial import Bench, run, shares_twin, taken
from app.evaluation.truth import OVER
from app.sim.faults import Fault, Scenario
from app.sim.occasions import Trigger

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from app.evaluation.draws import Drawn
    from app.evaluation.extensions import ExtraFault
    from app.evaluation.jobs import Job
    from app.evaluation.model import Row

FAULT_COLUMNS: Final = {"fault": "which fault of a plugin was provoked"}


def draw_fault(bench: Bench, fault: ExtraFault, seed: int, number: int, turn: int = 0) -> Drawn:
    """Draw a trial of a plugin's fault; a plain function of the policy and the other arguments.

    The size is between 1.15 and 1.85 times the limit. Where the fault begins at a time, that counts from the launch.

    Raises:
        ValueError: what the plugin draws is no fault.
    """
    rng = np.random.default_rng((seed, number, turn, 17))
    drawing = Drawing(bench.policy, rng, seed, number)
    size = OVER + bench.under.fault_size * float(rng.uniform(*FAR_SHARE))
    asked = drawing.clean(drawing.pick(fault.capabilities))
    made = Fault.read(dict(fault.draw(rng, size)))
    if made.at.time_s is not None:  # the cell's clock has run on while the start was prepared
        began = bench.stage.set(asked.start, asked.world, Scenario()).truth().time_s
        made = replace(made, at=Trigger(time_s=began + made.at.time_s, after_s=made.at.after_s))
    return replace(asked, kind=Kind.PERTURBED, scenario=Scenario(faults=(made,)), violation=fault.violation, size=size)


def run_faults(bench: Bench, job: Job, names: Sequence[str]) -> Iterator[Row]:
    """Run the trials of a job of a fault under some methods; a row for each of them and method.

    Raises:
        UnknownName: there is no such method or fault.
        ValueError: what the plugin draws is no fault.
    """
    methods, fault = [find_method(name) for name in names], find_fault(job.task)
    whole = any(map(shares_twin, methods))
    for number in range(job.first, job.first + job.count):
        trial = taken(bench, partial(draw_fault, bench, fault, job.seed, number), whole=whole)
        ran = run(bench, trial, methods)
        for method in methods:
            yield {**row(bench.policy, trial, method, ran[method.name]), "task": job.task, "fault": fault.name}
