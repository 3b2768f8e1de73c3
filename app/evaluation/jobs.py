"""The unit of work that a campaign hands to a worker process."""

from __future__ import annotations

from typing import NamedTuple


class Job(NamedTuple):
    """A stretch of trials of one method, one task and one seed; a plain function of these fields.

    Attributes:
        name: Unique within a campaign, and a file name: letters, digits, `-`, `_`, `.`.
        method: Name of a method or an ablation; a protocol may use other names for conditions of its own.
        task: Name of a task type; empty where a trial is one capability alone.
        seed: Seed of the run.
        first: Number of the first trial.
        count: How many trials.
        under: Circumstances other than the protocol's own, in its words.
    """

    name: str
    method: str
    task: str
    seed: int
    first: int
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]  # nobody counts the fields of a job
    under: str = ""
