"""Peers in the same run: discrete ordinates, path tracing, and an emitter of another kind of sky.

Each row has ``method``, ``setting``, ``note`` (one line); peers that compute the same light have ``groups``, error rows
as those of methods, with ``cpu_s`` the mean CPU seconds of all rays of an atmosphere.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from atmo_jit.errors import LLVMError

from .cost import timed
from .truth import FEW_CASES, Truth

STREAMS = ((8, 1), (16, 1), (16, 9))
SAMPLES = (64, 1024)
WIDTH, HEIGHT = 1280, 720


def rows(truth: Truth, quick: bool, skipped: list[dict[str, str]]) -> list[dict[str, Any]]:
    """A row per peer and setting; what cannot be measured here goes to ``skipped`` with its reason."""
    found: list[dict[str, Any]] = []
    for name, measure in (
        ("sasktran2", discrete_ordinates),
        ("path tracer", path_tracer),
        ("sunsky", emitters),
    ):
        try:
            found += measure(truth, quick)
        except (ImportError, PackageNotFoundError, LLVMError) as error:
            skipped.append({"what": name, "reason": f"{error} (optional extras: pip install 'atmo-jit[peers]')"})
    return found


def discrete_ordinates(truth: Truth, quick: bool) -> Iterator[dict[str, Any]]:
    """SASKTRAN2 on the same atmospheres and rays, one thread."""
    number = version("sasktran2")
    from .discrete_ordinates import DiscreteOrdinates

    cases = FEW_CASES if quick else None
    for streams, suns in STREAMS[:1] if quick else STREAMS:
        value, seconds = asked(truth, lambda air, a=streams, b=suns: DiscreteOrdinates(air, a, b).radiance, cases)
        yield _row("sasktran2", f"{streams} streams, {suns} suns", f"version {number}", truth, value, seconds)


def path_tracer(truth: Truth, quick: bool) -> Iterator[dict[str, Any]]:
    """This package's own reference: unbiased paths through the medium ``atmosphere_medium``."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    from atmo_jit.plugins import register
    from atmo_jit.plugins.rays import PathTracedSky

    register()
    for samples in SAMPLES[:1] if quick else SAMPLES:

        def solve(air: Any, samples: int = samples) -> Callable[[Any, Any], np.ndarray]:
            return lambda views, channel: PathTracedSky(air).radiance(views, samples, channel=channel)[0]

        value, seconds = asked(truth, solve, FEW_CASES if quick else None, by_channel=True)
        yield _row("path tracer", f"{samples} paths a ray", "unbiased: the error is noise", truth, value, seconds)


def asked(
    truth: Truth, solve: Callable[[Any], Any], cases: tuple[str, ...] | None, *, by_channel: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """(radiance, CPU seconds of all rays of the atmosphere) [N] of every ray; the second of two runs is timed.

    ``solve(atmosphere)`` is a function of the views, and ``by_channel`` also of the wavelength's index of each.
    """
    value, seconds = np.full(truth.L.shape, np.nan), np.full(truth.L.shape, np.nan)
    for case in truth.cases:
        if cases is not None and case.name not in cases and any(c.name in cases for c in truth.cases):
            continue
        radiance = solve(case.atmosphere)
        for _ in range(2):
            start = time.process_time()
            found = radiance(case.views, case.channel) if by_channel else radiance(case.views)
            seconds[case.rows] = time.process_time() - start
        value[case.rows] = found if by_channel else found[np.arange(len(case.rows)), case.channel]
    return value, seconds


def _row(method: str, setting: str, note: str, truth: Truth, value: np.ndarray, seconds: np.ndarray) -> dict[str, Any]:
    groups = truth.rows(value, seconds)
    day = next(row for row in groups if row["group"] == "day")
    text = f"{note}; day p95 {day['p95']:.3g} %, {np.nanmean(seconds):.3g} CPU s for the rays of an atmosphere"
    return {"method": method, "setting": setting, "note": text, "groups": groups}


def emitters(truth: Truth, quick: bool) -> Iterator[dict[str, Any]]:
    """Evaluation of a sky of 1280x720 directions by Mitsuba's emitter ``sunsky`` and by this package's."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register

    register()
    width, height = (160, 90) if quick else (WIDTH, HEIGHT)
    direction = _sky_directions(width, height)
    for name, parameters in (("sunsky", {"turbidity": 3.0}), ("atmosphere", {})):
        start = time.perf_counter()
        emitter = mi.load_dict({"type": name, "sun_direction": [0.0, 0.8, 0.6], "sun_scale": 0.0, **parameters})
        loaded = time.perf_counter() - start

        def evaluate(emitter: Any = emitter) -> None:
            hit = dr.zeros(mi.SurfaceInteraction3f, width * height)
            hit.wi = mi.Vector3f(*direction)
            hit.wavelengths = mi.Color0f()
            dr.eval(emitter.eval(hit))
            dr.sync_thread()

        cost = timed(evaluate, 3 if quick else 9)
        note = f"{1e3 * cost['wall_s']:.2f} ms wall, {1e3 * cost['cpu_s']:.2f} ms CPU; loading {loaded:.2f} s wall"
        setting = f"emitter, {width}x{height} directions"
        yield {"method": name, "setting": setting, "note": note, **cost, "load_wall_s": loaded}


def _sky_directions(width: int, height: int) -> list[Any]:
    """Incident directions (seen from the sky) of a latitude-longitude picture of the upper half of the sky."""
    import mitsuba as mi

    azimuth, zenith = np.meshgrid(
        (np.arange(width) + 0.5) * 2.0 * math.pi / width, (np.arange(height) + 0.5) * 0.5 * math.pi / height
    )
    sine = np.sin(zenith)
    columns = (-sine * np.cos(azimuth), -sine * np.sin(azimuth), -np.cos(zenith))
    return [mi.Float(column.ravel().astype(np.float32)) for column in columns]
