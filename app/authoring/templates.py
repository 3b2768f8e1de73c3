"""Templates for profiles, from what standards and law ask for: in own words, with the clause each number comes from.

A template asks; its answers become parts of a profile (`Draft`), which `drafting` writes into a copy of a policy. What
a standard leaves to the risk assessment has no default here: somebody has to say the number, and where it was found.

A policy made from a template conforms to nothing by itself. Safety functions with a required performance level are the
robot's and its safety controller's; Reins is a further layer above them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from app.authoring.collaboration import REGIONS, Distances, contact_speed_mps, lasting_force_n
from app.authoring.questions import Answers, Choice, Number, Question, Words, YesNo
from app.governance.policy_model import WALKING_MPS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

RISKS: Final = ("low", "medium", "high", "critical")
OUTCOMES: Final = ("recovered", "rolled_back", "terminated", "stopped", "taken_over", "fault")


class Bound(NamedTuple):
    """A limit of a profile, and where its number comes from."""

    most: float
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """What a template makes of its answers.

    Attributes:
        limits: Limits by name, in the place of the model profile's.
        sections: Further top-level keys of the profile, as values.
        confidence: Below which a proposal of any risk passes a human; None: nothing is added.
        clearance_m: How much the base keeps clear of everything at least; None: nothing is added.
        asked: The risks that pass a human under this profile, as a promise to be proved.
    """

    limits: Mapping[str, Bound] = field(default_factory=dict[str, Bound])
    sections: Mapping[str, Any] = field(default_factory=dict[str, Any])
    confidence: float | None = None
    clearance_m: float | None = None
    asked: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """A template.

    Attributes:
        name: What it is called.
        summary: What it makes, in a sentence.
        source: What it is derived from.
        notes: What it does not do, and what else to know before using it.
        questions: What it asks, beside what every template does.
        draft: Makes a draft of the answers.
        warn: Says what follows from the answers that is worth knowing.
    """

    name: str
    summary: str
    source: str
    notes: tuple[str, ...]
    questions: tuple[Question, ...]
    draft: Callable[[Answers], Draft]
    warn: Callable[[Answers], str] = lambda answers: ""


ASSESSMENT: Final = Words(
    key="assessment",
    asks="Where is your risk assessment (document and section)?",
    why="It becomes the source of every number below that no standard fixes: ISO 12100:2010 asks for the assessment, "
    "and whoever reads the policy later has to find it.",
)


def common(profiles: tuple[str, ...], like: str, name: str) -> tuple[Question, ...]:
    """Return what every template asks first: the profile's name, and the one it takes everything else from."""
    return (
        Words(key="profile", slug=True, asks="What is the new profile called?", default=name,
              why="Cells are put under it by this name."),
        Choice(key="like", among=profiles, asks="Which profile is it made from?", default=like,
               why="What the template does not ask about is taken over from it: watching, recovery, people."),
        YesNo(key="strictest", asks="Shall it be proved to allow nothing that the strictest profile refuses?",
              default="no", why="Then it stands first in `order` of properties.yaml, and stays so."),
        ASSESSMENT,
    )  # fmt: skip


def _number(answers: Answers, key: str) -> float:
    return cast("float", answers[key])


def _assessed(answers: Answers, key: str, also: str = "") -> Bound:
    """Return a limit whose number somebody has assessed."""
    return Bound(_number(answers, key), f"risk assessment: {answers['assessment']}" + (f"; {also}" if also else ""))


# ISO 10218: reduced speed --------------------------------------------------------------------------------------------

REDUCED_MPS: Final = 0.25
REDUCED: Final = "ISO 10218-1:2011, reduced speed: at most 250 mm/s at the tool centre point"


def _reduced(answers: Answers) -> Draft:
    return Draft(
        limits={
            "tcp_speed_mps": Bound(_number(answers, "tcp_speed_mps"), REDUCED),
            "base_speed_mps": _assessed(answers, "base_speed_mps"),
        }
    )


def _reduced_warning(answers: Answers) -> str:
    both = _number(answers, "tcp_speed_mps") + _number(answers, "base_speed_mps")
    if both <= REDUCED_MPS:
        return ""
    return (
        f"arm and base together come to {both:g} m/s in the room: 250 mm/s hold there only if they never move at once, "
        f"or if both limits add up to 0.25"
    )


# ISO/TS 15066: speed and separation ----------------------------------------------------------------------------------

