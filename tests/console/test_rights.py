"""Whom the console still knows, and what it lets each do: a token that goes, a role that may look, one that may not.

The sound that calls a person is theirs to switch off, by key as well.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import TypeAlias

import orjson
import pytest
from playwright.sync_api import expect

from app.api.auth import PRINCIPALS_FILE, issue_token
from app.clock import rfc3339, wall_s
from app.governance.model import Role
from tests.conftest import ServerProcess, until
from tests.console.conftest import PHONE, Floor, People, far, insist, stop

pytestmark = [pytest.mark.browser, pytest.mark.process]
ANSWERS = re.compile("^(Approve|Deny|I have seen it|Let it go on|Go on once|End it|No, roll)")
CONTROLS = re.compile("^(Pause|Resume|Roll back|Take over|Take the controls|Drive from here|Revoke|Reset)")


@pytest.fixture
def guest(server: ServerProcess) -> Iterator[str]:
    """The token of an operator who is known for as long as the test wants."""
    listed = server.data / PRINCIPALS_FILE
    before = listed.read_bytes()
    server.tokens["guest"] = issue_token(server.data, name="guest", role=Role.OPERATOR)
    until(lambda: server.get("/v1/cells", key="guest") if knows(server, "guest") else None, what="a guest who is known")
    yield "guest"
    listed.write_bytes(before)
    until(lambda: not knows(server, "guest"), what="a guest who is forgotten")


def knows(server: ServerProcess, key: str) -> bool:
    with server.client(key) as client:
        return client.get("/v1/cells").is_success


def withdraw(server: ServerProcess, name: str) -> None:
    listed = server.data / PRINCIPALS_FILE
    rows = [row for row in orjson.loads(listed.read_bytes())["principals"] if row["name"] != name]
    listed.write_bytes(orjson.dumps({"principals": rows}))


def lapse(server: ServerProcess, name: str) -> None:
    """Let a person's token expire at this moment."""
    listed = server.data / PRINCIPALS_FILE
    rows = orjson.loads(listed.read_bytes())["principals"]
    now = rfc3339(wall_s())
    rows = [{**row, "expires_at": now} if row["name"] == name else row for row in rows]
    listed.write_bytes(orjson.dumps({"principals": rows}))


GOING = pytest.mark.parametrize("goes", [withdraw, lapse], ids=["withdrawn", "expired"])
Going: TypeAlias = Callable[[ServerProcess, str], None]


