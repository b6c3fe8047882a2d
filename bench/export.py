"""A client's pictures against the solution: with the tables that `atmo-jit export` writes, and with its own.

``python -m bench.export`` prints the tables of docs/export.md; needs what :mod:`.client` needs. ``--time``: seconds of
whole processes, by layout.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from atmo_jit import mapping
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.export import LAYOUTS, TEXELS, Options, export
from atmo_jit.solved import Sky
from bench import client
from bench.client import View

OFF_HORIZON_DEG = 0.5  # nearer, the client's single-precision radii decide what a ray meets
SUNS_DEG = (20.0, 60.0, 80.0, 85.0, 87.0, 88.0, 89.0, 90.0, 91.0, 92.0, 93.0, 94.0, 95.0, 96.0, 97.0)


def main() -> None:
    """Print errors by view and by the sun's height."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time", action="store_true", help="Seconds of whole processes, by layout.")
    if parser.parse_args().time:
        times()
        return
    reason = client.missing()
    if reason is not None:
        raise SystemExit(f"bench.export: {reason}")
    air = Atmosphere.load("earth")
    by_sun = tuple(View(f"{sun:g}", 2.0, sun) for sun in SUNS_DEG)
    errors = pictures(air, client.VIEWS + by_sun)
    print("| view | tables | median | p95 | p99 | worst |\n|---|---|---|---|---|---|")
    for view in client.VIEWS:
        for name in (*TEXELS, "shipped"):
            figures = " | ".join(f"{100 * v:.3g}" for v in quantiles(errors[name, view.name]))
            print(f"| {view.name} | {name} | {figures} |")
    print("\n| sun, deg | exact: median | p95 | fitted: median | p95 | shipped: median | p95 | shipped over fitted |")
    print("|---|---|---|---|---|---|---|---|")
    for view in by_sun:
        exact, fitted, shipped = (quantiles(errors[name, view.name])[:2] for name in (*TEXELS, "shipped"))
        cells = [f"{100 * v:.3g}" for v in (*exact, *fitted, *shipped)] + [f"{shipped[0] / fitted[0]:.2g}"]
        print(f"| {view.name} | {' | '.join(cells)} |")


def times(count: int = 5) -> None:
    """Print wall and processor seconds of `atmo-jit export`, start of the process and reading back included: medians of
    ``count`` runs after a first one, which fills Dr.Jit's cache of kernels."""
    print("| layout | wall s | CPU s | MiB |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for layout in LAYOUTS:
            out = Path(folder) / layout
            command = [sys.executable, "-m", "atmo_jit", "export", "--atmosphere", "earth", "--layout", layout]
            runs = [_seconds([*command, "--out", str(out), "--quiet"]) for _ in range(count + 1)][1:]
            wall, cpu = (f"{np.median(v):.2f}" for v in zip(*runs, strict=True))
            size = sum(file.stat().st_size for file in out.iterdir()) / 2**20
            print(f"| {layout} | {wall} | {cpu} | {size:.1f} |")


def _seconds(command: list[str]) -> tuple[float, float]:
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - start
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def pictures(air: Atmosphere, views: tuple[View, ...]) -> dict[tuple[str, str], np.ndarray]:
    """Relative errors of the client's pixels by (tables, view), tables exported with either kind of texels or shipped
    with the client: of rays off the horizon, over the radiance or a thousandth of the picture's brightest in that
    channel."""
    sky = Sky(air, tolerance=0.001)
    errors = {}
    with tempfile.TemporaryDirectory() as folder:
        folders = {texels: Path(folder) / texels for texels in TEXELS}
        for texels, path in folders.items():
            export(air, "takram", path, Options(texels=texels))
        found = client.draw(sources(folders), folders | {"shipped": client.shipped()}, views)
    for view in views:
        exact, kept = truth(sky, view)
        scale = np.maximum(exact, 1e-3 * exact.reshape(-1, 3).max(axis=0))
        for name in (*TEXELS, "shipped"):
            errors[name, view.name] = (np.abs(found[f"{name}/client/{view.name}"] - exact) / scale)[kept]
    return errors


def sources(folders: dict[str, Path]) -> dict[str, dict[str, object]]:
    """What the client is to load: exports, and its own tables with the same parameters."""
    parameters = json.loads((next(iter(folders.values())) / "params.json").read_text(encoding="utf-8"))
    del parameters["metadata"]
    common = {"format": "binary", "type": "float", "parameters": parameters}
    return {name: common | {"url": f"/{name}"} for name in (*folders, "shipped")}


def truth(sky: Sky, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of the air without the ground's own along the view's rays, and which of them count."""
    zenith, azimuth = view.angles()
    constant = [np.full(zenith.shape, v) for v in (view.altitude_m, np.radians(view.sun_zenith_deg))]
    light = sky.rays(*(doubles(v) for v in (*constant, zenith, azimuth)), ground=False).radiance
    exact = np.stack([v.numpy() for v in light], axis=-1).reshape(*zenith.shape, -1).astype(float)
    edge = np.arccos(mapping.horizon(sky.atmosphere.bottom_radius_m, np.float64(view.altitude_m)))
    above = zenith < edge if view.altitude_m < 100.0 else np.full(zenith.shape, True)
    off = np.abs(zenith - edge) > np.radians(OFF_HORIZON_DEG)
    return exact, off & above & (exact.max(axis=-1) > 0.0)


def quantiles(error: np.ndarray) -> tuple[float, ...]:
    """Median, 95th and 99th percentile, and the worst."""
    return tuple(float(np.percentile(error, p)) for p in (50, 95, 99, 100))


if __name__ == "__main__":
    main()
