"""A headless Chromium over its debugging pipe, without a driver or package, and without network."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--remote-debugging-pipe",
)
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_WEBGL = ("--disable-3d-apis",)

COMMAND_SECONDS = 60.0


def chromium() -> str | None:
    """The browser on this machine; None if there is none, or if pipes cannot be inherited (Windows)."""
    return None if sys.platform == "win32" else next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """One page of the browser.

    Attributes:
        requests: addresses that it requested.
        complaints: errors and warnings of its console, and errors of its scripts.
    """

    def __init__(self, send: int, receive: int) -> None:
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self._send, self._receive, self._buffer, self._number = send, receive, b"", 0
        target = self.command("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.command("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.command(f"{domain}.enable")
        self.command("Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=-1,
                     uploadThroughput=-1)  # fmt: skip

    def command(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol; returns its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if hasattr(self, "_session"):
            message["sessionId"] = self._session
        os.write(self._send, json.dumps(message).encode() + b"\0")
        while True:
            found = self._next()
            if found.get("id") == self._number:
                assert "error" not in found, found["error"]
                return found["result"]

    def open(self, path: Path, width: int = 1400, height: int = 900) -> None:
        """Open a file and wait until its viewer is ready."""
        self.resize(width, height)
        self.command("Page.navigate", url=path.as_uri())
        self.wait("document.readyState === 'complete' && (document.getElementById('viewer').dataset.ready === 'true')")
        self.wait("true", 0.6)

    def resize(self, width: int, height: int) -> None:
        """Set the size of the window in pixels."""
        self.command("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                     mobile=False)  # fmt: skip

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript."""
        found = self.command("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, condition: str, at_least_s: float = 0.0) -> None:
        """Wait until an expression is true."""
        time.sleep(at_least_s)
        end = time.monotonic() + COMMAND_SECONDS
        while not self.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < end, f"{condition} never came; {self.complaints}"
            time.sleep(0.1)

    def click(self, selector: str) -> None:
        """Click the centre of an element with the mouse."""
        self.evaluate(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
        box = self.box(selector)
        at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2, "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, **at)
        self.wait("true", 0.6)

    def box(self, selector: str) -> dict[str, float]:
        """Position and size of an element in the window."""
        return self.evaluate(f"document.querySelector({selector!r}).getBoundingClientRect().toJSON()")

    def picture(self, selector: str | None = None, *, whole: bool = False) -> Image.Image:
        """Screenshot of an element, of the window, or of the whole page."""
        parameters: dict[str, Any] = {}
        if selector:
            box, scroll = self.box(selector), self.evaluate("window.scrollY")
            parameters["clip"] = {"x": box["x"], "y": box["y"] + scroll, "width": box["width"],
                                  "height": box["height"], "scale": 1}  # fmt: skip
        png = self.command("Page.captureScreenshot", format="png", captureBeyondViewport=whole, **parameters)["data"]
        return Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")

    def pixels(self, selector: str) -> np.ndarray:
        """Screenshot of a whole element as an array [H, W, 3], after scrolling it into the window."""
        self.evaluate(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
        self.wait("true", 0.3)
        return np.asarray(self.picture(selector), dtype=float)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            part = os.read(self._receive, 1 << 16)
            assert part, "the browser ended"
            self._buffer += part
        text, self._buffer = self._buffer.split(b"\0", 1)
        found = json.loads(text)
        method, event = found.get("method"), found.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(event["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(str(event["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and event["type"] in ("error", "warning", "assert"):
            self.complaints.append(str(event["args"]))
        elif method == "Log.entryAdded" and event["entry"]["level"] in ("error", "warning"):
            self.complaints.append(event["entry"]["text"])
        return found


@contextmanager
def browser(profile: Path, *flags: str) -> Iterator[Page]:
    """A browser with one page for the duration of the block.

    Args:
        profile: an empty folder for its profile.
        flags: further ones besides `FLAGS`.
    """
    program = chromium()
    assert program is not None, "ask `chromium()` first"
    there_out, here_in = os.pipe()
    here_out, there_in = os.pipe()

    def take_pipes() -> None:  # the browser reads commands from 3 and answers on 4
        reads, writes = os.dup(there_out), os.dup(there_in)
        os.dup2(reads, 3)
        os.dup2(writes, 4)

    line = [program, *FLAGS, *flags, f"--user-data-dir={profile}"]
    process = subprocess.Popen(
        line, preexec_fn=take_pipes, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(there_out)
    os.close(there_in)
    try:
        yield Page(here_in, here_out)
    finally:
        os.close(here_in)
        os.close(here_out)
        process.terminate()
        process.wait(20)
