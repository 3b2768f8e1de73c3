"""A long log replayed by several processes, each on its own stretch and with its own copy of the policy."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TYPE_CHECKING, Final

from app.audit.replay import Replay, replay, stretches, then_in_force
from app.governance.bundle import load_files
from app.interrupting import in_turn

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from app.audit.replay import Policies
    from app.governance.policy import PolicySet

ALONE: Final = 200_000  # events that one process reads in about the time another needs to start


def replay_in_processes(
    data_dir: Path, files: Mapping[str, str] | None, *, since: float | None = None, processes: int | None = None
) -> Replay:
    """Make recorded decisions again.

    Args:
        data_dir: the directory of a server.
        files: the policy that decides now; None is the version that decided then.
        since: wall time in seconds from which on; None is the beginning.
        processes: how many at most; one for each processor by default.

    Raises:
        RecordDamaged: there is no log, or it cannot be read.
        PolicyErrors: the files are no policy.
    """
    if files is not None:
        load_files(files)  # what is wrong with them is said once, and here
    parts = stretches(data_dir, since=since, count=processes or os.cpu_count() or 1)
    if len(parts) < 2 or parts[-1][1] - parts[0][0] <= ALONE:
        return _replay(data_dir, files, parts)
    whole = Replay()
    with ProcessPoolExecutor(len(parts), mp_context=get_context("spawn")) as pool:
        for replayed in in_turn(pool, _replay, ((data_dir, files, [part]) for part in parts)):
            whole.add(replayed)
    return whole


def _replay(data_dir: Path, files: Mapping[str, str] | None, parts: list[tuple[int, int]]) -> Replay:
    policies = then_in_force(data_dir) if files is None else _always(load_files(files))
    whole = Replay()
    for after, until in parts:
        whole.add(replay(data_dir, policies, after=after, until=until))
    return whole


def _always(policy: PolicySet) -> Policies:
    return lambda _: policy
