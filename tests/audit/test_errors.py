from __future__ import annotations

import json
from pathlib import Path

import pytest

from app.audit.errors import RecordUnreadable, RowUnreadable


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


def test_a_file_that_cannot_be_read_now_is_named_without_where_it_lies() -> None:
    error = RecordUnreadable(Path("/srv/secret/reins.db"), "unable to open database file")
    assert str(error) == "the record cannot be read now: `reins.db`: unable to open database file"
