"""The `reins` command: thin words over the rooms. Exit codes: 0 fine, 1 a finding (a check failed), 2 misuse.

Every command imports what it needs when it runs, so that `reins --help` answers at once.
"""

from __future__ import annotations

import errno
import platform
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from app.importing import importing

with importing():
    import typer
    from pydantic import ValidationError
    from typer.core import TyperGroup

    from app import __version__, cli_audit, cli_evaluate, cli_policy, cli_sim, cli_token, cli_versions
    from app.cli_data import directory
    from app.config import DEFAULT_PROFILE, CellSettings, ConfigError, Settings, cell_token, check_pace
    from app.terminal import MISUSE, say_error


class Commands(TyperGroup):
    """The commands, which name the value that one of them cannot read: typer says only what would be valid."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401  # typer's own
        """Run a command as typer does."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            if isinstance(cause := error.__cause__, ValidationError):
                error.message = f"`{cause.errors()[0]['input']}`: {error.message}"
            raise


app = typer.Typer(
    name="reins",
    cls=Commands,
    help="Reins governs what an agent may do with a robot: it admits, constrains, asks, watches, recovers and records.",
    epilog="Exit codes: 0 fine, 1 a finding, 2 misuse. Start with `reins demo`, or `reins serve` and the printed link.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    rich_markup_mode="rich",
)
app.add_typer(cli_token.app, name="token")
app.add_typer(cli_policy.app, name="policy")
cli_versions.register(cli_policy.app)
app.add_typer(cli_audit.app, name="audit")
app.add_typer(cli_sim.app, name="sim")

Data = Annotated[Path, typer.Option(help="Data directory.", envvar="REINS_DATA", parser=directory)]
Policies = Annotated[
    Path | None,
    typer.Option(help="Policy directory; default: ./policies, else the shipped one.", envvar="REINS_POLICIES"),
]
Pace = Annotated[
    float,
    typer.Option(
        help="Simulated seconds per second while a session works; 0: as fast as possible.", envvar="REINS_PACE"
    ),
]
Seed = Annotated[int, typer.Option(help="Seed of the simulated world.", envvar="REINS_SEED")]
Scenario = Annotated[
    str | None,
    typer.Option(
        help="What happens in the simulated world: a name, or a YAML file (docs/scenarios.md).", envvar="REINS_SCENARIO"
    ),
]
Robot = Annotated[str | None, typer.Option(help="Another robot model: an MJCF path, or a menagerie name.")]