@GOING
def test_a_token_that_goes_ends_the_console_and_what_it_showed(
    server: ServerProcess, people: People, floor: Floor, guest: str, goes: Going
) -> None:
    floor.ask()
    person, other = people.sit(server, guest), people.sit(server)
    expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    goes(server, "guest")
    expect(person.alert("This token is not valid here, or not any more.")).to_be_visible()
    expect(person.page.get_by_label("Token")).to_be_empty()
    expect(person.page.get_by_role("article")).to_have_count(0)
    expect(stop(person)).to_have_count(0)
    assert person.page.evaluate("sessionStorage.getItem('reins.token')") is None
    expect(other.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    expect(other.page.get_by_text(re.compile(r"^\d+ Hz$"))).to_be_visible()


@pytest.mark.parametrize("size", [None, PHONE], ids=["desk", "phone"])
def test_who_may_only_look_is_offered_nothing_but_the_stop(
    server: ServerProcess, people: People, floor: Floor, size: dict[str, int] | None
) -> None:
    floor.ask()
    person = people.sit(server, "auditor", size=size)
    expect(person.page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    expect(person.page.get_by_text("Operators answer; you may look.")).to_be_visible()
    expect(person.region("Waiting for operators")).to_be_visible()
    person.press("s")  # nothing that an auditor is refused is asked for
    person.press("t")
    expect(person.region("Drive by hand")).to_contain_text("Operators take the controls; you may look.")
    for words in (ANSWERS, CONTROLS):
        expect(person.button(words)).to_have_count(0)
    expect(stop(person)).to_be_enabled()
    if size == PHONE:
        expect(person.button("Drive")).to_be_disabled()
    assert server.post("/v1/cells/workcell-1/estop").is_success
    expect(person.page.get_by_text("workcell-1 is latched")).to_be_visible()
    expect(person.page.get_by_role("article")).not_to_contain_text(re.compile("You approve|You may"))


def test_an_agent_is_told_that_the_console_is_not_for_its_role(server: ServerProcess, people: People) -> None:
    person = people.open(f"{server.url}/#token={server.tokens['agent']}")
    expect(person.alert("This role or address may not use the console.")).to_be_visible()
    expect(stop(person)).to_have_count(0)


def test_the_sound_is_switched_by_key_said_aloud_and_kept(server: ServerProcess, people: People) -> None:
    person = people.sit(server)
    button = person.region("Waiting for you").get_by_role("button", name=re.compile("^(no )?sound "))
    expect(button).to_have_accessible_name("no sound yet")  # browsers let none begin before a click or a key
    button.click()
    expect(button).to_have_accessible_name("sound on")
    person.press("m")
    expect(person.page.get_by_role("status").filter(has_text="Sound for new questions is off.")).to_be_attached()
    person.page.reload()
    expect(button).to_have_accessible_name("sound off")
    button.press("Enter")
    expect(person.page.get_by_role("status").filter(has_text="Sound for new questions is on.")).to_be_attached()


def test_keys_alone_let_the_sound_begin(server: ServerProcess, people: People) -> None:
    made = "window.made = 0; class Heard extends AudioContext { constructor() { super(); window.made += 1; } }"
    person = people.open(
        f"{server.url}/#token={server.tokens['operator']}", init=f"{made} window.AudioContext = Heard;"
    )
    person.page.get_by_text(re.compile(r"^\d+ Hz$")).wait_for()
    assert person.page.evaluate("window.made") == 0
    person.press("m")  # a shortcut, which nothing behind it hears
    person.press("m")
    person.page.wait_for_function("window.made === 1")


def test_the_phones_menu_is_left_by_escape_and_gives_the_focus_back(server: ServerProcess, people: People) -> None:
    person = people.sit(server, size=PHONE)
    person.button("Menu").click()
    pages = person.page.get_by_role("navigation", name="Pages and settings")
    pages.get_by_role("link", name="Audit").focus()
    person.press("Escape")
    expect(pages).to_have_count(0)
    expect(person.button("Menu")).to_be_focused()
    expect(person.button("Menu")).to_have_attribute("aria-expanded", "false")


@GOING
def test_a_hand_whose_token_goes_is_off_the_robot_and_the_next_person_finds_nothing_of_it(
    server: ServerProcess, people: People, floor: Floor, guest: str, goes: Going
) -> None:
    """Comes last here: where it leaves the robot, the mug is out of reach."""
    person = people.sit(server, guest)
    person.press("t")
    person.button("Take the controls").click()
    began, keyboard = floor.base(), person.page.keyboard
    insist(
        person,
        lambda: keyboard.down("ArrowDown"),
        lambda: keyboard.up("ArrowDown"),
        lambda: far(floor.base(), began) > 0.1,
        "a base driven back",
    )
    goes(server, "guest")  # with the key still down
    expect(person.alert("This token is not valid here, or not any more.")).to_be_visible()
    until(lambda: server.cell()["control"] is None, what="controls that are free")
    until(lambda: floor.speed() < 0.01, what="a base at rest")
    keyboard.up("ArrowDown")
    person.page.get_by_label("Token").fill(server.tokens["operator_2"])
    person.press("Enter")
    expect(person.page.locator("header dl.facts")).to_contain_text("Nobody")
    expect(person.region("Waiting for you")).to_be_visible()
    expect(person.alert("You have lost the controls.")).to_have_count(0)
    expect(person.region("Drive by hand")).to_have_count(0)


def test_what_is_not_for_whoever_looks_does_not_look_as_if_it_were(server: ServerProcess, people: People) -> None:
    person = people.sit(server, "engineer", size=PHONE)
    drive, menu = person.button("Drive"), person.button("Menu")
    expect(drive).to_be_disabled()
    color = "(button) => getComputedStyle(button).color"
    assert drive.evaluate(color) != menu.evaluate(color)
