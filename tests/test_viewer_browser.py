"""The viewer in a real browser: it draws, its controls act, nothing is fetched or fails. Skipped where there is no Chromium."""

from __future__ import annotations

import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcdenoise.evaluation import report

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=800,900",
    "--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-pipe",
]  # fmt: skip
PATIENCE_S = 60

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium: apt-get install chromium")

Json = dict[str, Any]


class Browser:
    """Chromium spoken to over a pair of pipes: DevTools messages, each JSON and a zero byte."""

    def __init__(self, profile: Path, *flags: str) -> None:
        theirs_in, self.write_end = os.pipe()
        self.read_end, theirs_out = os.pipe()
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 20) for end in (theirs_in, theirs_out)]  # clear of 3 and 4, which Chromium uses
        self.process = subprocess.Popen(
            [str(PROGRAM), *FLAGS, *flags, f"--user-data-dir={profile}", "about:blank"],
            preexec_fn=lambda: [os.dup2(end, place) for place, end in enumerate(ends, 3)],
            pass_fds=(3, 4),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for end in (theirs_in, theirs_out, *ends):
            os.close(end)
        self.unread = b""
        self.n_calls = 0
        self.events: list[Json] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session: str | None = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    session: str | None = None

    def call(self, method: str, **parameters: Any) -> Json:
        """The result of a DevTools method; events that arrive meanwhile are kept."""
        self.n_calls += 1
        message = {"id": self.n_calls, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write_end, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + PATIENCE_S
        while True:
            *messages, self.unread = self.unread.split(b"\0")
            for position, text in enumerate(messages):
                answer = json.loads(text)
                if answer.get("id") == self.n_calls:
                    self.unread = b"\0".join([*messages[position + 1 :], self.unread])
                    assert "error" not in answer, answer["error"]
                    result: Json = answer["result"]
                    return result
                self.events.append(answer)
            assert select.select([self.read_end], [], [], max(until - time.monotonic(), 0))[0], f"{method}: no answer"
            read = os.read(self.read_end, 1 << 20)
            assert read, f"{method}: Chromium has ended"
            self.unread += read

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression, once it is there if it is a promise."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def state(self) -> Json:
        """What the page says of itself after everything asked for is drawn."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return dict(
            self.run(
                "({...document.body.dataset, words: Object.fromEntries(['shown', 'tag-left', 'tag-right', 'scale', 'plea']"
                ".map((id) => [id, $(id).hidden ? null : $(id).textContent])), focused: document.activeElement.id})"
            )
        )

    def open(self, path: Path, fragment: str = "") -> Json:
        """The state of a report once it is drawn."""
        self.events.clear()
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=f"{path.as_uri()}#probe=1&{fragment}")
        until = time.monotonic() + PATIENCE_S
        while not self.run("document.body?.dataset.ready ?? ''"):
            assert time.monotonic() < until, "the page was never drawn"
            time.sleep(0.02)
        return self.state()

    def set(self, control: str, value: float, event: str = "input") -> Json:
        """The state after a control was set as a hand would."""
        self.run(f"$('{control}').value = {value}; $('{control}').dispatchEvent(new Event('{event}', {{ bubbles: true }}))")
        return self.state()

    def click(self, control: str) -> Json:
        self.run(f"$('{control}').click()")
        return self.state()

    def press(self, *keys: str) -> Json:
        for key in keys:
            for kind in ("keyDown", "keyUp"):
                self.call("Input.dispatchKeyEvent", type=kind, key=key, **({"text": key} if len(key) == 1 else {}))
        return self.state()

    def drag(self, element: str, by: int, button: str = "left") -> Json:
        """The state after the mouse was pressed in the middle of an element, moved to the right and let go."""
        x, y = self.run(f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])($('{element}').getBoundingClientRect())")
        held = {"left": 1, "right": 2}[button]
        for kind, at, buttons in (("mousePressed", x, held), ("mouseMoved", x + by, held), ("mouseReleased", x + by, 0)):
            self.call("Input.dispatchMouseEvent", type=kind, x=at, y=y, button=button, buttons=buttons, clickCount=1)
        return self.state()

    def complaints(self) -> list[str]:
        """Console messages, uncaught errors, requests for anything but the page itself."""
        kinds = {"Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"}
        said = [json.dumps(event) for event in self.events if event.get("method") in kinds]
        requests = [
            event["params"]["request"]["url"] for event in self.events if event.get("method") == "Network.requestWillBeSent"
        ]
        return [text for text in said if "GPU stall due to ReadPixels" not in text] + [
            url for url in requests if url[:5] != "file:"
        ]

    def close(self) -> None:
        self.session = None
        self.call("Browser.close")
        self.process.wait(timeout=PATIENCE_S)
        os.close(self.read_end)
        os.close(self.write_end)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    running = Browser(tmp_path_factory.mktemp("profile"))
    yield running
    running.close()


@pytest.fixture(scope="module")
def clouds() -> tuple[np.ndarray, np.ndarray]:
    """A sphere with noise and without."""
    rng = np.random.default_rng(1)
    clean = rng.normal(size=(4000, 3))
    clean /= np.linalg.norm(clean, axis=1, keepdims=True)
    return clean * (1 + 0.1 * rng.normal(size=(4000, 1))), clean


@pytest.fixture
def write(tmp_path: Path) -> Callable[[report.Page], Path]:
    def write_page(page: report.Page) -> Path:
        report.write_html(tmp_path / "report.html", title="A scan", figures={"points": 4000}, page=page)
        return tmp_path / "report.html"

    return write_page


@pytest.fixture
def sphere(clouds: tuple[np.ndarray, np.ndarray], write: Callable[[report.Page], Path]) -> Path:
    """A report of both spheres with one step between them and every third point red."""
    noisy, clean = clouds
    red = np.where(np.arange(4000)[:, None] % 3 == 0, [[255, 0, 0]], [[255, 255, 255]]).astype(np.uint8)
    colours = {"rgb": red, "height": clean[:, 2]}
    return write(report.Page(before=noisy, after=clean, steps={"Iteration 1": (noisy + clean) / 2}, colours=colours))


def test_it_draws_on_both_sides_and_asks_nobody_for_anything(browser: Browser, sphere: Path) -> None:
    state = browser.open(sphere)
    assert min(int(state["left"]), int(state["right"])) > 10_000
    assert (state["colour"], state["divider"], state["step"]) == ("rgb", "0.5", "2")
    assert state["words"]["shown"] == "Shown: 4,000 points."
    assert (state["words"]["tag-left"], state["words"]["tag-right"]) == ("Before", "After")
    assert (state["requests"], state["errors"]) == ("0", "0")
    assert browser.complaints() == []


def test_every_control_changes_the_picture_and_back(browser: Browser, sphere: Path) -> None:
    first = browser.open(sphere)
    after, before = browser.set("divider", 0), browser.set("divider", 1)
    assert (after["divider"], before["divider"]) == ("0", "1")
    assert int(before["drawn"]) > 1.1 * int(after["drawn"])  # noise spreads the points over more of the picture
    browser.set("divider", 0.5)
    between = browser.set("step", 0.5)
    assert between["words"]["tag-right"] == "Before \u2192 Iteration 1 50 %"
    browser.set("step", 2)
    height, plain = browser.set("colour", 1, "change"), browser.set("colour", -1, "change")
    assert (height["colour"], plain["colour"]) == ("height", "plain")
    assert height["words"]["scale"].startswith("height")
    assert plain["words"]["scale"] is None
    browser.set("colour", 0, "change")
    large = browser.set("size", 1)
    assert int(large["drawn"]) > int(first["drawn"])
    browser.set("size", 0)
    flipped = browser.click("flip")
    assert flipped["fingerprint"] == before["fingerprint"]  # all of it before denoising, as with the divider at the right edge
    assert browser.click("flip")["fingerprint"] == first["fingerprint"]
    pictures = [first, after, before, between, height, plain, large]
    assert len({state["fingerprint"] for state in pictures}) == len(pictures)
    assert browser.complaints() == []


def test_keys_turn_zoom_and_reset(browser: Browser, sphere: Path) -> None:
    first = browser.open(sphere)
    zoomed = browser.press("+", "+", "+")
    assert int(zoomed["drawn"]) > 1.3 * int(first["drawn"])
    assert browser.press("ArrowLeft")["fingerprint"] != zoomed["fingerprint"]
    assert browser.press("r")["fingerprint"] == first["fingerprint"]
    assert browser.press("]")["divider"] == "0.55"
    assert browser.press(" ")["flipped"] == "true"
    assert browser.complaints() == []


def test_the_mouse_turns_moves_and_drags_the_divider(browser: Browser, sphere: Path) -> None:
    first = browser.open(sphere)
    divided = browser.drag("grip", 75)
    assert float(divided["divider"]) == pytest.approx(0.6, abs=0.01)  # 75 of about 750 pixels
    browser.set("divider", 0)
    whole = browser.press("r")
    turned = browser.drag("canvas", 60)
    assert turned["fingerprint"] != whole["fingerprint"]
    assert turned["focused"] == "canvas"
    assert browser.click("reset")["fingerprint"] == whole["fingerprint"]
    assert int(browser.drag("canvas", 60, "right")["right"]) > int(first["right"])
    assert browser.complaints() == []


def test_the_address_sets_the_view(browser: Browser, sphere: Path) -> None:
    state = browser.open(sphere, "colour=displacement&divider=0.25&step=1")
    assert (state["colour"], state["divider"], state["step"]) == ("displacement", "0.25", "1")
    assert state["words"]["tag-right"] == "Iteration 1"


def test_one_cloud_and_clouds_of_other_rows_are_drawn(
    browser: Browser, clouds: tuple[np.ndarray, np.ndarray], write: Callable[[report.Page], Path]
) -> None:
    noisy, clean = clouds
    alone = browser.open(write(report.Page(before=noisy)))
    assert int(alone["drawn"]) > 10_000
    assert alone["words"]["tag-left"] is None
    beside = browser.open(write(report.Page(before=noisy, after=clean[:3000], names=("Prediction", "Truth"))))
    assert (beside["words"]["tag-left"], beside["words"]["tag-right"]) == ("Prediction", "Truth")
    assert min(int(beside["left"]), int(beside["right"])) > 10_000
    empty = browser.open(write(report.Page(before=noisy[:0], after=clean[:0])))
    assert empty["drawn"] == "0"
    assert browser.complaints() == []


def test_without_webgl_the_page_says_so(sphere: Path, tmp_path: Path) -> None:
    without = Browser(tmp_path / "profile", "--disable-3d-apis")
    state = without.open(sphere)
    without.close()
    assert state["ready"] == "fallback"
    assert "WebGL 2" in state["words"]["plea"]
