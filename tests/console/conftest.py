"""People at real consoles: Chromium, signed in to a real server with a real cell, the built console between them.

Nothing a page complains of goes unnoticed: an error or a warning on its console (a violation of the content security
policy is one) fails the test that saw it, unless the test said beforehand that it comes, as a refused request does.
"""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import (
    Browser,
    ConsoleMessage,
    Error,
    Locator,
    Page,
    Playwright,
    Route,
    TimeoutError,
    expect,
    sync_playwright,
)

from tests.conftest import BEFORE_OTHERS, Ahead, ServerProcess, Servers, put_first, until

ROOT = Path(__file__).resolve().parents[2]
PLACES = ("/usr/lib/chromium/chromium", "chromium", "chromium-browser", "google-chrome")
# The same Chromium without the windows that nobody sees here; a page costs a fifth less of the processor in it.
SHELL = "/usr/lib/chromium/chromium-headless-shell"
# Root may not use the sandbox; SwiftShader draws where there is no graphics card; a container's /dev/shm is small.
# Of two lists of features that are off, Chromium heeds the last: so here is what Playwright turns off, as far as it
# concerns pages on loopback, and the two popups of an address bar that nobody sees. Every window built both anew, which
# took as much of the processor as a whole console does.
OFF = (
    "AvoidUnnecessaryBeforeUnloadCheckSync",
    "DestroyProfileOnBrowserClose",
    "HttpsUpgrades",
    "HttpsFirstBalancedModeAutoEnable",
    "LensOverlay",
    "MediaRouter",
    "NetworkTimeServiceQuerying",
    "OptimizationHints",
    "PaintHolding",
    "PreconnectToSearch",
    "SpareRendererForSitePerProcess",
    "WebUIOmniboxAimPopup",
    "WebUIOmniboxPopup",
)
FLAGS = (
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--mute-audio",
    f"--disable-features={','.join(OFF)}",
)
PATIENCE_MS = 30_000
TAPS, TAKEN_MS = 3, 5_000
TRIES = 3
LET_GO = "Hold to run; let go to stop"
expect.set_options(timeout=PATIENCE_MS)

DESK = {"width": 1440, "height": 900}
DESK_SMALL = {"width": 1280, "height": 800}
PHONE = {"width": 390, "height": 844}
NARROWEST = {"width": 320, "height": 640}
MAGNIFIED = {"width": 320, "height": 256}  # 1280 x 1024 at 400 % (WCAG 1.4.10)
SIDEWAYS = {"width": 844, "height": 390}
SIDEWAYS_SMALL = {"width": 667, "height": 375}
# Approve stands where it is first asked to be read, if reasons and values do not fit on the screen.
ANSWERS = ("^Deny", "^(Approve|Read it first)")
# A page is laid out anew, its observers see the new size, and the scene is drawn in it: each in a frame of its own.
THREE_FRAMES = """async () => {
    for (let frame = 0; frame < 3; frame += 1) await new Promise((done) => requestAnimationFrame(done));
}"""
# Presses what stands where a button has been moved to, in the very frame in which it has been.
PRESS_ONCE_MOVED = """(button) => {
    const stood = button.getBoundingClientRect().top;
    const look = () => {
        const { left, top, width, height } = button.getBoundingClientRect();
        if (Math.abs(top - stood) < 20) return requestAnimationFrame(look);
        const under = document.elementFromPoint(left + width / 2, top + height / 2).closest('button');
        const how = { bubbles: true, cancelable: true, pointerId: 1, button: 0 };
        for (const what of ['pointerdown', 'pointerup']) under.dispatchEvent(new PointerEvent(what, how));
        under.click();
        window.pressed = under.textContent.trim();
    };
    requestAnimationFrame(look);
}"""
SLOW_TO_POLISH = """
  - id: slow-to-polish
    applies_to: [grasp_object]
    when: has(metadata.intent) && metadata.intent == "polish it"
    then: modify
    set: {speed_mps: {max: 0.1}}
    because: Polishing is slow.
"""
TWO_FOR_THE_DRIVER = """
  - id: driver-two-approvers
    applies_to: [grasp_object]
    when: params.object_id == "driver_1"
    then: escalate
    approvers: 2
    because: The driver takes two.
"""
CONFIRMED = """confirm_before:
  - {capability: place_object, profile: human-shared, phases: [release], on_deny: rollback, on_timeout: terminate}
"""
HELD = ("ArrowDown", "ArrowUp", "ArrowLeft", "BracketLeft", "Meta")  # keys that tests hold, and may leave held
THUMB_PX = 48  # what a thumb hits, and how far up from the lower edge it comes easily
REACH_PX = 140
ASIDE_PX = 180  # and how far from the right edge, on a phone that is held sideways
# How a graphics card that is none speaks of itself; nothing of ours.
DRIVER_TALK = re.compile(r"GL Driver Message|GPU stall due to ReadPixels|software WebGL", re.IGNORECASE)


