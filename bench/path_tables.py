"""The path-traced air against the tables (``atmo_jit.sky``): fisheye pictures of two atmospheres, three altitudes and
six suns.

    python -m bench.path_tables                                   # tables on the terminal, 15 minutes on 2 cores
    python -m bench.path_tables --samples 1024 --size 12          # a quick look
    python -m bench.path_tables --page docs/accuracy.md --pictures docs/images

Pictures are equidistant fisheyes whose pixels are single rays, so that a horizon within a pixel makes no difference:
of the sky from 2 m, of the half towards the sun from 10 km, of the planet from 400 km. ``--page`` replaces the section
of the page that this command wrote before. Paths are traced by ``atmosphere_volpath``; while the sun is low they are
guided.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .page import table

SUNS = (10.0, 45.0, 75.0, 88.0, 92.0, 96.0)
# Altitude (m): zenith angle of the picture's axis and angle across the picture (degrees).
CAMERAS = {2.0: (0.0, 178.0), 10e3: (90.0, 178.0), 400e3: (180.0, 146.0)}
AIRS: dict[str, Mapping[str, Any]] = {"earth": {}, "haze": {"mie.scattering_per_m": 5e-5, "mie.phase.g": 0.8}}
BEGIN, END = "<!-- paths against tables: begin -->", "<!-- paths against tables: end -->"
TEXT = """## Paths against tables

Printed by `python -m bench.path_tables --page docs/accuracy.md --pictures docs/images` ({samples} paths for each
pixel, {size} x {size} pixels, {minutes:.0f} minutes). Fisheye pictures by the path-traced medium and by
`atmo_jit.sky` at the default tolerance, at 680, 550 and 440 nm: `earth`, and `haze`, which is `earth` with aerosol
scattering 5e-5 per metre. Differences are in per cent, where there is at least 1e-4 of the picture's largest radiance.
The paths have noise: "noise" is the median of their standard error, "beyond 3 sigma" the 95th percentile of what the
difference exceeds three standard errors by; the bias is the mean difference of the tables with its standard error.

"""


def directions(size: int, altitude_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels in the image circle [size, size] (bool), and their directions' zenith angle and azimuth (degrees)."""
    axis, across = CAMERAS[altitude_m]
    x, y = np.meshgrid(*(2.0 * (np.arange(size) + 0.5) / size - 1.0,) * 2, indexing="xy")
    radius = np.hypot(x, y)
    inside = radius <= 1.0
    angle, turn = np.radians(0.5 * across) * radius[inside], np.arctan2(y[inside], x[inside])
    local = np.stack([np.sin(angle) * np.sin(turn), np.sin(angle) * np.cos(turn), np.cos(angle)], axis=-1)
    c, s = np.cos(np.radians(axis)), np.sin(np.radians(axis))
    # Turned about y, the horizontal across the sun's azimuth; the top of a horizontal picture is up.
    world = local @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    return inside, np.degrees(np.arccos(world[:, 2])), np.degrees(np.arctan2(world[:, 1], world[:, 0]))


def pictures(air: str, altitude_m: float, sun: float, size: int, samples: int) -> dict[str, np.ndarray]:
    """Path-traced radiance ``paths`` and its standard error ``sigma``, and ``tables``: [pixels, 3], 1/sr; and which
    pixels they are of (``inside``).
    """
    import mitsuba as mi

    import atmo_jit
    from atmo_jit.plugins.planet import planet
    from atmo_jit.plugins.rays import LOW_SUN_DEG, trace, tracer_of

    description = {"solar_irradiance": 1.0, "sun_angular_radius_deg": 0.0}
    atmosphere = atmo_jit.Atmosphere.load("earth").replace({**description, **AIRS[air]})
    inside, zenith, azimuth = directions(size, altitude_m)
    angles = {"sun_zenith_deg": sun, "view_zenith_deg": zenith, "azimuth_deg": azimuth}
    tables = atmo_jit.sky(atmosphere, {"altitude_m": altitude_m, **angles}).radiance
    s, v, a = np.radians(sun), np.radians(zenith), np.radians(azimuth)
    parts = planet(atmosphere, sun_direction=[np.sin(s), 0.0, np.cos(s)], wavelength_rule="channels")
    medium = parts.pop("air")
    direction = np.stack([np.sin(v) * np.cos(a), np.sin(v) * np.sin(a), np.cos(v)], axis=-1)
    origin = np.broadcast_to([0.0, 0.0, altitude_m], direction.shape)
    tracer = tracer_of("atmosphere_volpath", guided=sun > LOW_SUN_DEG)
    scene = mi.load_dict({"type": "scene", **parts})
    mean, sigma, _ = trace(scene, medium, origin, direction, None, samples, integrator=tracer)
    return {"inside": inside, "paths": mean, "sigma": sigma, "tables": tables}


