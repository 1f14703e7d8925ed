"""The lab's page in a real headless browser."""

import fcntl
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest
from running_lab import running_lab, write_start

OVERLAPS = """[...document.querySelectorAll('#results svg')].flatMap((svg) => {
  const boxes = [...svg.querySelectorAll("text[text-anchor='middle']")].map((text) => text.getBoundingClientRect());
  return boxes.slice(1).filter((box, k) => box.left < boxes[k].right);
}).length"""  # numbers along the time axes that run into each other
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_lab() as address:
        yield address


def high_pipe() -> tuple[int, int]:
    ends = os.pipe()
    moved = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return moved[0], moved[1]


class Browser:
    """Headless Chromium over its debugging pipe (file descriptors 3 and 4, messages that end with a zero byte)."""

    def __init__(self, folder: Path) -> None:
        assert CHROMIUM is not None
        # Numbers from 10 on, so that none of them is 3 or 4 when the shell moves them there.
        read_here, write_there = high_pipe()
        read_there, write_here = high_pipe()
        command = f'exec "$0" "$@" 3<&{read_there} 4>&{write_there}'
        options = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-extensions",
        ]
        options += ["--remote-debugging-pipe", f"--user-data-dir={folder}", "--no-first-run", "about:blank"]
        options += [
            "--window-size=1280,1000",
            "--disable-background-networking",
            "--disable-component-update",
        ]
        self.process = subprocess.Popen(
            ["/bin/bash", "-c", command, CHROMIUM, *options],
            pass_fds=(read_there, write_there),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_there)
        os.close(write_there)
        self._in, self._out, self._buffer, self._last = read_here, write_here, b"", 0
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._session = None
        os.write(self._out, b'{"id":0,"method":"Browser.close"}\0')
        try:
            self.process.wait(timeout=15)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._last += 1
        message: dict[str, Any] = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                chunk = os.read(self._in, 1 << 16)
                assert chunk, "the browser ended"
                self._buffer += chunk
            line, _, self._buffer = self._buffer.partition(b"\0")
            answer = json.loads(line)
            if answer.get("id") == self._last:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def value(self, expression: str) -> Any:
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, expression: str, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f"{expression} stays false"
            time.sleep(0.05)

    def place(self, selector: str, share: float = 0.5) -> tuple[float, float]:
        self.value(f"document.querySelector('{selector}').scrollIntoView({{block: 'nearest'}})")
        box = self.value(f"JSON.stringify(document.querySelector('{selector}').getBoundingClientRect())")
        found = json.loads(box)
        return found["x"] + share * found["width"], found["y"] + 0.5 * found["height"]

    def click(self, selector: str, share: float = 0.5) -> None:
        x, y = self.place(selector, share)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drop(self, selector: str, path: Path) -> None:
        x, y = self.place(selector)
        data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=x, y=y, data=data)


@contextmanager
def page(server: str, folder: Path) -> Iterator[Browser]:
    with Browser(folder) as browser:
        browser.call("Page.navigate", url=server)
        browser.wait("document.body && document.body.dataset.shown !== undefined")
        yield browser


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on this machine")
def test_page_in_a_browser(server: str, tmp_path: Path) -> None:
    with page(server, tmp_path / "profile") as browser:
        curve = "document.querySelector('#current path.measured').getAttribute('d')"
        assert browser.value("document.querySelectorAll('#results svg path').length") == 5
        browser.wait("document.body.dataset.compared !== undefined")
        assert browser.value("document.getElementById('verdict').textContent").startswith("bearing")
        assert browser.value("document.getElementById('alarm').textContent").startswith("alarm after")
        assert browser.value("document.querySelectorAll('#roc path.roc, #roc circle').length") == 2

        browser.call(
            "Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True
        )
        browser.wait("document.getElementById('current').clientWidth < 390")
        browser.wait("document.body.dataset.judged === document.body.dataset.shown")
        assert browser.value(OVERLAPS) == 0
        browser.call("Emulation.clearDeviceMetricsOverride")
        browser.value(
            "document.getElementById('kind').value = 'healthy';"
            "document.getElementById('kind').dispatchEvent(new Event('change'))"
        )
        browser.wait("document.getElementById('verdict').textContent.startsWith('healthy')")
        assert browser.value("document.getElementById('alarm').textContent") == "no alarm"

        browser.value(
            "document.getElementById('kind').value = 'winding_contact';"
            "document.getElementById('kind').dispatchEvent(new Event('change'))"
        )
        browser.wait("document.getElementById('alarm').textContent.startsWith('alarm after')")
        before, severity = (
            browser.value(curve),
            browser.value("document.getElementById('severity_percent').value"),
        )
        shown = browser.value("document.body.dataset.shown")
        browser.click("#severity_percent", 0.9)
        browser.wait(f"Number(document.body.dataset.shown) > {shown}")
        assert float(browser.value("document.getElementById('severity_percent').value")) > float(severity)
        assert browser.value(curve) != before
        browser.wait("document.body.dataset.judged === document.body.dataset.shown")
        assert browser.value("document.getElementById('verdict').textContent").startswith("winding")

        browser.value(
            "document.getElementById('kind').add(new Option('no such', 'no_such'));"
            "document.getElementById('kind').value = 'no_such';"
            "document.getElementById('kind').dispatchEvent(new Event('change'))"
        )
        browser.wait("document.getElementById('alarm').textContent.includes('kind must be one of')")
        assert browser.value("document.querySelectorAll('#current path, #roc path').length") == 0
        assert not browser.value("document.getElementById('verdict').textContent")

        browser.drop("#drop", write_start(tmp_path / "capture.csv", "bearing"))
        browser.wait("document.body.dataset.taken === 'capture.csv'")
        assert browser.value("document.getElementById('recording-verdict').textContent").startswith("bearing")
        assert browser.value("document.querySelectorAll('#recording svg path').length") == 3

        broken = tmp_path / "<b>broken<b>.csv"
        broken.write_bytes(b"\xff\xfe\x00nonsense")
        browser.drop("#drop", broken)
        browser.wait(f"document.body.dataset.taken === {json.dumps(broken.name)}")
        assert broken.name in browser.value("document.getElementById('recording-verdict').textContent")
        assert browser.value("document.querySelectorAll('#recording b').length") == 0
