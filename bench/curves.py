"""How cost grows with size: resolution, wavelengths, views, threads; and a GPU where one is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.resolution import Resolution

from .cost import cost, timed
from .methods import DEFAULT_TOLERANCE, OwnSky, columns_of, scaled
from .page import table
from .speed import random_views

FACTORS, FINEST = (0.5, 0.7, 1.0, 1.4), 2.8
WAVELENGTHS = (1, 2, 4, 8, 16, 24, 40)


def measure(
    atmosphere: str = "earth", quick: bool = False, most_views: int = 10**6, skipped: list[dict[str, str]] | None = None
) -> dict[str, Any]:
    """All curves: ``resolution``, ``wavelengths``, ``views``, ``threads`` and, where there is a GPU, ``cuda``."""
    air = Atmosphere.load(atmosphere)
    repeats = 1 if quick else 5
    result = {
        "resolution": resolutions(air, (0.5, 0.7), 1.0, 100) if quick else resolutions(air, FACTORS, FINEST),
        "wavelengths": wavelengths(air, (1, 4) if quick else WAVELENGTHS, repeats),
        "views": views(air, 10**3 if quick else most_views, repeats),
        "threads": threads(air, repeats),
    }
    cuda = gpu(atmosphere, repeats)
    if cuda:
        result["cuda"] = cuda
    elif skipped is not None:
        skipped.append({"what": "GPU", "reason": "no CUDA device that Dr.Jit can use"})
    if skipped is not None and most_views < 10**7:
        skipped.append({"what": f"curve of views beyond {most_views:,}", "reason": "ask with --views 10000000"})
    return result


def resolutions(air: Atmosphere, factors: tuple[float, ...], finest: float, rays: int = 400) -> dict[str, Any]:
    """CPU seconds and the difference to ``finest`` times the resolution of the default tolerance, per factor.

    ``order``: of convergence, the slope of log p95 over -log factor (least squares); ``cost_power``: that of the CPU
    seconds over log factor.
    """
    base = Resolution.suited(air, DEFAULT_TOLERANCE)
    asked = random_views(rays, seed=5)
    asked["altitude_m"][::2] = 0.0

    def solve(factor: float) -> OwnSky:
        return OwnSky(air, 1e-4, scaled(base, factor))

    truth = solve(finest).radiance(asked)
    bright = truth > 1e-3 * truth.max(axis=0)
    rows = []
    for factor in factors:
        seconds = timed(lambda factor=factor: solve(factor), 1)
        error = np.abs(solve(factor).radiance(asked) / np.where(bright, truth, 1.0) - 1.0)[bright]
        median, p95 = (float(np.percentile(error, p) * 100) for p in (50, 95))
        rows.append({"factor": factor, **seconds, "median": median, "p95": p95})
    x = np.log([row["factor"] for row in rows])
    slopes = {
        "order": -np.polyfit(x, np.log([row["p95"] for row in rows]), 1)[0],
        "cost_power": np.polyfit(x, np.log([row["cpu_s"] for row in rows]), 1)[0],
    }
    return {"rows": rows, "finest": finest, **{name: float(slope) for name, slope in slopes.items()}}


def spectral(air: Atmosphere, count: int) -> Atmosphere:
    """``air`` at ``count`` wavelengths over its own range, its coefficients interpolated in log wavelength."""
    nm = air.wavelengths_nm
    low, high = float(nm.min()), float(nm.max())
    at = np.linspace(high, low, count) if count > 1 else np.array([float(np.median(nm))])
    document = air.to_dict()

    def resample(node: Any) -> Any:
        if isinstance(node, dict):
            # Lists that are not per wavelength: profiles, and tabulated or expanded phase functions.
            kept = ("profile", "cos_theta", "values", "moments")
            return {k: v if k in kept else resample(v) for k, v in node.items()}
        if isinstance(node, list) and node and isinstance(node[0], dict):
            return [resample(v) for v in node]
        if isinstance(node, list) and len(node) == len(nm):
            order = np.argsort(nm)
            return np.interp(np.log(at), np.log(nm[order]), np.asarray(node, float)[order]).tolist()
        return node

    return Atmosphere({**resample(document), "wavelengths_nm": at.tolist()})


def _line(rows: list[dict[str, Any]], key: str) -> dict[str, float]:
    """CPU seconds as ``fixed`` + ``each`` times the size, by relative least squares, and the largest deviation."""
    size, seconds = (np.array([row[k] for row in rows], float) for k in (key, "cpu_s"))
    design = np.column_stack([np.ones_like(size), size]) / seconds[:, None]
    (fixed, each), *_ = np.linalg.lstsq(design, np.ones_like(size), rcond=None)
    deviation = np.abs((fixed + each * size) / seconds - 1.0).max()
    return {"fixed_cpu_s": float(fixed), "each_cpu_s": float(each), "deviation": float(deviation)}


def wavelengths(air: Atmosphere, counts: tuple[int, ...], repeats: int) -> dict[str, Any]:
    """Seconds of a solve per number of wavelengths."""
    rows = []
    for count in counts:
        changed = spectral(air, count)
        rows.append({"wavelengths": count, **timed(lambda a=changed: OwnSky(a, DEFAULT_TOLERANCE), repeats)})
    return {"rows": rows, **_line(rows, "wavelengths")}


def views(air: Atmosphere, most: int, repeats: int) -> dict[str, Any]:
    """Seconds of the evaluation per number of views (any observer and sun), powers of ten from 100."""
    import drjit as dr

    solved = OwnSky(air, DEFAULT_TOLERANCE)
    rows, count = [], 100
    while count <= most:
        columns = columns_of(random_views(count))

        def evaluate(columns: list[Any] = columns) -> None:
            dr.eval(solved.sky.rays(*columns).radiance)
            dr.sync_thread()

        rows.append({"views": count, **timed(evaluate, repeats if count <= 10**5 else 1)})
        count *= 10
    return {"rows": rows, **_line(rows, "views")}


def threads(air: Atmosphere, repeats: int) -> list[dict[str, Any]]:
    """Seconds of a solve with one thread and with all."""
    import drjit as dr

    before = dr.thread_count()
    rows = []
    try:
        for count in sorted({1, before}):
            dr.set_thread_count(count)
            rows.append({"threads": count, **timed(lambda: OwnSky(air, DEFAULT_TOLERANCE), repeats)})
    finally:
        dr.set_thread_count(before)
    return rows


def gpu(atmosphere: str, repeats: int) -> dict[str, Any] | None:
    """What ``bench.cost.cost`` finds on the CUDA backend; None where there is none."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.CUDA):
        return None
    return cost("atmo-jit", f"tolerance {DEFAULT_TOLERANCE:g}", atmosphere, repeats, backend="cuda")


