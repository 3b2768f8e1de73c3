"""The screens: poses and scenes from cells to the consoles that watch them, each frame made once for all of them.

A cell sends frames only while at least one console watches it. A frame bears the place of its cell in the console's own
list, so consoles with the same list share its bytes.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import orjson

from app.protocol import ProtocolError, Scene, address_poses, measure_poses
from app.runtime.budget import Budget, drawings

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from app.protocol import Path
    from app.runtime.outlet import Outlet

LAST_NUMBER: Final = 2**32


@dataclass(slots=True)
class Screen:
    """What is shown of one cell: its scene and path as text, and who watches it at which place of their list."""

    scene: str | None = None
    path: str | None = None
    shape: tuple[int, int] | None = None  # how many bodies and gauges a frame has
    frames: int = 0
    watchers: dict[Outlet, int] = field(default_factory=dict["Outlet", int])
    drawings: Budget = field(default_factory=drawings)
    due: asyncio.TimerHandle | None = None  # until then the watchers have an older scene or path


class Screens:
    """All cells as consoles see them."""

    def __init__(self, show_cell: Callable[[str, bool], None]) -> None:
        """Take what has a cell begin and end to show itself."""
        self._show_cell = show_cell
        self._screens: dict[str, Screen] = {}

    def watched(self, cell: str) -> bool:
        """Say whether anybody watches a cell."""
        screen = self._screens.get(cell)
        return screen is not None and bool(screen.watchers)

    def watch(self, outlet: Outlet, cells: Sequence[str]) -> None:
        """Let a console watch these cells from now on, in place of those it watched before."""
        outlet.forget_frames()
        places = {cell: place for place, cell in reversed(list(enumerate(cells)))}  # named twice: the first place
        before = {name for name, screen in self._screens.items() if outlet in screen.watchers}
        for name in before - places.keys():
            del self._screens[name].watchers[outlet]
            if not self._screens[name].watchers:
                self._show_cell(name, False)
                self._forget(name)
        for name, place in places.items():
            screen = self._screens.setdefault(name, Screen())
            first = not screen.watchers
            screen.watchers[outlet] = place
            if name not in before:
                for text in (screen.scene, screen.path):
                    if text is not None:
                        outlet.say(text)
            if first:
                self._show_cell(name, True)

    def draw(self, cell: str, message: Scene | Path) -> None:
        """Pass on what a cell looks like, or the way it is planned to go."""
        screen = self._screens.get(cell)
        if screen is None:
            return
        text = orjson.dumps({**message.model_dump(mode="json"), "cell": cell}).decode()
        if isinstance(message, Scene):
            screen.scene, screen.shape = text, (len(message.bodies), len(message.gauges))
            screen.path = None  # what is planned by now comes behind it; where nothing is, nothing does
        else:
            screen.path = text
        if screen.due is None:
            self._tell(screen, text)

    def _tell(self, screen: Screen, *texts: str | None) -> None:
        """Tell whoever watches; where a cell draws more than it may, they are told later how it looks by then."""
        if (owed_s := screen.drawings.owed_s()) > 0:
            screen.due = asyncio.get_running_loop().call_later(owed_s, self._tell_late, screen)
            return
        for text in filter(None, texts):
            screen.drawings.spend(len(text))
            for outlet in screen.watchers:
                outlet.say(text)

    def _tell_late(self, screen: Screen) -> None:
        screen.due = None
        self._tell(screen, screen.scene, screen.path)

    def show(self, cell: str, frame: bytes) -> None:
        """Pass a frame on to whoever watches.

        Raises:
            ProtocolError: it is malformed, or does not fit the scene.
        """
        shape = measure_poses(frame)
        screen = self._screens.get(cell)
        if screen is None:
            return  # nobody watches any more, and the cell does not know yet
        if screen.shape is None or screen.due is not None:
            return  # of an earlier time that somebody watched; the scene is on its way
        if shape != screen.shape:
            raise ProtocolError(f"a frame of `{shape}` bodies and gauges; the scene has `{screen.shape}`")
        screen.frames = (screen.frames + 1) % LAST_NUMBER
        addressed: dict[int, bytes] = {}
        for outlet, place in screen.watchers.items():
            content = addressed.get(place)
            if content is None:
                content = addressed[place] = address_poses(frame, place, screen.frames)
            outlet.show(place, screen.frames, content)

    def _forget(self, cell: str) -> None:
        """Keep nothing of a cell that nobody watches: the next one to watch gets what it says then."""
        screen = self._screens.pop(cell)
        if screen.due is not None:
            screen.due.cancel()
