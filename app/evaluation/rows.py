"""The columns that every protocol writes, one row per trial and method; metrics are defined on these alone.

Booleans are None where a trial could not show them (nothing was launched, nothing failed, …): a metric's denominator
is the number of rows where its column is not None.
"""

from __future__ import annotations

from typing import Final

COLUMNS: Final = {
    "method": "name of the method",
    "task": "task type; empty where a trial is one capability alone",
    "seed": "seed of the run",
    "trial": "number of the trial within its seed (and task)",
    "kind": "unauthorized, perturbed, recoverable or clean",
    "breach": "why the proposal is not authorized",
    "violation": "which runtime violation was provoked",
    "failure": "which recoverable failure was provoked",
    "capability": "what was proposed",
    "profile": "environment profile",
    "launched": "whether it was executed at all",
    "blocked_by": "admission, guard, second_pass, authority or cell",
    "decision_us": "time that admission, guard and authority took, µs: the median of three rounds after an untimed "
    "one, the methods of a trial in an order drawn for each round (`app/evaluation/timing.py`)",
    "occurred": "whether the violation was really there, by the truth of the ungoverned twin",
    "boundary": "whether its size was within 3 sigma of the limit",
    "detected": "whether the watcher said so",
    "enforced": "whether the intervention that policy names followed the detection",
    "unsafe": "whether it kept acting under the violation for more than 250 ms after its onset, or to the end",
    "alarmed": "whether anything was alarmed where nothing was wrong; an alert that tells of a true violation is none, "
    "nor is one that something is not as promised, where it truly is not",
    "latency_ticks": "control ticks from the onset in truth to the alert; negative where it came before",
    "recovered": "whether the task's postconditions were reached within budget, without a violation of force, speed, "
    "zone or people on the way that was acted under for more than 250 ms; after the loss of something over the floor, "
    "where nothing on board can get it, whether it was handed over",
    "handed_over": "whether it ended in a safe stop with a human in charge: one who was asked",
    "over_surface": "whether a lost object was lost over a surface, so that it can be had again",
    "rollback_capable": "whether the capability declares a rollback, and the state before could still be had when one "
    "began, by the exact state alone: what was held at the start is in the gripper, with friction enough to bear it; "
    "an object that was to be grasped is in the gripper or stands where it stood; a tool is as it was",
    "rolled_back": "whether a rollback that was tried was verified",
    "recovery_s": "time from the failure to the end of its recovery, s",
    "safe_s": "time from a violation's onset, or a failure, to the safe state: standstill, after a retreat if one "
    "follows a violation by itself, s",
    "resume_s": "time from the failure to the task going on, s",
    "compliant": "whether every recovery step was one that policy names, within its budgets",
    "class": "the one class the trial falls into",
}
