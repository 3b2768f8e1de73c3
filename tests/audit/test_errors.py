from __future__ import annotations

import json

import pytest

from app.audit.errors import RowUnreadable


@pytest.mark.parametrize(
    ("cause", "problem"),
    [
        (json.JSONDecodeError("no end", "{", 1), "its content is no JSON"),
        (KeyError("secret"), "its content is not what a server writes"),
    ],
)
def test_a_row_that_cannot_be_read_is_named_and_its_content_kept_back(cause: Exception, problem: str) -> None:
    error = RowUnreadable("grants", "grant_1", cause)
    assert (error.table, error.key, error.problem) == ("grants", "grant_1", problem)
    assert str(error) == f"the row `grant_1` of the table `grants` cannot be read: {problem}"
