"""What governance asks of a robot or a simulator: the one seam between the cell and whatever moves.

A substrate moves only while a `Grant` is bound, and a grant is made by `app.governance.permit.verify` alone (design,
rule 1). The cell's runner calls, once per control tick and in this order: `skill.act` → `clamp` (governance) →
`substrate.step` → `watch` (governance). Everything a substrate reports comes from sensors; the simulator's truth is
offered apart, in its own room, for evaluation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from app.governance.model import Command, Json, Observation, SkillReport, Wish, WorldFacts
    from app.governance.permit import Grant


class Skill(Protocol):
    """One run of a capability on a substrate: a generator of commands, with no way to the actuators of its own."""

    def act(self, observation: Observation, rate: float) -> Command:
        """Return the command for this tick.

        `rate` in 0…1 scales the speed along the planned path: 0 holds in place with power kept (IEC 60204-1 category
        2), 1 runs. The runner ramps it; a skill must stay on its path whatever the rate does.
        """
        ...

    def report(self) -> SkillReport:
        """Say phase, progress and whether the skill believes that it is done or has failed."""
        ...


@runtime_checkable
class Steered(Protocol):
    """What binding the capability `takeover` returns besides a `Skill`: a run that a human steers."""

    @property
    def refused(self) -> str:
        """Return why the last wish could not be done (`unreachable`, `blocked`), or nothing."""
        ...

    def steer(self, wish: Wish) -> None:
        """Take what the human wants from the next tick on; a wish of nothing stops within 50 ms, along its own way."""
        ...


class Substrate(Protocol):
    """A robot with its sensors and skills."""

    id: str
    period_s: float

    def bind(self, grant: Grant, capability: str, params: Mapping[str, Json], *, careful: bool = False) -> Skill:
        """Unlock the actuators for a verified grant and prepare the named capability.

        `capability` and `params` are the grant's own, or those of a recovery it covers. Raises `SubstrateError` when
        the grant is not for this cell, does not cover the capability, or the capability cannot be prepared (with the
        failure name, for instance `no_path`).
        """
        ...

    def unbind(self) -> None:
        """Lock the actuators: the arm keeps its pose, the base brakes, the grip keeps its force."""
        ...

    def hold(self) -> Command:
        """Return the command that keeps everything where it is, with the present grip."""
        ...

    def step(self, command: Command) -> Observation:
        """Apply a command for one control period; return what the sensors saw. Without a bound grant it holds."""
        ...

    def observe(self) -> Observation:
        """Return the newest observation without stepping."""
        ...

    def stop(self, category: int) -> None:
        """Stop by IEC 60204-1 category: 0 removes power at once, 1 after the runner's controlled stop."""
        ...

    def reset(self) -> None:
        """Give power back with everything held where it stands; called at a launch, never before. Moves nothing."""
        ...

    def facts(self) -> WorldFacts:
        """Return what the sensors say about the world, for pre- and postconditions."""
        ...

    def scene(self) -> Mapping[str, Json]:
        """Return the static scene for displays: bodies, shapes, zones."""
        ...

    def poses(self) -> Callable[[], bytes]:
        """Copy the body poses of this moment, for displays, and return what packs them; any thread may call that.

        Packed are float32 x, y, z, qw, qx, qy, qz for each of the scene's `bodies`, in their order.
        """
        ...

    def way(self) -> tuple[tuple[float, float], ...]:
        """Return the way the base is planned to go, x and y in metres, for displays; empty where there is none."""
        ...

    def snapshot(self) -> object:
        """Return a state that `restore` brings back exactly (look-ahead, evaluation twins)."""
        ...

    def restore(self, state: object) -> None:
        """Bring back a state that `snapshot` returned."""
        ...


class SubstrateError(Exception):
    """A substrate refused or could not prepare; `failure` is a name recovery knows, `detail` says what and why."""

    def __init__(self, failure: str, detail: str) -> None:
        """Keep the facts; the message is made of them."""
        self.failure = failure
        self.detail = detail
        super().__init__(f"{failure}: {detail}")
