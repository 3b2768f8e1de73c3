"""What an operator's browser gets: Chromium, signed in to a real server with one real cell that drives to and fro.

Prints

- the first load: bytes that come over the wire (at most 300 kB compressed) and the time until the cell is drawn in 3D
  (at most 1.5 s on loopback);
- a proposal that waits for a person: from before it is posted until its card is on the screen (p95 at most 150 ms);
- poses applied to the 3D view per second (at least 25), and pictures drawn, which hang on the graphics card;
- with `--minutes`, the slope of the page's heap while it streams, after a warm-up in which every bounded list fills
  with what will go through it: a list that changes what it holds is as little flat as one that fills. So the cell
  drives in the warm-up as it does later, as often as the console keeps sessions, and five times as fast as it would:
  half an hour has the sessions and events of two and a half, poses come as ever.
  Beside it stands what grew, the page's own data or what the engine compiled of its functions, from two snapshots;
  with `--settled` the engine compiles nothing later on, and what grows is the page alone.

Chromium draws in software where there is no graphics card, and takes the processor's time from the server it watches.

    python benchmarks/bench_browser.py [--cards 60] [--seconds 20] [--only heap] [--minutes 30 [--settled]]
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench_post import ROOT, free_port, wait_until_up
from playwright.sync_api import Browser, BrowserContext, CDPSession, Page, sync_playwright

from tests.console.conftest import DESK, FLAGS, PLACES

# V8 compiles a function anew, better and larger, once it has been called often: seldom ones after hours. So the heap of
# a page that keeps nothing grows all the same, until every function has had its turn. With these it has at once.
SETTLED = (
    "--always-sparkplug",
    "--no-maglev",
    "--no-turbofan",
    "--no-lazy-feedback-allocation",
    "--no-flush-bytecode",
)
PATIENCE_MS = 60_000
KEPT_INVOCATIONS = 200  # as the console keeps them: a heap that fills a list has not grown
KEPT_EVENTS = 1_000
LOOK_S = 15.0
LOOKS = 3
FILLED_S = 2_400.0  # a warm-up that has not filled every list by then never will
HASTE = 5.0  # simulated seconds per second, for the heap
UNDER_WAY = frozenset({"running", "paused", "recovering", "escalated"})
# Kinds of nodes in a heap snapshot that hold what the page keeps; `code` is what V8 made of its functions.
OWN = ("object", "array", "string", "number", "closure", "concatenated string", "sliced string", "regexp", "symbol")
FAR = ({"target": "dock"}, {"target": "bench_a_stand"})
# Notes, in the page's own time: the first drawn cell, every card, every frame that was applied, every picture.
NOTES = """
    window.notes = { drawn: 0, cards: [], frames: 0, pictures: 0 };
    const { notes } = window;
    const seen = new WeakSet();
    const look = () => {
        if (notes.drawn === 0 && document.querySelector('.labels span') !== null) notes.drawn = performance.now();
        for (const card of document.querySelectorAll('article.card')) {
            if (seen.has(card)) continue;
            seen.add(card);
            notes.cards.push(Date.now());
        }
        requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
    const heard = Object.getOwnPropertyDescriptor(Worker.prototype, 'onmessage');
    Object.defineProperty(Worker.prototype, 'onmessage', { ...heard, set(take) {
        heard.set.call(this, (event) => {
            take(event);
            notes.frames += event.data.filter((one) => one.is === 'frame').length;
        });
    } });
    const fence = WebGL2RenderingContext.prototype.fenceSync;
    WebGL2RenderingContext.prototype.fenceSync = function (...given) {
        notes.pictures += 1;
        return fence.apply(this, given);
    };
"""
# Its worker's script does not come in the page's own line; the browser counts 300 bytes for the headers of each answer.
WORKERS = """
    performance.getEntriesByType('resource')
        .filter((one) => one.name.includes('/worker-')).map((one) => one.transferSize)
"""


@dataclass
class Served:
    """A server with one cell, and what drives it."""

    port: int
    tokens: dict[str, str]
    ended: threading.Event = field(default_factory=threading.Event)
    drives: Counter[str] = field(default_factory=Counter[str])  # by outcome

    def call(self, method: str, path: str, body: Any = None, key: str = "operator") -> Any:
        headers = {"Authorization": f"Bearer {self.tokens[key]}", "Content-Type": "application/json"}
        data = None if body is None else json.dumps(body).encode()
        url = f"http://127.0.0.1:{self.port}{path}"
        with urllib.request.urlopen(urllib.request.Request(url, data, headers, method=method)) as answer:
            return json.load(answer)

    def propose(self, capability: str, **params: Any) -> dict[str, Any]:
        return self.call("POST", "/v1/invocations", {"capability": capability, "params": params}, "agent")

    def drive(self, goal: Mapping[str, Any]) -> None:
        """Drive there. A watcher that asks gets no answer here: what is escalated is cancelled, to free the cell."""
        made = self.propose("navigate_to", **goal)
        cancelled = False
        while not self.ended.is_set() and made["status"] in UNDER_WAY:
            if made["status"] == "escalated" and not cancelled:
                self.call("POST", f"/v1/invocations/{made['id']}/cancel", {})
                cancelled = True
            made = self.call("GET", f"/v1/invocations/{made['id']}?wait=1")
        if made["status"] in UNDER_WAY:
            return
        self.drives[made["outcome"]] += 1
        if made["outcome"] != "succeeded":
            self.ended.wait(1.0)  # proposals that are refused must not take the place of drives

    def drive_on(self, goals: Sequence[Mapping[str, Any]]) -> None:
        """Have the base drive to and fro until told otherwise."""
        for goal in itertools.cycle(goals):
            if self.ended.is_set():
                return
            self.drive(goal)

    @contextmanager
    def driving(self, goals: Sequence[Mapping[str, Any]] = FAR) -> Iterator[Future[None]]:
        self.ended.clear()
        self.drives.clear()
        with ThreadPoolExecutor(1) as pool:
            driver = pool.submit(self.drive_on, goals)
            try:
                yield driver
            finally:
                self.ended.set()
            driver.result()  # raises what ended the driving early

    def logged(self) -> int:
        """Return how many events the record holds."""
        return self.call("GET", "/v1/audit/checkpoint", key="auditor")["size"]


@contextmanager
def page_of(browser: Browser, served: Served) -> Iterator[tuple[BrowserContext, Page]]:
    """Sign in with nothing cached; yields when the cell is drawn."""
    context = browser.new_context(viewport=DESK)
    context.set_default_timeout(PATIENCE_MS)
    context.add_init_script(NOTES)
    page = context.new_page()
    page.goto("about:blank")
    try:
        yield context, page
    finally:
        context.close()


def sign_in(page: Page, served: Served) -> None:
    page.goto(f"http://127.0.0.1:{served.port}/#token={served.tokens['operator']}")
    comes(page, "window.notes.drawn > 0")


def comes(page: Page, condition: str) -> None:
    """Wait in the page, frame by frame, for a condition; the page's policy forbids anybody to evaluate text there."""
    look = f"(resolve) => {{ const look = () => {condition} ? resolve() : requestAnimationFrame(look); look(); }}"
    page.evaluate(f"() => new Promise({look})")


def loaded(browser: Browser, served: Served, encodings: Sequence[str]) -> tuple[int, float]:
    """Sign in with nothing cached; return what came over the wire in bytes, and when the cell was drawn in ms."""
    with page_of(browser, served) as (context, page):
        came: list[int] = []
        line = context.new_cdp_session(page)
        line.send("Network.enable")
        line.send("Network.setExtraHTTPHeaders", {"headers": {"Accept-Encoding": ", ".join(encodings)}})
        line.on("Network.loadingFinished", lambda event: came.append(int(event["encodedDataLength"])))
        sign_in(page, served)
        return sum(came) + sum(page.evaluate(WORKERS)), page.evaluate("window.notes.drawn")


def first_load(browser: Browser, served: Served, loads: int) -> None:
    sizes, times_ms = zip(*(loaded(browser, served, ("br", "gzip")) for _ in range(loads)), strict=True)
    plain, _ = loaded(browser, served, ("gzip",))
    print(f"first load, nothing cached, {loads} times:")
    print(f"  {max(sizes) / 1000:.1f} kB over the wire by brotli (at most 300 kB),")
    print(f"  {plain / 1000:.1f} kB by gzip, as browsers have it from another machine without TLS (at most 300 kB)")
    print(
        f"  cell drawn after {statistics.median(times_ms):.0f} ms median, {max(times_ms):.0f} ms most (at most 1500 ms)"
    )


def cards(browser: Browser, served: Served, count: int) -> None:
    """Post what waits for a person, and see its card come."""
    rng = random.Random(7)  # noqa: S311
    took_ms: list[float] = []
    with page_of(browser, served) as (_, page):
        sign_in(page, served)
        for number in range(count):
            time.sleep(rng.uniform(0.05, 0.25))  # in any phase of the batches
            began_ms = time.time() * 1000
            made = served.propose("grasp_object", object_id="mug_1")
            assert made["status"] == "awaiting_approval", made["admission"]
            comes(page, f"window.notes.cards.length > {number}")
            took_ms.append(page.evaluate("window.notes.cards.at(-1)") - began_ms)
            served.call("POST", f"/v1/invocations/{made['id']}/cancel", {})
            comes(page, "document.querySelector('article.card') === null")
    ranked = statistics.quantiles(took_ms, n=20)
    print(f"proposal posted to card on screen, {count} proposals:")
    print(f"  median {statistics.median(took_ms):.0f} ms, p95 {ranked[18]:.0f} ms (at most 150 ms)")


def poses(browser: Browser, served: Served, seconds: float) -> None:
    with page_of(browser, served) as (_, page), served.driving():
        sign_in(page, served)
        before = page.evaluate("window.notes")
        began_s = time.perf_counter()
        page.wait_for_timeout(seconds * 1000)
        after, spent_s = page.evaluate("window.notes"), time.perf_counter() - began_s
        software = page.evaluate("""() => {
            const gl = document.createElement('canvas').getContext('webgl2');
            const info = gl?.getExtension('WEBGL_debug_renderer_info');
            return gl && info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : 'unknown';
        }""")
    print(f"one watched cell that moves, {seconds:.0f} s:")
    print(f"  {(after['frames'] - before['frames']) / spent_s:.1f} poses applied a second (at least 25)")
    print(f"  {(after['pictures'] - before['pictures']) / spent_s:.1f} pictures drawn a second, by {software}")


def heap(browser: Browser, served: Served, minutes: float, warm_up: float) -> None:
    points: list[tuple[float, float]] = []
    with page_of(browser, served) as (context, page):
        sign_in(page, served)
        line = context.new_cdp_session(page)
        logged = served.logged()
        with served.driving() as driver:

            def warm(at_s: float) -> bool:
                full = served.drives["succeeded"] >= KEPT_INVOCATIONS
                return driver.done() or at_s > FILLED_S or (full and at_s >= warm_up * 60.0)

            warmed_s = sample(line, page, warm, lambda _at, _size: None)
            filled = served.drives.copy()
            assert filled["succeeded"] >= KEPT_INVOCATIONS, f"the list of sessions is not full: {counted(filled)}"
            assert served.logged() - logged >= KEPT_EVENTS, "the list of events is not full"
            before = page.evaluate("window.notes.frames")
            made_of = parts(line)
            sample(
                line,
                page,
                lambda at_s: driver.done() or at_s >= minutes * 60.0,
                lambda at_s, size_b: points.append((at_s / 60.0, size_b / 1000.0)),
            )
            grown = parts(line)
            frames = page.evaluate("window.notes.frames") - before
        grown.subtract(made_of)
    slope, error = trend(points)
    first, last = points[0][1], points[-1][1]
    print(
        f"heap of the page, {minutes:g} minutes of streaming after {warmed_s / 60.0:.1f} of warm-up, {frames} frames:"
    )
    print(f"  drives in the warm-up: {counted(filled)}; measured: {counted(served.drives - filled)}")
    print(f"  {first:.0f} kB at first, {last:.0f} kB at last, least {min(size for _, size in points):.0f} kB")
    print(
        f"  slope {slope:+.1f} ± {error:.1f} kB a minute (95 %): flat where the interval holds 0 or growth is under 1 %"
    )
    print(f"  growth over 30 minutes at that slope {30 * slope / first:+.2%}")
    code, own = grown["code"], sum(grown[kind] for kind in OWN)
    share = own / sum(made_of[kind] for kind in OWN)
    print(f"  of two snapshots, around it: the page's own data {own / 1000:+.0f} kB ({share:+.2%}),")
    print(f"  what the engine compiled {code / 1000:+.0f} kB, the rest of the browser {grown['native'] / 1000:+.0f} kB")


def counted(outcomes: Counter[str]) -> str:
    return ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common()) or "none"


