"""What the `reins policy` commands share: the directory they are about, and how they say what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.governance.bundle import load
from app.governance.errors import PolicyErrors
from app.terminal import FINDING, err, say_error

if TYPE_CHECKING:
    from app.governance.policy import PolicySet

Directory = Annotated[
    Path | None, typer.Argument(help="The policy directory; default: ./policies, else the shipped one.")
]
Policies = Annotated[
    Path | None,
    typer.Option(help="The policy directory; default: ./policies, else the shipped one.", envvar="REINS_POLICIES"),
]

TimeLimit = Annotated[  # a day at most: endless is no number of milliseconds, which is what the solver counts in
    float, typer.Option("--time-limit", min=0.01, max=86_400, help="Seconds for all proofs together.")
]


def finding(found: PolicyErrors, folder: Path) -> typer.Exit:
    """Print every problem, and return the exit of a finding."""
    for problem in found.problems:
        err.print(str(problem), markup=False)
    say_error(f"{len(found.problems)} in `{folder}`")
    return typer.Exit(FINDING)


def load_policy(folder: Path) -> PolicySet:
    """Load a policy directory; what is wrong with it is printed, and ends the command."""
    try:
        return load(folder)
    except PolicyErrors as found:
        raise finding(found, folder) from found
