"""People at real consoles: Chromium, signed in to a real server with a real cell, the built console between them.

Nothing a page complains of goes unnoticed: an error or a warning on its console (a violation of the content security
policy is one) fails the test that saw it, unless the test said beforehand that it comes, as a refused request does.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Locator, Page, expect, sync_playwright

from tests.conftest import ServerProcess, Servers

ROOT = Path(__file__).resolve().parents[2]
PLACES = ("/usr/lib/chromium/chromium", "chromium", "chromium-browser", "google-chrome")
# Root may not use the sandbox; SwiftShader draws where there is no graphics card; a container's /dev/shm is small.
FLAGS = ("--no-sandbox", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--mute-audio")
PATIENCE_MS = 15_000
expect.set_options(timeout=PATIENCE_MS)

DESK = {"width": 1440, "height": 900}
PHONE = {"width": 390, "height": 844}
# How a graphics card that is none speaks of itself; nothing of ours.
DRIVER_TALK = re.compile(r"GL Driver Message|GPU stall due to ReadPixels|software WebGL", re.IGNORECASE)


@dataclass
class Person:
    """Somebody at a console: a browser of their own, and what its pages complained of."""

    context: BrowserContext
    page: Page
    expected: list[re.Pattern[str]] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def expects(self, complaint: str) -> None:
        self.expected.append(re.compile(complaint))

    def unexpected(self) -> list[str]:
        return [one for one in self.complaints if not any(known.search(one) for known in self.expected)]

    def press(self, key: str) -> None:
        self.page.keyboard.press(key)

    def button(self, name: str | re.Pattern[str]) -> Locator:
        return self.page.get_by_role("button", name=name)

    def region(self, name: str) -> Locator:
        return self.page.get_by_role("region", name=name)

    def alert(self, words: str) -> Locator:
        return self.page.get_by_role("alert").filter(has_text=words)

    def listen(self, page: Page) -> None:
        page.on("console", self._said)
        page.on("pageerror", lambda error: self.complaints.append(f"uncaught: {error}"))

    def _said(self, message: ConsoleMessage) -> None:
        if message.type in {"error", "warning", "assert"} and not DRIVER_TALK.search(message.text):
            self.complaints.append(f"{message.type}: {message.text} ({message.location.get('url', '')})")


@dataclass
class People:
    """Seats people at consoles; all of them leave with the test."""

    browser: Browser
    seated: list[Person] = field(default_factory=list)

    def open(self, url: str, *, size: dict[str, int] | None = None, theme: str = "dark") -> Person:
        """Open a page in a browser of its own, as big as `size`, where the system prefers `theme`."""
        narrow = size == PHONE
        context = self.browser.new_context(
            viewport=size or DESK, color_scheme=theme, reduced_motion="reduce", has_touch=narrow, is_mobile=narrow
        )
        context.set_default_timeout(PATIENCE_MS)
        person = Person(context, context.new_page())
        self.seated.append(person)
        person.listen(person.page)
        person.page.goto(url)
        return person

    def sit(self, server: ServerProcess, key: str = "operator", *, at: str = "", **how: object) -> Person:
        """Sign in by the link with the token of `key`; returns when the console shows the present."""
        person = self.open(f"{at or server.url}/#token={server.tokens[key]}", **how)
        person.page.get_by_text(re.compile(r"^\d+ Hz$")).wait_for()
        return person

    def leave(self) -> list[str]:
        said = [one for person in self.seated for one in person.unexpected()]
        for person in self.seated:
            person.context.close()
        return said


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Chromium, headless; ended with the package, for Playwright keeps an event loop running in this thread."""
    found = next((place for name in PLACES if (place := shutil.which(name))), None)
    if found is None:
        pytest.fail(
            "the console's tests drive Chromium, which is not here; install it (Debian: apt-get install chromium)",
            False,
        )
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found, args=list(FLAGS))
        yield chromium
        chromium.close()


@pytest.fixture(scope="session", autouse=True)
def built() -> None:
    """The console as it stands in `web/`: built anew only if it changed."""
    done = subprocess.run([sys.executable, str(ROOT / "web" / "build.py"), "build"], capture_output=True, text=True)
    assert done.returncode == 0, f"the console does not build: {done.stdout[-2000:]}{done.stderr[-2000:]}"


@pytest.fixture
def people(browser: Browser) -> Iterator[People]:
    made = People(browser)
    yield made
    assert made.leave() == []


@pytest.fixture(scope="module")
def serve(built: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., ServerProcess]]:
    """Start servers at will, shared by a module's tests."""
    made = Servers(tmp_path_factory.mktemp("console"))
    yield lambda *flags, cells=1: made.start(None, *flags, cells=cells)
    made.end()
