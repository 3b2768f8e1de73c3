"""Names as long as a plant gives them: they are broken where words end, and cover nothing."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import (
    DESK,
    DESK_SMALL,
    MAGNIFIED,
    PHONE,
    ROOT,
    SIDEWAYS,
    Floor,
    People,
    out_of_reach,
    resize,
    wider_than_the_screen,
)
from tests.test_join import Hand, token_of

pytestmark = [pytest.mark.browser, pytest.mark.process]
MUG = "calibration_weight_holder_mug_0001"
GLASS = "borosilicate_measuring_glass_with_spout_0042"
CELL = "workcell-9-at-the-north-line-of-hall-3-b"  # as long as one may be; the next one may end in another letter
# Whatever stands out of its own box, and so over what is beside it.
COVERED = """() => [...document.querySelectorAll('main *')].filter((one) => {
    const style = getComputedStyle(one);
    const sticks = style.display !== 'inline' && style.overflowX === 'visible' && one.clientWidth > 0;
    return sticks && one.scrollWidth > one.clientWidth + 1;
}).map((one) => `${one.tagName} ${one.textContent.trim().slice(0, 60)}`)"""


@pytest.fixture(scope="module")
def server(built: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """One server whose site names its things at length."""
    folder = tmp_path_factory.mktemp("names")
    policies = folder / "policies"
    shutil.copytree(ROOT / "policies", policies, ignore=shutil.ignore_patterns("tests"))
    site: Path = policies / "site.yaml"
    site.write_text(site.read_text().replace("mug_1:", f"{MUG}:").replace("glass_1:", f"{GLASS}:"))
    made = Servers(folder)
    try:
        yield made.start(None, "--pace", "1", "--policies", str(policies))
    finally:
        made.end()


@pytest.fixture
def neighbour(server: ServerProcess, tmp_path: Path) -> Iterator[Hand]:
    """Another cell, whose name is long; the server goes on knowing it."""
    hand = Hand(tmp_path)
    hand.join(server, token_of(server), "--id", CELL)
    until(lambda: CELL in [known["id"] for known in server.get("/v1/cells")["items"]], what=f"{CELL} joins")
    yield hand
    hand.end()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_long_names_stay_within_their_cards(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int]
) -> None:
    floor.ask(object_id=MUG)
    floor.ask(object_id=GLASS)
    person = people.sit(server, size=size)
    card = person.page.get_by_role("article", name=f"Grasp {MUG}")
    expect(card.get_by_role("row", name="Object")).to_contain_text(MUG)
    expect(card.get_by_role("cell", name=re.compile(MUG))).to_have_attribute("colspan", "3")
    expect(person.region("Waiting for you").locator("button.row")).to_contain_text(GLASS)
    for asked in (MUG, GLASS, MUG):  # what is shown is what one is asked about, and no newer proposal
        expect(person.page.get_by_role("article")).to_have_accessible_name(f"Grasp {asked}")
        expect(person.region("Session").get_by_role("heading")).to_have_text(f"Grasp {asked}")
        person.press("x")
    person.press("x")
    assert person.page.evaluate(COVERED) == []
    if size == PHONE:
        assert wider_than_the_screen(person.page) == []


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.usefixtures("neighbour")
def test_the_stop_names_its_cell_to_the_last_letter(
    server: ServerProcess, people: People, size: dict[str, int]
) -> None:
    person = people.sit(server, size=size)
    person.page.get_by_label("Cell", exact=True).select_option(CELL)
    pressed = person.button(f"Emergency stop: stop {CELL}")
    for screen in (size,) if size == DESK else (size, SIDEWAYS, MAGNIFIED):
        resize(person, screen)
        name = pressed.get_by_text(CELL)
        expect(name).to_be_visible()
        wide, room = name.evaluate("(name) => [name.scrollWidth, name.clientWidth]")
        assert wide <= room
        at, around = name.bounding_box(), pressed.bounding_box()
        assert at is not None
        assert around is not None
        assert around["y"] <= at["y"]
        assert at["y"] + at["height"] <= around["y"] + around["height"]
        assert screen in (DESK, MAGNIFIED) or out_of_reach(pressed) == []


def test_a_long_name_moves_nothing_of_the_header_under_the_stop(
    server: ServerProcess, people: People, floor: Floor, neighbour: Hand
) -> None:
    floor.ask(object_id=MUG)  # the header says that it waits
    person = people.sit(server)
    person.page.get_by_label("Cell", exact=True).select_option(CELL)
    neighbour.end()
    assert server.post(f"/v1/cells/{CELL}/estop").is_success
    expect(person.page.get_by_role("banner")).to_contain_text("Not heard, stop sent")
    stop, link = person.button(re.compile("^Emergency stop")), person.page.get_by_text(re.compile(r"^\d+ Hz$"))
    for screen in (DESK, DESK_SMALL, {"width": 1242, "height": 800}):
        resize(person, screen)
        around, at = stop.bounding_box(), link.bounding_box()
        assert around is not None
        assert at is not None
        assert at["x"] + at["width"] <= around["x"]
