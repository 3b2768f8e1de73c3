"""A session in one hand: everything an operator does to it is reached by touch, and the stop stays where it was."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Locator, expect

from tests.conftest import ServerProcess, until
from tests.console.conftest import PHONE, Floor, People, Person, far, out_of_reach, stop

pytestmark = [pytest.mark.browser, pytest.mark.process]


def says(person: Person) -> Locator:
    """What the robot says of itself, in the phone's header."""
    return person.page.locator("header .says")


def test_a_session_is_paused_resumed_and_rolled_back_by_touch(
    server: ServerProcess, people: People, floor: Floor
) -> None:
    person = people.sit(server, size=PHONE)
    began = floor.base()
    drive = floor.drive_off()
    until(lambda: far(floor.base(), began) > 0.2, what="a base on its way")
    person.button("Pause").tap()
    expect(says(person)).to_contain_text("Paused, holding")
    assert out_of_reach(stop(person)) == []
    person.button("Resume").tap()
    expect(says(person)).to_contain_text("Running")
    expect(person.button("Pause")).to_be_in_viewport(ratio=1)
    person.button("Roll back").tap()
    ended = server.await_status(drive["id"], "failed", "completed")
    assert ended["outcome"] == "rolled_back"
    assert far(floor.base(), began) < 0.1
    expect(person.button(re.compile("Pause|Resume|Roll back"))).to_have_count(0)


def test_a_stop_is_left_in_two_steps_on_the_fleet_page(server: ServerProcess, people: People, floor: Floor) -> None:
    person = people.sit(server, size=PHONE)
    person.page.evaluate("location.hash = '#/fleet'")
    card = person.region("workcell-1")
    card.get_by_label("Profile").select_option("real-restricted")
    expect(card.get_by_role("button", name="Keep human-shared")).to_be_focused()
    person.press("Enter")
    expect(card.get_by_label("Profile")).to_be_focused()  # what goes gives the focus back
    card.get_by_role("button", name="Emergency stop of workcell-1").tap()
    expect(card.get_by_text("workcell-1 is latched")).to_be_visible()
    with person.page.expect_request("**/v1/cells/workcell-1/reset") as first:
        card.get_by_role("button", name="Reset…").tap()
    assert first.value.post_data_json == {"step": "arm"}
    assert server.cell()["latched"] is True
    expect(card.get_by_role("button", name="Keep stopped")).to_be_focused()
    with person.page.expect_request("**/v1/cells/workcell-1/reset") as second:
        card.get_by_role("button", name="Yes, reset the stop").tap()
    assert (second.value.post_data_json or {})["step"] == "confirm"
    expect(card.get_by_role("button", name="Emergency stop of workcell-1")).to_be_visible()
    assert server.cell()["latched"] is False
