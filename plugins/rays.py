"""Path-traced radiance of single rays, with its standard error: the form in which the reference is compared with
numbers.

    mi.set_variant("llvm_ad_mono")
    sky = PathTracedSky("earth")
    mean, error, hits = sky.radiance(views, samples=100_000)      # views as for atmo_jit.sky; 1/sr, [N, W]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere

from .planet import planet

# Paths in flight at a time: about 0.3 GB.
BATCH = 2**20
# Deep enough that roulette only ends what has lost nearly everything.
ROULETTE_DEPTH = 1000
LOW_SUN_DEG = 85.0  # zenith angle beyond which few paths find the light by themselves


def tracer_of(name: str, max_depth: int = -1, **options: Any) -> Any:
    """An integrator for :func:`trace`, ``options`` as for ``mi.load_dict``.

    The roulette of Mitsuba's own integrators would end paths in the air that have lost little.
    """
    roulette = {} if name == "atmosphere_volpath" else {"rr_depth": ROULETTE_DEPTH}
    return mi.load_dict({"type": name, "max_depth": max_depth, **roulette, **options})


def trace(
    scene: Any,
    medium: Any,
    origin: np.ndarray,
    direction: np.ndarray,
    time: np.ndarray | None,
    samples: int,
    *,
    seed: int = 0,
    max_depth: int = -1,
    integrator: Any = "atmosphere_volpath",
    advance: Callable[[float], None] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean radiance, its standard error, and the number of samples that were not 0: [N, channels], [N, channels], [N].

    origin, direction: [N, 3], scene units; time [N], None for random ones from 0 to 1; medium: the one that the rays
    start in; samples: of each ray, rounded up to whole batches; integrator: its name, or one that was made before (and
    then knows its own max_depth). For vectorised variants that are not polarised."""
    tracer = tracer_of(integrator, max_depth) if isinstance(integrator, str) else integrator
    sampler = mi.load_dict({"type": "independent"})
    count = len(origin)
    each = max(1, min(samples, BATCH // count))
    batches = -(-samples // each)
    start = [mi.Float(column.tolist()) for column in (*origin.T, *direction.T)]
    at = None if time is None else mi.Float(time.tolist())
    total = squares = hits = 0.0
    for batch in range(batches):
        sampler.seed(seed * batches + batch, count * each)
        ray_index = dr.arange(mi.UInt32, count * each) // each
        o, d = start[:3], start[3:]
        ray = dr.zeros(mi.RayDifferential3f, count * each)
        ray.o = mi.Point3f(*(dr.gather(mi.Float, c, ray_index) for c in o))
        ray.d = mi.Vector3f(*(dr.gather(mi.Float, c, ray_index) for c in d))
        ray.time = sampler.next_1d() if at is None else dr.gather(mi.Float, at, ray_index)
        ray.maxt = dr.inf
        radiance = tracer.sample(scene, sampler, ray, medium)[0]
        dr.eval(radiance)  # all channels in one kernel
        values = np.stack([np.array(c, dtype=np.float64) for c in radiance], axis=-1).reshape(count, each, -1)
        total, squares = total + values.sum(axis=1), squares + (values**2).sum(axis=1)
        hits = hits + (values != 0.0).any(axis=-1).sum(axis=1)
        if advance:
            advance((batch + 1) / batches)
    number = each * batches
    mean = total / number
    return mean, np.sqrt(np.maximum(squares / number - mean**2, 0.0) / max(number - 1, 1)), hits


class PathTracedSky:
    """Radiance of a list of views, as ``atmo_jit.sky`` takes them, in sunlight of irradiance 1 at every wavelength."""

    def __init__(self, atmosphere: Any) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)

    def radiance(
        self,
        views: Mapping[str, np.ndarray],
        samples: int,
        *,
        channel: np.ndarray | None = None,
        integrator: str = "atmosphere_volpath",
        max_depth: int = -1,
        **options: Any,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean (1/sr), standard error and number of samples that were not 0, all [N, W]; options as for :func:`trace`.

        channel: index [N] of the only wavelength that is wanted of each view; the results then are [N]. While the sun
        is lower than LOW_SUN_DEG the tables guide ``atmosphere_volpath``.
        """
        count = len(self.atmosphere.wavelengths_nm)
        view = {name: np.asarray(values, dtype=np.float64) for name, values in views.items()}
        wanted = np.arange(count)[None] if channel is None else np.asarray(channel)[:, None]
        wavelength = np.broadcast_to(wanted, (len(view["altitude_m"]), wanted.shape[1]))
        results = [np.zeros(wavelength.shape) for _ in range(3)]
        for zenith in np.unique(view["sun_zenith_deg"]):
            rows = np.flatnonzero(view["sun_zenith_deg"] == zenith)
            s, v, a = (
                np.radians(zenith),
                np.radians(view["view_zenith_deg"][rows]),
                np.radians(view["azimuth_deg"][rows]),
            )
            parts = planet(self.atmosphere, sun_direction=[np.sin(s), 0.0, np.cos(s)], sun="each")
            air = parts.pop("air")
            direction = np.stack([np.sin(v) * np.cos(a), np.sin(v) * np.sin(a), np.cos(v)], axis=-1)
            origin = np.stack([0.0 * v, 0.0 * v, view["altitude_m"][rows]], axis=-1)
            repeat = wavelength.shape[1]
            guided = {"guided": True} if integrator == "atmosphere_volpath" and zenith > LOW_SUN_DEG else {}
            time = (wavelength[rows].ravel() + 0.5) / count
            found = trace(
                mi.load_dict({"type": "scene", **parts}),
                air,
                np.repeat(origin, repeat, axis=0),
                np.repeat(direction, repeat, axis=0),
                time,
                samples,
                integrator=tracer_of(integrator, max_depth, **guided),
                **options,
            )
            for result, values in zip(results, (found[0][:, 0], found[1][:, 0], found[2]), strict=True):
                result[rows] = values.reshape(len(rows), repeat)
        mean, error, hits = (result if channel is None else result[:, 0] for result in results)
        return mean, error, hits
