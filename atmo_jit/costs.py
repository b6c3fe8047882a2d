"""What a solve and its views will cost and how accurate they will be, before they are made.

The forms are those of the algorithm: a solve's seconds are a sum of loop sizes, each times a constant. The constants
are measured, by ``python -m bench.constants``, which prints this module's block of them; another machine is taken for
faster or slower by the ratio of one bare loop's speed (:func:`machine_factor`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from .atmosphere import Atmosphere
from .backend import padded
from .harmonics import pair_count
from .optics import MAX_CHANNELS
from .resolution import Resolution

VIEWS_AT_ONCE = 1 << 18  # of atmo_jit.sky: bounds memory

# --- printed by `python -m bench.constants` ---
# CPU seconds per unit of each loop's size (see `loop_sizes`), kernels warm.
SECONDS = {"fixed": 0.00552, "beam": 2.74e-09, "project": 0, "gather": 0, "contract": 4.25e-09}
# CPU seconds of a view: first for every band of wavelengths, then for each moment of it.
RAY_SECONDS = {"band": 1.14e-06, "moment": 4.79e-08}
# MiB beyond imports: fixed, per square of the MiB of the largest table of order 1 (tables along the paths between the
# nodes grow with the square of those at the nodes), per view evaluated at once.
MEMORY = {"fixed": 11.7, "square": 1.2, "view": 0.000242}
# 95th percentile of the error (per cent) by tolerance: clear air, haze, against independent references, their noise
# included.
ERRORS = {0.1: (0.481, 0.903), 0.03: (0.353, 0.647), 0.01: (0.242, 0.41), 0.003: (0.212, 0.379), 0.001: (0.196, 0.359)}
# CPU nanoseconds of a pass of the bare loop of `bare_nanoseconds` on the machine that the constants are from.
BARE_NANOSECONDS = 0.406
# --- end ---

HAZE_DEPTH = 0.05  # optical depth of aerosol from which the second column of ERRORS holds
LEAST_ORDERS = 3


@dataclass(frozen=True)
class Cost:
    """A prediction: CPU seconds of the solve and of the views, MiB beyond imports, error (95th percentile, %)."""

    solve_cpu_s: float
    views_cpu_s: float
    mib: float
    error_percent: float

    @property
    def cpu_s(self) -> float:
        """CPU seconds in all."""
        return self.solve_cpu_s + self.views_cpu_s


def orders_expected(atmosphere: Atmosphere, tolerance: float, most: int) -> int:
    """How many orders will be gathered until their extrapolated sum is steady to a tenth of ``tolerance``.

    A photon meets air or ground again with probability q, about s (1 + albedo (1 - s)), s = 1 - exp(-3/4 of the
    scattering optical depth); the extrapolation makes of that the rate of conjugate gradients,
    (1 - sqrt(1 - q)) / (1 + sqrt(1 - q)).
    """
    s = -np.expm1(-0.75 * float(np.max(scattering_depth(atmosphere))))
    root = np.sqrt(1.0 - min(s * (1.0 + float(np.max(atmosphere.ground_albedo)) * (1.0 - s)), 0.999))
    rate = max((1.0 - root) / (1.0 + root), 1e-6)
    return int(np.clip(round(2.0 + np.log(0.1 * tolerance) / np.log(rate)), LEAST_ORDERS, most))


def scattering_depth(atmosphere: Atmosphere) -> np.ndarray:
    """Vertical scattering optical depth [W]."""
    total = np.zeros(len(atmosphere.wavelengths_nm))
    for constituent in atmosphere.constituents:
        total = total + constituent.scattering_per_m * column_m(atmosphere, constituent.profile)
    return total


def column_m(atmosphere: Atmosphere, profile: Any) -> float:
    """Vertical column (m) of a profile's density."""
    h = atmosphere.thickness_m * np.linspace(0.0, 1.0, 2049) ** 3
    return float(np.trapezoid(np.asarray(profile.density(h)), h))


def band_sizes(wavelengths: int) -> list[int]:
    """Wavelengths of each band that is solved together."""
    return [min(MAX_CHANNELS, wavelengths - first) for first in range(0, wavelengths, MAX_CHANNELS)]


