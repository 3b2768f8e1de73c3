"""Why a session ended without its task done, in terms an agent can replan on: {rule, code, message, remedy}.

The code is the failure as skills, watch rules and recovery name it, or the cell's own word for how it ended.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from app.runtime.drafts import reason

if TYPE_CHECKING:
    from collections.abc import Mapping

RULE: Final = "cell/session"
KNOWN: Final[Mapping[str, tuple[str, str]]] = {
    "object_not_found": ("the object is not where it was remembered", "inspect the area where it may be"),
    "grasp_failed": ("the grasp did not succeed", "look again, then grasp again"),
    "object_lost": ("the grip holds the object no more", "inspect the area, then grasp it again"),
    "no_path": ("no way leads there", "choose another target, or wait until the way is free"),
    "blocked": ("something stands in the way", "choose another way or target, or wait until it is free"),
    "unreachable": ("it is out of reach from here", "navigate to the stand beside it"),
    "placement_failed": ("the object does not stand where it was put", "inspect the surface, then place it again"),
    "tool_failed": ("the tool is not in the state asked for", "operate it again"),
    "perception_mismatch": ("the world is not as it was perceived", "inspect the area"),
    "timeout": ("it took longer than the capability may", "propose it again, or a smaller step"),
    "stall": ("it made no progress", "propose it again"),
    "postcondition_failed": ("sensors do not confirm that it was done", "inspect, then propose it again"),
    "contact": ("contact was harder than policy allows", "look at what is in the way first"),
    "overgrip": ("the gripper closed harder than it was told", "leave it to a human: the gripper needs service"),
    "overspeed": ("the robot moved faster than it was told", "leave it to a human: the drives need service"),
    "zone": ("the robot came to a forbidden zone", "choose a way that keeps away from it"),
    "instability": ("the robot did not follow its commands", "leave it to a human"),
    "sensor_fault": ("a sensor cannot be believed", "wait until it is mended"),
    "retries_exhausted": ("it was tried as often as policy allows", "change what is proposed"),
    "rollback_failed": ("it could not be undone and verified", "inspect before anything else"),
    "recovery_failed": ("recovering from it failed, too", "leave it to a human"),
    "link_lost": ("the link to the cell was lost", "propose it again when the link holds"),
    "operator": ("an operator ended it", "ask before it is proposed again"),
    "expired": ("nobody answered in time", "propose it again when somebody is on duty"),
    "taken_over": ("a human took the controls", "look at `takeover.facts`: the state it left"),
    "control_lapsed": ("the human at the controls left without a word", "wait until somebody has seen to the robot"),
    "cancelled": ("it was cancelled", ""),
    "estop": ("an emergency stop ended it", "wait until it is reset"),
    "guard_broken": ("what guards the cell broke, and power was cut", "leave it to a human: the cell needs service"),
    "loop_broken": ("the cell's control loop broke, and power was cut", "leave it to a human: the cell needs service"),
    "not_held": ("the arm moved while it was held, and power was cut", "leave it to a human: the drives need service"),
    "shutdown": ("the cell was shut down", "propose it again when the cell is back"),
    "journal_unavailable": ("the cell cannot write its journal", "propose it again once there is room for it"),
    "another_site": (
        "the robot works by another site than the policy's",
        "propose it again once the cell is restarted",
    ),
    "session_lost": ("the cell came back and knows nothing of it any more", "inspect, then propose it again"),
    "cell_lost": ("the cell has been away for too long", "propose it again when the cell is back"),
    "cell_restarted": ("the cell was started anew while it ran", "inspect, then propose it again"),
    "launch_unconfirmed": ("the cell never confirmed the launch", "inspect, then propose it again"),
    "permit_expired": (
        "by the cell's clock its authorization had run out",
        "propose it again once the clocks of server and cell agree",
    ),
    "not_yet_valid": (
        "by the cell's clock its authorization is from the future",
        "propose it again once the clocks of server and cell agree",
    ),
    "clock_put_back": (
        "the cell's clock was put back, and what the cell used up before that it does not know any more",
        "propose it again once that clock has come to where it was",
    ),
    "used": ("the cell may have used its authorization up before its journal was begun", "propose it again"),
    "holding": ("the cell holds since it lost its link", "propose it again when the link holds"),
    "unknown_capability": ("the robot has no skill for it", "choose another capability, or another cell"),
    "unknown_name": ("the cell knows nothing of that name", "choose another, or wait until the cell is restarted"),
    "power_off": ("the robot's power is off", "wait until it is reset"),
    "verified": ("it was rolled back; the world is as it was before", "change what is proposed"),
}

OF_PERMITS: Final[Mapping[str, str]] = {"expired": "permit_expired"}
"""What a cell says of an authorization in a word that means something else of a session."""


def of_refusal(code: str) -> str:
    """Return the failure of a session that its cell would not begin, by what the cell said of its authorization."""
    return OF_PERMITS.get(code, code)


def described(code: str) -> str:
    """Return what is known of a failure in words, its code behind them; of one that nobody knows, the code alone."""
    known = KNOWN.get(code)
    return f"`{code}`" if known is None else f"{known[0]} (`{code}`)"


def failure(*codes: str) -> dict[str, Any]:
    """Return the `failure` of an invocation: one reason for each code, what went wrong first.

    Args:
        codes: The failure that recovery could not mend, and how the session ended; empty and repeated ones are left
            out.
    """
    named = [code for code in dict.fromkeys(codes) if code]
    return {"reasons": [reason(RULE, code, *KNOWN.get(code, (f"the session ended: {code}", ""))) for code in named]}
