"""Headless Chromium, driven as a person would: clicks, drops, and no error on the console."""

import fcntl
import json
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

from real_parts import installed


def high_pipe() -> tuple[int, int]:
    ends = os.pipe()
    moved = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return moved[0], moved[1]


class Browser:
    """Headless Chromium over its debugging pipe (file descriptors 3 and 4, messages that end with a zero byte)."""

    def __init__(self, folder: Path) -> None:
        program = installed("chromium", "chromium-browser", "google-chrome", package="chromium")
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
        options += [
            "--disable-background-networking",
            "--disable-component-update",
            "--window-size=1280,1000",
        ]
        options += ["--remote-debugging-pipe", f"--user-data-dir={folder}", "--no-first-run", "about:blank"]
        self.process = subprocess.Popen(
            ["/bin/bash", "-c", command, program, *options],
            pass_fds=(read_there, write_there),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_there)
        os.close(write_there)
        self._in, self._out, self._buffer, self._last = read_here, write_here, b"", 0
        self._session: str | None = None
        self.errors: list[str] = []
        """What scripts threw or wrote to the console as an error; a refused request is none."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Runtime.enable")

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
        if error is None:
            assert not self.errors, self.errors

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
            self._note(answer)
            if answer.get("id") == self._last:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(parameters["exceptionDetails"]))
        elif message.get("method") == "Runtime.consoleAPICalled" and parameters["type"] == "error":
            self.errors.append(str(parameters["args"]))

    def open(self, url: str, until: str = "document.readyState === 'complete'") -> None:
        self.call("Page.navigate", url=url)
        self.wait(f"location.href !== 'about:blank' && {until}")

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
def opened(url: str, until: str = "document.readyState === 'complete'") -> Iterator[Browser]:
    """A browser that shows a page; what its scripts throw fails the test."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder, Browser(Path(folder)) as browser:
        browser.open(url, until)
        yield browser
