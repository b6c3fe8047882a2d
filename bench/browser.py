"""A headless Chromium under remote control: the DevTools protocol over a pipe, without another package.

>>> from bench.browser import Browser
>>> with Browser(1280, 720) as browser:  # doctest: +SKIP
...     browser.open("http://127.0.0.1:8000/")
...     browser.evaluate("document.title")

WebGL2 runs in software (SwiftShader).
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from typing import Any

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
KEY_CODES = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Tab": 9, "PageUp": 33, "PageDown": 34}
KEY_CODES |= {"Home": 36, "End": 35, "Enter": 13}
SHIFT = 8


def missing() -> str | None:
    """What is not installed, None where a browser is."""
    return None if any(map(shutil.which, PROGRAMS)) else f"no Chromium ({', '.join(PROGRAMS)})"


class Browser:
    """One page of a ``width`` x ``height`` window. Raises RuntimeError where the browser does not do as told.

    ``problems``: errors and warnings of the page; ``requests``: addresses that it asked for.
    """

    def __init__(self, width: int, height: int, mobile: bool = False, timeout_s: float = 120.0) -> None:
        self.size, self.mobile, self.timeout_s = (width, height), mobile, timeout_s
        self.problems: list[str] = []
        self.requests: list[str] = []
        self._rest, self._count, self._session = b"", 0, None

    def __enter__(self) -> Browser:
        self.profile = tempfile.TemporaryDirectory(prefix="atmo-jit-browser-", ignore_cleanup_errors=True)
        program = next(filter(None, map(shutil.which, PROGRAMS)))
        ours, theirs = os.pipe(), os.pipe()
        size = f"--window-size={self.size[0]},{self.size[1]}"
        own = ("--remote-debugging-pipe", size, f"--user-data-dir={self.profile.name}")
        # They have to be the file descriptors 3 and 4 there; copies above those cannot be in the way.
        given = [fcntl.fcntl(fd, fcntl.F_DUPFD, 10) for fd in (ours[0], theirs[1])]
        shell = f'exec "$@" 3<&{given[0]} 4>&{given[1]}'
        self.process = subprocess.Popen(
            ["bash", "-c", shell, "bash", program, *FLAGS, *own, "about:blank"],
            pass_fds=given,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in (ours[0], theirs[1], *given):
            os.close(fd)
        self._write, self._read = ours[1], theirs[0]
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        width, height = self.size
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=self.mobile
        )
        return self

    def __exit__(self, *error: Any) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self._write)
        os.close(self._read)
        self.profile.cleanup()

    def call(self, method: str, **parameters: Any) -> Any:
        """The result of a command of the protocol."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"the browser: {method}: {answer['error']['message']}")
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            if not select.select([self._read], [], [], self.timeout_s)[0]:
                raise RuntimeError(f"the browser sent nothing for {self.timeout_s:g} s")
            part = os.read(self._read, 1 << 20)
            if not part:
                raise RuntimeError("the browser ended")
            self._rest += part
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        self._note(message.get("method"), message.get("params", {}))
        return message

    def _note(self, event: str | None, about: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            details = about["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description", details["text"]))
        elif event == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning", "assert"):
            self.problems.append(" ".join(str(a.get("value", a.get("description"))) for a in about["args"]))
        elif event == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            # That drawing waited for a pixel that is read back is no fault; a busy machine says so now and then.
            if "GL Driver Message (OpenGL, Performance" in about["entry"]["text"]:
                return
            self.problems.append(f"{about['entry']['text']} {about['entry'].get('url', '')}")
        elif event == "Network.requestWillBeSent":
            self.requests.append(about["request"]["url"])

    def open(self, address: str) -> None:
        """Begin to load a page."""
        self.call("Page.navigate", url=address)

    def evaluate(self, expression: str) -> Any:
        """The value of an expression, awaited where it is a promise."""
        found = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in found:
            details = found["exceptionDetails"]
            raise RuntimeError(f"the page: {details.get('exception', {}).get('description', details['text'])}")
        return found["result"].get("value")

    def until(self, expression: str, timeout_s: float = 60.0) -> Any:
        """The first true value of an expression; an expression that throws is not true yet."""
        expression = f"(() => {{ try {{ return {expression}; }} catch {{ return null; }} }})()"
        end = time.monotonic() + timeout_s
        while True:
            value = self.evaluate(expression)
            if value:
                return value
            if time.monotonic() > end:
                raise RuntimeError(f"the page: {expression} stayed {value!r} for {timeout_s:g} s")
            time.sleep(0.02)

    def key(self, name: str, modifiers: int = 0) -> None:
        """Press and release a key."""
        about = {"key": name, "code": name, "modifiers": modifiers}
        if len(name) == 1:
            about |= {"text": name, "code": ""}
        else:
            about |= {"windowsVirtualKeyCode": KEY_CODES[name]} | ({"text": "\r"} if name == "Enter" else {})
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, **about)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 5) -> None:
        """Press at one place of the page, move to another, and let go."""
        for i in range(steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            kind = "mousePressed" if i == 0 else "mouseMoved"
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
        x, y = end
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)

    def screenshot(self) -> bytes:
        """A PNG of the page."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
