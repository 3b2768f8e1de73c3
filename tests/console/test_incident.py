"""An incident: five questions at once, on two cells. Nothing is lost, nothing shouts, nothing moves under a finger."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from playwright.sync_api import Locator, Route, expect

from tests.conftest import ServerProcess, Servers, put_in_profile, until
from tests.console.conftest import (
    ANSWERS,
    DESK,
    PHONE,
    PRESS_ONCE_MOVED,
    THREE_FRAMES,
    People,
    Person,
    box,
    out_of_reach,
    stop,
    wider_than_the_screen,
)
from tests.console.test_access import AXE, faults, overlap

# Nothing is said on the socket but what is read there: a stop goes over HTTP alone.
UNSAID = """(() => {
    const post = Worker.prototype.postMessage;
    Worker.prototype.postMessage = function (said, ...more) {
        if (!JSON.stringify(said).includes('"estop"')) post.call(this, said, ...more);
    };
})()"""

# How many tones the page has let sound: three are an alarm. A machine that plays none takes its time to say so.
TONES = """(() => {
    window.tones = 0;
    Object.defineProperty(AudioContext.prototype, 'state', { get: () => 'running' });
    const make = AudioContext.prototype.createOscillator;
    AudioContext.prototype.createOscillator = function () { window.tones += 1; return make.call(this); };
})()"""

pytestmark = [pytest.mark.browser, pytest.mark.process]
FIRST = "Grasp mug_1"
# In the order of urgency, which is not the one they come in: the risk counts before the deadline.
REST = ("Pull down at the lever", "Press at the press", "Grasp glass_1", "Grasp driver_1")
GOAL = "fetch mug_1 and deliver it to bench_b"
ASKED: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("workcell-1", "grasp_object", {"object_id": "mug_1", "force_n": 80}),
    ("workcell-1", "grasp_object", {"object_id": "glass_1"}),
    ("workcell-2", "operate_tool", {"tool": "lever", "action": "pull_down"}),
    ("workcell-1", "grasp_object", {"object_id": "driver_1"}),
    ("workcell-2", "operate_tool", {"tool": "press", "action": "press"}),
)
# Every text that a screen reader is made to say at once, in order.
LISTEN = """() => {
    window.heard = [];
    const alert = [...document.querySelectorAll('[role=alert]')].find((one) => one.classList.contains('hidden'));
    new MutationObserver(() => window.heard.push(alert.textContent)).observe(
        alert, { childList: true, characterData: true, subtree: true });
}"""


def cells_of(server: ServerProcess) -> list[dict[str, Any]]:
    return server.get("/v1/cells")["items"]


@dataclass
class Incident:
    """Two cells, the second before the tools, and what is asked of them."""

    server: ServerProcess
    made: list[str] = field(default_factory=list)

    def begin(self, person: Person) -> None:
        """Ask the first, and the rest when somebody has it before them: what is open stays open."""
        for cell, capability, params in ASKED:
            proposed = self.server.launch(capability, cell, metadata={"intent": GOAL}, **params)
            assert proposed["status"] == "awaiting_approval", proposed["admission"]
            self.made.append(proposed["id"])
            if len(self.made) == 1:
                expect(cards(person)).to_have_accessible_name(FIRST)

    def ask(self, cell: str, capability: str, **params: Any) -> str:
        proposed = self.server.launch(capability, cell, **params)
        assert proposed["status"] == "awaiting_approval", proposed["admission"]
        self.made.append(proposed["id"])
        return proposed["id"]

    def drive(self, cell: str, **params: Any) -> None:
        proposed = self.server.launch("navigate_to", cell, **params)
        assert proposed["status"] == "running", proposed["admission"]
        self.made.append(proposed["id"])

    def clear(self) -> None:
        for invocation in self.made:
            self.server.post(f"/v1/invocations/{invocation}/cancel")
            self.server.await_status(invocation, "denied", "failed", "completed")


@pytest.fixture(scope="module")
def server(built: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    made = Servers(tmp_path_factory.mktemp("incident"))
    try:
        found = made.start(None, "--pace", "1", cells=2)
        until(
            lambda: all(cell["online"] for cell in cells_of(found)) and len(cells_of(found)) == 2,
            what="two cells online",
        )
        put_in_profile(found, "sim-relaxed", "workcell-2")  # for the way: five times as fast as where people are
        drive = found.launch("navigate_to", "workcell-2", target="tool_stand", speed_mps=1.5)
        assert found.await_status(drive["id"], "completed", "failed")["outcome"] == "succeeded"
        put_in_profile(found, "human-shared", "workcell-2")
        yield found
    finally:
        made.end()


@pytest.fixture
def incident(server: ServerProcess) -> Iterator[Incident]:
    made = Incident(server)
    yield made
    made.clear()


def cards(person: Person) -> Locator:
    return person.region("Waiting for you").get_by_role("article")


def rows(person: Person) -> Locator:
    return person.region("Waiting for you").locator("button.row")


def deny(person: Person) -> Locator:
    return person.button(re.compile("^Deny"))


def test_five_at_once_are_sorted_counted_and_told_in_two_sentences_and_what_waits_for_another_person_makes_room(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server)
    person.page.evaluate(LISTEN)
    incident.begin(person)
    expect(rows(person)).to_have_count(4)
    expect(cards(person)).to_have_accessible_name(FIRST)
    expect(rows(person)).to_have_text([re.compile(rf"^\s*{title}.*[12]:\d\d\s*$", re.DOTALL) for title in REST])
    expect(rows(person).first).to_contain_text("workcell-2")
    expect(deny(person)).to_be_focused()
    expect(cards(person)).to_contain_text(f"planner says: “{GOAL}”")
    for row in rows(person).all():
        expect(row).to_be_in_viewport(ratio=1)
    heard = until(
        lambda: (len(said := person.page.evaluate("window.heard")) > 1 and said) or person.page.wait_for_timeout(20),
        what="a second sentence",
    )
    assert heard == [
        f"Waiting for you: {FIRST} in workcell-1, medium risk.",
        f"4 new questions, 5 wait for you. Most urgent of the new: {REST[0]} in workcell-2, high risk.",
    ]
    rows(person).filter(has_text=REST[1]).click()
    expect(cards(person)).to_have_accessible_name(REST[1])
    yes = person.button(re.compile("^Approve"))
    expect(yes).to_be_enabled()
    person.press("a")
    expect(cards(person)).to_have_accessible_name(REST[0])
    expect(deny(person)).to_be_focused()
    expect(person.region("Waiting for you").locator(".count")).to_have_text("4")
    expect(rows(person).last).to_contain_text("1 of 2 approved by you")


@pytest.mark.drawn
def test_of_two_cells_each_part_of_the_page_names_its_own(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server)
    incident.drive("workcell-1", target="bench_a_stand")
    incident.ask("workcell-2", "operate_tool", tool="lever", action="pull_down")
    session = person.region("Session")
    expect(cards(person)).to_contain_text("Picture, session and stages on this page are of workcell-1, another cell")
    expect(deny(person)).to_have_accessible_description("planner · workcell-2")  # what is asked may be the same in both
    expect(session).to_contain_text(re.compile(r"workcell-1\s·\sinv_"))
    expect(session).to_contain_text("The question that is open is about workcell-2, another cell.")
    stages = person.page.get_by_role("list", name="The seven stages of the session in workcell-1")
    expect(stages.locator("..")).to_contain_text(re.compile(r"workcell-1\s· Drive to"))
    person.button("Show workcell-2").click()
    expect(cards(person)).not_to_contain_text("another cell")
    expect(session).to_contain_text(re.compile(r"workcell-2\s·\sinv_"))
    expect(session).not_to_contain_text("another cell")
    expect(person.page.get_by_role("list", name="The seven stages of the session in workcell-2")).to_be_visible()


def test_an_incident_is_worked_off_by_keyboard_the_gravest_first(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server)
    incident.begin(person)
    expect(rows(person)).to_have_count(4)
    expect(person.button(f"2 more urgent (open {REST[0]} in workcell-2)")).to_be_visible()
    person.press("x")
    expect(cards(person)).to_have_accessible_name(REST[2])  # the next below; round at the end to the gravest
    person.press("x")
    person.press("x")
    for left, title in ((4, REST[0]), (3, REST[1])):
        expect(cards(person)).to_have_accessible_name(title)
        expect(rows(person)).to_have_count(left)
        expect(deny(person)).to_be_focused()
        person.press("Enter")
        expect(cards(person).get_by_label("Reason if denied")).to_be_focused()
        for key in ("ArrowDown", "Home", "ArrowDown", "Enter"):  # the first one opens the list
            person.press(key)
        person.press("d")
    expect(rows(person)).to_have_count(2)
    denied = [server.get(f"/v1/invocations/{id}")["status"] for id in incident.made]
    assert denied == ["awaiting_approval", "awaiting_approval", "denied", "awaiting_approval", "denied"]


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_axe_finds_nothing_where_several_wait_in_two_cells(
    server: ServerProcess, people: People, incident: Incident, size: dict[str, int]
) -> None:
    person, axe, found = people.sit(server, size=size), AXE.read_text(), dict[str, list[str]]()
    incident.begin(person)
    expect(rows(person)).to_have_count(4)
    expect(stop(person)).to_contain_text("workcell-1")
    expect(person.button(f"2 more urgent (open {REST[0]} in workcell-2)")).to_be_visible()
    found["more urgent"] = faults(person.page, axe)
    person.press("x")
    person.press("x")
    person.press("x")
    expect(cards(person)).to_have_accessible_name(REST[0])
    if size == PHONE:  # the bar's answers are another cell's than its stop
        expect(person.page.locator("footer .docked")).to_have_text(re.compile(rf"^{REST[0]}\s*workcell-2\s*\d:\d\d$"))
    expect(person.button(re.compile(rf"^next in .* \(open {FIRST} in workcell-1\)$"))).to_be_visible()
    found["next"] = faults(person.page, axe)
    person.page.evaluate("location.hash = '#/fleet'")
    expect(person.page.get_by_role("heading", name="workcell-2")).to_be_visible()
    found["fleet"] = faults(person.page, axe)
    expect(person.region("workcell-2")).to_contain_text(re.compile(r"2 questions, \d:\d\d"))
    expect(person.page.get_by_role("link", name=re.compile("5 questions"))).to_be_in_viewport(ratio=1)
    expect(person.page).to_have_title(re.compile(r"^\(5, \d:\d\d\) Reins console$"))
    person.press("x")
    expect(cards(person)).to_be_visible()
    assert {name: what for name, what in found.items() if what} == {}


def test_a_stop_from_the_fleet_page_that_is_not_confirmed_is_told_on_every_page_until_it_is_and_then_as_another_cells(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server, init=f"{UNSAID}; {TONES}")
    person.expects("ERR_FAILED|ERR_INTERNET_DISCONNECTED")
    said = person.alert("The stop of workcell-2 is not confirmed.")
    door = "**/v1/cells/workcell-2/estop"
    person.page.route(door, lambda route: route.abort())
    person.press("4")
    card = person.region("workcell-2")
    card.get_by_role("button", name="Emergency stop of workcell-2").click()
    expect(said).to_be_visible()
    expect(card).to_contain_text("Not confirmed. Use the emergency stop at the cell.")
    expect(person.region("workcell-1")).not_to_contain_text("Not confirmed.")
    assert not cells_of(server)[1]["latched"]
    person.press("1")
    expect(person.region("The cell in 3D")).to_be_visible()
    width = box(person.page.get_by_label("Cell", exact=True))["width"]
    expect(said).to_be_visible()
    expect(stop(person)).to_have_accessible_name("Emergency stop: stop workcell-1")  # which is not what failed
    person.page.unroute(door)
    expect(said).to_have_count(0)
    assert cells_of(server)[1]["latched"]
    assert not cells_of(server)[0]["latched"]
    latched = person.alert(
        "Emergency stop: workcell-2 is latched, another cell than STOP is for. Pressed by operator at"
    )
    expect(latched).to_be_visible()
    assert box(person.page.get_by_label("Cell", exact=True))["width"] == width
    assert person.page.evaluate("window.tones") == 3
    expect(stop(person)).to_have_accessible_name("Emergency stop: stop workcell-1")
    latched.get_by_role("link", name="See it on Fleet").click()
    expect(card.get_by_role("button", name="Reset…")).to_be_visible()
    expect(latched).to_have_count(0)  # its card tells of it there
    person.press("2")
    latched.get_by_role("button", name="Understood").click()
    expect(latched).to_have_count(0)
    for again in range(2):
        assert server.post("/v1/cells/workcell-2/reset").is_success
        expect(latched).to_have_count(0)
        if not again:
            assert server.post("/v1/cells/workcell-2/estop").is_success
            expect(latched).to_be_visible()  # a new one is news


def test_a_banner_on_a_stop_leads_to_the_card_of_its_cell_however_far_down_that_stands(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server, size=PHONE)
    person.press("4")
    expect(
        person.page.get_by_role("heading", name="workcell-2")
    ).to_be_visible()  # the page is there at once from now on
    person.press("1")
    assert server.post("/v1/cells/workcell-2/estop").is_success
    person.tap(person.page.get_by_role("link", name="See it on Fleet"))
    expect(person.page.get_by_role("heading", name="workcell-1")).not_to_be_in_viewport()
    expect(person.page.get_by_role("heading", name="workcell-2")).to_be_in_viewport()
    assert server.post("/v1/cells/workcell-2/reset").is_success


def test_what_became_of_one_answer_is_put_away_by_a_double_press_and_of_the_other_it_is_still_told(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server)
    for thing in ("mug_1", "glass_1"):
        incident.ask("workcell-1", "grasp_object", object_id=thing)
    for _ in range(2):
        expect(deny(person)).to_be_enabled()
        cards(person).get_by_label("Grip force you approve").fill("11")
        person.page.locator("body").click(position={"x": 1, "y": 1})
        person.press("x")
    incident.clear()
    told = person.alert("your edit was not sent")
    expect(told).to_have_count(2)
    kept = told.last.text_content()
    person.twice(told.first.get_by_role("button", name="Understood"), 150)
    expect(told).to_have_count(1)
    expect(told).to_have_text(kept or "")
    told.get_by_role("button", name="Understood").click()
    expect(told).to_have_count(0)


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_who_says_twice_that_one_stop_is_known_to_have_failed_does_not_give_up_the_stop_of_another_cell(
    server: ServerProcess, people: People, size: dict[str, int]
) -> None:
    person = people.sit(server, init=UNSAID, size=size)
    person.expects("ERR_FAILED|ERR_INTERNET_DISCONNECTED")
    door = "**/v1/cells/*/estop"
    person.page.route(door, lambda route: route.abort())
    person.press("4")
    try:
        for cell in ("workcell-1", "workcell-2"):
            person.button(f"Emergency stop of {cell}").click()
        failed = [person.alert(f"The stop of {cell} is not confirmed.") for cell in ("workcell-1", "workcell-2")]
        for one in failed:
            expect(one).to_be_visible()
        person.twice(failed[0].get_by_role("button", name="Understood"), 150)
        expect(failed[0]).to_have_count(0)
        expect(failed[1]).to_be_visible()
        person.page.unroute(door)
        until(lambda: cells_of(server)[1]["latched"], what="a stop that is still sent")
    finally:
        for cell in ("workcell-1", "workcell-2"):
            server.post(f"/v1/cells/{cell}/reset")


def test_a_stop_on_the_fleets_page_stays_where_it_is_when_a_banner_comes_and_the_socket_alone_carries_it(
    server: ServerProcess, people: People
) -> None:
    person = people.sit(server)
    person.expects("ERR_FAILED|ERR_INTERNET_DISCONNECTED")
    person.press("4")
    card = person.region("workcell-2")
    button = card.get_by_role("button", name="Emergency stop of workcell-2")
    expect(button).to_be_visible()
    person.page.wait_for_timeout(600)  # what it says in its first half second scrolls nothing: it is read from its top
    stands = box(button)
    try:
        server.post("/v1/cells/workcell-1/estop", key="operator_2")
        expect(person.page.locator(".banners").get_by_role("button", name="Reset…")).to_be_visible()
        assert box(button)["y"] == pytest.approx(stands["y"], abs=2)
    finally:
        server.post("/v1/cells/workcell-1/reset")
    expect(person.page.locator(".banners").get_by_role("button", name="Reset…")).to_have_count(0)
    assert box(button)["y"] == pytest.approx(stands["y"], abs=2)

    tried: list[str] = []

    def abort(route: Route) -> None:
        tried.append(route.request.url)
        route.abort()

    person.page.route("**/v1/cells/workcell-2/estop", abort)
    button.click()
    expect(card).to_contain_text("Stopped, latched")
    expect(person.alert("The stop of workcell-2 is not confirmed.")).to_have_count(0)
    events = server.get("/v1/audit/events?kind=human&limit=1000")["items"]
    words = [event["body"]["op"] for event in events if event["body"].get("cell") == "workcell-2"]
    assert tried
    assert words[-1] == "estop"
    assert words[-2:] != ["estop", "estop"]  # said again and again, it is one
    assert server.post("/v1/cells/workcell-2/reset").is_success


@pytest.mark.drawn
def test_the_trace_of_another_cell_is_drawn_and_the_stop_stays_where_it_is(
    server: ServerProcess, people: People
) -> None:
    driven = server.get("/v1/invocations?cell=workcell-2&status=completed&limit=100")["items"]
    ended = driven[-1]["id"]  # the one that brought the robot there; what was never launched has no telemetry
    until(lambda: server.get(f"/v1/audit/events?invocation={ended}&kind=telemetry")["items"], what="its telemetry")
    person = people.sit(server)
    person.page.evaluate(f"location.hash = '#/audit/{ended}'")
    replay = person.region("The robot at this moment, from the record")
    picture = replay.locator("canvas")
    expect(picture).to_be_visible()
    expect(replay.locator(".note")).to_have_count(0)
    expect(stop(person)).to_be_enabled()  # of the first cell, still
    moment, shots = person.page.get_by_role("slider", name="Moment of the session"), list[bytes]()
    for end in ("min", "max"):
        moment.evaluate(f"(at) => {{ at.value = at.{end}; at.dispatchEvent(new Event('input', {{bubbles: true}})); }}")
        person.page.evaluate(THREE_FRAMES)
        shots.append(picture.screenshot())
    assert shots[0] != shots[1]
    for name in ("workcell-2", "workcell-1"):  # whichever cell is chosen
        person.page.get_by_label("Cell", exact=True).select_option(name)
        expect(replay.locator(".note")).to_have_count(0)
    person.page.set_viewport_size(PHONE)
    person.page.evaluate(THREE_FRAMES)
    assert not overlap(box(replay.locator(".stamp")), box(replay.locator(".limits")))
    person.page.set_viewport_size(DESK)
    person.press("1")
    expect(person.region("The cell in 3D").locator("canvas")).to_be_visible()
    expect(person.page.get_by_text(re.compile(r"^[1-9]\d* Hz$"))).to_be_visible()
    labels, note = person.page.locator(".live .labels"), person.page.locator(".live .scene .note")
    expect(labels).to_contain_text("robot")
    pid = server.cell_pid("workcell-2")
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    try:
        until(lambda: not server.cell("workcell-2")["online"], what="a cell that is not heard")
        person.page.get_by_label("Cell", exact=True).select_option("workcell-2")
        expect(note).to_have_text("No picture of workcell-2 has come yet.")
        expect(labels).to_be_hidden()  # they are those of the cell that was looked at before
        expect(person.page.locator(".live .session.stale")).to_be_visible()
    finally:
        os.kill(pid, signal.SIGCONT)
    expect(note).to_have_count(0)
    expect(labels).to_contain_text("robot")
    expect(person.page.locator(".live .stale")).to_have_count(0)


def test_in_an_incident_on_a_phone_answers_and_stop_stay_in_reach(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server, size=PHONE)
    incident.begin(person)
    expect(rows(person)).to_have_count(4)
    more = person.button(f"2 more urgent (open {REST[0]} in workcell-2)")
    expect(more).to_be_in_viewport(ratio=1)
    more.tap()
    expect(cards(person)).to_have_accessible_name(REST[0])
    for answer in ANSWERS:
        expect(person.button(re.compile(answer))).to_be_in_viewport(ratio=1)
    assert out_of_reach(stop(person)) == []
    assert wider_than_the_screen(person.page) == []
    expect(cards(person)).to_contain_text("workcell-2")
    show = person.button("Show workcell-2")
    expect(
        show.locator("css=:scope:not([data-arming])")
    ).to_be_visible()  # it takes no finger just after the page moved
    show.tap()
    expect(person.button("Emergency stop: stop workcell-2")).to_be_visible()
    deny(person).tap()
    expect(cards(person).get_by_label("Reason if denied")).to_be_focused()
    expect(cards(person).get_by_label("Reason if denied")).to_be_in_viewport(ratio=1)
    person.says_why()
    deny(person).tap()
    expect(rows(person)).to_have_count(3)
    expect(cards(person)).to_have_accessible_name(REST[1])


def test_on_a_phone_whoever_listens_hears_at_the_answers_which_question_they_are_for(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server, size=PHONE)
    incident.ask("workcell-2", "operate_tool", tool="lever", action="pull_down")
    expect(person.page.get_by_role("group", name=REST[0]).get_by_role("button", name="Deny")).to_be_focused()
    incident.ask("workcell-2", "operate_tool", tool="press", action="press")
    expect(rows(person)).to_have_count(1)
    person.press("x")
    expect(person.page.get_by_role("group", name=REST[1]).get_by_role("button", name="Deny")).to_be_focused()


@pytest.mark.usefixtures("free_again")
def test_on_a_phone_a_question_that_comes_or_goes_moves_no_pause_and_no_pad_and_the_stop_names_its_cell(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server, size=PHONE)
    incident.drive("workcell-1", target="dock")
    pause = person.button("Pause")
    expect(pause).to_be_enabled()
    expect(person.button("Roll back")).to_be_visible()  # which comes with what the cell says first, and takes a third
    stands = box(pause)
    incident.ask("workcell-2", "operate_tool", tool="press", action="press")
    expect(deny(person)).to_be_visible()
    assert box(pause) == stands
    answer, named = box(deny(person)), box(person.page.locator("footer .docked"))
    assert named["y"] + named["height"] <= answer["y"]
    assert answer["y"] + answer["height"] <= stands["y"]
    assert stands["y"] + stands["height"] <= box(stop(person))["y"]
    pause.tap()
    server.await_status(incident.made[0], "paused")
    expect(stop(person)).to_contain_text("workcell-1")
    assert out_of_reach(stop(person)) == []
    assert wider_than_the_screen(person.page) == []
    incident.clear()
    expect(deny(person)).to_have_count(0)

    person.button("Drive").tap()
    person.button("Take the controls").tap()
    expect(person.page.get_by_text("Hold to run; let go to stop")).to_be_visible()
    pads = person.region("Drive by hand").get_by_role("button")
    stand = [box(button) for button in pads.all()]
    top = person.page.evaluate("document.querySelector('#page').scrollTop")
    assert len(stand) > 12  # the ways of base and tool, and what else stands there
    proposed = incident.ask("workcell-2", "operate_tool", tool="press", action="press")
    badge = person.button(re.compile("^Menu *, *1 *question waits"))
    expect(badge).to_be_visible()
    assert [box(button) for button in pads.all()] == stand
    expect(person.page.locator("footer .choice")).to_have_count(0)
    badge.tap()
    person.page.get_by_role("navigation").get_by_role("button", name="1 question").tap()
    expect(deny(person)).to_be_in_viewport()
    server.post(f"/v1/invocations/{proposed}/cancel")
    expect(badge).to_have_count(0)
    person.page.evaluate("(top) => { document.querySelector('#page').scrollTop = top; }", top)
    assert [box(button) for button in pads.all()] == stand


@pytest.mark.usefixtures("free_again")
def test_a_banner_that_moves_the_answers_keeps_fingers_off_them_for_a_moment(
    server: ServerProcess, people: People, incident: Incident
) -> None:
    person = people.sit(server)
    asked = incident.ask("workcell-2", "operate_tool", tool="press", action="press")
    approve = person.button(re.compile("^Approve"))
    expect(approve).to_be_enabled()
    escalation = f"/v1/escalations/{server.get(f'/v1/invocations/{asked}')['escalation']['id']}"
    seen = person.button("I have seen it")
    seen.evaluate(PRESS_ONCE_MOVED)
    approve.evaluate(PRESS_ONCE_MOVED)
    assert server.post("/v1/cells/workcell-1/takeover", key="operator_2").is_success
    # Asked anew each time: what a page would have to evaluate by itself, its policy (unsafe-eval) forbids.
    assert until(lambda: person.page.evaluate("window.pressed"), what="a press").startswith("Approve")
    expect(approve).to_be_enabled()
    assert server.get(escalation)["approvals"] == []
    assert server.get(escalation)["acknowledged"] == []
    seen.click()
    until(lambda: server.get(escalation)["acknowledged"] != [], what="somebody who has seen it")
    approve.click()
    until(lambda: server.get(escalation)["approvals"] != [], what="an approval")
