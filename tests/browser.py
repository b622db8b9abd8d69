"""A headless Chromium driven over a pipe by its own debugging protocol, with nothing but the standard library."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SECONDS = 60


def find() -> str | None:
    """The browser's path: $VISDOM_BROWSER, or the first on the path."""
    return os.environ.get("VISDOM_BROWSER") or next((p for n in NAMES if (p := shutil.which(n))), None)


needed = pytest.mark.skipif(find() is None, reason=f"no browser is installed ({', '.join(NAMES)})")


class Page:
    """One page of a browser of its own; to be used in a `with` block."""

    def __init__(self) -> None:
        self.errors: list[str] = []
        """What the page wrote to its console as errors, and exceptions."""
        self._profile = tempfile.mkdtemp(prefix="visdom-browser-")
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()

        def arrange() -> None:
            # The protocol reads from descriptor 3 and writes to 4, which the pipe's own ends may occupy.
            a, b = os.dup(theirs_in), os.dup(theirs_out)
            high = [os.dup2(a, 20), os.dup2(b, 21)]
            os.dup2(high[0], 3)
            os.dup2(high[1], 4)

        flags = ["--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--remote-debugging-pipe"]
        flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        flags += ["--no-first-run", "--disable-extensions", f"--user-data-dir={self._profile}", "about:blank"]
        self._process = subprocess.Popen(
            [find() or "chromium", *flags],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            close_fds=False,
            pass_fds=(),
            preexec_fn=arrange,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._read, self._write, self._rest, self._count = ours_in, ours_out, b"", 0
        self._events: list[dict[str, Any]] = []
        target = self._send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(20)
        os.close(self._read)
        os.close(self._write)
        shutil.rmtree(self._profile, ignore_errors=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol to the page."""
        return self._send(method, self._session, **parameters)

    def open(self, address: str) -> None:
        """Loads an address and waits for its end."""
        self._events.clear()
        self.call("Page.navigate", url=address)
        self._wait(lambda: any(e["method"] == "Page.loadEventFired" for e in self._events))

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def until(self, script: str, seconds: float = SECONDS) -> None:
        """Waits until a JavaScript expression is true."""
        end = time.monotonic() + seconds
        while not self.run(f"Boolean({script})"):
            if time.monotonic() > end:
                raise TimeoutError(script)
            time.sleep(0.1)

    def size(self, width: int, height: int) -> None:
        """The size of the window."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )

    def prefer(self, scheme: str) -> None:
        """ "dark" or "light"."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def press(self, key: str, code: int) -> None:
        """A key, by its name and number."""
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def picture(self, path: Path | None = None) -> np.ndarray:
        """(H, W, 3) uint8 RGB of the window."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            path.write_bytes(data)
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert found is not None
        return np.ascontiguousarray(found[..., ::-1])

    def _send(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        self._count += 1
        number = self._count
        message = {"id": number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        answers: list[dict[str, Any]] = []
        self._wait(lambda: bool(answers), lambda m: answers.append(m) if m.get("id") == number else None)
        if "error" in answers[0]:
            raise RuntimeError(f"{method}: {answers[0]['error']}")
        return answers[0]["result"]

    def _wait(self, done: Any, hand_on: Any = lambda _: None) -> None:
        end = time.monotonic() + SECONDS
        while not done():
            if not select.select([self._read], [], [], max(0, end - time.monotonic()))[0]:
                raise TimeoutError("the browser does not answer")
            chunk = os.read(self._read, 1 << 20)
            if not chunk:
                raise RuntimeError("the browser has gone")
            *messages, self._rest = (self._rest + chunk).split(b"\0")
            for text in messages:
                message = json.loads(text)
                self._note(message)
                hand_on(message)

    def _note(self, message: dict[str, Any]) -> None:
        kind, about = message.get("method"), message.get("params", {})
        if kind is not None:
            self._events.append(message)
        if kind == "Runtime.exceptionThrown":
            self.errors.append(str(about["exceptionDetails"]))
        elif kind == "Runtime.consoleAPICalled" and about["type"] == "error":
            self.errors.append(str([a.get("value", a.get("description")) for a in about["args"]]))
        elif kind == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.errors.append(about["entry"]["text"])
