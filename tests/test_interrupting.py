"""Several processes at one thing: what is given up ends at once, and Ctrl-C is for whoever waits for them."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import active_children, get_context

import pytest

from app.interrupting import in_turn

LONG_S = 300.0  # longer than any test may take


def give_up_after_the_first() -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for _ in in_turn(pool, time.sleep, [(0.0,), *[(LONG_S,)] * 4]):
            raise KeyboardInterrupt


@pytest.mark.process
def test_what_is_given_up_is_not_waited_for() -> None:
    before = set(active_children())
    with pytest.raises(KeyboardInterrupt):
        give_up_after_the_first()
    assert set(active_children()) == before


@pytest.mark.process
def test_an_interrupt_of_all_leaves_the_processes_at_their_work() -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        done = in_turn(pool, time.sleep, [(0.0,), *[(0.5,)] * 3])
        next(done)
        for process in active_children():
            assert process.pid is not None
            os.kill(process.pid, signal.SIGINT)
        assert list(done) == [None] * 3