def sample(line: CDPSession, page: Page, over: Callable[[float], bool], take: Callable[[float, float], None]) -> float:
    """Take the heap's size after a full collection every `LOOK_S`, until it is `over`; returns the seconds spent."""
    began_s = time.perf_counter()
    while not over(at_s := time.perf_counter() - began_s):
        take(at_s, min(held(line) for _ in range(LOOKS)))
        page.wait_for_timeout(LOOK_S * 1000)
    return at_s


def parts(line: CDPSession) -> Counter[str]:
    """Return the heap's bytes by kind of node, from a snapshot after a full collection."""
    told: list[str] = []

    def take(event: dict[str, str]) -> None:
        told.append(event["chunk"])

    line.on("HeapProfiler.addHeapSnapshotChunk", take)
    held(line)
    line.send("HeapProfiler.takeHeapSnapshot", {"reportProgress": False})
    line.remove_listener("HeapProfiler.addHeapSnapshotChunk", take)
    snapshot = json.loads("".join(told))
    fields, kinds = (snapshot["snapshot"]["meta"][name] for name in ("node_fields", "node_types"))
    kind, size, each = fields.index("type"), fields.index("self_size"), len(fields)
    sizes: Counter[str] = Counter()
    for at in range(0, len(snapshot["nodes"]), each):
        sizes[kinds[0][snapshot["nodes"][at + kind]]] += snapshot["nodes"][at + size]
    return sizes


