"""Takes the pictures of the console that are kept in `docs/pictures/`: `make pictures`."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

from tests.conftest import ServerProcess, Servers, until
from tests.console.conftest import DESK, FLAGS, PHONE, ROOT, Floor, People, Person, chromium

FOLDER = ROOT / "docs" / "pictures"
LIMIT_B = 250_000


def views(person: Person, floor: Floor, ended: str) -> Iterator[str]:
    """Lead a person from picture to picture."""
    page = person.page
    floor.ask()
    expect(page.get_by_role("article", name="Grasp mug_1")).to_be_visible()
    page.mouse.move(0, 0)
    yield "live"
    page.evaluate(f"location.hash = '#/audit/{ended}'")
    moment = page.get_by_role("slider", name="Moment of the session")
    expect(page.locator("article.trace canvas").first).to_be_visible()
    moment.evaluate("(at) => { at.value = at.max * 0.6; at.dispatchEvent(new Event('input', {bubbles: true})); }")
    yield "audit"
    page.evaluate("location.hash = '#/policy'")
    expect(page.get_by_role("table").first).to_be_visible()
    yield "policy"
    page.evaluate("location.hash = '#/fleet'")
    expect(page.get_by_role("heading", name="Fleet")).to_be_visible()
    yield "fleet"


def take(people: People, server: ServerProcess) -> None:
    floor = Floor(server)
    x, y = floor.base()
    drive = floor.drive(x_m=x, y_m=y - 0.3, yaw_rad=1.5708)["id"]
    server.await_status(drive, "completed")
    server.await_status(floor.drive(target="bench_a_stand")["id"], "completed")
    until(lambda: server.get(f"/v1/audit/events?invocation={drive}&kind=telemetry")["items"], what="its telemetry")
    for name, size in (("desk", DESK), ("phone", PHONE)):
        for theme in ("dark", "light"):
            person = people.sit(server, size=size, theme=theme)
            for view in views(person, floor, drive):
                person.page.wait_for_timeout(1_500)  # plots and scene fill; nothing is decided on it
                file = FOLDER / f"{view}-{name}-{theme}.png"
                person.page.screenshot(path=file)
                print(f"{file.relative_to(ROOT)} {file.stat().st_size // 1024} kB")
            floor.clear()
            floor.made.clear()


def main() -> int:
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        servers = Servers(Path(folder))
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(FLAGS))
        try:
            take(People(browser), servers.start(None, "--pace", "1"))
        finally:
            browser.close()
            servers.end()
    heavy = [file.name for file in FOLDER.glob("*.png") if file.stat().st_size > LIMIT_B]
    return f"heavier than {LIMIT_B} B: {', '.join(heavy)}" if heavy else 0


if __name__ == "__main__":
    sys.exit(main())
