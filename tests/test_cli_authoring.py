"""`reins policy schemas` and `new`, as the command line runs them."""

from __future__ import annotations

from pathlib import Path

import orjson
from typer.testing import CliRunner

from app.cli import app
from app.governance.bundle_schema import KINDS, SUFFIX, schema


def test_schemas_are_written_where_the_files_look_for_them(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["policy", "schemas", str(tmp_path / "schemas")])
    assert done.exit_code == 0, done.output
    written = {path.name: orjson.loads(path.read_bytes()) for path in (tmp_path / "schemas").iterdir()}
    assert written == {f"{kind}{SUFFIX}": schema(kind) for kind in KINDS}


def test_schemas_that_cannot_be_written_are_misuse(tmp_path: Path) -> None:
    (tmp_path / "schemas").write_text("in the way")
    assert CliRunner().invoke(app, ["policy", "schemas", str(tmp_path / "schemas")]).exit_code == 2
