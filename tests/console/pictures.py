"""Takes the pictures of the console that are kept in `docs/pictures/`: `make pictures`."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import DESK, FLAGS, PHONE, ROOT, SIDEWAYS, Floor, People, Person, Windows, chromium

FOLDER = ROOT / "docs" / "pictures"
LIMIT_B = 300_000
CANDIDATE_WHY = "mugs slip at 60 N"
SIZES = {"desk": DESK, "phone": PHONE, "sideways": SIDEWAYS}
ALL_VIEWS = ("desk", "phone")
# Somebody walks up to the robot on its third drive, and stays until the pictures are taken.
SCENARIO = """summary: Somebody walks up to the robot while it drives, and stays.
people:
  - points: [[7.4, 3.9], [2.7, 3.5]]
    speed_mps: 1.2
    start: {capability: navigate_to, phase: drive, run: 3, after_s: 1.0}
    stay_s: {1: 900.0}
"""


def shoot(person: Person, name: str) -> None:
    for _ in range(2):
        person.press("m")  # a key lets the sound begin
    person.page.mouse.move(0, 0)
    person.page.wait_for_timeout(1_500)  # plots and scene fill; nothing is decided on it
    person.page.screenshot(path=FOLDER / f"{name}.png")


def live(person: Person) -> None:
    asked = person.page.get_by_role("article", name="Drive to bench_b")
    # Nothing else holds the robot: a cell whose link broke off on a busy machine makes another picture.
    expect(asked).to_contain_text("A person stayed inside the protective distance, or at its edge.")


def takeover(person: Person) -> None:
    person.press("t")
    person.button("Take the controls").click()
    expect(person.page.get_by_text("Hold to run; let go to stop")).to_be_visible()


def audit(ended: str) -> Callable[[Person], None]:
    def look(person: Person) -> None:
        page = person.page
        page.evaluate(f"location.hash = '#/audit/{ended}'")
        moment = page.get_by_role("slider", name="Moment of the session")
        expect(page.locator("article.trace canvas").first).to_be_visible()
        moment.evaluate("(at) => { at.value = at.max * 0.6; at.dispatchEvent(new Event('input', {bubbles: true})); }")

    return look


def policy(person: Person) -> None:
    person.page.evaluate("location.hash = '#/policy'")
    expect(person.page.get_by_role("table").first).to_be_visible()


def fleet(person: Person) -> None:
    person.page.evaluate("location.hash = '#/fleet'")
    expect(person.page.get_by_role("heading", name="Fleet")).to_be_visible()


def versions(person: Person) -> None:
    person.page.evaluate("location.hash = '#/policy/Versions'")
    person.region("Versions").get_by_role("link").filter(has_text=CANDIDATE_WHY).click()
    expect(person.page.get_by_role("region", name="What it would change")).to_contain_text("Loosens")


def keep_candidate(server: ServerProcess) -> None:
    """Have an engineer bring a version that grips harder; it is not put in force."""
    with server.client("engineer") as client:
        digest = client.get("/v1/policies").json()["items"][0]["digest"]
        files = client.get(f"/v1/policies/{digest}/files").json()["files"]
        profile = files["profiles/human-shared.yaml"]
        files = {name: text for name, text in files.items() if not name.startswith("tests/")}
        files["profiles/human-shared.yaml"] = profile.replace("grip_force_n: {max: 60,", "grip_force_n: {max: 70,")
        assert files["profiles/human-shared.yaml"] != profile
        kept = client.post("/v1/policies", json={"files": files, "why": CANDIDATE_WHY})
        assert kept.is_success, kept.text


def picture(people: People, server: ServerProcess, lead: Callable[[Person], None], name: str, key: str) -> None:
    """Seat one person, lead them to a view, and shoot: several drawing at once take the time from the cell."""
    _, size, theme = name.rsplit("-", 2)
    person = people.sit(server, key, size=SIZES[size], theme=theme)
    lead(person)
    shoot(person, name)
    leave(people)


def leave(people: People) -> None:
    assert people.leave() == []


def take(people: People, server: ServerProcess) -> None:
    floor = Floor(server)
    x, y = floor.base()
    ended = floor.drive(x_m=x, y_m=y - 0.3, yaw_rad=1.5708)["id"]
    server.await_status(ended, "completed")
    server.await_status(floor.drive(target="bench_a_stand")["id"], "completed")
    until(lambda: server.get(f"/v1/audit/events?invocation={ended}&kind=telemetry")["items"], what="its telemetry")
    keep_candidate(server)
    person = people.sit(server)  # there from the start: the plots tell how it came
    held = floor.drive(target="bench_b_stand")["id"]
    server.await_status(held, "escalated")
    live(person)
    shoot(person, "live-desk-dark")
    leave(people)
    for name in ("live-phone-dark", "live-desk-light", "live-phone-light", "live-sideways-dark"):
        picture(people, server, live, name, "operator")
    views = [("audit", audit(ended), "operator"), ("policy", policy, "operator")]
    views += [("versions", versions, "engineer"), ("fleet", fleet, "operator")]
    for view, lead, key in views:
        for size in ALL_VIEWS:
            picture(people, server, lead, f"{view}-{size}-dark", key)
    for size in ALL_VIEWS:
        person = people.sit(server, size=SIZES[size])
        takeover(person)
        shoot(person, f"takeover-{size}-dark")
        person.button("End session").click()
        server.await_status(held, "failed", "completed")
        leave(people)


def lost_links(server: ServerProcess) -> int:
    """Count how often a cell's link broke off while the pictures were taken; they tell of it."""
    events = server.get("/v1/audit/events?kind=cell&limit=500")["items"]
    return sum(event["body"].get("link") == "lost" for event in events)


def main() -> int | str:
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        scenario = Path(folder) / "scenario.yaml"
        scenario.write_text(SCENARIO)
        servers = Servers(Path(folder))
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(FLAGS))
        try:
            server = servers.start(None, "--pace", "1", "--scenario", str(scenario))
            take(People(Windows(browser)), server)
            lost = lost_links(server)
        finally:
            browser.close()
            servers.end()
    if lost > 0:
        return f"the cell's link was lost `{lost}` times, and the event lists show it: take them where less is going on"
    heavy = [file.name for file in FOLDER.glob("*.png") if file.stat().st_size >= LIMIT_B]
    return f"{LIMIT_B} B or heavier: {', '.join(heavy)}" if heavy else 0


if __name__ == "__main__":
    sys.exit(main())
