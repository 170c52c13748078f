"""Chromium under test: driven over its DevTools protocol through a pipe, so that no driver and no port is needed."""

import base64
import fcntl
import io
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NO_CHROMIUM = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--remote-debugging-pipe", "about:blank",
)  # fmt: skip


def in_a_browser(test: Any) -> Any:
    """Marks a test that needs Chromium: `make test-viewers` runs it."""
    return pytest.mark.viewers(NO_CHROMIUM(test))


class Tab:
    """One page: `requests` (addresses) and `complaints` (console, errors, the browser's own log) since it was made."""

    def __init__(self, reader: io.BufferedReader, writer: io.BufferedWriter):
        self._reader, self._writer, self._last, self._session = reader, writer, 0, {}
        self.requests: list[str] = []
        self.complaints: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its answer; raises RuntimeError where the browser is gone or refuses."""
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters, **self._session}
        self._writer.write(json.dumps(message).encode() + b"\0")
        self._writer.flush()
        while True:
            answer = self._receive()
            if answer.get("id") == self._last:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def open(self, page: Path | str, width: int, height: int) -> None:
        """Opens a file or an address in a window of so many pixels; returns once its scripts have run for the first
        time."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Page.navigate", url=page.as_uri() if isinstance(page, Path) else page)
        self.wait_for_load()

    def wait_for_load(self) -> None:
        """Returns once a page that is being opened has run its scripts for the first time."""
        while self._receive().get("method") != "Page.loadEventFired":
            pass

    def run(self, script: str) -> Any:
        """The value of an expression, awaited."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in found:
            raise RuntimeError(f"{script}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def mouse(self, kind: str, x: int, y: int, **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def key(self, code: str, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key)

    def picture(self) -> np.ndarray:
        """What the window shows, (h, w, 3) in [0, 1], once the page had two frames to draw it."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255.0

    def _receive(self) -> dict[str, Any]:
        content = bytearray()
        while not content.endswith(b"\0"):
            byte = self._reader.read1(1)
            if not byte:
                raise RuntimeError("Chromium has ended")
            content.extend(byte)
        message = json.loads(content[:-1])
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            case "Network.webSocketCreated":
                self.requests.append(message["params"]["url"])
            case "Runtime.consoleAPICalled" | "Runtime.exceptionThrown" | "Log.entryAdded":
                self.complaints.append(json.dumps(message["params"]))
        return message


@contextmanager
def chromium(profile: Path) -> Iterator[Tab]:
    """A headless browser with software WebGL and a new profile; it ends with the context."""
    (read_commands, write_commands), (read_answers, write_answers) = os.pipe(), os.pipe()
    # Chromium reads commands from descriptor 3 and answers on 4: first moved out of the way of those two
    theirs = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (read_commands, write_answers)]
    command = ["bash", "-c", f'exec "$@" 3<&{theirs[0]} 4>&{theirs[1]}', "bash"]
    command += [str(CHROMIUM), f"--user-data-dir={profile}", *_FLAGS]
    process = subprocess.Popen(command, pass_fds=theirs, stderr=subprocess.DEVNULL)
    for end in (read_commands, write_answers, *theirs):
        os.close(end)
    try:
        with os.fdopen(read_answers, "rb") as reader, os.fdopen(write_commands, "wb") as writer:
            yield Tab(reader, writer)
    finally:
        process.kill()
        process.wait()