@dataclass
class Person:
    """Somebody at a console: a browser of their own, and what its page complained of."""

    page: Page
    expected: list[re.Pattern[str]] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
    heard: list[tuple[Any, Callable[[Any], object]]] = field(default_factory=list)

    def expects(self, complaint: str) -> None:
        self.expected.append(re.compile(complaint))

    def unexpected(self) -> list[str]:
        return [one for one in self.complaints if not any(known.search(one) for known in self.expected)]

    def press(self, key: str) -> None:
        self.page.keyboard.press(key)

    def enter(self, button: Locator) -> None:
        """Press what has the focus; what has just come takes no press yet."""
        expect(button).to_be_focused()
        expect(button).to_be_enabled()
        self.press("Enter")

    def tap(self, button: Locator) -> None:
        """Bring a button into sight, and tap it when it takes a press: out of sight none does that has just come."""
        button.scroll_into_view_if_needed()
        button.tap()

    def sends(self, path: str, button: Locator) -> Any:
        """Tap as people do, until a request goes to `path`; returns its body.

        What the page moves takes no finger for a moment, and one that a busy browser hears late is no tap to it.
        """
        for _ in range(TAPS):
            try:
                with self.page.expect_request(path, timeout=TAKEN_MS) as sent:
                    self.tap(button)
            except TimeoutError:
                continue
            return sent.value.post_data_json
        pytest.fail(f"{TAPS} taps of {button}, and nothing went to {path}")

    def twice(self, button: Locator, after_ms: int) -> dict[str, float]:
        """Press twice in the same place, whatever stands there by the second time; returns where that was."""
        button.scroll_into_view_if_needed()
        expect(button).to_be_enabled()
        at = box(button)
        x, y = at["x"] + at["width"] / 2, at["y"] + at["height"] / 2
        touches = self.page.evaluate("navigator.maxTouchPoints > 0")
        press = self.page.touchscreen.tap if touches else self.page.mouse.click
        press(x, y)
        self.page.wait_for_timeout(after_ms)
        press(x, y)
        return {"x": x, "y": y}

    def button(self, name: str | re.Pattern[str]) -> Locator:
        return self.page.get_by_role("button", name=name)

    def says_why(self, reason: str = "not needed") -> None:
        """Choose the reason of a denial, which none is sent without."""
        self.page.get_by_label(re.compile("^Reason if")).select_option(label=reason)

    def region(self, name: str) -> Locator:
        return self.page.get_by_role("region", name=name)

    def alert(self, words: str) -> Locator:
        return self.page.get_by_role("alert").filter(has_text=words)

    def listen(self) -> None:
        self.hears("console", self._said)
        self.hears("pageerror", lambda error: self.complaints.append(f"uncaught: {error}"))

    def hears(self, event: Any, act: Callable[[Any], object]) -> None:
        """Act upon each such event of the page, for as long as this person sits at it."""
        self.page.on(event, act)
        self.heard.append((event, act))

    def leave(self) -> None:
        for event, act in self.heard:
            self.page.remove_listener(event, act)
        self.page.unroute_all(behavior="ignoreErrors")

    def _said(self, message: ConsoleMessage) -> None:
        if message.type in {"error", "warning", "assert"} and not DRIVER_TALK.search(message.text):
            self.complaints.append(f"{message.type}: {message.text} ({message.location.get('url', '')})")


