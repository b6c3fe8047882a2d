"""The viewer's server: whom it answers, what, and how it says no. No browser, and one solution."""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from atmo_jit.atmosphere import Atmosphere, AtmosphereError
from atmo_jit.bake.client import bruneton_tables, scattering_nodes
from atmo_jit.cli import main
from atmo_jit.errors import InputError
from atmo_jit.export.containers import read_exr
from atmo_jit.viewer.live import SCATTERING, Live, framed, unframed
from atmo_jit.viewer.server import HOST, Server

BINARY = "application/octet-stream"


class Unsolved(Live):
    """What is served, but nothing solved before it is asked for."""

    def warm(self):
        pass


@contextmanager
def serving(make):
    with Server(make) as server:
        thread = threading.Thread(target=lambda: server.serve_forever(poll_interval=0.01))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(scope="module")
def server():
    with serving(lambda: Unsolved(Atmosphere.load("earth"), "earth")) as found:
        yield found


def ask(server, method, path, body=None, **headers):
    connection = http.client.HTTPConnection(HOST, server.port, timeout=60)
    connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    found = answer.status, answer.read(), answer.headers
    connection.close()
    return found


def post(server, path, value):
    return ask(server, "POST", path, json.dumps(value), Content_Type="application/json")


def test_the_page_may_load_nothing_from_elsewhere(server):
    for path in ("/", "/main.js", "/state", "/lookup.glsl", "/nothing"):
        _, body, headers = ask(server, "GET", path)
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none';") and "http" not in policy and "unsafe" not in policy
        assert b"https://" not in body and b"//cdn" not in body
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil.example"}, {"Host": "127.0.0.1:1"}, {"Origin": "http://evil.example"}, {"Origin": "null"}],
    ids=str,
)
def test_others_are_not_answered(server, headers):
    for method, path in (("GET", "/state"), ("POST", "/texels")):
        status, body, _ = ask(server, method, path, **headers)
        assert status == 403 and b"earth" not in body


def test_a_form_of_another_page_cannot_ask(server):
    """Without a preflight browsers send these kinds only."""
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
        status, body, _ = ask(server, "POST", "/atmosphere", '{"parameters": {}}', Content_Type=kind)
        assert status == 400 and b"allowed: application/json" in body
    assert ask(server, "OPTIONS", "/texels")[0] == 501


def test_files_outside_of_the_page_are_not_there(server):
    for path in ("/../server.py", "/%2e%2e/server.py", "/__init__.py", "//etc/passwd"):
        assert ask(server, "GET", path)[0] == 404


def test_bad_values_get_the_line_of_the_command_line(server):
    status, body, _ = post(server, "/atmosphere", {"parameters": {"mie.phase.g": 1.5}})
    with pytest.raises(AtmosphereError) as expected:
        Atmosphere.load("earth").replace({"mie.phase.g": 1.5})
    assert status == 400 and json.loads(body) == {"error": str(expected.value)}


@pytest.mark.parametrize(
    "path, value, text",
    [
        ("/texels", {"parameters": {}, "altitudes": [0, 33], "suns": [0, 1]}, "altitudes: found [0, 33]; allowed"),
        ("/texels", {"parameters": {}, "altitudes": [0, 1], "suns": [1, 1]}, "suns: found [1, 1]; allowed"),
        ("/texels", {"parameters": {}, "altitudes": [0.0, 1], "suns": [0, 1]}, "altitudes: found"),
        ("/texels", {"parameters": {}}, "request.altitudes: found nothing"),
        ("/error", {"parameters": {}, "altitude_m": -1, "sun_zenith_deg": 0}, "altitude_m: found -1"),
        ("/error", [], "request: found []"),
    ],
)
def test_bad_requests_are_one_line(server, path, value, text):
    status, body, _ = post(server, path, value)
    assert status == 400 and text in json.loads(body)["error"]


def test_broken_json_is_one_line(server):
    status, body, _ = ask(server, "POST", "/error", "{", Content_Type="application/json")
    assert status == 400 and json.loads(body)["error"].startswith("request: is not JSON")
    assert ask(server, "POST", "/error", "x" * (1 << 17), Content_Type="application/json")[0] == 400


def test_the_saved_atmosphere_is_one(server):
    status, body, headers = post(server, "/atmosphere", {"parameters": {"mie.phase.g": 0.7, "ground_albedo": 0.4}})
    assert status == 200 and headers["Content-Type"] == "application/json"
    expected = Atmosphere.load("earth").replace({"mie.phase.g": 0.7, "ground_albedo": 0.4})
    assert Atmosphere(json.loads(body)) == expected


def test_pictures_become_openexr(server, tmp_path):
    pixels = np.arange(18, dtype=np.float32).reshape(2, 3, 3)
    status, body, _ = ask(server, "POST", "/exr", framed({"width": 3, "height": 2}, [pixels]), Content_Type=BINARY)
    (tmp_path / "sky.exr").write_bytes(body)
    assert status == 200
    np.testing.assert_array_equal(read_exr(tmp_path / "sky.exr")[..., :3], pixels)
    for about in ({"width": 3, "height": 3}, {"width": 0, "height": 0}, {"width": 3}, {"width": 3.0, "height": 2}, []):
        assert ask(server, "POST", "/exr", framed(about, [pixels]), Content_Type=BINARY)[0] == 400
    assert ask(server, "POST", "/exr", b"\xff\xff\xff\xff", Content_Type=BINARY)[0] == 400