SSM: Final = "ISO/TS 15066:2016, 5.5.4"


def _separated(answers: Answers) -> Draft:
    return Draft(
        limits={key: _assessed(answers, key, SSM) for key in ("tcp_speed_mps", "base_speed_mps")},
        sections={"shared_floor": True, "separation": _distances(answers)._asdict()},
    )


def _distances(answers: Answers) -> Distances:
    return Distances(*(_number(answers, key) for key in Distances._fields))


def _separation_warning(answers: Answers) -> str:
    fast = _number(answers, "tcp_speed_mps") + _number(answers, "base_speed_mps")
    standing_m, moving_m = (_distances(answers).separation_m(speed) for speed in (0.0, fast))
    return (
        f"the robot will pause below {standing_m:.2f} m from a person while it stands, and below {moving_m:.2f} m with "
        "arm and base at their limits"
    )


# ISO/TS 15066: power and force limiting ------------------------------------------------------------------------------


PFL: Final = "ISO/TS 15066:2016, 5.5.5 and Table A.2"


def _touched(answers: Answers) -> tuple[str, ...]:
    return cast("tuple[str, ...]", answers["body_regions"])


def _contact_speed(answers: Answers) -> float:
    load_kg = _number(answers, "tool_kg") + _number(answers, "payload_kg")
    return contact_speed_mps(_touched(answers), moving_kg=_number(answers, "moving_mass_kg"), load_kg=load_kg)


def _limited(answers: Answers) -> Draft:
    speed_mps, by = _contact_speed(answers), answers["assessment"]
    lasting = f"{PFL}, lasting contact: {', '.join(_touched(answers))}"
    return Draft(
        limits={
            "contact_force_n": Bound(lasting_force_n(_touched(answers)), lasting),
            "grip_force_n": _assessed(answers, "grip_force_n", f"at most 140 N on hand and fingers ({PFL})"),
            "tcp_speed_mps": _touching(answers, "tcp_speed_mps", speed_mps),
            "base_speed_mps": _touching(answers, "base_speed_mps", speed_mps),
            "payload_kg": Bound(_number(answers, "payload_kg"), f"the load assumed for contact: {by}"),
        },
        sections={"shared_floor": True},
    )


def _touching(answers: Answers, key: str, contact_mps: float) -> Bound:
    """Return an assessed speed, lowered to the one at which a contact reaches its transient force."""
    found = _assessed(answers, key, f"below {contact_mps:.2f} m/s (ISO/TS 15066:2016, Annex A)")
    return found._replace(most=min(found.most, math.floor(contact_mps * 100) / 100))


def _limited_warning(answers: Answers) -> str:
    speed_mps, limits = _contact_speed(answers), _limited(answers).limits
    lowered = [key for key in ("tcp_speed_mps", "base_speed_mps") if _number(answers, key) > limits[key].most]
    told = f"; lowered to it: {', '.join(lowered)}" if lowered else ""
    both = limits["tcp_speed_mps"].most + limits["base_speed_mps"].most
    if both > speed_mps:
        told += f"; arm and base together come to {both:g} m/s in the room, which is more, if they ever move at once"
    return (
        f"a free contact reaches its transient force at {speed_mps:.2f} m/s with this mass{told}; pressure has "
        "limits of its own in Table A.2, which only a measurement shows"
    )


# ISO 13482: personal care --------------------------------------------------------------------------------------------


def _caring(answers: Answers) -> Draft:
    return Draft(
        limits={
            "tcp_speed_mps": _assessed(answers, "tcp_speed_mps", "ISO 13482:2014, 6 (speed)"),
            "base_speed_mps": _assessed(answers, "base_speed_mps", "ISO 13482:2014, 6 (speed)"),
            "contact_force_n": _assessed(answers, "contact_force_n", "ISO 13482:2014, 6 (force)"),
        },
        sections={"shared_floor": True},
        confidence=_number(answers, "confidence"),
        clearance_m=_number(answers, "clearance_m"),
    )


# The EU AI Act: human oversight --------------------------------------------------------------------------------------


