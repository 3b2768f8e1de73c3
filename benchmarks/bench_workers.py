"""Does the memory of an evaluation worker stay flat? Resident memory over trials of protocol `physical` in one process.

Prints one JSON line: the memory after the first trials and after the last, and the slope between in kB a trial. Worlds
are prepared and code is loaded during the first quarter, which is left out of the slope. Trials are drawn from a tuning
seed, each under Reins.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from app.evaluation.jobs import Job
from app.evaluation.model import TUNING_SEEDS
from app.evaluation.physical_protocol import run
from app.governance.bundle import load

TRIALS = 1000
WARM_SHARE = 0.25
PAGE_KB = 4


def resident_kb() -> int:
    """Return this process's resident memory."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * PAGE_KB


def main(trials: int) -> None:
    """Run trials one by one and print what became of the memory."""
    policy = load(Path("policies"))
    seen: list[int] = []
    for number in range(trials):
        for _ in run(Job(f"bench_{number}", "reins", "", TUNING_SEEDS[0], number, 1), policy):
            pass
        seen.append(resident_kb())
    warm = seen[round(WARM_SHARE * trials) :]
    slope = float(np.polyfit(np.arange(len(warm)), np.array(warm), 1)[0])
    print(json.dumps({"trials": trials, "warm_mb": warm[0] / 1024, "last_mb": warm[-1] / 1024, "kb_per_trial": slope}))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS)
