"""What derivatives cost beside the sky itself: ``python -m bench.gradients [--views N] [--tolerance T]``.

Every row is measured in a process of its own, warm: each turn has another atmosphere of the same profiles, as a fit
has. CPU milliseconds, the median of many turns, and the most memory beyond imports: of several rounds, each with all
rows, the medians, and those of the quotients within a round.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from typing import Any

import numpy as np

TURNS, ROUNDS = 12, 3
VALUES = ("mie.scattering_per_m", "mie.phase.g", "ground_albedo", "rayleigh.scattering_per_m")
ALL_VALUES = (*VALUES, "mie.single_scattering_albedo", "ozone.absorption_per_m", "solar_irradiance")
PROFILES = ("rayleigh.scale_height_m", "mie.scale_height_m", "ozone.center_m", "ozone.half_width_m")
OF_VIEWS = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg")
ROWS = {
    "solve": "solve",
    "primal": "solve and evaluate (Sky.rays)",
    "forward 1": "forward, 1 parameter",
    "forward 4": "forward, 4 parameters",
    "forward profile": "forward, 1 parameter of a profile",
    "reverse values": "reverse, all coefficients, g, albedos, solar irradiance",
    "reverse shape": "reverse, these and all profiles",
    "reverse all": "reverse, these and all of the views",
    "fine values": "reverse, all coefficients, g, albedos, solar irradiance, with `fine`",
}


def measure(row: str, views: int, tolerance: float) -> dict[str, float]:
    """CPU and wall milliseconds and MiB of one row."""
    import drjit as dr

    from atmo_jit import Atmosphere, Linearization, Sky
    from atmo_jit.backend import doubles

    from .cost import memory_mib, timed

    rng = np.random.default_rng(0)
    where = {
        "altitude_m": np.zeros(views),
        "sun_zenith_deg": np.full(views, 60.0),
        "view_zenith_deg": rng.uniform(0.0, 85.0, views),
        "azimuth_deg": rng.uniform(0.0, 180.0, views),
    }
    earth, turn = Atmosphere.load("earth"), 0
    dr.eval(doubles([1.0]) + 1.0)
    before = memory_mib()

    def another() -> Any:
        nonlocal turn
        turn += 1
        return earth.replace({"mie.scattering_per_m": [4e-6 * (1.0 + 0.001 * turn)] * 3})

    def work() -> None:
        kind, _, what = row.partition(" ")
        if kind in ("solve", "primal"):
            sky = Sky(another(), tolerance=tolerance)
            if kind == "primal":
                angles = [doubles(np.radians(where[name])) for name in OF_VIEWS[1:]]
                dr.eval(sky.rays(doubles(where["altitude_m"]), *angles).radiance)
        else:
            at = Linearization(another(), where, tolerance=tolerance, fine=kind == "fine")
            if kind == "forward":
                at.jacobian({"1": VALUES[:1], "4": VALUES, "profile": PROFILES[:1]}[what])
            else:
                more = {"values": (), "shape": PROFILES, "all": (*PROFILES, *OF_VIEWS)}[what]
                at.vjp({"radiance": 1.0}, (*ALL_VALUES, *more))
        dr.sync_thread()

    for _ in range(3):
        work()
    times = timed(work, TURNS)
    return {
        "cpu_ms": 1e3 * times["cpu_s"],
        "wall_ms": 1e3 * times["wall_s"],
        "peak_mib": memory_mib(peak=True) - before,
    }


def table(views: int, tolerance: float) -> str:
    """The rows as Markdown."""
    rounds = [{row: _measured(row, views, tolerance) for row in ROWS} for _ in range(ROUNDS)]
    lines = [f"| {views} views, tolerance {tolerance:g} | CPU ms | of primal | MiB | of primal |"]
    lines.append("|---|---|---|---|---|")
    for row, text in ROWS.items():
        cells = []
        for key in ("cpu_ms", "peak_mib"):
            value = statistics.median(found[row][key] for found in rounds)
            share = statistics.median(found[row][key] / found["primal"][key] for found in rounds)
            cells += [f"{value:.0f}", f"{share:.1f}"]
        lines.append(f"| {text} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _measured(row: str, views: int, tolerance: float) -> dict[str, float]:
    command = [sys.executable, "-m", __spec__.name if __spec__ else "bench.gradients", "--row", row]
    command += ["--views", str(views), "--tolerance", str(tolerance)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=256)
    parser.add_argument("--tolerance", type=float, default=0.01)
    parser.add_argument("--row", choices=ROWS)
    given = parser.parse_args()
    if given.row:
        print(json.dumps(measure(given.row, given.views, given.tolerance)))
    else:
        print(table(given.views, given.tolerance))


if __name__ == "__main__":
    main()
