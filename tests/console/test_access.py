"""Who can use the console: axe finds nothing on any page, and on a phone the stop lies under the thumb."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Locator, Page, expect

from app.api.pages import FOLDER, WORKER, read_pages
from tests.conftest import ServerProcess, until
from tests.console.conftest import (
    ANSWERS,
    DESK,
    DESK_SMALL,
    PHONE,
    ROOT,
    SIDEWAYS,
    SIDEWAYS_SMALL,
    THUMB_PX,
    Floor,
    People,
    Person,
    box,
    out_of_reach,
    resize,
    stop,
    wider_than_the_screen,
)
from tests.console.test_link import BROKEN
from tests.console.wire import wire_to

pytestmark = [pytest.mark.browser, pytest.mark.process]
MANY = 5_000  # events of one trace
AXE = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"
# In the other theme nothing but colours differs: two of a hundred rules look at them, and take half of the time.
EVERYTHING = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
COLOURS = ["color-contrast", "link-in-text-block"]
FIND = """async ([runOnly, off]) => {
    const rules = Object.fromEntries(off.map((rule) => [rule, { enabled: false }]));
    const { violations } = await axe.run(document, { runOnly, rules, resultTypes: ['violations'] });
    return violations.map(({id, nodes}) => id + ': ' + nodes.map((node) => node.html.slice(0, 160)).join(' | '));
}"""


@pytest.fixture(scope="module")
def axe() -> str:
    return AXE.read_text()


def faults(page: Page, axe: str, rules: list[str] = EVERYTHING, *, off: Sequence[str] = ()) -> list[str]:
    if not page.evaluate("'axe' in window"):
        page.evaluate(axe)
    return page.evaluate(FIND, [rules, list(off)])


@pytest.fixture
def trace(server: ServerProcess, floor: Floor) -> str:
    """A question that was answered: a trace without telemetry is one, too."""
    asked = floor.ask()
    floor.answer(asked, "deny")
    return asked["id"]


def overlap(one: dict[str, float], other: dict[str, float]) -> bool:
    """Say whether two boxes have a point in common."""
    return all(
        one[at] < other[at] + other[long] and other[at] < one[at] + one[long]
        for at, long in (("x", "width"), ("y", "height"))
    )


def views(person: Person, floor: Floor, trace: str) -> Iterator[str]:
    """Lead a person through everything that can be on screen, one view after the other."""
    page = person.page
    floor.ask()
    expect(page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    yield "Live, asked"
    page.evaluate("location.hash = '#/audit'")
    page.get_by_role("searchbox", name="Search the record").fill("mug_1 authority")
    page.get_by_role("button", name="Search", exact=True).click()
    expect(person.region("Find").get_by_role("mark").first).to_be_visible()
    yield "Audit"
    person.button("Events").click()
    expect(person.button("Newest first: turn round")).to_be_visible()
    page.evaluate(f"location.hash = '#/audit/{trace}'")
    expect(page.get_by_role("heading", name="Grasp mug_1")).to_be_visible()
    yield "Audit, a trace"
    page.evaluate("location.hash = '#/policy'")
    expect(page.get_by_role("table").first).to_be_visible()
    yield "Policy"
    page.evaluate("location.hash = '#/fleet'")
    expect(page.get_by_role("heading", name="Fleet")).to_be_visible()
    yield "Fleet"
    page.evaluate("location.hash = '#/live'")
    person.press("t")
    person.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible()
    yield "Live, with its panels"


def change_theme(person: Person, there: str) -> None:
    person.press("n")
    assert person.page.evaluate("document.documentElement.dataset.theme") == there


@pytest.mark.parametrize("sizes", [(DESK, DESK_SMALL), (PHONE, SIDEWAYS)], ids=["desk", "phone"])
@pytest.mark.drawn
def test_axe_finds_nothing_on_any_page_in_dark_and_light(
    server: ServerProcess, people: People, floor: Floor, axe: str, trace: str, sizes: tuple[dict[str, int], ...]
) -> None:
    found: dict[str, list[str]] = {}
    person = people.sit(server, size=sizes[0])
    for name in views(person, floor, trace):
        change_theme(person, "light")
        found[f"{name}, light"] = faults(person.page, axe, COLOURS)
        change_theme(person, "dark")  # the key leads there and back
        for size in reversed(sizes):
            resize(person, size)
            # No letter of a large desk is smaller, or of another colour, than on a small one.
            found[f"{name}, {size}"] = faults(person.page, axe, off=COLOURS if size == DESK else ())
            if PHONE in sizes:
                found[f"{name}, stop, {size}"] = out_of_reach(stop(person))
        if PHONE in sizes:
            found[f"{name}, width"] = wider_than_the_screen(person.page)
    assert {name: what for name, what in found.items() if what} == {}


def long_trace(server: ServerProcess, trace: str, count: int) -> dict[str, Any]:
    """Return a trace with many events behind its own, as a session has them whose people come and go for hours."""
    found = server.get(f"/v1/invocations/{trace}/trace")
    last = found["items"][-1]
    began = datetime.fromisoformat(last["at"])
    for k in range(1, count - len(found["items"]) + 1):
        body = {"signal": "WARNING", "rule": "separation_m", "value": 0.5, "threshold": 0.6, "tick": 4 * k}
        at = (began + timedelta(seconds=0.04 * k)).isoformat()
        found["items"].append(last | {"seq": last["seq"] + k, "at": at, "kind": "alert", "body": body})
    return found


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_of_a_trace_of_thousands_what_is_in_sight_is_drawn_and_all_can_be_gone_through(
    server: ServerProcess, people: People, axe: str, trace: str, size: dict[str, int]
) -> None:
    whole = long_trace(server, trace, MANY)
    person = people.sit(server, size=size)
    person.page.route(f"**/v1/invocations/{trace}/trace", lambda route: route.fulfill(json=whole))
    person.page.evaluate(f"location.hash = '#/audit/{trace}'")
    events = person.region("Events of the session")
    listed, drawn = events.get_by_role("listitem"), events.locator("svg")
    expect(events).to_contain_text(f"of {MANY}")
    assert listed.count() == MANY
    current, rows = events.locator("[aria-current=step]"), events.get_by_role("list")
    moment = person.page.get_by_role("slider", name="Moment of the session")
    events.get_by_role("heading").scroll_into_view_if_needed()
    for share in (0.5, 1, 0.02):
        moment.evaluate(
            """(range, share) => { range.value = share * range.max;
            range.dispatchEvent(new Event('input', {bubbles: true})); }""",
            share,
        )
        expect(current.locator("svg")).to_have_count(1)
        until(lambda: within(current, rows) or person.page.wait_for_timeout(20), what="the event of that moment")
        assert drawn.count() < MANY / 10
    current.focus()
    for _ in range(60):
        person.press("Tab")
    focused = events.locator("button:focus")
    expect(focused.locator("svg")).to_have_count(1)
    assert within(focused, rows)
    at = focused.inner_text()
    person.press("Enter")
    expect(current).to_be_focused()
    assert current.inner_text() == at
    assert faults(person.page, axe) == []


def within(row: Locator, rows: Locator) -> bool:
    (inner, outer) = (box(row), box(rows))
    return outer["y"] <= inner["y"] and inner["y"] + inner["height"] <= outer["y"] + outer["height"]


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.drawn
def test_axe_finds_nothing_on_what_is_greyed_out(
    server: ServerProcess, people: People, floor: Floor, axe: str, size: dict[str, int]
) -> None:
    floor.ask()
    floor.ask("glass_1")
    with wire_to(urlsplit(server.url).port or 0) as wire:
        person = people.sit(server, size=size, at=f"http://127.0.0.1:{wire.port}")
        person.expects(BROKEN)
        expect(person.button(re.compile("^(next|lapses) in"))).to_be_visible()
        expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
        person.page.evaluate("location.hash = '#/policy'")
        expect(person.page.get_by_role("table").first).to_be_visible()
        person.page.evaluate("location.hash = '#/live'")
        wire.cut()
        expect(person.alert("Link down.")).to_be_visible()
        expect(person.page.locator(".live .stale").first).to_be_visible()
        for part in ("h2", ".count", ".next"):
            expect(person.page.locator(f".waiting > header > {part}")).to_have_class(re.compile(r"\bstale\b"))
        found: dict[str, list[str]] = {}
        change_theme(person, "light")
        found["light"] = faults(person.page, axe, COLOURS)
        change_theme(person, "dark")
        found["dark"] = faults(person.page, axe)
        person.page.evaluate("location.hash = '#/policy'")
        expect(person.page.locator("#page .policy.stale")).to_be_visible()
        found["policy"] = faults(person.page, axe)
    assert found == {"light": [], "dark": [], "policy": []}


def test_axe_finds_nothing_where_one_signs_in(server: ServerProcess, people: People, axe: str) -> None:
    person = people.open(server.url)
    expect(person.page.get_by_label("Token")).to_be_visible()
    assert faults(person.page, axe) == []
    person.page.emulate_media(color_scheme="light")
    person.page.reload()
    expect(person.page.get_by_label("Token")).to_be_visible()
    assert person.page.evaluate("document.documentElement.dataset.theme") == "light"
    assert faults(person.page, axe, COLOURS) == []


def answers_in_sight(person: Person) -> None:
    for size in (PHONE, SIDEWAYS):
        resize(person, size)
        for answer in ANSWERS:
            button = person.button(re.compile(answer))
            expect(button).to_be_in_viewport(ratio=1)
            assert box(button)["height"] >= THUMB_PX


def test_on_a_phone_nothing_is_covered_while_one_is_asked_and_while_one_drives_and_the_stop_is_pressed_by_touch(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    asked = floor.ask()
    answers_in_sight(person)
    card = person.page.get_by_role("article", name="Grasp mug_1")
    for size in (SIDEWAYS, SIDEWAYS_SMALL):
        resize(person, size)
        person.page.evaluate("document.querySelectorAll('*').forEach((one) => one.scrollTo(0, 0))")  # as on arrival
        for shown in (
            card.get_by_role("heading"),
            card.locator(".risk"),
            card.locator(".clock"),
            person.button("Menu"),
        ):
            expect(shown).to_be_in_viewport(ratio=1)
        for part in ("needs approval in", "Grip force", "Reason if denied"):
            row = card.get_by_text(re.compile(part, re.IGNORECASE)).first
            row.scroll_into_view_if_needed()
            for answer in ANSWERS:
                expect(person.button(re.compile(answer))).to_be_in_viewport(ratio=1)
                assert overlap(box(person.button(re.compile(answer))), box(row)) is False
            assert out_of_reach(stop(person)) == []
    floor.answer(asked, "deny")
    expect(card).to_be_hidden()
    person.button("Drive").click()
    person.button("Take the controls").click()
    expect(person.page.get_by_text("Hold to run; let go to stop")).to_be_visible()
    for size in (SIDEWAYS, SIDEWAYS_SMALL):
        resize(person, size)
        for part in (*person.region("Drive by hand").get_by_role("button").all(), person.region("The cell in 3D")):
            expect(part).to_be_in_viewport(ratio=1)
        assert out_of_reach(stop(person)) == []
    person.button("End session").click()
    expect(person.button("Take the controls")).to_be_visible()
    resize(person, PHONE)
    stop(person).tap()
    expect(person.page.get_by_text("Stopped, latched")).to_be_visible()
    assert server.cell()["latched"] is True


def test_no_word_of_the_header_is_cut_where_text_is_spaced_out(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.press("t")
    person.button("Take the controls").click()
    expect(person.page.get_by_text("Hold to run; let go to stop")).to_be_visible()
    # As WCAG 1.4.12 has it.
    person.page.evaluate(
        """() => {
            const spaced = new CSSStyleSheet();
            spaced.replaceSync('* { line-height: 1.5 !important; letter-spacing: .12em !important; '
                + 'word-spacing: .16em !important; } p { margin-bottom: 2em !important; }');
            document.adoptedStyleSheets = [spaced];
        }"""
    )
    for width in (1920, 1561, 1401, 1280, 1241, 800):
        resize(person, {"width": width, "height": 900})
        cut = person.page.locator("header.top dd > span, header.top .stop > span").evaluate_all(
            """(found) => found.filter((one) => one.scrollWidth > one.clientWidth || one.scrollHeight > one.clientHeight
            || one.getBoundingClientRect().height > one.parentElement.clientHeight).map((one) => one.textContent)"""
        )
        assert cut == [], width
    person.button("End session").click()
    expect(person.button("Take the controls")).to_be_visible()


def test_the_script_that_runs_by_itself_is_the_one_that_is_sent_with_a_policy_of_its_own() -> None:
    built = read_pages(FOLDER)
    named = rb"assets/worker-[\w-]+\.js"
    begun = {name.decode() for page in built.values() for name in re.findall(named, page.forms[""])}
    assert begun == {name for name in built if WORKER.fullmatch(name)}
    assert len(begun) == 1


def test_a_browser_that_is_too_old_says_so(server: ServerProcess, people: People) -> None:
    person = people.open(f"{server.url}/#token={server.tokens['operator']}", init="delete AbortSignal.any")
    expect(person.page.get_by_text(re.compile("Firefox 124, Safari 17.4 or a newer one"))).to_be_visible()
    expect(person.page.get_by_role("button")).to_have_count(0)


FIELDS = """() => [...document.querySelectorAll('input, select, textarea')]
    .filter((one) => one.checkVisibility() && parseFloat(getComputedStyle(one).fontSize) < 16)
    .map((one) => one.outerHTML)"""


@pytest.mark.parametrize("size", [PHONE, SIDEWAYS])
def test_no_field_is_so_small_that_an_iphone_enlarges_the_page(
    size: dict[str, int], server: ServerProcess, people: People, floor: Floor
) -> None:
    floor.ask()
    person = people.sit(server, size=size)
    expect(person.page.get_by_label("Grip force you approve")).to_be_visible()
    assert person.page.evaluate(FIELDS) == []
    for view, field in {"audit": "Search the record", "policy": "Stated confidence", "fleet": "Profile"}.items():
        person.page.evaluate(f"location.hash = '#/{view}'")
        expect(person.page.get_by_label(field, exact=True)).to_be_visible()
        assert person.page.evaluate(FIELDS) == []
