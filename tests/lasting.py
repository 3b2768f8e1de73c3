"""Cells that are a test's own hand: what they said last counts however long nobody ran."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.runtime import cells, fleet

if TYPE_CHECKING:
    import pytest

LASTING_S = 30.0


def let_states_last(patch: pytest.MonkeyPatch) -> None:
    """Let a state count for longer than a test takes.

    A hand speaks when its test says so, in the process of the server that hears it: how long a busy machine takes
    between is no silence of the cell's.
    """
    for module in (cells, fleet):
        patch.setattr(module, "FRESH_S", LASTING_S)
