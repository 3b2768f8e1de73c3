"""`reins sim`: the simulated workcell without a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from app.cli_policies import load_policy
from app.config import find_policies
from app.terminal import FINDING, err, say

NOMINAL = 0.99
MOST_WORLDS, MOST_JOBS = 1_000_000, 1024

app = typer.Typer(help="The simulated workcell without a server.", no_args_is_help=True)


@app.callback()
def group() -> None:
    """The simulated workcell without a server."""


@app.command()
def soak(
    seeds: Annotated[int, typer.Option(help="How many worlds.", min=1, max=MOST_WORLDS)] = 20,
    jobs: Annotated[int, typer.Option(help="How many processes.", min=1, max=MOST_JOBS)] = 1,
    first: Annotated[int, typer.Option(help="The first seed.", min=0)] = 0,
    policies: Annotated[Path | None, typer.Option(help="Policy directory, for its site.")] = None,
) -> None:
    """Run every skill through seeded worlds and report its success; exit 1 where one stays under 99 %.

    [bold]reins sim soak --seeds 200 --jobs 2[/]
    """
    from app.sim.soak import soak as run_soak

    site = load_policy(find_policies(policies)).site
    with Progress(console=err, transient=True) as bars:
        bar = bars.add_task("worlds", total=seeds)
        report = run_soak(
            site, seeds=seeds, jobs=jobs, first=first, progress=lambda done, _total: bars.update(bar, completed=done)
        )
    for line in report.lines():
        say(line)
    if report.worst < NOMINAL:
        raise typer.Exit(FINDING)


@app.command()
def fuzz(
    seeds: Annotated[int, typer.Option(help="How many stories.", min=1)] = 20,
    first: Annotated[int, typer.Option(help="The first seed.", min=0)] = 0,
    ticks: Annotated[int, typer.Option(help="How long a story is, in hundredths of a second.", min=1)] = 2500,
    policies: Annotated[Path | None, typer.Option(help="Policy directory.")] = None,
) -> None:
    """Play random scenarios and words of operators on a simulated cell; exit 1 where something does not hold.

    Says which invariant it was, and the shortest story that breaks it. [bold]reins sim fuzz --seeds 200[/]
    """
    from app.ordeal.playing import ordeal

    policy = load_policy(find_policies(policies))
    with Progress(console=err, transient=True) as bars:
        bar = bars.add_task("stories", total=seeds)
        found = ordeal(
            policy, seeds=seeds, first=first, ticks=ticks, progress=lambda done: bars.update(bar, completed=done)
        )
    if found is None:
        say(f"{seeds} stories, and everything held")
        return
    for line in found.lines():
        say(line)
    raise typer.Exit(FINDING)