def loop_sizes(resolution: Resolution, orders: int) -> dict[str, float]:
    """Passes of the loops of one band's solve.

    ``beam``: sunlight along the paths; ``project``: moments of order 1; ``gather``, ``contract``: the later orders.
    """
    r = resolution
    later = r.stages[-1]
    first_nodes = r.altitudes * (r.first_up + r.first_down) * r.suns * r.first_suns
    paths = r.altitudes * (later.up + later.down) * r.altitudes
    gathers = max(orders - 1, 0)
    return {
        "fixed": 1.0,
        "beam": first_nodes * r.beam_azimuths * r.altitudes * r.beam_refine,
        "project": first_nodes * (r.first_azimuths * (r.first_degree + 1) + pair_count(r.first_degree)),
        "gather": gathers * paths * r.suns * later.azimuths * (later.degree + 1),
        "contract": gathers * paths * r.suns * pair_count(later.degree),
    }


def table_mib(resolution: Resolution, channels: int) -> float:
    """MiB of the largest table of a solve: order 1 at every node, direction, sun and azimuth."""
    r = resolution
    count = r.altitudes * (r.first_up + r.first_down) * r.suns * r.first_suns * r.first_azimuths
    return 4.0 * count * padded(channels) / 2.0**20


def predict(atmosphere: Atmosphere, resolution: Resolution, tolerance: float, orders: int | None, views: int) -> Cost:
    """The cost of a solve and of ``views`` rays marched through it, on this machine."""
    gathered = orders or orders_expected(atmosphere, tolerance, resolution.orders)
    sizes = loop_sizes(resolution, gathered)
    bands = band_sizes(len(atmosphere.wavelengths_nm))
    factor = machine_factor()
    solve = len(bands) * sum(SECONDS[name] * size for name, size in sizes.items())
    moments = pair_count(resolution.first_degree)
    ray = len(bands) * (RAY_SECONDS["band"] + RAY_SECONDS["moment"] * moments)
    at_once = min(views, VIEWS_AT_ONCE)
    memory = MEMORY["fixed"] + MEMORY["square"] * table_mib(resolution, max(bands)) ** 2 + MEMORY["view"] * at_once
    return Cost(factor * solve, factor * ray * views, memory, error_expected(atmosphere, tolerance))


def error_expected(atmosphere: Atmosphere, tolerance: float) -> float:
    """95th percentile of the error (%), interpolated in the logarithms of the measured ones."""
    aerosol = [c.scattering_per_m * column_m(atmosphere, c.profile) for c in atmosphere.mie]
    hazy = bool(aerosol) and float(np.max(sum(aerosol))) > HAZE_DEPTH
    tolerances = sorted(ERRORS)
    errors = [ERRORS[t][int(hazy)] for t in tolerances]
    return float(np.exp(np.interp(np.log(tolerance), np.log(tolerances), np.log(errors))))


@lru_cache(maxsize=1)
def machine_factor() -> float:
    """How much slower this machine is than that of the constants: CPU time of a bare loop, in some milliseconds."""
    return bare_nanoseconds() / BARE_NANOSECONDS


def bare_nanoseconds(lanes: int = 1 << 16, steps: int = 128) -> float:
    """CPU nanoseconds of a pass of a loop with a square root and two exponentials; the fastest of five."""
    import drjit as dr

    from .backend import floats, types

    t = types()
    start = floats(np.linspace(0.0, 1.0, lanes))
    count, scale = dr.opaque(t.UInt, steps, 1), dr.opaque(t.Float, -0.7, 1)

    def step(i: Any, x: Any, total: Any) -> tuple[Any, ...]:
        return i + 1, dr.sqrt(dr.fma(x, x, 0.1)), total + dr.exp(x * scale) + dr.exp(x * x * scale * 0.25)

    best = np.inf
    for _ in range(6):  # the first compiles
        begin = time.process_time()
        state = (t.UInt(0), start, dr.zeros(t.Float, lanes))
        *_, total = dr.while_loop(state, lambda i, *_: i < count, step, max_iterations=-1, label="bare")
        dr.eval(total)
        dr.sync_thread()
        best = min(best, time.process_time() - begin)
    return 1e9 * best / (lanes * steps)
