"""The cell in 3D: really drawn, and drawn again when the graphics card drops the picture."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Route, expect

from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import DESK, PHONE, THREE_FRAMES, Floor, People, Person, box

pytestmark = [pytest.mark.browser, pytest.mark.process]
# The share of the picture that is not its commonest colour, the empty background; names and buttons make little of it.
DRAWN = """async (encoded) => {
    const bytes = Uint8Array.from(atob(encoded), (letter) => letter.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([bytes], { type: 'image/png' }));
    const pen = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
    pen.drawImage(picture, 0, 0);
    const pixels = new Uint32Array(pen.getImageData(0, 0, picture.width, picture.height).data.buffer);
    const counts = new Map();
    for (const pixel of pixels) counts.set(pixel, (counts.get(pixel) ?? 0) + 1);
    return 1 - Math.max(...counts.values()) / pixels.length;
}"""
# How many of its pixels are as red as what is violated; a person is amber, and a robot grey.
RED = """async (encoded) => {
    const bytes = Uint8Array.from(atob(encoded), (letter) => letter.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([bytes], { type: 'image/png' }));
    const pen = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
    pen.drawImage(picture, 0, 0);
    const { data } = pen.getImageData(0, 0, picture.width, picture.height);
    let found = 0;
    for (let k = 0; k < data.length; k += 4) found += data[k] - data[k + 1] > 90 ? 1 : 0;
    return found;
}"""
RING_PX = 300  # the ring around the robot has some thousand
ABOVE_PX, BELOW_PX = 70, 80  # the words over the picture, and the legend under it, are red as well
# Somebody walks up to the robot while it drives, and stays there.
WALKS_UP = """summary: Somebody walks up to the robot while it drives, and stays.
people:
  - points: [[7.4, 3.9], [2.7, 3.5]]
    speed_mps: 1.6
    start: {capability: navigate_to, phase: drive, run: 1, after_s: 0.2}
    stay_s: {1: 900.0}
