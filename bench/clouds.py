"""White clouds over white ground: what part of the light comes back, and what their solve takes.

    python -m bench.clouds                      # gas and aerosol of optical depths 10 to 160
    python -m bench.clouds --depths 40

Processor seconds of a solve are the least of three on nodes that are there already, of all threads.
"""

from __future__ import annotations

import argparse
import time

import atmo_jit

from .invariants import returned_light
from .monte_carlo import load_twins
from .worlds import world


def cloud(kind: str, depth: float) -> dict:
    """Gas, or aerosol with g = 0.85, that absorbs nothing, over ground that absorbs nothing."""
    white = {"wavelengths_nm": [550], "solar_irradiance": 1, "ground_albedo": 1.0}
    if kind == "gas":
        return world(**white, rayleigh={"scattering_per_m": depth / 5000.0, "scale_height_m": 5000}, mie=None)
    phase = {"type": "henyey_greenstein", "g": 0.85}
    aerosol = {"scattering_per_m": depth / 2000.0, "single_scattering_albedo": 1.0, "scale_height_m": 2000}
    return world(**white, rayleigh=None, mie={**aerosol, "phase": phase})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depths", type=float, nargs="+", default=[10.0, 20.0, 40.0, 80.0, 160.0])
    twins = load_twins()
    print("| cloud | depth | light returned | solve, CPU s |\n|---|---|---|---|")
    for kind in ("gas", "aerosol"):
        for depth in parser.parse_args().depths:
            air, seconds = cloud(kind, depth), []
            back = returned_light(air, twins.Twin(air))[0]
            for _ in range(3):
                before = time.process_time()
                atmo_jit.Sky(air)
                seconds.append(time.process_time() - before)
            print(f"| {kind} | {depth:g} | {back:.4f} | {min(seconds):.2f} |", flush=True)


if __name__ == "__main__":
    main()