@app.command()
def serve(  # noqa: PLR0913  # its options
    *,
    host: Annotated[str, typer.Option(help="Address to listen on.", envvar="REINS_HOST")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one and prints it.", envvar="REINS_PORT")] = 8000,
    data: Data = Path("data"),
    policies: Policies = None,
    profile: Annotated[
        str, typer.Option(help="Environment profile; the default is the strictest.", envvar="REINS_PROFILE")
    ] = DEFAULT_PROFILE,
    cells: Annotated[int, typer.Option(help="Simulated cells to start as children.", envvar="REINS_CELLS")] = 1,
    pace: Pace = 1.0,
    seed: Seed = 0,
    scenario: Scenario = None,
    robot: Robot = None,
    take_policies: Annotated[
        bool, typer.Option("--take-policies", help="Put the directory in force, whatever an engineer had put there.")
    ] = False,
    prove: Annotated[
        bool, typer.Option(help="Prove what is in force behind the start, unless that was done.", envvar="REINS_PROVE")
    ] = True,
) -> None:
    """Start the server, with simulated cells of its own.

    [bold]reins serve[/]                                  one cell, profile human-shared, http://127.0.0.1:8000

    [bold]reins serve --profile sim-relaxed --pace 0[/]   as fast as the simulation goes

    [bold]reins serve --cells 0[/]                        no cell of its own; others join with `reins cell`

    The first start writes tokens.json into the data directory and prints where. Ctrl-C brings the robots to a
    controlled stop and leaves. A policy directory with an error does not start: each error is printed with its line.
    """
    with importing():
        from app.main import serve as serve_with

    settings = Settings(
        host=host,
        port=port,
        data=data,
        policies=policies,
        profile=profile,
        cells=cells,
        pace=pace,
        seed=seed,
        scenario=scenario,
        robot=robot,
        take_policies=take_policies,
        prove=prove,
    )
    raise typer.Exit(serve_with(settings))


@app.command()
def cell(  # noqa: PLR0913  # its options
    *,
    server: Annotated[
        str | None, typer.Option(help="The server's address, for instance http://127.0.0.1:8000.")
    ] = None,
    id: Annotated[str, typer.Option("--id", help="The cell's name; one process for each.")] = "workcell-2",
    data: Annotated[
        Path | None, typer.Option(help="What the cell keeps; default: cells/<id>.", parser=directory)
    ] = None,
    server_key: Annotated[
        str | None, typer.Option(help="The kernel's public key (base64); default: trust the first one seen, keep it.")
    ] = None,
    pace: Pace = 1.0,
    seed: Seed = 0,
    scenario: Scenario = None,
    robot: Robot = None,
    server_file: Annotated[Path | None, typer.Option(hidden=True)] = None,
    parent: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Join a simulated cell to a server, on this machine or another one.

    [bold]REINS_CELL_TOKEN=$(cat data/cell.token) reins cell --server http://127.0.0.1:8000 --id workcell-2[/]

    The cell dials in and goes on dialling; while the server is away it holds the robot where it is.
    """
    with importing():
        from app.workcell import run_cell

    settings = CellSettings(
        id=id,
        token=cell_token(),
        data=data or Path("cells") / id,
        server=server,
        server_file=server_file,
        server_key=server_key,
        pace=pace,
        seed=seed,
        scenario=scenario,
        robot=robot,
        parent=parent,
    )
    raise typer.Exit(run_cell(settings))


@app.command()
def demo(
    *,
    approver: Annotated[
        Literal["scripted", "console"], typer.Option(help="Who answers: nobody is needed, or a human in the console.")
    ] = "scripted",
    pace: Pace = 1.0,
    keep: Annotated[bool, typer.Option(help="Keep the server running afterwards.")] = False,
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.")] = 0,
    folder: Annotated[Path, typer.Option(help="Where the demo keeps its data directories.", parser=directory)] = Path(
        ".demo"
    ),
) -> None:
    """Run the paper's Algorithm 1 on a server of its own: fetch in a shared workspace, a person walks in.

    [bold]reins demo[/]                       needs nobody; exit 0 only if the record shows every step

    [bold]reins demo --approver console[/]    waits for a human to approve
    """
    from app.demo import demo as play

    check_pace(pace)
    raise typer.Exit(play(folder, scripted=approver == "scripted", keep=keep, pace=pace, port=port))


@app.command()
def approver(
    *,
    policy: Annotated[Path, typer.Option(help="Habits: who, how fast, approves what, at which error rate (YAML).")],
    server: Annotated[
        str | None,
        typer.Option(help="The server's address; default: as the data directory says.", envvar="REINS_SERVER"),
    ] = None,
    data: Data = Path("data"),
    token: Annotated[
        str | None,
        typer.Option(
            help="An operator's token; default: the data directory's.", envvar="REINS_TOKEN", show_default=False
        ),
    ] = None,
) -> None:
    """Answer escalations as a simulated person of given habits would; Ctrl-C ends. Never in front of a real robot.

    The token is taken from the data directory's tokens.json, under the key that the habits name as `approver`. One
    that was issued later stands in no file and is given: `approver` is then the name that it was issued for. A
    question whose answer the server does not take, say an edit that does not fit the capability, is left and named.

    The habits are a YAML file. All keys may be left out; without a rule that matches the answer is deny.

      approver: operator              # who answers, a key of tokens.json
      reads_s: {min: 0.5, max: 1.5}   # how long it reads before it answers, in s
      error_rate: 0.0                 # share of answers that come out wrong
      seed: 7                         # of both draws
      rules:                          # the first that matches decides
        - match: {capability: grasp_object, risk: medium}
          decision: approve           # or deny, or ignore: somebody else answers
          edit: {force_n: 40}         # approve with this instead, or not at all
        - match: {kind: session}      # a session that asks; it takes no edit
          decision: approve

    What `match` can name: capability, risk (low, medium, high, critical), kind (approval, session), agent;
    each with one value or a list of them. A rule that names nothing matches everything.
    """
    from app.demo import approve

    raise typer.Exit(approve(policy, server, data, token))


app.command()(cli_evaluate.evaluate)


def _version(asked: bool) -> None:
    if asked:
        version()
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None: ...


@app.command()
def version() -> None:
    """Print the version."""
    typer.echo(f"reins {__version__} (Python {platform.python_version()}, {platform.system()} {platform.machine()})")


def main() -> None:
    """Run the command line; a setting or a path that cannot be used, and a full output, are said in one line."""
    try:
        app()
    except ConfigError as error:
        say_error(str(error))
        sys.exit(MISUSE)
    except OSError as error:
        if error.errno not in {errno.ENOSPC, errno.EDQUOT, errno.ENAMETOOLONG, errno.EACCES}:
            raise
        say_error(str(error))
        sys.exit(MISUSE)


if __name__ == "__main__":
    main()