HEAD = """## How cost grows

**Resolution.** Every count of nodes, directions and moments of the default tolerance times a factor, against {finest:g}
times: the 95th percentile of the difference falls with the power {order:.2f} of the factor, the cost grows with the
power {cost_power:.2f}.
"""
WAVES = """**Wavelengths.** A solve takes {fixed:.3f} + {each:.4f} W CPU seconds, within {deviation:.0f} % (groups of
four share their geometry).
"""
RAYS = """**Views.** An evaluation takes {fixed:.1f} ms + {each:.2f} us per ray of CPU time, within {deviation:.0f} %.
"""


def section(curves: Mapping[str, Any]) -> str:
    """The curves in Markdown."""
    waves, rays = curves["wavelengths"], curves["views"]
    time = {"cpu_s": "CPU s", "wall_s": "wall s"}
    parts = [
        HEAD.format(**curves["resolution"]),
        table(curves["resolution"]["rows"], {"factor": "factor", **time, "median": "median %", "p95": "p95 %"}),
        WAVES.format(fixed=waves["fixed_cpu_s"], each=waves["each_cpu_s"], deviation=100 * waves["deviation"]),
        table(waves["rows"], {"wavelengths": "wavelengths", **time}),
        RAYS.format(fixed=1e3 * rays["fixed_cpu_s"], each=1e6 * rays["each_cpu_s"], deviation=100 * rays["deviation"]),
        table(rays["rows"], {"views": "views", **time}),
        "**Threads.** A solve with one thread and with all.\n",
        table(curves["threads"], {"threads": "threads", **time}),
    ]
    if "cuda" in curves:
        parts.append(f"**GPU.** A solve on CUDA, warm: {curves['cuda']['warm']['wall_s']:.4f} s.\n")
    return "\n".join(parts)


def in_words(curves: Mapping[str, Any]) -> list[str]:
    """The constants, for the terminal."""
    waves, rays, steps = curves["wavelengths"], curves["views"], curves["resolution"]
    return [
        f"order of convergence {steps['order']:.2f}, cost to the power {steps['cost_power']:.2f} of the resolution",
        f"solve: {waves['fixed_cpu_s']:.3f} + {waves['each_cpu_s']:.4f} W CPU s for W wavelengths",
        f"views: {1e3 * rays['fixed_cpu_s']:.1f} ms + {1e6 * rays['each_cpu_s']:.2f} us each, CPU",
    ]
