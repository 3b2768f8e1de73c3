"""An ordeal for a cell: random scenarios and random words of operators, against what has to hold in every tick.

One seed is one story: a workcell with its faults and people, and a list of words (launches, pauses, stops, hands on the
controls, a link or a disk that is lost), drawn beforehand. Each word has randomness of its own, so that leaving one out
changes no other: a story that breaks an invariant is shortened until every word that is left is needed for it.
"""

from __future__ import annotations

import random
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from app.ordeal.story import TICKS, Finding, Scene, Story, Word
from app.sim.faults import SENSOR_FAULTS, Fault
from app.sim.occasions import Trigger
from app.sim.people import Walk
from app.sim.sensors import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from app.governance.model import Json
    from app.governance.policy import PolicySet

SHORTENINGS: Final = 60
_OBJECTS: Final = ("mug_1", "glass_1", "driver_1")
_WORDS: Final[Mapping[str, float]] = {
    "launch": 6, "hand": 2, "back": 1.5, "jog": 3, "pause": 3, "resume": 3, "stop": 1, "rollback": 1.5, "cancel": 0.7,
    "confirm": 1, "resolve_continue": 2.5, "resolve_terminate": 0.5, "let_go": 0.7, "end_takeover": 0.5,
    "escalate": 0.7, "estop": 0.7, "reset": 2, "lose": 0.7, "welcome": 2, "again": 0.5, "stranger": 0.5, "disk": 0.3,
    "break": 0.2,
}  # fmt: skip


def ordeal(
    policy: PolicySet,
    *,
    seeds: int,
    first: int = 0,
    ticks: int = TICKS,
    progress: Callable[[int], None] = lambda _: None,
) -> Finding | None:
    """Play stories until an invariant does not hold; return that one, as short as it gets, or None.

    Args:
        policy: what is decided and watched by; its site is what is built.
        seeds: how many stories.
        first: the first seed.
        ticks: how long a story is.
        progress: told how many stories are over.
    """
    for done, seed in enumerate(range(first, first + seeds)):
        if (found := play(policy, seed, words_of(seed, ticks))) is not None:
            return shortened(policy, found)
        progress(done + 1)
    return None


def play(policy: PolicySet, seed: int, words: Sequence[Word]) -> Finding | None:
    """Play one story; return what did not hold."""
    with TemporaryDirectory(prefix="reins-ordeal-") as folder:
        return Story(policy, seed, scene_of(policy, seed), words, Path(folder)).play()


def shortened(policy: PolicySet, found: Finding) -> Finding:
    """Leave out words as long as the same invariant breaks without them."""
    kept = found
    for word in found.words[::-1][:SHORTENINGS]:
        fewer = [one for one in kept.words if one is not word]
        again = play(policy, found.seed, fewer)
        if again is not None and again.invariant == found.invariant:
            kept = again
    return kept


def words_of(seed: int, ticks: int) -> list[Word]:
    """Draw what is said in the story of a seed."""
    draw, at, words = _draw(seed, "words"), 5, [Word(5, "welcome", 0)]
    gap = draw.choice((15, 40, 80))
    while (at := at + 1 + int(draw.expovariate(1.0 / gap))) < ticks:
        (kind,) = draw.choices(list(_WORDS), list(_WORDS.values()))
        words.append(Word(at, kind, draw.getrandbits(32)))
    return words


def scene_of(policy: PolicySet, seed: int) -> Scene:
    """Draw the profile, the faults and the people of a seed."""
    draw = _draw(seed, "scene")
    faults = tuple(_fault(draw) for _ in range(draw.choice((0, 0, 1, 1, 2))))
    people = tuple(_walk(draw) for _ in range(draw.choice((0, 0, 1, 2))))
    return Scene(draw.choice(sorted(policy.profiles)), faults, people)


def _draw(seed: int, what: str) -> random.Random:
    return random.Random(f"{what} {seed}")  # noqa: S311  # repeatable, no secret


def _fault(draw: random.Random) -> Fault:
    thing = draw.choice(_OBJECTS)
    kinds: Sequence[tuple[str, dict[str, Json]]] = (
        ("grip_gain", {"gain": draw.choice((0.1, 0.5, 1.5, 2.0))}),
        ("speed_scaling", {"gain": draw.choice((0.5, 1.5, 2.0))}),
        ("slippery", {"object": thing, "friction": 0.05}),
        ("missing", {"object": thing}),
        ("blocked", {"x_m": draw.uniform(1.2, 3.4), "y_m": draw.uniform(2.0, 3.4)}),
        ("odometry_bias", {"x_mps": draw.uniform(-0.1, 0.1)}),
        ("payload_shift", {"object": thing, "factor": draw.choice((0.3, 2.0, 5.0)), "offset_m": 0.02}),
        (
            "sensor",
            {"sensor": draw.choice(SENSORS), "fault": draw.choice(SENSOR_FAULTS), "size": draw.choice((0.05, 0.3))},
        ),
        ("fade", {"strength": draw.choice((0.1, 0.5, 0.9))}),
        ("misplaced", {"object": thing, "x_m": draw.uniform(-0.1, 0.1)}),
        ("habit", {"habit": draw.choice(("obstinate", "overconfident", "hung", "dead_reckoning"))}),
    )
    kind, sizes = draw.choice(kinds)
    lasts_s = draw.choice((None, 0.2, 1.0, 4.0))
    return Fault(kind=kind, at=Trigger(time_s=draw.uniform(0.5, 20.0)), sizes=sizes, for_s=lasts_s)


def _walk(draw: random.Random) -> Walk:
    near = (draw.uniform(1.2, 2.4), draw.uniform(3.4, 4.2))
    return Walk(
        points=((4.0, 3.0), near, (0.4, 3.0)),
        start=Trigger(time_s=draw.uniform(1.0, 20.0)),
        stay_s=((1, draw.choice((0.0, 1.0, 4.0, 8.0))),),
    )
