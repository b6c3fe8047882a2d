"""The viewer's server: its page and its tables over HTTP, to this machine only.

Nothing listens but 127.0.0.1, nothing is answered that is not addressed to it (``Host``) or comes from another page
(``Origin``), and the page may load nothing from anywhere else (``Content-Security-Policy``).

Requests: ``GET`` the files of ``page/``, ``/lookup.glsl``, ``/state``; ``POST`` JSON to ``/texels``, ``/error`` and
``/atmosphere``, and a framed picture to ``/exr``. What a user got wrong is answered with status 400 and the line that
the command line would print.
"""

from __future__ import annotations

import json
import sys
import tempfile
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from .._fields import mapping
from ..errors import InputError, one_line, shown
from ..image import Picture, write_exr

HOST = "127.0.0.1"
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".glsl": "text/plain; charset=utf-8",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
JSON_LIMIT, PICTURE_LIMIT = 1 << 16, 1 << 28  # bytes of a request
LARGEST_SIDE = 8192  # pixels


class Server(ThreadingHTTPServer):
    """Serves one atmosphere at ``port`` (0: any that is free). ``make``: gives its :class:`.live.Live`; called in the
    one thread that solves, as everything is that touches Dr.Jit. Raises InputError where nothing can listen there."""

    daemon_threads = True
    request_queue_size = 128  # a page asks for many things at once; those beyond five were turned away

    def __init__(self, make: Callable[[], Any], port: int = 0) -> None:
        self._solver = ThreadPoolExecutor(max_workers=1)
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(f"--port: found {port}; allowed: a port from 0 to 65535 that is free ({reason})") from None
        self.port = self.server_address[1]
        self.page = {f.name: f.read_bytes() for f in (files(__package__) / "page").iterdir()}
        self._live = self._solver.submit(make)
        self._solver.submit(lambda: self.live.warm())

    @property
    def live(self) -> Any:
        """What is served, once it is there."""
        return self._live.result()

    def ask(self, question: Callable[[Any], Any]) -> Any:
        """What ``question(live)`` returns or raises, asked in the thread that solves."""
        return self._solver.submit(lambda: question(self.live)).result()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            traceback.print_exc()

    def server_close(self) -> None:
        super().server_close()
        self._solver.shutdown(wait=False, cancel_futures=True)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = f"atmo-jit/{__version__}", ""
    disable_nagle_algorithm = True
    server: Server

    def do_GET(self) -> None:
        """A file of the page, the look-up, or the state."""
        self._answer(self._read)

    def do_POST(self) -> None:
        """Texels, errors, the atmosphere as JSON, a picture as OpenEXR."""
        self._answer(self._compute)

    def _answer(self, find: Callable[[str], tuple[str, bytes] | None]) -> None:
        try:
            if not self._local():
                self.close_connection = True
                return self._send(403, KINDS[".glsl"], b"this server answers pages of its own only\n")
            found = find(self.path.partition("?")[0].lstrip("/") or "index.html")
            if found is None:
                self.close_connection = True  # a body may be left unread
                return self._send(404, KINDS[".glsl"], b"there is nothing of that name\n")
            self._send(200, *found)
        except InputError as error:
            self._fail(400, str(error))
        except ConnectionError:
            raise
        except Exception as error:
            traceback.print_exc()
            self._fail(500, f"{type(error).__name__}: {error}")

    def _local(self) -> bool:
        """Whether the request is addressed to this server by a local name, and not from another site's page."""
        names = {f"{name}:{self.server.port}" for name in (HOST, "localhost")}
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in names and (origin is None or origin.removeprefix("http://") in names)

    def _read(self, name: str) -> tuple[str, bytes] | None:
        if name == "state":
            return _json(self.server.live.describe())
        if name == "lookup.glsl":
            return KINDS[".glsl"], self.server.live.lookup().encode()
        if name in self.server.page:
            return KINDS[Path(name).suffix], self.server.page[name]
        return None

    def _compute(self, name: str) -> tuple[str, bytes] | None:
        if name == "exr":
            return "image/x-exr", exr(self._body("application/octet-stream", PICTURE_LIMIT))
        keys = {
            "texels": ("parameters", "altitudes", "suns"),
            "error": ("parameters", "altitude_m", "sun_zenith_deg"),
            "atmosphere": ("parameters",),
        }.get(name)
        if keys is None:
            return None
        try:
            request = json.loads(self._body("application/json", JSON_LIMIT))
        except (ValueError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"request: is not JSON ({error})") from None
        values = [mapping(request, "request", keys)[key] for key in keys]
        if name == "texels":
            from .live import framed

            return "application/octet-stream", self.server.ask(lambda live: framed(*live.texels(*values)))
        if name == "error":
            return _json(self.server.ask(lambda live: live.error(*values)))
        return _json(self.server.live.atmosphere(*values).to_dict(), indent=2)

    def _body(self, kind: str, limit: int) -> bytes:
        """The request's body. A page of another site cannot send these kinds without being allowed to."""
        length = self.headers.get("Content-Length", "")
        wanted = self.headers.get("Content-Type", "").partition(";")[0].strip()
        if not (length.isascii() and length.isdigit()) or int(length) > limit or wanted != kind:
            self.close_connection = True
            found = f"{shown(wanted)} of {shown(length)} bytes"
            raise InputError(f"request: found {found}; allowed: {kind} of up to {limit} bytes")
        return self.rfile.read(int(length))

    def _fail(self, status: int, text: str) -> None:
        self._send(status, *_json({"error": one_line(text)}))

    def _send(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing."""


def exr(body: bytes) -> bytes:
    """An OpenEXR file of a framed picture: JSON {"width", "height", "about": {header attributes}}, then linear sRGB
    [height, width, 3], the top row first. Raises InputError for another body."""
    from .live import unframed

    about, numbers = unframed(body)
    sides = [mapping(about, "picture", ("width", "height"), ("about",))[k] for k in ("width", "height")]
    if not all(type(n) is int and 0 < n <= LARGEST_SIDE for n in sides) or numbers.size != 3 * sides[0] * sides[1]:
        found = f"{shown(sides[0])} x {shown(sides[1])} pixels and {numbers.size} numbers"
        raise InputError(f"picture: found {found}; allowed: sides from 1 to {LARGEST_SIDE} and 3 numbers a pixel")
    header = about.get("about", {})
    if not isinstance(header, dict) or not all(isinstance(v, (str, float, int)) for v in header.values()):
        raise InputError("picture.about: allowed: an object of texts and numbers")
    pixels = np.asarray(numbers, dtype=np.float32).reshape(sides[1], sides[0], 3)
    with tempfile.TemporaryDirectory(prefix="atmo-jit-") as folder:
        path = Path(folder) / "sky.exr"
        write_exr(path, Picture(pixels, ("R", "G", "B")), {f"atmo_jit.{k}": v for k, v in header.items()})
        return path.read_bytes()


def _json(value: Any, indent: int | None = None) -> tuple[str, bytes]:
    return "application/json", json.dumps(value, indent=indent).encode()