def _overseen(answers: Answers) -> Draft:
    risks = [risk for risk in RISKS if risk in cast("tuple[str, ...]", answers["risks"])]
    approval = {
        "risk": risks,
        "within_s": _number(answers, "within_s"),
        "on_timeout": "deny",
        "approvers": {"default": 1, "critical": 2},
    }
    modes = ["approval-required", "interrupt-enabled", "takeover-enabled", "review-only"]
    review = {"outcomes": [*cast("tuple[str, ...]", answers["review"])]}
    return Draft(
        sections={
            "keep_every_tick": answers["keep_every_tick"],
            "authority": {"modes": modes, "approval": approval, "review": review},
        },
        confidence=_number(answers, "confidence"),
        asked=tuple(risks),
    )


_ARM: Final = Number(
    key="tcp_speed_mps", asks="How fast may the arm move, in m/s?",
    why="No clause fixes this number: it comes from your risk assessment.",
)  # fmt: skip
_BASE: Final = Number(
    key="base_speed_mps", asks="How fast may the base drive, in m/s?",
    why="No clause fixes this number: it comes from your risk assessment.",
)  # fmt: skip
_CONFIDENCE: Final = Number(
    key="confidence", asks="Below which confidence of the agent does every proposal pass a human, 0 to 1?", most=1.0,
    why="No clause fixes this number: it comes from how your agent's stated confidence relates to its errors.",
)  # fmt: skip

