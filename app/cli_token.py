"""The `reins token` commands: who may come in by which token. A server that runs takes a change within 2 s."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli_data import directory
from app.config import ConfigError
from app.governance.model import Role
from app.terminal import MISUSE, say, say_error

if TYPE_CHECKING:
    from collections.abc import Generator

LEAST_HOURS = 0.01
MOST_HOURS = 876_000  # a hundred years: the record writes no year beyond 9999

app = typer.Typer(help="Bearer tokens: issue, list, withdraw.", no_args_is_help=True)
Data = Annotated[Path, typer.Option(help="Data directory.", envvar="REINS_DATA", parser=directory)]


@app.command("issue")
def issue(
    name: Annotated[str, typer.Argument(help="What the record calls the bearer; for an agent the name policy knows.")],
    *,
    role: Annotated[Role, typer.Option(help="What the bearer may do.")],
    hours: Annotated[
        float | None, typer.Option(help="How long it holds, up to a hundred years; default: for good.")
    ] = None,
    station: Annotated[
        str | None, typer.Option(help="An operator's: the cell they stand at, and take over first; a cell's: its name.")
    ] = None,
    data: Data = Path("data"),
) -> None:
    """Issue a token and print it; it is not kept anywhere, only its digest. A server that runs takes it within 2 s.

    [bold]reins token issue planner --role agent --hours 8[/]
    """
    from app.api.auth import issue_token

    if hours is not None and not LEAST_HOURS <= hours <= MOST_HOURS:  # nor is it so of NaN
        raise ConfigError(
            "hours", f"{hours:g}", f"{LEAST_HOURS} to {MOST_HOURS}, or none: the token then holds for good"
        )
    with _told("no token issued", data):
        text = issue_token(data, name=name, role=role, ttl_s=None if hours is None else hours * 3600, station=station)
    typer.echo(text)


@app.command("list")
def list_tokens(*, data: Data = Path("data")) -> None:
    """List whose tokens hold, and until when; the tokens themselves are nowhere.

    [bold]reins token list[/]
    """
    from app.api.auth import issued
    from app.clock import rfc3339, wall_s

    with _told("no tokens listed", data):
        known = issued(data)
    width = max((len(one.principal.name) for one in known), default=0)
    for one in known:
        until = "for good" if one.expires_at_s is None else f"until {rfc3339(one.expires_at_s)}"
        over = ", which is over" if one.expired(wall_s()) else ""
        station, role = one.principal.station, one.principal.role
        where = "dials in as" if role is Role.CELL else "stands at"
        say(
            f"{one.principal.name:<{width}}  {role.value:<8}  {until}{over}"
            + (f", {where} {station}" if station else "")
        )


@app.command("withdraw")
def withdraw(
    name: Annotated[str, typer.Argument(help="Whose tokens: the name they were issued for.")],
    *,
    but_newest: Annotated[
        bool, typer.Option("--but-newest", help="All but the one issued last, which takes their place.")
    ] = False,
    data: Data = Path("data"),
) -> None:
    """Withdraw every token of a name. A server that runs lets its bearer do nothing more within 2 s.

    [bold]reins token withdraw planner[/]

    [bold]reins token withdraw planner --but-newest[/]    after `reins token issue planner …`, and handing that on
    """
    from app.api.auth import withdraw_tokens

    with _told("nothing withdrawn", data):
        count = withdraw_tokens(data, name, but_newest=but_newest)
    say(f"withdrew {count} token{'' if count == 1 else 's'} of `{name}`")


@contextmanager
def _told(what: str, data: Path) -> Generator[None]:
    """Say in one line why something could not be done with a data directory, and end with the code for misuse."""
    from app.api.auth import PrincipalsUnreadable
    from app.audit.errors import RecordDamaged, RecordUnreadable

    try:
        yield
    except (OSError, ValueError, PrincipalsUnreadable, RecordDamaged, RecordUnreadable) as error:
        missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        hint = f"`{data}` must be a data directory that `reins serve` has made" if missing else ""
        say_error(f"{what}: {error}", hint=hint)
        raise typer.Exit(MISUSE) from error
