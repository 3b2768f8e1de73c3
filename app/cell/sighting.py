"""Where people and movable things are during a session, for its telemetry: a replay would lack them otherwise.

People are where the tracker says, which is what the watcher judges by. Things (what the site knows as objects and
tools, and whatever else the substrate says is loose) are where displays show them. The control loop only takes
references, five times a second of its own time; working them into messages is done on the link's thread (`Sightings`).
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final, cast

from app import protocol
from app.protocol import POSE_BYTES, Sighting

if TYPE_CHECKING:
    from app.cell.display import Socket
    from app.cell.loop import Outbox
    from app.cell.moment import Sight
    from app.governance.model import Site
    from app.protocol import Scene

MOVED: Final = 0.001  # metres, or the same of a quaternion: a tenth of a degree
MAX_PEOPLE: Final = 64
_POSE: Final = struct.Struct("<7f")

Pose = tuple[float, float, float, float, float, float, float]


def things(scene: Scene, site: Site) -> tuple[str, ...]:
    """Return which bodies of a scene are things: the site's, and what is loose besides, as an obstacle is."""
    loose = cast("list[str]", scene.scene.get("loose", []))
    return tuple(dict.fromkeys((*site.objects, *site.tools, *loose)))


class Sightings:
    """Sends what was seen over one link: people each time, things when they have moved."""

    def __init__(self, outbox: Outbox) -> None:
        """Begin with nothing sent: whoever takes it up on this link has to learn where everything is."""
        self._outbox = outbox
        self._invocation = ""
        self._sent: dict[str, Pose] = {}

    async def show(self, socket: Socket) -> None:
        """Send what has been seen since the last time."""
        while self._outbox.sights:
            await socket.send(protocol.encode(self._worked(self._outbox.sights.popleft())))

    def _worked(self, sight: Sight) -> Sighting:
        if sight.invocation != self._invocation:
            self._invocation, self._sent = sight.invocation, {}
        moved = {name: pose for name, pose in self._things(sight.poses()).items() if self._moved(name, pose)}
        self._sent |= moved
        people = [(track.person, track.x_m, track.y_m) for track in sight.people]
        seen = [track for track in people if math.isfinite(track[1]) and math.isfinite(track[2])]
        return Sighting(invocation=sight.invocation, time_s=sight.time_s, people=seen[:MAX_PEOPLE], bodies=moved)

    def _things(self, packed: bytes) -> dict[str, Pose]:
        scene = self._outbox.scene
        bodies = [] if scene is None or len(packed) != len(scene.bodies) * POSE_BYTES else scene.bodies
        poses = dict(zip(bodies, _POSE.iter_unpack(packed), strict=False))
        return {
            name: poses[name] for name in self._outbox.things if name in poses and all(map(math.isfinite, poses[name]))
        }

    def _moved(self, name: str, pose: Pose) -> bool:
        before = self._sent.get(name)
        return before is None or any(abs(a - b) > MOVED for a, b in zip(before, pose, strict=True))