"""
LOSE = "(canvas) => canvas.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
# Has no picture really drawn before a while is over, as on a machine that cannot keep up.
SLOWLY = """(() => {
    const { fenceSync, getSyncParameter } = WebGL2RenderingContext.prototype, begun = new WeakMap();
    WebGL2RenderingContext.prototype.fenceSync = function (...how) {
        const fence = fenceSync.apply(this, how);
        begun.set(fence, performance.now());
        return fence;
    };
    WebGL2RenderingContext.prototype.getSyncParameter = function (fence, what) {
        return performance.now() - begun.get(fence) < 70 ? this.UNSIGNALED : getSyncParameter.call(this, fence, what);
    };
})();"""
COARSEST = 0.8  # of the window's width is the picture's own, where it is drawn as coarsely as it ever is
MUCH = 0.2
LOST = 2  # how often what draws is lost on its way


def drawn(person: Person) -> float:
    picture = person.region("The cell in 3D").screenshot()
    return person.page.evaluate(DRAWN, base64.b64encode(picture).decode())


def camera(person: Person) -> dict[str, Any]:
    return json.loads(person.page.evaluate("sessionStorage.getItem('reins.camera')"))


def range_m(stand: dict[str, Any]) -> float:
    return math.dist(stand["position"], stand["target"])


def red(person: Person) -> int:
    around = box(person.region("The cell in 3D"))
    clip = around | {"y": around["y"] + ABOVE_PX, "height": around["height"] - ABOVE_PX - BELOW_PX}
    return person.page.evaluate(RED, base64.b64encode(person.page.screenshot(clip=clip)).decode())


@pytest.fixture(scope="module", params=["human-shared", "real-restricted"])
def crossed(
    request: pytest.FixtureRequest, built: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ServerProcess]:
    """A server whose robot is held, once it drives, by somebody who comes and stays; from then on neither moves.

    The one profile computes which distance has to be kept, the other one names it.
    """
    folder = tmp_path_factory.mktemp("crossed")
    scenario = folder / "scenario.yaml"
    scenario.write_text(WALKS_UP)
    servers = Servers(folder)
    try:
        server = servers.start(None, "--pace", "1", "--scenario", str(scenario), "--profile", request.param)
        yield server
    finally:
        servers.end()


def held_anew(server: ServerProcess) -> str:
    """Have the robot drive, or told to go on, and so held for as long as the watcher holds before it asks."""
    known = server.get("/v1/invocations")["items"]
    if not known:
        return server.launch("navigate_to", target="bench_b_stand")["id"]
    until(lambda: told_on(server, known[0]["id"]), what="a session that is told to go on")
    return known[0]["id"]


def told_on(server: ServerProcess, session: str) -> bool:
    """Tell it to go on as one has to: where it asks already, since a busy machine was late, by an answer."""
    path = f"/v1/invocations/{session}"
    document = server.get(path)
    if document["status"] != "escalated":
        return all(server.post(f"{path}/{word}").is_success for word in ("pause", "resume"))
    asked = f"/v1/escalations/{document['escalation']['id']}"
    answer = {"decision": "approve", "digest": server.get(asked)["digest"]}
    if not server.post(f"{asked}/resolve", answer).is_success:
        return False
    server.await_status(session, "running", "paused")
    return True


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.drawn
def test_whom_the_watcher_holds_is_paused_to_stay_and_resumed_only_then(
    crossed: ServerProcess, people: People, size: dict[str, int]
) -> None:
    person = people.sit(crossed, size=size)
    scene, pause, resume = person.region("The cell in 3D"), person.button("Pause"), person.button("Resume")
    held_anew(crossed)
    expect(scene).to_contain_text("It goes on by itself once they have left, unless somebody pauses it.")
    expect(pause).to_have_attribute("aria-disabled", "false")
    expect(resume).to_have_attribute("aria-disabled", "true")
    pause.click()
    expect(resume).to_have_attribute("aria-disabled", "false")
    expect(scene).to_contain_text("It waits for Resume, also once they have left.")
    assert crossed.cell()["session"]["paused_by"] == ["operator", "watch"]
    resume.click()
    expect(resume).to_have_attribute("aria-disabled", "true")


@pytest.mark.drawn
def test_who_comes_to_a_robot_that_holds_sees_the_violated_distance_in_red(
    crossed: ServerProcess, people: People
) -> None:
    held = crossed.await_status(held_anew(crossed), "escalated")
    why = crossed.get(f"/v1/escalations/{held['escalation']['id']}")["reasons"]
    assert {"separation", "people"}.intersection(reason["code"] for reason in why), why
    person = people.sit(crossed)
    scene = person.region("The cell in 3D")
    figure = scene.locator(".labels [data-tone=danger]")
    for _ in range(3):  # whether the picture or the first measurement comes first
        expect(scene).to_contain_text("to a person. Robot needs")
        until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
        until(
            lambda: figure.text_content() == scene.locator(".headline strong").text_content(),
            what="the distance the watcher measured, beside the line to whom it is to",
        )
        until(lambda: red(person) > RING_PX, within_s=10.0, what="a red ring around the robot")
        person.page.reload()

    # What goes on is seen from as near as all of it allows; the whole cell is one press away, and so is the way back.
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
    until(lambda: red(person) > RING_PX, what="a red ring around the robot")
    near = red(person)
    person.page.get_by_label("View from the corner").click()
    until(lambda: RING_PX < red(person) < near / 1.5, what="the ring from the cell's corner")
    person.page.get_by_label("View what goes on").click()
    until(lambda: red(person) > near / 1.2, what="the ring from as near as before")


@pytest.mark.drawn
def test_a_replay_shows_people_clear_of_what_it_says_of_them(crossed: ServerProcess, people: People) -> None:
    session = held_anew(crossed)
    crossed.await_status(session, "escalated")
    crossed.post(f"/v1/invocations/{session}/cancel")
    crossed.await_status(session, "completed", "failed")
    person = people.sit(crossed, size=PHONE)
    person.page.evaluate(f"location.hash = '#/audit/{session}'")
    said = person.page.get_by_text("People stand where the tracker saw them")
    name = person.page.locator(".labels span", has_text="person 1")
    expect(said).to_be_visible()
    person.page.get_by_role("slider").press("End")
    expect(name).to_be_visible()
    until(lambda: box(name)["y"] >= box(said)["y"] + box(said)["height"], within_s=5.0, what="a name clear of words")


@pytest.mark.drawn
def test_the_cell_is_drawn_and_drawn_again_in_either_theme_after_the_graphics_were_lost(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    person.expects("CONTEXT_LOST_WEBGL")
    scene, words = person.region("The cell in 3D"), "The graphics card dropped the picture"
    for theme in ("dark", "light"):  # what is drawn again is drawn as from the first
        assert person.page.evaluate("document.documentElement.dataset.theme") == theme
        until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
        scene.locator("canvas").evaluate(LOSE)
        scene.get_by_text(words).wait_for()
        scene.locator("canvas").wait_for(state="visible")
        expect(scene.get_by_text(words)).to_have_count(0)
        until(lambda: drawn(person) > MUCH, what="a cell that is drawn again")
        assert scene.locator("canvas").count() == 1
        person.press("n")


@pytest.mark.drawn
def test_the_camera_is_turned_by_keys_where_tab_has_led_and_nowhere_else(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server)
    picture = person.page.get_by_role("application", name="Camera: arrow keys turn it")
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
    person.page.get_by_label("View from above").click()
    above = camera(person)
    person.page.get_by_label("View from the corner").press("Enter")
    corner = camera(person)
    assert (above["view"], corner["view"]) == ("top", "overview")
    person.page.get_by_label("View what goes on").focus()
    person.press("Shift+Tab")
    expect(picture).to_be_focused()
    person.press("ArrowLeft")
    turned = camera(person)
    assert turned["view"] is None
    assert turned["target"] == pytest.approx(corner["target"])
    assert range_m(turned) == pytest.approx(range_m(corner))
    assert turned["position"] != pytest.approx(corner["position"])
    person.press("ArrowRight")
    assert camera(person)["position"] == pytest.approx(corner["position"])
    for key, nearer in (("+", True), ("-", False)):
        before = range_m(camera(person))
        person.press(key)
        assert (range_m(camera(person)) < before) == nearer
    person.press("ArrowUp")
    assert camera(person)["position"][2] > corner["position"][2]
    person.press("Shift+ArrowDown")

    # Who clicks has not gone there, and arrows that drive the robot do so from there as well.
    stood = camera(person)
    person.page.get_by_label("View from the corner").focus()
    picture.click(position={"x": 300, "y": 200})
    expect(picture).not_to_be_focused()
    person.press("ArrowLeft")
    assert camera(person) == stood
    person.press("t")
    person.button("Take the controls").click()
    expect(person.page.get_by_text("Hold to run; let go to stop")).to_be_visible()
    picture.focus()
    person.page.keyboard.down("ArrowDown")
    expect(person.page.get_by_text("Moving while you hold")).to_be_visible()
    person.page.keyboard.up("ArrowDown")
    assert camera(person) == stood


@pytest.mark.drawn
def test_a_picture_that_is_drawn_more_coarsely_is_still_the_one_from_where_the_camera_stood(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, init=SLOWLY)
    scene = person.region("The cell in 3D")
    picture, bench = scene.locator("canvas"), scene.locator(".labels span", has_text="bench_a")
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
    floor.drive_off()
    expect(scene.get_by_text("planned path")).to_be_visible()
    person.page.evaluate(THREE_FRAMES)
    stood = bench.get_attribute("style")
    until(
        lambda: picture.evaluate(f"(it) => it.width < {COARSEST} * it.clientWidth") or person.page.wait_for_timeout(50),
        what="a picture that is drawn more coarsely",
    )
    person.page.evaluate(THREE_FRAMES)
    assert bench.get_attribute("style") == stood


@pytest.mark.drawn
def test_on_a_phone_the_cell_is_drawn_too(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    until(lambda: drawn(person) > MUCH, what="a cell that is drawn")
    # Who has pulled at it finds the way back; a mere touch pulls at nothing.
    picture, back = person.region("The cell in 3D").locator("canvas"), person.page.get_by_label("View what goes on")
    picture.click(position={"x": 60, "y": 40})
    assert camera(person)["view"] == "scene"
    expect(back).to_be_hidden()
    around = box(picture)
    person.page.mouse.move(around["x"] + 60, around["y"] + 40)
    person.page.mouse.down()
    person.page.mouse.move(around["x"] + 90, around["y"] + 40, steps=3)
    person.page.mouse.up()
    expect(back).to_be_visible()
    assert camera(person)["view"] is None
    back.click()
    expect(back).to_be_hidden()
    assert camera(person)["view"] == "scene"


def test_a_browser_without_3d_says_so_and_shows_the_rest(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server)
    drive, scene = floor.drive_off(), person.region("The cell in 3D")
    expect(scene.get_by_text("This browser draws no 3D")).to_be_visible()
    expect(scene.get_by_role("group", name="Views")).to_have_count(0)
    scene.get_by_role("button", name="Pause").click()
    server.await_status(drive["id"], "paused")


@pytest.mark.drawn
def test_what_draws_the_cell_is_fetched_again_when_it_did_not_come(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    """Over a bad link: nothing says that this browser cannot draw, and nobody has to load the console anew."""
    person = people.open(f"{server.url}/icon.svg")
    person.expects("ERR_CONNECTION_RESET")
    asked: list[str] = []

    def lose_some(route: Route) -> None:
        asked.append(route.request.url)
        if len(asked) <= LOST:
            route.abort("connectionreset")
        else:
            route.continue_()

    person.page.route(re.compile(r"/assets/view-[^/]*\.js"), lose_some)
    person.page.goto(f"{server.url}/#token={server.tokens['operator']}")
    scene = person.region("The cell in 3D")
    expect(scene.get_by_text("could not be loaded yet; it is fetched again")).to_be_visible()
    expect(scene.get_by_text("could not be loaded yet")).to_be_hidden()
    until(lambda: drawn(person) > MUCH or person.page.wait_for_timeout(100), what="a cell that is drawn")
    assert len(asked) == LOST + 1
