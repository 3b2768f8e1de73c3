"""One run of a skill, and which skills there are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeAlias

from app.cell.substrate import SubstrateError
from app.governance.model import Command, Json, Observation, SkillReport, SkillState
from app.sim.body import Body, Moves, SkillFailed
from app.sim.skills_arm import grasp_object, inspect_area, place_object
from app.sim.skills_drive import navigate_to, reposition_base, safe_retreat, transport_object
from app.sim.skills_jog import CAPABILITY as TAKEOVER
from app.sim.skills_jog import Jog, takeover
from app.sim.skills_recover import regrasp, release_and_retract, retrace
from app.sim.skills_tool import operate_tool

if TYPE_CHECKING:
    from app.governance.model import Point
    from app.sim.body import Senses

Prepare: TypeAlias = Callable[[Body, Mapping[str, Json]], Moves]

# A skill is prepared by a plain function, which may refuse, and then run as a generator of commands.
SKILLS: Mapping[str, Prepare] = {
    "navigate_to": navigate_to,
    "inspect_area": inspect_area,
    "grasp_object": grasp_object,
    "place_object": place_object,
    "transport_object": transport_object,
    "operate_tool": operate_tool,
    "release_and_retract": release_and_retract,
    "safe_retreat": safe_retreat,
    "reposition_base": reposition_base,
    "retrace": retrace,
    "regrasp": regrasp,
}
RECOVERIES = frozenset({"release_and_retract", "safe_retreat", "reposition_base", "retrace", "regrasp"})


class Run:
    """A skill on its way; implements `Skill`."""

    def __init__(self, capability: str, params: Mapping[str, Json], body: Body) -> None:
        """Prepare the skill.

        Raises:
            SubstrateError: it cannot be prepared, with the failure name.
        """
        self.capability, self.starts = capability, 1
        self._body, self._params = body, params
        self._moves = SKILLS[capability](body, params)
        self._state, self._failure = SkillState.RUNNING, ""
        self._said = SkillReport(body.phase, body.progress)
        self.detail = ""

    def act(self, observation: Observation, rate: float) -> Command:
        """Return the command for this tick; at a rate of 0 everything stays where it is."""
        body = self._body
        body.seen, body.rate = observation, rate
        if self._state is not SkillState.RUNNING or rate <= 0.0:
            held = body.hold()
            return held if held.grip_force_n >= 0.0 else held._replace(grip_force_n=0.0)
        if "hung" in body.senses.habits:
            return body.hold()
        try:
            return next(self._moves)
        except StopIteration:
            self._state, body.progress = SkillState.SUCCEEDED, 1.0
        except SkillFailed as failed:
            self._give_up(failed)
        return body.hold()

    @property
    def way(self) -> tuple[Point, ...]:
        """Return the way the base is planned to go; empty where there is none."""
        return self._body.way

    def _give_up(self, failed: SkillFailed) -> None:
        """Fail, unless a fault has taught the skill something worse."""
        habits = self._body.senses.habits
        self._failure, self.detail = failed.failure, failed.detail
        if "obstinate" in habits:
            try:
                self._moves = SKILLS[self.capability](self._body, self._params)
            except SubstrateError as error:
                self._state, self._failure, self.detail = SkillState.FAILED, error.failure, error.detail
            else:
                self.starts += 1
        elif "overconfident" in habits:
            self._state, self._failure, self._body.progress = SkillState.SUCCEEDED, "", 1.0
        else:
            self._state = SkillState.FAILED

    def report(self) -> SkillReport:
        """Say phase, progress and state."""
        body, said = self._body, self._said
        if (
            said.progress != body.progress
            or said.phase != body.phase
            or said.state is not self._state
            or said.failure != self._failure
        ):
            self._said = said = SkillReport(body.phase, body.progress, self._state, self._failure)
        return said


def start(
    capability: str,
    params: Mapping[str, Json],
    senses: Senses,
    observation: Observation,
    held: Command,
    *,
    careful: bool,
) -> Run | Jog:
    """Prepare a run of a skill, or a human's driving, from the command that is being held."""
    if capability == TAKEOVER:
        return takeover(params, senses, observation, held)
    return Run(capability, params, Body(senses, observation, held, careful=careful))
