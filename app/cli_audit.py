"""`reins audit`: what an auditor does with a data directory, whether or not a server runs on it. Reads only."""

from __future__ import annotations

import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import orjson
import typer

from app.audit.checkpoint import NoteInvalid, parse_verifier
from app.audit.errors import EventUnreadable, RecordDamaged, RecordUnreadable
from app.audit.searching import Words
from app.cli_data import directory
from app.terminal import FINDING, INTERRUPTED, MISUSE, out, say, say_error

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from app.audit.checkpoint import Verifier
    from app.audit.event import Event

app = typer.Typer(
    help="Verify, show, export and follow the record of a data directory; works beside a running server.",
    no_args_is_help=True,
)

Data = Annotated[Path, typer.Option(help="The server's data directory.", envvar="REINS_DATA", parser=directory)]


def _words(text: str) -> Words:
    words = Words(text)
    if not words.words:
        raise typer.BadParameter("it is empty: valid are words that an event holds, for instance `mug_1 separation`")
    return words


Text = Annotated[
    Words | None,
    typer.Option(
        metavar="WORDS",
        parser=_words,
        help="Only events that hold all of these words, in whatever case: actor, kind, and what stands in the body.",
    ),
]
Newest = Annotated[bool, typer.Option("--newest", help="The newest first.")]
FOLLOW_S = 0.5
PAGE = 500
INTERRUPTION = "interrupted"


@app.command()
def verify(
    data: Data = Path("data"),
    key: Annotated[Path | None, typer.Option(help="The log's public key as kept elsewhere; default: log.pub.")] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(help="A checkpoint kept elsewhere, or a copy of checkpoints.log: is it of this very log?"),
    ] = None,
) -> None:
    """Recompute the whole log from the stored bytes; compare indexes, state and telemetry files with it.

    [bold]reins audit verify --data data --key log.pub.copy --checkpoint log.jsonl.checkpoint[/]

    Who has the server's disk has its key, and can write another history and sign it. What was kept elsewhere tells.
    """
    from app.audit.examination import examine_file

    with _said(data, interrupted="interrupted: not all was compared, so nothing is said of this record"):
        verifier = None if key is None else _verifier(key)
        with out.status("verifying …"):
            found = examine_file(data, verifier, checkpoint)
    log = found.log
    if not log.ok:
        say_error(f"event {log.first_bad}: {log.problem}", hint=_good(log.size))
        raise typer.Exit(FINDING)
    for problem in found.database or ():
        say_error(problem, hint="queries by an index may leave events out; the events themselves are good")
    for problem in found.state:
        say_error(problem, hint="what is listed of it is not what was recorded; its trace is")
    for problem in found.telemetry:
        say_error(problem)
    say(f"{log.size} events, root {log.root}: every byte of theirs is as it was signed")
    if checkpoint is not None:
        say(f"what was kept in {checkpoint} vouches for this very log")
    say(
        "not compared: what else is kept beside them, which nobody signs (settings but for stops, used permits, uses "
        "of grants, idempotency keys; of versions of policy their status and why they were brought; of invocations "
        "their failures and takeovers; reports that the log holds and a row does not count; when a row last changed, "
        "`updated_at`)"
    )
    if not found.ok:
        raise typer.Exit(FINDING)


def _verifier(key: Path) -> Verifier:
    """Read a public key. Raises `OSError`, `ValueError` naming a file that holds none."""
    try:
        return parse_verifier(key.read_text(encoding="utf-8"))
    except (NoteInvalid, UnicodeDecodeError) as error:
        raise ValueError(f"`{key}` is no public key of a log: {error}; valid is what `log.pub` holds") from error


def _good(size: int) -> str:
    """Say what may be relied on: whole batches, each under its signed checkpoint; the bad event's own is not."""
    return f"events 1 to {size} are good, up to the last checkpoint before it" if size else "nothing before it is good"