@dataclass
class Windows:
    """Browsers that stand open, each for one person after the other: to make one anew costs as much as a page does.

    What somebody leaves behind is gone when the next one comes, as when a browser is opened: the page with its socket
    and its worker, what it stored, what was held down. The process that shows the pages of this server stays.
    """

    browser: Browser
    free: dict[tuple[bool, str], list[Page]] = field(default_factory=lambda: defaultdict(list))
    taken: dict[Page, tuple[bool, str]] = field(default_factory=dict)

    def take(self, size: dict[str, int], theme: Any, init: str) -> Page:
        kind = (size in (PHONE, SIDEWAYS), init)
        page = self.free[kind].pop() if self.free[kind] else self._open(*kind)
        page.set_viewport_size({"width": size["width"], "height": size["height"]})
        page.emulate_media(color_scheme=theme, reduced_motion="reduce", forced_colors="none")
        self.taken[page] = kind
        return page

    def give_back(self, page: Page) -> None:
        """Leave the console for a picture of the same server: from there on nothing of it runs."""
        kind = self.taken.pop(page)
        try:
            page.goto(urlsplit(page.url)._replace(path="/icon.svg", fragment="").geturl(), timeout=TAKEN_MS)
            page.evaluate("sessionStorage.clear(), localStorage.clear()")
            for key in HELD:
                page.keyboard.up(key)
            page.mouse.up()
        except Error:  # its server is no more, or its wire
            page.context.close()
        else:
            self.free[kind].append(page)

    def close(self) -> None:
        for page in (*self.taken, *(one for free in self.free.values() for one in free)):
            page.context.close()

    def _open(self, held: bool, init: str) -> Page:
        context = self.browser.new_context(has_touch=held, is_mobile=held)
        context.set_default_timeout(PATIENCE_MS)
        context.add_init_script(init)
        return context.new_page()


@dataclass
class People:
    """Seats people at consoles; all of them leave with the test."""

    windows: Windows
    seated: list[Person] = field(default_factory=list)

    def open(self, url: str, *, size: dict[str, int] | None = None, theme: str = "dark", init: str = "") -> Person:
        """Open a page in a browser of its own, `size` big, where the system prefers `theme`; `init` runs first."""
        person = Person(self.windows.take(size or DESK, theme, init))
        self.seated.append(person)
        person.listen()
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
            person.leave()
            self.windows.give_back(person.page)
        self.seated.clear()
        return said


STANDS = {"dock": (0.8, 0.8), "bench_a_stand": (1.6, 4.6)}  # as in policies/site.yaml


