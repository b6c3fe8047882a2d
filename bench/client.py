"""Pictures drawn by a real client: @takram/three-atmosphere in headless Chromium, from tables on the loopback.

Needs Chromium, and the npm packages of ``make client`` in ``.client/node_modules`` (or in the folder that
ATMO_JIT_CLIENT names). WebGL2 runs in software.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from bench import browser

ROOT = Path(__file__).resolve().parents[1]
PAGE = Path(__file__).with_name("client_page.html")
WIDTH, HEIGHT, FOV_DEG = 160, 96, 60.0
KINDS = {".js": "text/javascript", ".mjs": "text/javascript", ".html": "text/html", ".json": "application/json"}


@dataclass(frozen=True)
class View:
    """A pinhole picture from above the origin, z up: ``elevation_deg`` of its middle, in the azimuth of the sun."""

    name: str
    altitude_m: float
    sun_zenith_deg: float
    elevation_deg: float = 15.0
    fov_deg: float = FOV_DEG

    @property
    def sun(self) -> np.ndarray:
        """Unit vector toward the sun."""
        angle = np.radians(self.sun_zenith_deg)
        return np.array([np.sin(angle), 0.0, np.cos(angle)])

    @property
    def axes(self) -> np.ndarray:
        """Forward, and half the picture's width and height."""
        e = np.radians(self.elevation_deg)
        tangent = np.tan(np.radians(0.5 * self.fov_deg))
        right = np.array([0.0, -tangent * WIDTH / HEIGHT, 0.0])
        return np.array([[np.cos(e), 0.0, np.sin(e)], right, tangent * np.array([-np.sin(e), 0.0, np.cos(e)])])

    @property
    def rays(self) -> np.ndarray:
        """Unit vectors through the pixels' centres [HEIGHT, WIDTH, 3], the lowest row first."""
        forward, right, up = self.axes
        y, x = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (HEIGHT, WIDTH))
        rays = forward + x[None, :, None] * right + y[:, None, None] * up
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def angles(self) -> tuple[np.ndarray, np.ndarray]:
        """View zenith and azimuth from the sun (rad) of the rays."""
        x, y, z = np.moveaxis(self.rays, -1, 0)
        return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


VIEWS = (
    View("noon", 2.0, 20.0),
    View("sunset", 2.0, 88.0),
    View("twilight", 2.0, 96.0),
    View("10 km", 10e3, 60.0, -5.0),
    View("space", 400e3, 70.0, -25.0),
)


def missing() -> str | None:
    """What is not installed, None where everything is."""
    if browser.missing():
        return browser.missing()
    if not (packages() / "@takram" / "three-atmosphere").is_dir():
        return f"no @takram/three-atmosphere below {packages()} (make client)"
    return None


def required() -> bool:
    """Whether a missing client is a failure: the environment says so where it was to be installed (.ci/run)."""
    return os.environ.get("ATMO_JIT_CLIENT_REQUIRED", "0") not in ("", "0")


def packages() -> Path:
    """The folder node_modules."""
    return Path(os.environ.get("ATMO_JIT_CLIENT", ROOT / ".client")) / "node_modules"


def shipped() -> Path:
    """The client's own tables."""
    return packages() / "@takram" / "three-atmosphere" / "assets"


def draw(
    tables: dict[str, dict[str, Any]],
    folders: dict[str, Path],
    views: tuple[View, ...] = VIEWS,
    timeout_s: float = 120.0,
) -> dict[str, np.ndarray]:
    """Pixels [HEIGHT, WIDTH, 3] by "tables/kind/view", kind "client" or "snippet".

    ``tables``: by name, what to load (client_page.html); their addresses begin with ``/<a key of folders>``. Raises
    RuntimeError with what the page says when it fails.
    """
    job = {
        "width": WIDTH,
        "height": HEIGHT,
        "tables": tables,
        "views": [
            {
                "name": v.name,
                "altitude": v.altitude_m,
                "fov": v.fov_deg,
                "sun": v.sun.tolist(),
                "axes": v.axes.tolist(),
                "forward": v.axes[0].tolist(),
                "up": (v.axes[2] / np.linalg.norm(v.axes[2])).tolist(),
            }
            for v in views
        ],
    }
    results: queue.Queue[tuple[str, bytes]] = queue.Queue()
    content = {"/page.html": PAGE.read_bytes(), "/job.json": json.dumps(job).encode()}
    found: dict[str, np.ndarray] = {}
    folders = {"npm": packages(), **folders}
    with _server(content, folders, results) as port, _browser(f"http://127.0.0.1:{port}/page.html"):
        while True:
            try:
                name, body = results.get(timeout=timeout_s)
            except queue.Empty:
                raise RuntimeError(f"the browser sent nothing for {timeout_s:g} s") from None
            if name == "error":
                raise RuntimeError(f"the client's page failed: {body.decode(errors='replace')}")
            if name == "done":
                return found
            if name != "renderer":
                found[name] = np.frombuffer(body, "<f4").reshape(HEIGHT, WIDTH, 4)[..., :3].astype(float)


class _Handler(BaseHTTPRequestHandler):
    """Files of some folders, and a place to send results to."""

    def __init__(self, content: dict[str, bytes], folders: dict[str, Path], results: Any, *arguments: Any) -> None:
        self.content, self.folders, self.results = content, folders, results
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """A file."""
        from urllib.parse import unquote

        path = unquote(self.path.partition("?")[0])
        body = self.content.get(path)
        first, _, rest = path.lstrip("/").partition("/")
        if body is None and first in self.folders:
            file = (self.folders[first] / rest).resolve()
            if file.is_file() and file.is_relative_to(self.folders[first].resolve()):
                body = file.read_bytes()
        self.send_response(404 if body is None else 200)
        self.send_header("Content-Type", KINDS.get(Path(path).suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(len(body or b"")))
        self.end_headers()
        self.wfile.write(body or b"")

    def do_POST(self) -> None:
        """A result."""
        from urllib.parse import unquote

        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.results.put((unquote(self.path).removeprefix("/result/"), body))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing."""


@contextmanager
def _server(content: dict[str, bytes], folders: dict[str, Path], results: Any) -> Iterator[int]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, content, folders, results))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def _browser(address: str) -> Iterator[None]:
    program = next(filter(None, map(shutil.which, browser.PROGRAMS)))
    with tempfile.TemporaryDirectory(prefix="atmo-jit-client-", ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [program, *browser.FLAGS, f"--user-data-dir={profile}", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
