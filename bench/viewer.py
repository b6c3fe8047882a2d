"""The viewer in headless Chromium: from the command to the first picture, from a slider to the sky, frames per second.

``python -m bench.viewer`` prints the figures of docs/viewer.md. ``--screenshot FILE.png`` takes the picture there.
WebGL2 runs in software, on the same cores as the solver.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bench.browser import Browser, missing

SIZES = {"laptop": (1280, 720, False), "phone": (390, 844, True)}
STARTS, MOVES, FRAMES = 5, 20, 20
FIRST = "document.documentElement.dataset.firstPictureMs"
LATENCY = "document.documentElement.dataset.latencyMs"
READY = "viewer.tables.has(viewer.tables.needs(viewer.view))"
# One slider moved to a place from 0 to 1 of its range, as its user would.
MOVE = """(() => {{
    delete document.documentElement.dataset.latencyMs;
    const input = document.getElementById({name!r});
    input.value = +input.min + {share} * (input.max - input.min);
    input.dispatchEvent(new Event("input", {{bubbles: true}}));
}})()"""
FRAME = """(async () => {{
    const {{view, renderer}} = viewer, times = [];
    for (let i = 0; i < {count}; i++) {{
        view.set("yaw_deg", view.yaw_deg + 1);
        const start = performance.now();
        viewer.draw(1);
        renderer.finish();
        times.push(performance.now() - start);
        await new Promise(requestAnimationFrame);
    }}
    return times;
}})()"""


@contextmanager
def viewer(*options: str, usage: list[int] | None = None) -> Iterator[str]:
    """`atmo-jit view` as a process of its own; its address. ``usage``: takes its number."""
    command = [sys.executable, "-m", "atmo_jit", "view", "--no-browser", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        if not line:
            raise RuntimeError("atmo-jit view printed no address")
        if usage is not None:
            usage.append(process.pid)
        yield line.split()[0]
    finally:
        process.terminate()
        process.wait(10)
        process.stdout.close()


def processor_seconds(process: int) -> float:
    """That a process has used (Linux)."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def look(browser: Browser, **values: float) -> None:
    """Set the view and wait for its tables."""
    sets = "".join(f"viewer.view.set({name!r}, {value});" for name, value in values.items())
    browser.evaluate(f"(() => {{ {sets} viewer.look(); }})()")
    browser.until(READY)


def first_picture(browser: Browser) -> tuple[float, float]:
    """Seconds from the command to the first picture, the browser's own start not counted: it has an empty page. Then
    the command's processor seconds until there."""
    start, usage = time.perf_counter(), []
    with viewer(usage=usage) as address:
        browser.open(address)
        browser.until(FIRST)
        return time.perf_counter() - start, processor_seconds(usage[0])


def latencies(browser: Browser, name: str, process: int) -> list[tuple[float, float]]:
    """Seconds from a slider's event to the drawn sky, for moves one after another, warm; the server's processor seconds
    in each."""
    found = []
    for i in range(MOVES + 3):
        before = processor_seconds(process)
        browser.evaluate(MOVE.format(name=name, share=0.3 + 0.4 * ((0.618 * i) % 1.0)))
        wall = float(browser.until(LATENCY)) / 1000.0
        found.append((wall, processor_seconds(process) - before))
    return found[3:]


def main() -> None:
    """Print the figures, and take a picture where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--screenshot", type=Path, help="Write a picture of the page there, and measure nothing.")
    options = parser.parse_args()
    if missing():
        raise SystemExit(f"bench.viewer: {missing()}")
    if options.screenshot:
        with viewer() as address, Browser(1280, 720) as browser:
            browser.open(address)
            browser.until(FIRST)
            look(browser, sun_zenith_deg=84, altitude_m=9000, pitch_deg=1, yaw_deg=172, fov_deg=65)
            browser.until("document.documentElement.dataset.known == '1'", 180)
            browser.until("document.getElementById('whole-error').textContent", 60)
            options.screenshot.write_bytes(browser.screenshot())
        return
    with Browser(1280, 720) as browser:
        starts = [first_picture(browser) for _ in range(STARTS)]
    rows: list[tuple[str, Any]] = [("command to first picture, the browser already running", starts)]
    usage: list[int] = []
    with viewer(usage=usage) as address, Browser(1280, 720) as browser:
        browser.open(address)
        browser.until(FIRST)
        sliders = {"aerosol scattering": "mie.scattering_per_m", "g": "mie.phase.g", "ozone": "ozone.absorption_per_m"}
        sliders["ground albedo"] = "ground_albedo"
        for label, name in sliders.items():
            rows.append((f"slider to sky, {label}", latencies(browser, name, usage[0])))
        look(browser, altitude_m=400e3, pitch_deg=-20)
        rows.append(("slider to sky, seen from space", latencies(browser, "mie.phase.g", usage[0])))
        for label, view in {"ground": {"altitude_m": 2, "pitch_deg": 12}, "space": {"altitude_m": 4e5}}.items():
            look(browser, **view)
            frames = [(t / 1000.0, 0.0) for t in browser.evaluate(FRAME.format(count=FRAMES))]
            rows.append((f"frame of 960 x 720 pixels in software, {label}", frames))
    print("| what | median s | fastest s | slowest s | processor s of the command |\n|---|---|---|---|---|")
    for label, seconds in rows:
        wall, used = np.array(seconds).T
        figures = (np.median(wall), wall.min(), wall.max(), used.mean())
        print(f"| {label} | {' | '.join(f'{v:.3f}' for v in figures)} |")


if __name__ == "__main__":
    main()