@dataclass
class Floor:
    """The cell of the shared server as one test has it: what it started there is over when it ends."""

    server: ServerProcess
    made: list[str] = field(default_factory=list)
    latest: dict[str, Any] = field(default_factory=dict)  # what was answered to the last proposal

    def ask(self, object_id: str = "mug_1", **metadata: Any) -> dict[str, Any]:
        """Propose a grasp, which waits for a person."""
        self._reach(object_id)
        return self._propose("awaiting_approval", "grasp_object", metadata, object_id=object_id, force_n=80)

    def grasp_slowly(self) -> dict[str, Any]:
        """Propose a grasp that a standing grant answers for, and that takes a while."""
        self._reach("mug_1")
        return self._propose("running", "grasp_object", {}, object_id="mug_1", speed_mps=0.02)

    def _reach(self, object_id: str) -> None:
        """Have the robot reach a thing: a grasp of what is out of reach would be put off for good."""
        # Where it stands says too little: it reaches what is before it, and whoever drove it may have turned it.
        away = not self.server.facts()["objects"][object_id]["reachable"]
        cell = self.server.cell()
        if away and cell["busy"] is None and not cell["latched"]:
            self.drive(target="bench_a_stand")
            until(lambda: self.server.cell()["busy"] is None, what="a robot that is back at the bench")

    def put_down(self) -> None:
        """Have the gripper empty: what an earlier test let begin may have been cancelled too late to stop it."""
        if self.server.facts()["holding"] is None:
            return
        placed = self._propose("running", "place_object", {}, surface="bench_a")
        self.answer(self.server.await_status(placed["id"], "escalated"), "approve")  # that it lets go
        assert self.server.await_status(placed["id"], "completed")["outcome"] == "succeeded"

    def answer(self, asked: dict[str, Any], decision: str) -> None:
        path = f"/v1/escalations/{asked['escalation']['id']}"
        digest = self.server.get(path)["digest"]
        assert self.server.post(f"{path}/resolve", {"decision": decision, "digest": digest}).is_success

    def drive(self, **params: Any) -> dict[str, Any]:
        """Propose a drive, which begins at once."""
        return self._propose("running", "navigate_to", {}, **params)

    def drive_off(self) -> dict[str, Any]:
        """Propose the longer one of two drives, which takes a while wherever earlier tests have left the robot."""
        at = self.base()
        return self.drive(target=max(STANDS, key=lambda name: math.dist(at, STANDS[name])))

    def settled(self, invocation: str) -> dict[str, Any]:
        return self.server.await_status(invocation, "denied", "running", "completed", "failed")

    def base(self) -> tuple[float, float]:
        x, y, _ = self.server.facts()["base"]
        return x, y

    def speed(self) -> float:
        """Return how fast the base drives, m/s; NaN, which is neither fast nor slow, while the cell says nothing."""
        return self.server.cell()["gauges"].get("base_speed_mps", math.nan)

    def clear(self) -> None:
        until(self.unlatched, what="a cell that no stop latches")
        for invocation in self.made:
            self.server.post(f"/v1/invocations/{invocation}/cancel")
            self.server.await_status(invocation, "denied", "deferred", "completed", "failed")

    def unlatched(self) -> bool:
        if not self.server.cell()["latched"]:
            return True
        # Its answer says what a launch would meet: a busy cell may be late to say that it has heard of the reset.
        return not self.server.post("/v1/cells/workcell-1/reset").json().get("latched", True)

    def _decided(self, body: dict[str, Any]) -> dict[str, Any] | None:
        self.latest = self.server.post("/v1/invocations", body, key="agent").json()
        return None if self.latest["status"] == "deferred" else self.latest

    def _propose(self, status: str, capability: str, metadata: dict[str, Any], **params: Any) -> dict[str, Any]:
        body = {"capability": capability, "params": params, "metadata": metadata}
        # What is deferred may be proposed again: the cell comes to rest, and sees afresh what stands before it.
        try:
            proposed = until(lambda: self._decided(body))
        except pytest.fail.Exception as error:
            raise AssertionError(f"the cell is not free for {body}: {self.latest['admission']}") from error
        assert proposed["status"] == status, proposed["admission"]
        self.made.append(proposed["id"])
        return proposed


@contextmanager
def at_once(path: str, *people: Person) -> Iterator[None]:
    """Hold the requests of each person at the door of their browser until all have sent theirs; then let all go."""
    held: list[Route] = []
    sent: set[int] = set()

    def holding(number: int) -> Callable[[Route], None]:
        def hold(route: Route) -> None:
            held.append(route)
            sent.add(number)  # a page may send more than one

        return hold

    for number, person in enumerate(people):
        person.page.route(path, holding(number))
    yield
    until(lambda: len(sent) == len(people) or people[0].page.wait_for_timeout(20), what=f"all at {path}")
    for route in held:
        route.continue_()
    for person in people:
        person.page.unroute(path)


def stop(person: Person) -> Locator:
    return person.button(re.compile("^Emergency stop: .* workcell-1$"))


def box(button: Locator) -> dict[str, float]:
    found = button.bounding_box()
    assert found is not None
    return dict(found)


def reload_in_hand(person: Person, floor: Floor) -> None:
    """Load a page anew that has the controls; where it took longer than its holder may be silent, take them again."""
    kept, server = person.page.get_by_text(LET_GO), floor.server
    for _ in range(TRIES):
        person.page.reload()
        until(lambda: kept.is_visible() or server.cell()["control"] is None, what="controls that are kept, or gone")
        if server.cell()["control"] is not None:
            return
        expect(person.button("Take over")).to_be_enabled()
        person.press("t")
        person.button("Take the controls").click()
        expect(kept).to_be_visible()
    pytest.fail("no page was loaded within a lease")


def on_top(button: Locator) -> bool:
    """Say whether a finger on the middle of it hits it, and not what covers it or has cut it off."""
    return button.evaluate(
        """(button) => { const {x, y, width, height} = button.getBoundingClientRect();
        return button.contains(document.elementFromPoint(x + width / 2, y + height / 2)); }"""
    )