def test_texels_are_those_of_the_exported_tables(server, earth):
    """A block over HTTP against the client's table, baked whole but small enough to wait for."""
    altitudes, suns = [31, 32], [30, 32]
    status, body, _ = post(server, "/texels", {"parameters": {}, "altitudes": altitudes, "suns": suns})
    about, numbers = unframed(body)
    assert status == 200 and about["g"] == 0.8 and about["ground_albedo"] == pytest.approx([0.1] * 3)
    a, rows, angles, s = 1, *SCATTERING[1:3], 2
    sizes = [64 * 256 * 3, 16 * 64 * 3, SCATTERING[0] * rows // 2 * 3, *[a * rows * angles * s * 3] * 2]
    assert len(numbers) == sum(sizes)
    mie = np.split(numbers, np.cumsum(sizes))[4].reshape(a, rows, angles, s, 3)
    exact = bruneton_tables(earth, block=(slice(*altitudes), slice(*suns)))
    np.testing.assert_allclose(mie, exact.mie, rtol=1e-5)


@pytest.mark.parametrize("suns", [slice(6, 10), slice(24, 28)], ids=["twilight", "day"])
def test_what_is_shown_first_is_not_solved_worse(server, earth, suns):
    """A sky that is solved for these suns alone, as after a slider's move."""

    def texels(_):
        live = Live(Atmosphere.load("earth"), "earth")
        live.texels({}, [1, 3], [suns.start, suns.stop])
        tables = live._tables({})
        assert tables.solved(suns).suns is not None
        return tables.found.scattering[1:3, :, :, suns]

    exact = bruneton_tables(earth, block=(slice(1, 3), suns)).scattering
    error = np.abs(server.ask(texels) - exact) / np.maximum(exact, 1e-3 * exact.max())
    assert error.max() < 5e-3 and np.percentile(error, 99) < 5e-4


def test_blocks_are_parts_of_the_whole(earth):
    size, block = (6, 8, 4, 8), (slice(2, 4), slice(1, 4))
    whole, part = (bruneton_tables(earth, size=size, block=b) for b in ((slice(None), slice(None)), block))
    for name in ("rayleigh", "mie", "higher"):
        np.testing.assert_allclose(
            getattr(part, name), getattr(whole, name)[block[0], :, :, block[1]], rtol=2e-4, atol=1e-9
        )
    nodes = [np.broadcast_to(v, size) for v in scattering_nodes(whole.mapping, size)]
    for found, all_of_it in zip(scattering_nodes(whole.mapping, size, block), nodes, strict=True):
        expected = all_of_it[block[0], :, :, block[1]]
        np.testing.assert_array_equal(np.broadcast_to(found, expected.shape), expected)


@pytest.mark.parametrize("altitude, sun", [(2.0, 60.0), (59e3, 91.0), (400e3, 70.0), (2e7, 5.0)])
def test_a_view_reads_no_other_texels(server, altitude, sun):
    """Everything else is made far too bright, and rays all around the observer are drawn."""

    def error(live):
        tables = live._tables({})
        block = tables.cells(altitude, np.radians(sun))
        tables.known[:] = False
        tables.fill(block)
        for table in (tables.found.scattering, tables.found.single_mie):
            kept = table[block[0], :, :, block[1]].copy()
            table[:] = 1e9
            table[block[0], :, :, block[1]] = kept
        assert tables.known.sum() < 0.7 * tables.known.size
        return live.error({}, altitude, sun)

    found = server.ask(error)
    assert found["view"]["worst"] < 3.0 and found["whole"] is None


@pytest.fixture(scope="module")
def earth(server):
    """The solved Earth, in the thread where the server solves."""
    return server.ask(lambda live: live._tables({}).solved(slice(0, 32)))


def test_the_command_refuses_in_one_line(capsys, server):
    for arguments, text in (
        (["--atmosphere", "nowhere.json"], "atmosphere: found"),
        (["--port", str(server.port)], f"--port: found {server.port}; allowed"),
        (["--port", "70000"], "70000"),
        (["--tolerance", "2"], "--tolerance is 2.0"),
    ):
        assert main(["view", "--no-browser", *arguments]) == 2
        error = capsys.readouterr().err.strip()
        assert text in error and len(error.splitlines()) == 1


def test_what_the_tables_cannot_show_is_refused(tmp_path, capsys):
    air = Atmosphere.load("earth").replace({"sun_angular_radius_deg": 30.0})
    path = tmp_path / "air.json"
    path.write_text(json.dumps(air.to_dict()))
    assert main(["view", "--no-browser", "--atmosphere", str(path)]) == 2
    assert "sun_angular_radius_deg: found 30" in capsys.readouterr().err
    with pytest.raises(InputError, match="no constituents"):
        Live(Atmosphere({"wavelengths_nm": [550], "bottom_radius_m": 1e6, "top_radius_m": 1.1e6}), "empty")


def test_an_interrupt_ends_it_without_a_word():
    # Jobs that a shell starts in the background ignore interrupts, and so would all processes below them.
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from atmo_jit.cli import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", code, "view", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert not process.stderr.read()
