"""The viewer in headless Chromium: its pixels against the solution, its sliders, keys, pointer and files."""

from __future__ import annotations

import base64
import json
import time

import numpy as np
import pytest
import tolerances

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.export.containers import read_exr
from atmo_jit.image import _compressed
from atmo_jit.solved import Sky
from atmo_jit.spectrum import SpectralBasis
from bench.browser import SHIFT, Browser, missing
from bench.client import required
from bench.viewer import FIRST, LATENCY, READY, SIZES, look, viewer

pytestmark = pytest.mark.client

WIDTH, HEIGHT = 80, 60
OFF_HORIZON_DEG, OFF_SUN_DEG = 0.5, 2.0
VIEWS = {
    "noon": {"altitude_m": 100, "sun_zenith_deg": 25, "pitch_deg": 20, "yaw_deg": 150, "fov_deg": 80},
    "sunset": {"altitude_m": 500, "sun_zenith_deg": 88, "pitch_deg": 12, "yaw_deg": 185, "fov_deg": 70},
    "twilight": {"altitude_m": 2, "sun_zenith_deg": 95, "pitch_deg": 20, "yaw_deg": 180, "fov_deg": 60},
    "10 km": {"altitude_m": 10e3, "sun_zenith_deg": 60, "pitch_deg": -10, "yaw_deg": 90, "fov_deg": 80},
    "space": {"altitude_m": 400e3, "sun_zenith_deg": 70, "pitch_deg": -30, "yaw_deg": 180, "fov_deg": 60},
    "far": {"altitude_m": 20000e3, "sun_zenith_deg": 40, "pitch_deg": -80, "yaw_deg": 180, "fov_deg": 50},
}
PIXELS = f"""(async () => {{
    const {{renderer, view}} = viewer, target = renderer.target("test", {WIDTH}, {HEIGHT});
    renderer.radiance(view, target);
    const bytes = new Uint8Array(renderer.read(target).buffer);
    let text = "";
    for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
    return btoa(text);
}})()"""


@pytest.fixture(scope="module")
def address():
    if missing():
        if required():
            pytest.fail(missing())
        pytest.skip(missing())
    with viewer() as found:
        yield found


@pytest.fixture(scope="module")
def laptop(address):
    with Browser(*SIZES["laptop"]) as browser:
        browser.open(address)
        browser.until(FIRST)
        yield browser


@pytest.fixture
def browser(laptop):
    """The page with the atmosphere of the file, and without complaints so far."""
    laptop.problems.clear()
    laptop.evaluate("document.getElementById('reset').click()")
    look(laptop, **VIEWS["sunset"])
    yield laptop
    assert not laptop.problems


def pixels(browser):
    """Linear sRGB [HEIGHT, WIDTH, 3] of the view, the lowest row first."""
    return np.frombuffer(base64.b64decode(browser.evaluate(PIXELS)), "<f4").reshape(HEIGHT, WIDTH, 4)[..., :3]


