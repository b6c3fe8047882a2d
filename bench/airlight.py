"""What the integrator ``atmosphere_path`` saves on a ray, and what it costs in accuracy.

    python -m bench.airlight

``atmo_jit.march`` of random rays (1 m to 10 km up, suns from the zenith to 92 degrees) with the solved field and four
nodes a piece, as ``Sky.rays`` does it, and with the integrator's table of the field and two nodes. Errors are relative
to the first, in per cent; CPU microseconds are the least of several runs over rays side by side in a picture.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.bake.source import SourceTable
from atmo_jit.march import NODES, march
from atmo_jit.solved import Sky

FEW_NODES = 2  # plugins.airlight.NODES
RAYS, RUNS = 1 << 15, 7
AIRS = {"earth": {}, "haze": {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.8}}


def radiance(band: Any, rays: Any, source: Any, nodes: int) -> np.ndarray:
    """Radiance [C, N] of rays."""
    light = march(band.optics, band.columns, rays, source=source, nodes=nodes)
    dr.eval(light.single, light.multiple, light.transmittance)
    return np.array([a.numpy() + b.numpy() for a, b in zip(light.single, light.multiple, strict=True)])


def main() -> int:
    rng = np.random.default_rng(1)
    for name, changes in AIRS.items():
        sky = Sky(Atmosphere.load("earth").replace(changes))
        (band,) = sky.bands
        started = time.process_time()
        table = SourceTable(band.field)
        made = time.process_time() - started
        u = [rng.random(RAYS) for _ in range(4)]
        anywhere = (10.0 ** (4.0 * u[0]), np.radians(92.0 * u[1]), np.arccos(2.0 * u[2] - 1.0), 2.0 * np.pi * u[3])
        along = np.linspace(0.0, 1.0, RAYS)
        picture = (np.full(RAYS, 2.0), np.full(RAYS, 1.0), np.arccos(0.3 + 0.5 * along), 1.0 + along)
        random, regular = (sky.enter(*map(doubles, views))[0] for views in (anywhere, picture))
        cases = {
            "field": (band.source, NODES),
            "field, few nodes": (band.source, FEW_NODES),
            "table": (table, NODES),
            "table, few nodes": (table, FEW_NODES),
        }
        truth = radiance(band, random, *cases["field"])
        print(f"{name}: table of {table.nbytes / 1e6:.0f} MB made in {made:.2f} CPU s")
        for case, (source, nodes) in cases.items():
            error = 100.0 * np.abs(radiance(band, random, source, nodes) / truth - 1.0)
            best = np.inf
            for _ in range(RUNS):
                started = time.process_time()
                radiance(band, regular, source, nodes)
                best = min(best, time.process_time() - started)
            parts = {"median": 50, "p95": 95, "p99": 99}
            figures = ", ".join(f"{part} {np.percentile(error, q):.3f}" for part, q in parts.items())
            print(f"  {case:18} {1e6 * best / RAYS:6.2f} us a ray; error % {figures}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
