"""What the commands make of a directory that data is kept in."""

from __future__ import annotations

from pathlib import Path

import typer


def directory(text: str) -> Path:
    """Read a data directory's path; whether there is one is for each command to say.

    No path at all is refused: `Path("")` is the working directory, where `--data "$UNSET"` would put keys and tokens.

    Raises:
        typer.BadParameter: no path, one that cannot be written as UTF-8, or that of a file.
    """
    if not str(text):
        raise typer.BadParameter("it is empty, maybe a variable that is not set; valid: a directory, `.` for this one")
    path = Path(text)
    try:
        str(path).encode()
    except UnicodeEncodeError as error:  # the record's database is opened by an address, which is UTF-8
        raise typer.BadParameter(f"`{str(path)!a}` is no text in UTF-8; valid: a name that is") from error
    if path.is_file():
        raise typer.BadParameter(f"`{path}` is a file; valid: a directory")
    return path
