"""Measures the constants of ``atmo_jit/costs.py`` on this machine and prints them as they stand there.

    python -m bench.constants

Solves of several atmospheres at several tolerances give the seconds per pass of each loop (non-negative least squares
of relative errors), evaluations of many views the seconds of a ray, processes of their own the memory, and the
reference data, where they are, the errors.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np

from atmo_jit import costs
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.harmonics import pair_count
from atmo_jit.resolution import Resolution

from .cost import cost, memory_mib, timed
from .methods import METHODS, TOLERANCES, OwnSky, columns_of
from .speed import random_views
from .truth import Truth

CHANGES: dict[str, dict[str, Any]] = {
    "earth": {},
    "gas alone": {"mie": None},
    "haze": {"mie.scattering_per_m": 5e-5, "ground_albedo": 0.3},
    "thick haze": {"mie.scattering_per_m": 1e-4, "ground_albedo": 0.9},
    "one wavelength": {},
}
VIEWS = 50_000
VIEW_MEMORY = "view-memory"  # the argument with which a process of its own measures that


def atmospheres() -> dict[str, Atmosphere]:
    """The atmospheres that are measured."""
    found = {name: Atmosphere.load("earth").replace(changes) for name, changes in CHANGES.items()}
    from .curves import spectral

    found["one wavelength"] = spectral(found["earth"], 1)
    return found


def solves(tolerances: tuple[float, ...] = (0.03, 0.01, 0.003), repeats: int = 3) -> list[dict[str, Any]]:
    """CPU seconds and loop sizes of every solve."""
    rows = []
    for name, air in atmospheres().items():
        for tolerance in tolerances:
            resolution = Resolution.suited(air, tolerance)
            orders = costs.orders_expected(air, tolerance, resolution.orders)
            seconds = timed(lambda a=air, t=tolerance: OwnSky(a, t), repeats)["cpu_s"]
            sizes = costs.loop_sizes(resolution, orders)
            rows.append({"atmosphere": name, "tolerance": tolerance, "cpu_s": seconds, "sizes": sizes})
    return rows


def fitted(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Seconds per pass: the non-negative combination of loop sizes that is closest to the seconds, relatively."""
    from scipy.optimize import nnls

    names = list(rows[0]["sizes"])
    seconds = np.array([row["cpu_s"] for row in rows])
    design = np.array([[row["sizes"][name] for name in names] for row in rows]) / seconds[:, None]
    scale = design.max(axis=0)
    found, _ = nnls(design / scale, np.ones(len(rows)))
    return {name: float(v) for name, v in zip(names, found / scale, strict=True)}


def rays() -> dict[str, float]:
    """CPU seconds of a view: per band and per moment of it."""
    import drjit as dr

    points = []
    for name, air in atmospheres().items():
        if name == "one wavelength":
            continue
        solved = OwnSky(air, 0.01)
        columns = columns_of(random_views(VIEWS))

        def evaluate(columns: list[Any] = columns, solved: OwnSky = solved) -> None:
            dr.eval(solved.sky.rays(*columns).radiance)
            dr.sync_thread()

        points.append((pair_count(solved.sky.resolution.first_degree), timed(evaluate, 3)["cpu_s"] / VIEWS))
    moments, seconds = (np.array(column) for column in zip(*points, strict=True))
    design = np.column_stack([np.ones(len(points)), moments]) / seconds[:, None]
    from scipy.optimize import nnls

    (band, moment), _ = nnls(design, np.ones(len(points)))
    return {"band": float(band), "moment": float(moment)}


def memory() -> dict[str, float]:
    """MiB: fixed and per square of the largest table's MiB from solves, per view from an evaluation."""
    air = Atmosphere.load("earth")
    points = []
    for tolerance in (0.1, 0.01, 0.001):
        found = cost("atmo-jit", f"tolerance {tolerance:g}", "earth", 0)
        points.append((costs.table_mib(Resolution.suited(air, tolerance), 3), found["peak_mib"]))
    tables, peaks = (np.array(column) for column in zip(*points, strict=True))
    square, fixed = np.polyfit(tables**2, peaks, 1, w=1.0 / peaks)
    return {"fixed": max(float(fixed), 0.0), "square": max(float(square), 0.0), "view": _mib_of_a_view()}


def _mib_of_a_view() -> float:
    """MiB of a view in ``atmo_jit.sky``: arguments in double and results in single precision, and what is marched."""
    command = [sys.executable, "-m", "atmo_jit.bench.constants", VIEW_MEMORY]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def _growth_by_views() -> float:
    """How much the peak of this process grows by as many views as are evaluated at once, MiB per view."""
    import atmo_jit

    atmo_jit.sky("earth", random_views(1000))
    before = memory_mib(peak=True)
    atmo_jit.sky("earth", random_views(costs.VIEWS_AT_ONCE))
    return max(memory_mib(peak=True) - before, 0.0) / costs.VIEWS_AT_ONCE


def errors() -> dict[float, tuple[float, float]]:
    """95th percentile (%) of the error by tolerance: day rays through clear air, and through haze. The noise of the
    reference is part of it (0.23 %), so that a prediction errs on the safe side."""
    truth = Truth.of_reference()
    found = {}
    for tolerance in sorted(TOLERANCES, reverse=True):
        value, _ = truth.radiance(lambda a, t=tolerance: METHODS["atmo-jit"].solve(f"tolerance {t:g}", a), once=True)
        groups = {row["group"]: row["p95"] for row in truth.rows(value)}
        found[tolerance] = (groups["day"], groups["haze"])
    return found


def block() -> str:
    """The constants as lines of ``costs.py``."""
    rows = solves()
    seconds = fitted(rows)
    for row in rows:
        model = sum(seconds[name] * size for name, size in row["sizes"].items())
        print(
            f"{row['atmosphere']:16} {row['tolerance']:6g} {row['cpu_s']:8.3f} s, model {model:8.3f} s", file=sys.stderr
        )

    def shown(values: dict[str, float]) -> str:
        return "{" + ", ".join(f'"{name}": {value:.3g}' for name, value in values.items()) + "}"

    lines = [f"SECONDS = {shown(seconds)}", f"RAY_SECONDS = {shown(rays())}", f"MEMORY = {shown(memory())}"]
    try:
        pairs = ", ".join(f"{t:g}: ({a:.3g}, {b:.3g})" for t, (a, b) in errors().items())
        lines.append(f"ERRORS = {{{pairs}}}")
    except FileNotFoundError as error:
        lines.append(f"# ERRORS: not measured, {error}")
    lines.append(f"BARE_NANOSECONDS = {costs.bare_nanoseconds():.3g}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(_growth_by_views() if sys.argv[1:] == [VIEW_MEMORY] else block())
