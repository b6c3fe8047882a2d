"""Several at once: processes with one kernel cache and one output folder, threads, a thousand solves, many requests."""

from __future__ import annotations

import http.client
import json
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import atmo_jit
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.files import read_npz
from atmo_jit.viewer.live import Live
from atmo_jit.viewer.server import HOST, JSON_LIMIT, Server

VIEWS = {"altitude_m": 0.0, "sun_zenith_deg": 60.0, "view_zenith_deg": np.linspace(0.0, 85.0, 20), "azimuth_deg": 90.0}
SOLVES, MIB = 1000, 2**20


def test_two_processes_share_cache_and_output(tmp_path):
    np.savez(tmp_path / "views.npz", **{k: np.broadcast_to(np.asarray(v, float), 20) for k, v in VIEWS.items()})
    command = [sys.executable, "-m", "atmo_jit", "sky", "--atmosphere", "earth", "--views", "views.npz", "--quiet"]
    running = [subprocess.Popen([*command, "--out", "a.npz"], cwd=tmp_path) for _ in range(2)]
    assert [process.wait(timeout=120) for process in running] == [0, 0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "views.npz"]
    found = read_npz(tmp_path / "a.npz", kinds="biufU")["radiance"]
    assert found == pytest.approx(atmo_jit.sky("earth", VIEWS).radiance, rel=1e-5)


def test_threads_find_what_one_finds():
    airs = [Atmosphere.load("earth").replace({"mie.phase.g": g}) for g in (0.6, 0.7, 0.8, 0.9)]
    want = [atmo_jit.sky(air, VIEWS).radiance for air in airs]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(2):
            for found, one in zip(pool.map(lambda air: atmo_jit.sky(air, VIEWS).radiance, airs), want, strict=True):
                assert found == pytest.approx(one, rel=1e-4)


def memory() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_a_thousand_solves_take_no_more_memory_than_a_hundred():
    """Of atmospheres that share a grid, and of some that do not."""
    air, after = Atmosphere.load("earth"), {}
    for i in range(SOLVES):
        changes = {"ground_albedo": i / SOLVES, "rayleigh.scale_height_m": 8000.0 + 10.0 * (i // 20 % 20)}
        atmo_jit.sky(air.replace(changes), VIEWS, tolerance=0.05)
        after[i + 1] = memory() if i + 1 in (SOLVES // 2, SOLVES) else 0
    assert after[SOLVES] - after[SOLVES // 2] < 64 * MIB


class Unsolved(Live):
    """What is served, but nothing solved before it is asked for."""

    def warm(self):
        pass


def test_fifty_requests_at_once():
    """Good, bad and broken ones; each gets its answer, and the server is there afterwards."""

    def ask(number: int) -> int:
        kind = number % 5
        connection = http.client.HTTPConnection(HOST, server.port, timeout=60)
        try:
            if kind == 0:
                connection.request("GET", "/state")
            elif kind == 1:
                connection.request("GET", f"/../{'../' * number}etc/passwd")
            elif kind == 2:
                body = json.dumps({"parameters": {"mie.phase.g": 0.1 + number / 100}})
                connection.request("POST", "/atmosphere", body, {"Content-Type": "application/json"})
            elif kind == 3:
                connection.request("POST", "/error", "[" * (JSON_LIMIT - 1), {"Content-Type": "application/json"})
            else:
                connection.putrequest("POST", "/texels")
                connection.putheader("Content-Length", "-5" if number % 2 else "9" * 30)
                connection.endheaders()
            return connection.getresponse().status
        finally:
            connection.close()

    with Server(lambda: Unsolved(Atmosphere.load("earth"), "earth")) as server:
        thread = threading.Thread(target=lambda: server.serve_forever(poll_interval=0.01))
        thread.start()
        try:
            for rubbish in (b"\0\xff\n\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"A" * 70_000):
                with socket.create_connection((HOST, server.port), timeout=10) as raw:
                    try:
                        raw.sendall(rubbish)
                        raw.shutdown(socket.SHUT_WR)
                        assert b"Traceback" not in raw.recv(10_000)
                    except ConnectionError:
                        pass
            with ThreadPoolExecutor(50) as pool:
                found = list(pool.map(ask, range(50)))
            assert found == [(200, 404, 200, 400, 400)[i % 5] for i in range(50)]
            assert ask(0) == 200
        finally:
            server.shutdown()
            thread.join()
