"""Baked tables: their error against the solution, their size, and what they cost, beside the maps that others use.

Run from the repository root::

    python -m bench.tables            # everything, text
    python -m bench.tables --json
    python -m bench.tables --part sky-view|4d|froxels|time
    python -m bench.tables --part time --threads 1    # where other programs run: none waits for another

Errors are those of :mod:`atmo_jit.bake.error`: at random views half a degree off the horizon, relative, in per cent.
Times are medians of warm kernels; CPU time is that of all threads, waiting ones included.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict

import drjit as dr
import numpy as np

from atmo_jit import mapping
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles, floats, types
from atmo_jit.bake.client import SCATTERING, bruneton_tables
from atmo_jit.bake.error import Error, froxels_error, sky_view_error, tables_error
from atmo_jit.bake.froxels import Froxels
from atmo_jit.bake.sky_view import SIZE, SkyView
from atmo_jit.bake.tables import Size, Tables4D
from atmo_jit.mapping import Hillaire, texels
from atmo_jit.needs import Needs
from atmo_jit.phase import RayleighPhase
from atmo_jit.plan import plan
from atmo_jit.solved import RayLight, Sky

from .cost import timed

Row = dict[str, object]

PICTURE = (1280, 720)
OBSERVERS = ((1.0, 30.0), (1.0, 70.0), (1.0, 88.0), (1.0, 94.0), (1e4, 60.0))  # altitude (m), sun zenith (deg)
SKY_VIEWS = ((48, 24, 32), (64, 32, 48), SIZE, (128, 64, 96))
SUNS = ((0.0, 60.0), (60.0, 85.0), (85.0, 94.0))
TABLES = (
    Size(),
    Size(altitudes=10),
    Size(altitudes=24),
    Size(up=14, down=8),
    Size(up=32, down=20),
    Size(suns=32),
    Size(suns=96),
    Size(azimuths=5),
    Size(scattering=(48, 64, 40)),
)
HAZE = {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.9}


class HillaireView:
    """Hillaire's sky-view table of 192 x 108 texels of radiance, bilinear, with the evaluation of a SkyView: a peer."""

    size = (108, 192)

    def __init__(self, sky: Sky, altitude_m: float, sun_zenith: float) -> None:
        self.altitude_m, self.sun_zenith = altitude_m, sun_zenith
        air = sky.atmosphere
        self.to = Hillaire(air.bottom_radius_m, air.top_radius_m)
        rows, columns = self.size
        v, u = (a.ravel() for a in np.meshgrid(texels(rows), texels(columns), indexing="ij"))
        mu, cos_phi, _ = self.to.sky_view_inverse(np.full(v.size, altitude_m), v, u)
        zenith, azimuth = np.arccos(np.clip(mu, -1, 1)), np.arccos(np.clip(cos_phi, -1, 1))
        light = sky.rays(*map(doubles, (np.full(v.size, altitude_m), np.full(v.size, sun_zenith), zenith, azimuth)))
        self.values = [c.numpy().reshape(self.size) for c in light.radiance]
        self.nbytes = sum(v.nbytes for v in self.values)

    def radiance(self, view_zenith: object, azimuth: object) -> list[object]:
        mu, cos_phi = np.cos(view_zenith.numpy().astype(float)), np.cos(azimuth.numpy().astype(float))
        h = np.full(mu.size, self.altitude_m)
        v, u = self.to.sky_view(h, mu, cos_phi, mu < mapping.horizon(self.to.bottom, h))
        return [floats(_interpolate(values, v, u)) for values in self.values]


def _interpolate(values: np.ndarray, *coordinates: np.ndarray) -> np.ndarray:
    """Multilinear interpolation at unit coordinates of nodes on both ends."""
    cells = [np.clip(x, 0.0, 1.0) * (n - 1) for x, n in zip(coordinates, values.shape, strict=False)]
    low = [np.minimum(c.astype(int), n - 2) for c, n in zip(cells, values.shape, strict=False)]
    total = 0.0
    for corner in np.ndindex(*(2,) * len(cells)):
        weight = math.prod(c - i if o else 1.0 - (c - i) for c, i, o in zip(cells, low, corner, strict=True))
        part = values[tuple(i + o for i, o in zip(low, corner, strict=True))]
        total = total + weight.reshape(-1, *(1,) * (part.ndim - 1)) * part
    return total


