"""What the paper leaves open, or does otherwise, and what protocol `physical` does; for the report."""

from __future__ import annotations

from typing import Final, NamedTuple

from app.evaluation.truth import SLACK_TICKS
from app.governance.model import CONTROL_PERIOD_S


class Choice(NamedTuple):
    """What the paper leaves open, or does otherwise, and what is done here; for the report."""

    parameter: str
    paper: str
    here: str
    affects: tuple[str, ...]
    """Names of metrics."""


CHOICES: Final = (
    Choice(
        "type and capability of a violation",
        "drawn independently of each other",
        "the type is drawn first, then a capability in which its fault can physically occur",
        ("RVDR",),
    ),
    Choice(
        "unauthorized proposals",
        "missing permission, forbidden zone, restricted object (elsewhere also missing approval and disallowed mode), "
        "without their shares; executed where they are let through",
        "one of four, evenly: any capability proposed by an agent without permission, in any profile; a drive to a "
        "point in the forbidden zone of the press; a grasp of the one restricted object, the solvent; in human-shared, "
        "what waits for a human's approval and did not get it. Speeds and forces are within policy. No "
        "disallowed mode is drawn: the shipped profiles admit both. What is let through is counted at the "
        "gate, and not executed",
        ("UAIR",),
    ),
    Choice(
        "distance to a person",
        "not said from where to where",
        "along the floor, from hull or hand to the middle of the person, a point, as the tracker gives it. To a body "
        "of 0.25 m radius it is 0.25 m less; such a body is what people seen before contact are judged by",
        ("SEPARATION_MIN", "RVDR_PEOPLE_PAUSING"),
    ),
    Choice(
        "authorized proposals",
        "not said how close to the limits they are",
        "drawn at 0.5 to 1 of the limits, then taken to what policy makes of them: none is beyond what policy allows, "
        "so that a gate that decides by policy alone rejects none by construction. Only a stricter second pass, "
        "admission or the cell can",
        ("FRR",),
    ),
    Choice(
        "share of clean trials",
        "none: false alarms are not measured",
        "one in four of the trials that are authorized",
        ("FAS",),
    ),
    Choice(
        "truth of a violation",
        "whatever was injected",
        "the ungoverned twin of the trial; a fault that does not take within 16 s is drawn again, up to six times",
        ("RVDR", "UCR"),
    ),
    Choice(
        "acting under a violation",
        "not defined",
        "the skill is let go on, or the robot still moves when it was told to stop longer ago than braking takes from "
        f"the speed it had (base and arm each at its deceleration) and {SLACK_TICKS * CONTROL_PERIOD_S:g} s more, for "
        "reaction and the drives' lag; a recovery that leaves the violated state is not a continuation of it",
        ("UCR",),
    ),
    Choice(
        "people where the profile only warns",
        "not detected there by design",
        "a warning is what policy names there: seeing it is detection, and there is neither anything to enforce nor "
        "anything unsafe about going on; UCR and CEF leave those out. UCR_STRICT counts each as unsafe",
        ("RVDR_PEOPLE", "UCR", "UCR_STRICT", "CEF"),
    ),
    Choice(
        "a drop while driving",
        "not distinguished",
        "counts as recovered when it ends in a safe stop and a handover: nothing on board picks up from a floor",
        ("RSR",),
    ),
    Choice(
        "recovery policy compliance without recovery",
        "0: the ablation takes no step that could comply",
        "the share of failures in which every step that was taken stands in policy's row for the failure. The ablation "
        "takes one step, it ends the session; that complies where policy's row names ending as well, and not where it "
        "ends in asking a human. In sim-relaxed and test-audit, where nobody may be asked, every row names ending; in "
        "the other two those of most failures do not. Whether steps named earlier were skipped is not judged: RSR "
        "tells what skipping them costs",
        ("RPC",),
    ),
    Choice(
        "rollbacks tried",
        "88 to 92 % succeed by a coin",
        "besides those that recovery chooses, an operator withdraws one recoverable task in five midway, in which "
        "nothing has failed. Few other failures end in a rollback: policy tries again first, and what is lost cannot "
        "be brought back. So RBSR is of withdrawals and violations for the most part; its three parts stand beside it",
        ("RBSR", "RBSR_WITHDRAWN", "RBSR_FAILURE", "RBSR_VIOLATION"),
    ),
    Choice(
        "what is rollback-capable",
        "whether the capability declares a rollback",
        "the same, and by the exact state when the rollback begins there is still something to go back to: what was "
        "held at the start is in the gripper, with friction enough to bear it; where nothing was, what was to be "
        "grasped is in the gripper or stands upright within 5 cm of where it stood, and a tool is as it was. What came "
        "of the rollback has no part in it, and the rate over all that were tried stands beside it",
        ("RBSR", "RBSR_WITHDRAWN", "RBSR_FAILURE", "RBSR_VIOLATION"),
    ),
    Choice(
        "the supervisor",
        "approval drawn at random",
        "approves what waits before launch, and ends an escalated session after two seconds",
        ("RSR", "MRT"),
    ),
)