@app.command()
def show(
    invocation: Annotated[str, typer.Argument(help="An invocation, for instance inv_01M7…")],
    data: Data = Path("data"),
    text: Text = None,
    *,
    newest: Newest = False,
) -> None:
    """Print everything recorded under one invocation, in order.

    [bold]reins audit show inv_01M7… --text separation[/]   what it says of one rule
    """
    from app.audit import archive

    with _said(data):
        events = archive.show(data, invocation, text)
    if not events:
        say_error(f"nothing is recorded under `{invocation}`{_holding(text)}")
        raise typer.Exit(FINDING)
    if not _print(events[::-1] if newest else events):
        raise typer.Exit(FINDING)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(help="Where to write; the checkpoint is written beside it.")],
    data: Data = Path("data"),
    format: Annotated[Literal["jsonl"], typer.Option("--format", help="One event a line, exact bytes.")] = "jsonl",
) -> None:
    """Write the log as a file that can be checked without this program."""
    from app.audit import archive

    with _said(data, interrupted="interrupted: nothing was exported"), out.status("exporting …"):
        written = archive.export(data, file, format)
    say(f"{written.count} events in {written.events} (sha256 {written.sha256}), signed by {written.checkpoint}")


@app.command()
def tail(
    data: Data = Path("data"),
    limit: Annotated[int, typer.Option("--limit", "-n", help="How many.", min=1, max=PAGE)] = 20,
    text: Text = None,
    *,
    newest: Newest = False,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on as events come; Ctrl-C ends.")] = False,
) -> None:
    """Print the newest events; with words, the newest that hold them, however far back those stand.

    [bold]reins audit tail --text "mug_1 denied" -n 1[/]   when it was denied last

    [bold]reins audit tail --text separation --follow[/]   what goes on about one rule
    """
    from app.audit import archive

    if newest and follow:
        raise typer.BadParameter("what follows is always newer: valid is one of `--newest` and `--follow`")
    with _said(data, interrupted="" if follow else INTERRUPTION):
        with out.status("searching …" if text else "reading …"):
            events, end = archive.tail(data, limit=limit, words=text)
        good = _print(events[::-1] if newest else events)
        while follow:
            time.sleep(FOLLOW_S)
            events, end = archive.tail(data, limit=PAGE, after=end, words=text)
            good &= _print(events)
    if text and not events:
        say_error(f"nothing is recorded{_holding(text)}")
    if not good or (text and not events):
        raise typer.Exit(FINDING)


def _holding(words: Words | None) -> str:
    return "" if words is None else f" that holds {' and '.join(f'`{word}`' for word in words.words)}"


def _print(events: Iterable[Event]) -> bool:
    """Print events, and of one that cannot be read, that it is there; say whether all could be."""
    good = True
    for event in events:
        try:
            body = orjson.dumps(event.payload()).decode()
        except EventUnreadable as error:
            good = False
            say_error(str(error), hint="look with `reins audit verify`, which says up to where the log is good")
            continue
        say(f"{event.seq:>6}  {event.at}  {event.kind:<16} {event.invocation or '-':<30} {event.actor:<12} {body}")
    return good


@contextmanager
def _said(data: Path, *, interrupted: str = INTERRUPTION) -> Generator[None]:
    """Say what is wrong in a line: a damaged record is a finding, a directory without one is misuse.

    A record that cannot be read now is no finding either. What Ctrl-C ends before its time says so; with nothing to say
    of that, it is how the command is meant to end.
    """
    try:
        yield
    except KeyboardInterrupt:
        if not interrupted:
            raise typer.Exit from None
        say_error(interrupted)
        raise typer.Exit(INTERRUPTED) from None
    except RecordDamaged as error:
        say_error(str(error), hint="" if data.is_dir() else "name the data directory of a server with --data")
        raise typer.Exit(FINDING if (data / "reins.db").exists() else MISUSE) from error
    except (OSError, ValueError, NoteInvalid, RecordUnreadable) as error:
        say_error(str(error))
        raise typer.Exit(MISUSE) from error