class BrunetonView:
    """The clients' scattering tables, evaluated as a client does, with the evaluation of Tables4D."""

    def __init__(self, sky: Sky) -> None:
        self.sky, air = sky, sky.atmosphere
        self.radius, self.thickness = air.bottom_radius_m, air.thickness_m
        self.tables = bruneton_tables(sky)
        self.halves = [
            [v[:, rows] for v in (self.tables.scattering, self.tables.mie)]
            for rows in (slice(SCATTERING[1] // 2 - 1, None, -1), slice(SCATTERING[1] // 2, None))
        ]
        self.nbytes = sum(v.nbytes for half in self.halves for v in half)

    def rays(self, altitude: object, sun: object, zenith: object, azimuth: object, *, ground: bool) -> RayLight:
        h, s, z, a = (v.numpy() for v in (altitude, sun, zenith, azimuth))
        mu, mu_s = np.cos(z), np.cos(s)
        nu = mu * mu_s + np.sin(z) * np.sin(s) * np.cos(a)
        to, hits = self.tables.mapping, mu < mapping.horizon(self.radius, h)
        x_r = to.transmittance(h, mu)[0]
        x = (x_r, to.view(h, mu, hits), to.angle(nu), to.sun(mu_s))
        single, mie = (np.where(hits[:, None], *(_interpolate(half[i], *x) for half in self.halves)) for i in (0, 1))
        phase = self.sky.atmosphere.mie[0].phase.value(nu)
        light = single * RayleighPhase().value(nu)[:, None] + mie * np.reshape(phase, (len(nu), -1))
        return RayLight([floats(c) for c in light.T], [])


def sky_views(sky: Sky, name: str) -> Iterator[Row]:
    """Error of sky views by observer and size, and of Hillaire's."""
    for altitude, sun_deg in OBSERVERS:
        sun = math.radians(sun_deg)
        made = [(f"{n[0]}+{n[1]} x {n[2]}", lambda n=n: SkyView(sky, altitude, sun, n)) for n in SKY_VIEWS]  # noqa: B023
        made.append(("Hillaire 108 x 192", lambda: HillaireView(sky, altitude, sun)))  # noqa: B023
        for label, make in made:
            table = make()
            error = sky_view_error(table, sky)
            yield _row(label, f"{name}, {altitude:g} m, sun at {sun_deg:g} deg", table.nbytes, error)


def four_dimensional(sky: Sky, name: str) -> Iterator[Row]:
    """Error of 4-D tables by sun and size, and of the clients' layout."""
    made = [(_difference(size), lambda size=size: Tables4D(sky, size)) for size in TABLES]
    made.append(("Bruneton 32 x 128 x 8 x 32", lambda: BrunetonView(sky)))
    for label, make in made:
        start = time.process_time()
        table = make()
        dr.sync_thread()
        seconds = time.process_time() - start
        for suns in SUNS:
            row = _row(label, f"{name}, suns at {suns[0]:g}-{suns[1]:g} deg", table.nbytes, tables_error(table, suns))
            yield {**row, "bake_cpu_s": seconds}


def _row(table: str, where: str, size: int, error: Error) -> Row:
    found = asdict(error)
    return {"table": table, "where": where, "KiB": size / 1024, "worst_place": found.pop("where"), **found}


def _difference(size: Size) -> str:
    """What distinguishes a size from the default."""
    default = asdict(Size())
    changed = [f"{k} {v}" for k, v in asdict(size).items() if v != default[k]]
    return ", ".join(changed) or "default: " + ", ".join(f"{k} {v}" for k, v in default.items())


def froxels(sky: Sky, name: str) -> Iterator[Row]:
    """Error of aerial perspective in a camera's frustum."""
    for altitude, sun_deg in OBSERVERS:
        table = Froxels.frustum(sky, altitude, math.radians(sun_deg), camera())
        where = f"{name}, {altitude:g} m, sun at {sun_deg:g} deg"
        yield _row("froxels 32 x 32 x 32", where, table.nbytes, froxels_error(table, sky))


def camera() -> np.ndarray:
    """Corners of a horizontal 90 x 59 degree picture, 20 degrees beside the sun: [2, 2, 3] for Froxels.frustum."""
    yaw, height = math.radians(20.0), PICTURE[1] / PICTURE[0]
    forward, right = np.array([math.cos(yaw), math.sin(yaw), 0.0]), np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    up = np.array([0.0, 0.0, height])
    return np.array([[forward + side * right + lift * up for side in (-1, 1)] for lift in (1, -1)])


def times(name: str) -> Iterator[Row]:
    """Milliseconds of baking and of a picture."""
    t = types()
    sky = Sky(name)
    pixel = dr.arange(t.UInt, PICTURE[0] * PICTURE[1])
    px, py = t.Float(pixel % PICTURE[0]), t.Float(pixel // PICTURE[0])
    dr.eval(px, py)
    half = 0.5 * PICTURE[0]

    def picture(view: SkyView) -> None:
        x, z = (px - half) / half, (0.5 * PICTURE[1] - py) / half
        forward = dr.rsqrt(dr.fma(x, x, dr.fma(z, z, 1.0)))
        dr.eval(view.along(forward, x * forward, z * forward))
        dr.sync_thread()

    suns = iter(0.3 + 1e-3 * np.arange(100_000))
    tables = Tables4D(sky)
    changed = max((c for c in sky.atmosphere.constituents if c.phase is not None), key=lambda c: c.name != "rayleigh")
    planned = plan(name, Needs.of_observer(name, 1.0, 45.0))

    def another() -> Atmosphere:
        more = changed.scattering_per_m * (1.0 + next(suns))
        return sky.atmosphere.replace({f"{changed.name}.scattering_per_m": more})

    def march(count: int = 20_000) -> None:
        rng = np.random.default_rng(0)
        place = (np.full(count, 1.0), np.full(count, 0.8), np.arccos(rng.uniform(-1, 1, count)), rng.random(count))
        dr.eval(sky.rays(*map(doubles, place)).radiance)
        dr.sync_thread()

    view = SkyView(sky, 1.0, 0.8)
    work: dict[str, Callable[[], object]] = {
        "20,000 rays marched": march,
        "sky view baked": lambda: SkyView(sky, 1.0, next(suns)),
        "1280 x 720 picture from a sky view": lambda: picture(view),
        "1280 x 720 picture from the 4-D tables": lambda: picture(SkyView(tables, 1.0, next(suns))),
        "sky view baked, 1280 x 720 picture": lambda: picture(SkyView(sky, 1.0, next(suns))),
        "the same after a change of the atmosphere": lambda: picture(SkyView(Sky(another()), 1.0, next(suns))),
        "the same, one sun, as planned": lambda: picture(SkyView(planned.solve(another()), 1.0, np.radians(45.0))),
        "4-D tables baked": lambda: Tables4D(sky),
        "Bruneton's tables at clients' sizes baked": lambda: bruneton_tables(sky),
        "froxels baked": lambda: Froxels.frustum(sky, 1.0, next(suns), camera()),
    }
    for what, do in work.items():
        found = timed(do, 5 if "baked" in what else 31)
        yield {"what": what, "where": name, "wall_ms": 1e3 * found["wall_s"], "cpu_ms": 1e3 * found["cpu_s"]}


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "sky-view": lambda: (row for name, sky in _skies() for row in sky_views(sky, name)),
    "4d": lambda: (row for name, sky in _skies() for row in four_dimensional(sky, name)),
    "froxels": lambda: (row for name, sky in _skies() for row in froxels(sky, name)),
    "time": lambda: times("earth"),
}


def _skies() -> Iterator[tuple[str, Sky]]:
    earth = Sky("earth")
    yield "earth", earth
    yield "haze", Sky(earth.atmosphere.replace(HAZE))


def line(row: Row) -> str:
    """One row as text."""
    if "wall_ms" in row:
        return f"{row['what']:44}{row['where']:8}{row['wall_ms']:9.2f} ms{row['cpu_ms']:9.2f} ms CPU"
    figures = "".join(f"{100.0 * row[key]:9.3f}" for key in ("median", "p95", "p99", "worst"))
    bake = f"{row['bake_cpu_s']:7.2f} s" if "bake_cpu_s" in row else ""
    place = ", ".join(f"{key} {value:.4g}" for key, value in row["worst_place"].items())
    return f"{row['where']:36}{row['KiB']:9.0f} KiB{bake}{figures}  {row['table']} (worst: {place})"


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.tables", description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    parser.add_argument("--part", choices=tuple(PARTS), help="only this part")
    parser.add_argument("--threads", type=int, metavar="N", help="how many to use (default: all cores)")
    options = parser.parse_args(arguments)
    if options.threads:
        dr.set_thread_count(options.threads)
    found: dict[str, list[Row]] = {}
    for part in [options.part] if options.part else PARTS:
        if not options.json:
            print(f"\n{part}" + ("" if part == "time" else ": error in per cent, median, p95, p99, worst"))
        for row in PARTS[part]():
            found.setdefault(part, []).append(row)
            if not options.json:
                print(line(row), flush=True)
    if options.json:
        print(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
