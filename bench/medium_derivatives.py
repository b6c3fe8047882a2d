"""Derivatives of path-traced radiance by ``prbvolpath`` against ``sky_derivatives.npz``.

    python -m bench.medium_derivatives --samples 1000000            # all 19 rays, 20 minutes on 2 cores
    python -m bench.medium_derivatives --samples 4000000 --rays 14  # some

Each line is one ray: relative difference and standard error of radiance and of its derivatives with respect to aerosol
scattering (at fixed single-scattering albedo), g and ground albedo; then the derivative with respect to the
single-scattering albedo beside the difference quotient of two renders with the same random numbers. ``prbvolpath``
ignores the medium that a sensor is in, so a null sphere is around it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import reference

BATCH = 2**15
DEPTH = {"max_depth": 1000, "rr_depth": 1000}
CAPSULE_M = 0.5
MORE = 4  # times the samples where they say too little
STEP = 0.02  # of the single-scattering albedo, for the difference quotient
TRUTH = ("L", "dL_dbetaM", "dL_dg", "dL_dalbedo")


class RaySensor:
    """A sensor of one pixel that sees along one ray: ``origin`` and ``direction`` are set before use."""

    def __init__(self, props: Any) -> None:
        mi.Sensor.__init__(self, props)

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> tuple[Any, Any]:
        one = dr.ones(mi.Float, dr.width(sample2))  # the integrator counts the samples by the width of what it gets
        ray = mi.Ray3f(mi.Point3f(*self.origin) * one, mi.Vector3f(*self.direction) * one, time, mi.Color0f())
        return ray, mi.Spectrum(one)

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> Any:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return "RaySensor"


def scene_of(data: dict[str, np.ndarray], row: int) -> Any:
    """The scene of one ray of the data."""
    from atmo_jit.plugins.planet import planet
    from atmo_jit.plugins.variants import bound

    s, v, a = (float(np.radians(data[k][row])) for k in ("sun_zenith_deg", "view_zenith_deg", "rel_azimuth_deg"))
    parts = planet(reference.atmosphere_of(data, np.array([row])), sun_direction=[np.sin(s), 0.0, np.cos(s)])
    props = mi.Properties()
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance", "rfilter": {"type": "box"}}
    props["film"], props["sampler"] = mi.load_dict(film), mi.load_dict({"type": "independent"})
    sensor = bound(RaySensor, "Sensor")(props)
    sensor.origin = [0.0, 0.0, float(data["obs_height"][row])]
    sensor.direction = [float(x) for x in (np.sin(v) * np.cos(a), np.sin(v) * np.sin(a), np.cos(v))]
    around = {"type": "sphere", "center": sensor.origin, "radius": CAPSULE_M, "bsdf": {"type": "null"}}
    around["exterior"] = parts["air"]
    integrator = {"type": "prbvolpath", **DEPTH}
    return mi.load_dict({"type": "scene", "integrator": integrator, **parts, "around": around, "sensor": sensor})


def derivatives(data: dict[str, np.ndarray], row: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error [6] of radiance, its four derivatives, and the last one's difference quotient."""
    scene = scene_of(data, row)
    parameters = mi.traverse(scene)
    ends = ("mie.scattering_per_m", "mie.phase.g", "reflectance.value", "mie.single_scattering_albedo")
    names = [next(key for key in parameters.keys() if key.endswith(end)) for end in ends]
    albedo = names[3]
    start = float(data["ssa_M"][row])
    found = []
    least = max(2, -(-samples // BATCH))
    for batch in range(MORE * least):
        if batch == least and not is_noisy(found):
            break
        seed = 1_000_003 * row + 4 * batch
        for name in names:
            parameters[name] = dr.detach(parameters[name])
            dr.enable_grad(parameters[name])
        parameters.update()
        picture = mi.render(scene, parameters, spp=BATCH, seed=seed, seed_grad=seed + 1)
        dr.backward(dr.sum(picture.array))
        gradients = [float(dr.grad(parameters[name])[0]) for name in names]
        ends_of_step = []
        for step in (-STEP, STEP):
            parameters[albedo] = mi.Float(start + step)
            parameters.update()
            ends_of_step.append(float(mi.render(scene, spp=BATCH, seed=seed + 2).array[0]))
        parameters[albedo] = mi.Float(start)
        parameters.update()
        quotient = (ends_of_step[1] - ends_of_step[0]) / (2.0 * STEP)
        found.append([float(picture.array[0]), *gradients, quotient])
    values = np.array(found)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


def is_noisy(found: list[list[float]]) -> bool:
    """Whether the difference quotient, the last column, is known to less than a tenth of the derivative before it: rare
    paths make most of its variance then, and a standard error from few batches says too little of them."""
    values = np.array(found)
    error = values[:, -1].std(ddof=1) / np.sqrt(len(values))
    return bool(error > 0.1 * abs(values[:, -2].mean()))


def compare(samples: int, rows: Sequence[int] | None = None) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Of every ray: its index, relative differences [5] (L, beta_M, g, albedo; quotient for the last) and sigmas."""
    data = reference.load("sky_derivatives")
    for row in range(len(data["L"])) if rows is None else rows:
        mean, error = derivatives(data, row, samples)
        truth = np.array([*(data[name][row] for name in TRUTH), mean[5]])
        sigma = np.array([data["L_sigma"][row], *(data[f"{name}_sigma"][row] for name in TRUTH[1:]), error[5]])
        # The quotient of two renders is the noisier of its pair: a ratio to it would be far from a normal distribution.
        scale = np.abs([*truth[:4], mean[4]])
        yield row, (mean[:5] - truth) / scale, np.hypot(error[:5], sigma) / scale


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--rays", type=int, nargs="*")
    given = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_mono")
    from atmo_jit.plugins import register

    register()
    print("ray  difference +- sigma (%): radiance, d/d beta_M, d/d g, d/d albedo, d/d single-scattering albedo")
    for row, difference, sigma in compare(given.samples, given.rays):
        text = "  ".join(f"{100 * d:+7.2f} +- {100 * s:5.2f}" for d, s in zip(difference, sigma, strict=True))
        print(f"{row:3d}  {text}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