def held(line: CDPSession) -> int:
    """Return the heap's bytes after a full collection; what the page has since dropped is among them: least is best."""
    line.send("HeapProfiler.collectGarbage")
    return line.send("Runtime.getHeapUsage")["usedSize"]


def trend(points: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the least-squares slope, and half its 95 % interval (normal)."""
    times, sizes = zip(*points, strict=True)
    line = statistics.linear_regression(times, sizes)
    rests = [size - (line.slope * at + line.intercept) for at, size in points]
    spread = sum((at - statistics.fmean(times)) ** 2 for at in times)
    return line.slope, 1.96 * (sum(rest**2 for rest in rests) / (len(points) - 2) / spread) ** 0.5


@contextmanager
def served(folder: Path, pace: float = 1.0) -> Iterator[Served]:
    port = free_port()
    serve = [sys.executable, "-m", "app.cli", "serve", "--port", str(port), "--data", str(folder), "--cells", "1"]
    serve += ["--pace", str(pace), "--no-prove"]  # measured is serving alone
    server = subprocess.Popen(serve, cwd=ROOT, stdout=subprocess.DEVNULL)
    try:
        wait_until_up(port, "/readyz", server)
        yield Served(port, json.loads((folder / "tokens.json").read_text()))
    finally:
        server.terminate()
        server.wait(10)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loads", type=int, default=5)
    parser.add_argument("--cards", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--minutes", type=float, default=0.0, help="of streaming for the heap's slope; 0 leaves it out")
    parser.add_argument("--warm-up", type=float, default=5.0, metavar="MINUTES")
    parser.add_argument("--only", choices=("heap",))
    parser.add_argument("--settled", action="store_true", help="have V8 compile every function once, at its first call")
    chosen = parser.parse_args()
    place = next((found for name in PLACES if (found := shutil.which(name))), None)
    if place is None:
        print("chromium is missing (Debian: apt-get install chromium)", file=sys.stderr)
        return 1
    subprocess.run([sys.executable, str(ROOT / "web" / "build.py"), "build"], check=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        flags = [*FLAGS, f"--js-flags={' '.join(SETTLED)}"] if chosen.settled else list(FLAGS)
        browser = playwright.chromium.launch(executable_path=place, args=flags)
        if chosen.only is None:
            with served(Path(folder, "watched")) as found:
                first_load(browser, found, chosen.loads)
                cards(browser, found, chosen.cards)
                poses(browser, found, chosen.seconds)
        if chosen.minutes > 0:
            with served(Path(folder, "streaming"), HASTE) as found:
                heap(browser, found, chosen.minutes, chosen.warm_up)
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