def truth(air, view):
    """The same from the solution, and which rays are off the horizon and the sun."""
    yaw, pitch = np.radians(view["yaw_deg"]), np.radians(view["pitch_deg"])
    tangent = np.tan(np.radians(0.5 * view["fov_deg"]))

    def direction(azimuth, elevation):
        return np.array(
            [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
        )

    y, x = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (HEIGHT, WIDTH))
    rays = direction(yaw, pitch) + tangent * (
        x[None, :, None] * direction(yaw + 0.5 * np.pi, 0.0)
        + y[:, None, None] * direction(yaw, pitch + 0.5 * np.pi) * HEIGHT / WIDTH
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    sun = direction(np.pi, np.radians(90.0 - view["sun_zenith_deg"]))
    zenith = np.arccos(rays[..., 2]).ravel()
    azimuth = (np.arctan2(rays[..., 0], rays[..., 1]) - np.pi).ravel()
    constant = [np.full(zenith.shape, v) for v in (view["altitude_m"], np.radians(view["sun_zenith_deg"]))]
    light = Sky(air).rays(*map(doubles, (*constant, zenith, azimuth)))
    exact = np.stack([v.numpy() for v in light.radiance], axis=-1) @ SpectralBasis.of(air).srgb_matrix.T
    edge = np.arcsin(air.bottom_radius_m / (air.bottom_radius_m + view["altitude_m"]))
    off = np.abs(np.pi - zenith - edge) > np.radians(min(OFF_HORIZON_DEG, 0.02 * view["fov_deg"]))
    off &= (rays @ sun).ravel() < np.cos(np.radians(OFF_SUN_DEG))
    return exact.reshape(HEIGHT, WIDTH, 3), off.reshape(HEIGHT, WIDTH)


def errors(found, exact, kept):
    return (np.abs(found - exact) / np.maximum(exact, 1e-3 * exact.max(axis=(0, 1))))[kept]


@pytest.mark.parametrize("name", VIEWS)
def test_pixels_are_those_of_the_solution(browser, name):
    look(browser, **VIEWS[name])
    exact, kept = truth(Atmosphere.load("earth"), VIEWS[name])
    error = errors(pixels(browser), exact, kept)
    median, high = tolerances.VIEWER[name]
    print(name, np.median(error), np.percentile(error, 95), error.max())
    assert np.median(error) < median and np.percentile(error, 95) < high


def test_sliders_solve_another_atmosphere(browser):
    """Keys on the sliders of g and albedo; the picture is then that of the atmosphere that the page saves."""
    for name, key in (("mie.phase.g", "ArrowLeft"), ("ground_albedo", "ArrowRight")):
        browser.evaluate(f"document.getElementById({name!r}).focus()")
        for _ in range(30):
            browser.key(key)
    browser.until(READY)
    changes = browser.evaluate("viewer.tables.parameters")
    assert changes["mie.phase.g"] == pytest.approx(0.65) and changes["ground_albedo"] == pytest.approx(0.4)
    look(browser, **VIEWS["10 km"])
    found = pixels(browser)
    median, high = tolerances.VIEWER["10 km"]
    air = Atmosphere.load("earth")
    error = errors(found, *truth(air.replace(changes), VIEWS["10 km"]))
    assert np.median(error) < median and np.percentile(error, 95) < high
    assert np.median(errors(found, *truth(air, VIEWS["10 km"]))) > 5.0 * median


def test_a_slider_follows_the_pointer(browser):
    box = browser.evaluate(
        "(() => { const i = document.getElementById('mie.scattering_per_m'); i.scrollIntoView();"
        "const b = i.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()"
    )
    before = pixels(browser)
    y = box[1] + 0.5 * box[3]
    browser.evaluate("(() => { delete document.documentElement.dataset.latencyMs; })()")
    browser.drag((box[0] + 0.5 * box[2], y), (box[0] + 0.75 * box[2], y))
    browser.until(LATENCY)
    browser.until(READY)
    assert browser.evaluate("viewer.tables.parameters['mie.scattering_per_m']") > 1e-5
    assert np.median(np.abs(pixels(browser) / before - 1.0)) > 0.05
    assert "ms" in browser.evaluate("document.getElementById('seconds').textContent")


def test_keys_and_pointer_move_the_camera(browser):
    def state(*names):
        return [browser.evaluate(f"viewer.view.{name}") for name in names]

    browser.evaluate("document.getElementById('picture').focus()")
    names = ("yaw_deg", "pitch_deg", "fov_deg", "altitude_m", "sun_zenith_deg")
    before = state(*names)
    for key in ("ArrowRight", "ArrowUp", "+", "PageUp"):
        browser.key(key)
    browser.key("ArrowUp", SHIFT)
    after = state(*names)
    assert [np.sign(b - a) for a, b in zip(before, after, strict=True)] == [1, 1, -1, 1, -1]
    browser.key("Home")
    assert state("yaw_deg") == [180]
    browser.drag((400, 300), (500, 300))
    (yaw,) = state("yaw_deg")
    assert yaw < 180 - 3
    assert browser.evaluate("document.getElementById('yaw_deg').value") == pytest.approx(str(round(2 * yaw) / 2))


def test_the_error_of_the_tables_is_shown(browser):
    browser.until("document.getElementById('view-error').textContent.includes('median')", 60)


def test_files_are_those_of_the_picture(browser, tmp_path):
    browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    browser.evaluate("document.getElementById('mie.phase.g').focus()")
    browser.key("ArrowLeft")
    browser.until(READY)
    for button, name in (("exr", "sky.exr"), ("png", "sky.png"), ("json", "atmosphere.json")):
        browser.evaluate(f"document.getElementById({button!r}).focus()")
        browser.key("Enter")
        end = time.monotonic() + 30
        while not (tmp_path / name).exists():
            assert time.monotonic() < end, f"{name} was not saved"
            time.sleep(0.05)
    air = Atmosphere.load(tmp_path / "atmosphere.json")
    assert air == Atmosphere.load("earth").replace({"mie.phase.g": 0.795})

    import mitsuba as mi

    light = read_exr(tmp_path / "sky.exr")[..., :3]
    exposure = browser.evaluate("viewer.exposure()")
    shown = np.array(mi.Bitmap(str(tmp_path / "sky.png")).convert(mi.Bitmap.PixelFormat.RGB)).astype(float)
    linear = _compressed(light.astype(float), exposure)
    expected = 255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert shown.shape == light.shape and np.abs(shown - expected).max() <= 1.0


def test_no_request_leaves_the_machine(laptop, address):
    assert laptop.requests and all(u.startswith((address, "blob:" + address, "about:")) for u in laptop.requests)
    laptop.evaluate("fetch('http://127.0.0.1:9/').catch(() => 0)")
    assert any("Content Security Policy" in problem for problem in laptop.problems)
    laptop.problems.clear()


@pytest.mark.parametrize("size", SIZES)
def test_every_control_is_named_and_fits(address, size):
    with Browser(*SIZES[size]) as browser:
        browser.open(address)
        browser.until(FIRST)
        assert browser.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        assert browser.evaluate("document.getElementById('picture').clientHeight") > 0.4 * SIZES[size][1]
        browser.call("Accessibility.enable")
        nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
        wanted = ("slider", "button", "checkbox", "application")
        controls = [n for n in nodes if n.get("role", {}).get("value") in wanted]
        assert len(controls) >= 16
        assert all(n["name"]["value"] for n in controls), json.dumps(controls)[:500]
        narrow = browser.evaluate(
            "[...document.querySelectorAll('input, button')].filter((e) => {"
            "const b = e.getBoundingClientRect(); return b.left < 0 || b.right > innerWidth; }).length"
        )
        assert narrow == 0
        assert not browser.problems
