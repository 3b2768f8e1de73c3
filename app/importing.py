"""Importing without the collector and without threads that nobody needs, for what starts often and imports much."""

from __future__ import annotations

import gc
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Generator


@contextmanager
def importing() -> Generator[None]:
    """Import without the collector: modules stay, and looking for garbage among them takes a sixth of a start.

    Numpy's and SciPy's linear algebra has a thread for each core, which spins as it is loaded: a third of a cell's
    start. Matrices are small here and need one, also in what is started from here; whoever says otherwise is heard.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()