def compare(found: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The figures of one pair of pictures, in per cent, where there is at least 1e-4 of the largest radiance."""
    bright = found["tables"] > 1e-4 * found["tables"].max(axis=0)
    paths, sigma, tables = (found[name][bright] for name in ("paths", "sigma", "tables"))
    # Over the tables, which have no noise: the mean of a ratio to a noisy number is not the ratio of the means.
    ratio, noise = paths / tables, sigma / tables
    return {
        "pixels": int(bright.sum()),
        "median": 100.0 * float(np.median(np.abs(ratio - 1.0))),
        "p95": 100.0 * float(np.percentile(np.abs(ratio - 1.0), 95)),
        "noise": 100.0 * float(np.median(noise)),
        "beyond": 100.0 * float(np.percentile(np.maximum(np.abs(ratio - 1.0) - 3.0 * noise, 0.0), 95)),
        "bias": 100.0 * float(1.0 - np.mean(ratio)),
        "bias_error": 100.0 * float(np.sqrt(np.sum(noise**2)) / len(noise)),
    }


def draw(air: str, found: Mapping[tuple[float, float], Mapping[str, np.ndarray]], path: Path) -> None:
    """Pictures of the radiance by paths (at 550 nm, each to its own maximum) and of the differences of the tables."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.7 * len(SUNS) + 0.8, 3.5 * len(CAMERAS)), layout="constrained")
    axes = figure.subplots(2 * len(CAMERAS), len(SUNS))
    for i, altitude in enumerate(CAMERAS):
        for j, sun in enumerate(SUNS):
            one = found[altitude, sun]
            grids = []
            paths = np.where(one["paths"][:, 1] > 0.0, one["paths"][:, 1], np.nan)  # no path found the sun: no ratio
            for values in (one["paths"][:, 1], 100.0 * (one["tables"][:, 1] / paths - 1.0)):
                grid = np.full(one["inside"].shape, np.nan)
                grid[one["inside"]] = values
                grids.append(grid)
            brightest = np.nanpercentile(grids[0], 98)
            axes[2 * i, j].imshow((grids[0] / brightest) ** (1 / 2.2), cmap="gray", vmin=0.0, vmax=1.0)
            shown = axes[2 * i + 1, j].imshow(grids[1], cmap="RdBu_r", vmin=-2.0, vmax=2.0)
            axes[2 * i, j].set_title(f"sun {sun:g} deg" if i == 0 else "", fontsize=9)
        axes[2 * i, 0].set_ylabel(f"{altitude:g} m", fontsize=9)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.colorbar(shown, ax=axes, label="tables against paths, % (550 nm)", shrink=0.5)
    figure.savefig(path, dpi=90)


def measure(size: int, samples: int) -> Iterator[tuple[str, float, float, dict[str, np.ndarray]]]:
    """All pairs of pictures: atmosphere, altitude, sun, and what :func:`pictures` gives."""
    for air in AIRS:
        for altitude in CAMERAS:
            for sun in SUNS:
                yield air, altitude, sun, pictures(air, altitude, sun, size, samples)


def section_of(page: Path) -> str:
    """The section that this command wrote into a page, with its marks; empty if there is none."""
    text = page.read_text() if page.is_file() else ""
    return text[text.index(BEGIN) : text.index(END) + len(END)] + "\n" if BEGIN in text and END in text else ""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=2**14, help="paths for each pixel")
    parser.add_argument("--size", type=int, default=28, help="pixels across a picture")
    parser.add_argument("--page", type=Path)
    parser.add_argument("--pictures", type=Path, metavar="FOLDER")
    given = parser.parse_args(arguments)
    import atmo_jit  # noqa: F401, I001  (first: it chooses the LLVM library)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register

    register()
    started = time.perf_counter()
    rows, found = [], {air: {} for air in AIRS}
    for air, altitude, sun, one in measure(given.size, given.samples):
        found[air][altitude, sun] = one
        row = compare(one)
        bias = f"{row['bias']:+.3f} +- {row['bias_error']:.3f}"
        rows.append({"air": air, "altitude": f"{altitude:g}", "sun": f"{sun:g}", **row, "bias": bias})
        figures = "  ".join(f"{name} {value:.3g}" for name, value in row.items())
        print(f"{air:6s} {altitude:7g} m  sun {sun:2g}  {figures}", flush=True)
    columns = {"air": "atmosphere", "altitude": "altitude m", "sun": "sun deg", "pixels": "values"}
    columns |= {
        "median": "median %",
        "p95": "p95 %",
        "noise": "noise %",
        "beyond": "p95 beyond 3 sigma %",
        "bias": "bias %",
    }
    shown = {"samples": given.samples, "size": given.size, "minutes": (time.perf_counter() - started) / 60.0}
    text = TEXT.format(**shown) + table(rows, columns)
    if given.pictures:
        for air in AIRS:
            name = f"paths_{air}.png"
            draw(air, found[air], given.pictures / name)
            text += f"\n![Path-traced fisheyes of {air}, and the tables' difference from them](images/{name})\n"
    if given.page:
        old, page = section_of(given.page), given.page.read_text()
        new = f"{BEGIN}\n{text}{END}\n"
        given.page.write_text(page.replace(old, new) if old else page.rstrip("\n") + "\n\n" + new)
    return 0


if __name__ == "__main__":
    sys.exit(main())