def out_of_reach(button: Locator) -> list[str]:
    """Say why the stop cannot be pressed with the thumb of the hand that holds the phone."""
    at = box(button)
    screen = button.page.viewport_size
    assert screen is not None
    sideways = screen["width"] > screen["height"]
    wrong = {
        "covered": not on_top(button),
        "too small": min(at["height"], at["width"] / 2) < THUMB_PX,
        "too high up": at["y"] < screen["height"] - REACH_PX,
        "too far aside": sideways and at["x"] < screen["width"] - ASIDE_PX,
        "cut off": at["y"] + at["height"] > screen["height"] or at["x"] + at["width"] > screen["width"],
    }
    return [words for words, so in wrong.items() if so]


def insist(
    person: Person, press: Callable[[], object], release: Callable[[], object], so: Callable[[], bool], what: str
) -> None:
    """Hold something to run until it has run.

    As a person does: let go and pressed anew where the page let go of it, as it does while its link is late, and where
    it asks for that, as the robot wants it while it is still coming to rest.
    """
    idle = person.page.get_by_text("Hold to run; let go to stop")
    asked = person.page.get_by_text("let go of everything, then press again")
    pad = person.page.get_by_role("group", name="Hold to run")
    expect(idle).to_be_visible()  # nothing counts before
    press()

    def done() -> bool:
        if not pad.count():
            pytest.fail(f"the controls went before {what}")
        if idle.is_visible() or asked.is_visible():
            release()
            expect(asked).to_be_hidden()
            press()
        return so()

    until(done, what=what)


def far(here: tuple[float, float], there: tuple[float, float]) -> float:
    return abs(here[0] - there[0]) + abs(here[1] - there[1])


def resize(person: Person, size: dict[str, int]) -> None:
    """Turn or exchange the screen; returns when the page is laid out for it."""
    person.page.set_viewport_size({"width": size["width"], "height": size["height"]})
    person.page.evaluate(THREE_FRAMES)


def slide(person: Person, start: tuple[float, float], end: tuple[float, float], steps: int = 12) -> None:
    """Put a finger down, draw it along, and lift it."""
    finger = person.page.context.new_cdp_session(person.page)
    for step in range(steps + 1):
        x, y = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
        kind = "touchMove" if step else "touchStart"
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y}]})
        person.page.wait_for_timeout(16)
    finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    finger.detach()


def wider_than_the_screen(page: Page) -> list[str]:
    """Say where a page has to be scrolled sideways: on a phone, however it is held, and on 320 px (WCAG 1.4.10)."""
    before = page.viewport_size
    assert before is not None
    found: list[str] = []
    for screen in (NARROWEST, MAGNIFIED, PHONE, SIDEWAYS, SIDEWAYS_SMALL):
        page.set_viewport_size({"width": screen["width"], "height": screen["height"]})
        page.evaluate(THREE_FRAMES)
        for part in ("html", "main"):
            width, room = page.locator(part).evaluate("(one) => [one.scrollWidth, one.clientWidth]")
            found += [f"{part}: {width} px in {room} on {screen['width']}"] if width > room else []
    page.set_viewport_size(before)
    return found


def chromium() -> str:
    """Return where Chromium is; a machine without one is told what it lacks."""
    found = next((place for name in (SHELL, *PLACES) if (place := shutil.which(name))), None)
    if found is None:
        pytest.fail(
            "the console's tests drive Chromium; it is missing (Debian: apt-get install chromium)", pytrace=False
        )
    return found


@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    """Ended with the package, for Playwright keeps an event loop running in this thread."""
    with sync_playwright() as made:
        yield made