TEMPLATES: Final[Mapping[str, Template]] = {
    template.name: template
    for template in (
        Template(
            name="reduced-speed",
            summary="A profile for work within reach of people at reduced speed.",
            source="ISO 10218-1:2011 (reduced speed control, manual reduced speed)",
            notes=(
                "There is a 2025 edition of ISO 10218: see which of the two is to be kept where you are.",
                "Reduced speed is about the tool centre point's speed in the room; the base's speed adds to the arm's.",
            ),
            questions=(
                Number(key="tcp_speed_mps", asks="How fast may the arm move, in m/s?", most=REDUCED_MPS, default="0.25",
                       why="Reduced speed is at most 250 mm/s; your risk assessment may ask for less.", source=REDUCED),
                Number(key="base_speed_mps", asks="How fast may the base drive, in m/s?", most=REDUCED_MPS,
                       why="While the base moves the tool, the same 250 mm/s hold; how much of it comes from your risk "
                       "assessment.", source=REDUCED),
            ),
            draft=_reduced,
            warn=_reduced_warning,
        ),
        Template(
            name="speed-and-separation",
            summary="A profile in which the robot keeps a protective distance from people, and pauses below it.",
            source="ISO/TS 15066:2016, 5.5.4; ISO 10218-1:2011, 5.10.4; ISO 13855:2010",
            notes=(
                "S_p = v_h (T_r + T_s) + v_r T_r + v_r T_s / 2 + C + Z_d + Z_r in every control tick (5.5.4).",
                "Measure stopping time with the greatest load, reach and speed as ISO 10218-1:2011 says.",
                "When the robot goes on after a pause, and how long it waits before it asks, are the model profile's.",
            ),
            questions=(
                Number(key="human_speed_mps", asks="How fast may a person come closer, in m/s?", least=WALKING_MPS,
                       default="1.6", source=SSM, why="Where a person's speed is not measured, 1.6 m/s are "
                       "assumed; ISO 13855:2010 has 2.0 m/s for distances up to 0.5 m."),
                Number(key="reaction_s", asks="From sensing a person to the first braking: how many seconds (T_r)?",
                       why="Measure it: sensors, transfer and control together. No clause fixes it.", source=SSM),
                Number(key="stopping_s", asks="From first braking to standstill: how many seconds (T_s)?",
                       why="Measure it as ISO 10218-1:2011 describes. No clause fixes it.", source=SSM),
                Number(key="intrusion_m", asks="How far may a person reach in unsensed, in m (C)?",
                       above=-math.inf, least=0.0,
                       why="ISO 13855:2010 gives it by the detection capability: 0.85 m where an arm goes unnoticed.",
                       source=SSM),
                Number(key="position_uncertainty_m", asks="How uncertain is a person's place, in m (Z_d)?",
                       above=-math.inf, least=0.0,
                       why="From your tracker's data sheet or measurement. No clause fixes it.", source=SSM),
                Number(key="robot_uncertainty_m", asks="How uncertain is the robot's place, in m (Z_r)?",
                       above=-math.inf, least=0.0,
                       why="From your robot's localisation. No clause fixes it.", source=SSM),
                _ARM, _BASE,
            ),
            draft=_separated,
            warn=_separation_warning,
        ),
        Template(
            name="force-limited",
            summary="A profile in which the robot may be touched, with force and speed bounded by what may be touched.",
            source="ISO/TS 15066:2016, 5.5.5 and Annex A; ISO 10218-1:2011, 5.10.5",
            notes=(
                "Skull, forehead, face and larynx cannot be chosen: contact there is to be prevented (5.5.5).",
                "Annex A is informative; pressure, edges and clamping have to be measured at the application.",
                "Contact force is the mean over 20 ms here; Table A.2 allows a short contact twice the lasting force.",
            ),
            questions=(
                Choice(key="body_regions", among=tuple(REGIONS), several=True,
                       asks="Which parts of the body may be touched?", source=PFL,
                       why="Your risk assessment says which can be reached; the least of their forces holds."),
                Number(key="moving_mass_kg", asks="How heavy are the robot's moving parts, in kg (M)?",
                       why="From the manufacturer; half of it counts in a contact.",
                       source="ISO/TS 15066:2016, Annex A"),
                Number(key="tool_kg", asks="How heavy is the tool, in kg?", above=-math.inf, least=0.0,
                       why="It counts whole in a contact, beside the load; 0 where it is among the moving parts.",
                       source="ISO/TS 15066:2016, Annex A"),
                Number(key="payload_kg", asks="How heavy is what it carries at most, in kg?",
                       why="With the tool it counts whole in a contact (m_L), and it becomes the payload limit.",
                       source="ISO/TS 15066:2016, Annex A"),
                Number(key="grip_force_n", asks="How strongly may the gripper grip, in N?", most=140.0, source=PFL,
                       why="Hand and fingers bear 140 N in lasting contact; how much less, your risk assessment says."),
                _ARM, _BASE,
            ),
            draft=_limited,
            warn=_limited_warning,
        ),
        Template(
            name="personal-care",
            summary="A profile for a robot among people who are no trained staff, under supervision of its decisions.",
            source="ISO 13482:2014, 5.12 (autonomous decisions) and 6 (control of space, speed and force, sensing)",
            notes=(
                "ISO 13482:2014 gives no numbers for speed, force or distance: all of them are your risk assessment's.",
                "Children and people who cannot step aside are foreseeable there; assess for them.",
            ),
            questions=(
                _ARM, _BASE,
                Number(key="contact_force_n", asks="How hard may the robot touch, in N?",
                       source="ISO 13482:2014, 6 (force)",
                       why="ISO 13482:2014 gives no number; ISO/TS 15066:2016 has some for adults at work."),
                Number(key="clearance_m", asks="How far does the base keep from everything, in m?",
                       source="ISO 13482:2014, 6 (space, sensing)", most=1.0,
                       why="From your sensing and stopping distance. No clause fixes it."),
                _CONFIDENCE,
            ),
            draft=_caring,
        ),
        Template(
            name="human-oversight",
            summary="A profile in which people can understand, approve, interrupt, take over and review what is done.",
            source="Regulation (EU) 2024/1689 (AI Act), Articles 12, 14, 19 and 26",
            notes=(
                "Whether your system is of high risk, Article 6 and Annexes I and III decide, not this template.",
                "Article 14(4): people can decide against an output (d), stop the system (e), and know how easily one "
                "relies on it (b).",
                "Articles 19 and 26(6): logs are kept for at least six months; Reins deletes none by itself.",
                "Article 26(2): those who oversee have the competence and authority to; Reins cannot check that.",
            ),
            questions=(
                Choice(key="risks", among=RISKS, several=True, asks="At which risks does a person approve beforehand?",
                       default="high,critical", source="AI Act, Article 14(4)(d)",
                       why="The Act asks that people can decide against an output; at which risks, you assess."),
                Number(key="within_s", asks="How many seconds has a person to answer?", most=86_400.0,
                       source="AI Act, Article 14(4)(d)", why="Silence denies. No article fixes this number."),
                _CONFIDENCE,
                Choice(key="review", among=OUTCOMES, several=True, default=",".join(OUTCOMES[1:]),
                       asks="Which endings wait for a person's verdict afterwards?", source="AI Act, Article 26(5)",
                       why="Whoever deploys the system monitors how it works."),
                YesNo(key="keep_every_tick", default="yes", asks="Is every control tick kept in the telemetry?",
                      source="AI Act, Article 12", why="The Act asks for a log of what shows risks; this keeps all."),
            ),
            draft=_overseen,
        ),
    )
}  # fmt: skip