def before_what_computes(driven: Browser) -> None:
    """Give a browser its turns before the tests that only compute, but not before servers and cells."""
    session = driven.new_browser_cdp_session()
    for process in session.send("SystemInfo.getProcessInfo")["processInfo"]:
        if process["type"] == "browser":  # the others are of its session
            put_first(process["id"], BEFORE_OTHERS // 2)
    session.detach()


@pytest.fixture(scope="package")
def browser(playwright: Playwright) -> Iterator[Browser]:
    """Chromium, headless."""
    with playwright.chromium.launch(executable_path=chromium(), args=list(FLAGS)) as driven:
        before_what_computes(driven)
        yield driven


@pytest.fixture(scope="package")
def flat_browser(playwright: Playwright) -> Iterator[Browser]:
    """Chromium as on a machine that draws no 3D: the console says so, and everything else works."""
    with playwright.chromium.launch(executable_path=chromium(), args=[*FLAGS, "--disable-3d-apis"]) as driven:
        before_what_computes(driven)
        yield driven


@pytest.fixture(scope="session", autouse=True)
def built() -> None:
    """The console as it stands in `web/`: built anew only if it changed."""
    done = subprocess.run([sys.executable, str(ROOT / "web" / "build.py"), "build"], capture_output=True, text=True)
    assert done.returncode == 0, f"the console does not build: {done.stdout[-2000:]}{done.stderr[-2000:]}"


@pytest.fixture(scope="module")
def windows(browser: Browser) -> Iterator[Windows]:
    """Ended with the module: pages of another server are another process's."""
    made = Windows(browser)
    yield made
    made.close()


@pytest.fixture(scope="module")
def flat_windows(flat_browser: Browser) -> Iterator[Windows]:
    made = Windows(flat_browser)
    yield made
    made.close()


@pytest.fixture
def people(request: pytest.FixtureRequest) -> Iterator[People]:
    """Who sits down at a console; they have left before the floor is cleared, so no page says a stop once more then."""
    if "floor" in request.fixturenames:
        request.getfixturevalue("floor")
    drawn = request.node.get_closest_marker("drawn") is not None
    made = People(request.getfixturevalue("windows" if drawn else "flat_windows"))
    yield made
    assert made.leave() == []


@pytest.fixture(scope="session")
def console_ahead(
    request: pytest.FixtureRequest, built: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Ahead]:
    def begin() -> Servers:
        folder = tmp_path_factory.mktemp("console")
        shutil.copytree(ROOT / "policies", folder / "policies")
        restricted = folder / "policies" / "profiles" / "real-restricted.yaml"
        shipped = restricted.read_text()
        restricted.write_text(shipped.replace("within_s: 300", "within_s: 3"))
        assert restricted.read_text() != shipped
        authority = folder / "policies" / "authority.yaml"
        unconfirmed = authority.read_text()
        authority.write_text(re.sub(r"^confirm_before: \[\].*\n", CONFIRMED, unconfirmed, flags=re.MULTILINE))
        assert authority.read_text() != unconfirmed
        grasp = folder / "policies" / "capabilities" / "grasp_object.yaml"
        bounded = grasp.read_text()
        grasp.write_text(bounded.replace("maximum: 140,", "maximum: 140, allOf: [{maximum: 140}],"))
        assert grasp.read_text() != bounded
        with (folder / "policies" / "organization.yaml").open("a") as rules:
            rules.write(TWO_FOR_THE_DRIVER + SLOW_TO_POLISH)
        made = Servers(folder)
        made.begin(None, "--pace", "1", "--policies", str(folder / "policies"))
        return made

    made = Ahead(request, begin)
    yield made
    made.end()


@pytest.fixture(scope="module")
def server(console_ahead: Ahead) -> Iterator[ServerProcess]:
    """One server with one cell in real time, where people share the floor; a module's tests have it in turn.

    Its policy is the shipped one, but that whoever is asked under `real-restricted` has three seconds to answer, that
    grasping the driver takes two people, that a person confirms before something is let go, that whoever
    means to polish grasps slowly, and that the bound of a grasp's force stands in its manifest twice.
    """
    with console_ahead.take() as server:
        yield server


@pytest.fixture
def floor(server: ServerProcess) -> Iterator[Floor]:
    made = Floor(server)
    made.put_down()
    yield made
    made.clear()


@pytest.fixture
def free_again(server: ServerProcess) -> Iterator[None]:
    """Nobody keeps the controls for the next test."""
    yield
    control = server.cell()["control"]
    if control is not None:
        server.post(f"/v1/invocations/{control['invocation']}/release", {"then": "end"})
    until(lambda: server.cell()["control"] is None and server.cell()["busy"] is None, what="controls that are free")
