"""From a path-traced hazy sky back to its aerosol: by the tables, then by gradients of the path tracer itself.

    python -m atmo_jit.fits.recover_aerosol --out aerosol            # about a minute on 2 cores
    python fits/recover_aerosol.py --out aerosol --tolerance 0.9     # tables that are coarse, and set right

A fisheye picture of a hazy sky is path-traced (``atmosphere_volpath``), noise and all: there is no table in it. The
aerosol's scattering coefficient and g are then fitted to it with the fast sky of this package. What bias its tables T
have is then taken away by the path tracer: where the fit ended, sum (T - D) / sigma^2 dT = 0 for the data D and their
errors sigma, while without bias sum (P - D) / sigma^2 dP = 0, P being the path tracer's picture. The difference of the
two is, but for products of two small numbers,

    gradient = sum (P - T) / sigma^2 dP / d(beta_M, g)              dP by prbvolpath (Vicini et al. 2021)
    step     = -S gradient                                          S: covariance of the fit by tables

and the step is one of Gauss-Newton's. The data do not enter, and neither does their noise; that of the step comes from
P, of which a new picture is traced at the fit. The derivatives weigh small numbers, so few paths do for them; how those
of the tables, which have no noise, do instead is printed beside. Written are recover_aerosol.json and
recover_aerosol.png: data, fit, residual, and the likelihood's ellipses with the truth.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import atmo_jit
from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.fits.config import FitConfig
from atmo_jit.fits.fit import Fit, fit
from atmo_jit.fits.observations import Observations, observations
from atmo_jit.fits.pictures import directions
from atmo_jit.fits.result import result

NAMES = ("mie.scattering_per_m", "mie.phase.g")
START = (1e-5, 0.6)
ALTITUDE_M = 2.0
LEAST_ELEVATION_DEG = 2.0
POOLED = 128  # pixels of one scattering angle whose noise is taken to be alike
CAPSULE_M = 0.5
MORE = 8  # times the paths of the data are traced at the fit: the step then has a third of the fit's error
PICTURE = {"projection": "fisheye", "fov_deg": 180.0, "up_deg": 0.0}


@dataclass(frozen=True)
class HazySky:
    """What is recovered: the aerosol's scattering coefficient (1/m) and g, under a sun at ``sun_zenith_deg``."""

    scattering_per_m: float = 3e-5
    g: float = 0.75
    sun_zenith_deg: float = 50.0

    @property
    def atmosphere(self) -> atmo_jit.Atmosphere:
        """``earth`` with this aerosol and a point sun of irradiance 1: radiance comes in 1/sr."""
        changes = {"solar_irradiance": 1.0, "sun_angular_radius_deg": 0.0}
        changes |= dict(zip(NAMES, (self.scattering_per_m, self.g), strict=True))
        return atmo_jit.Atmosphere.load("earth").replace(changes)

    def pixels(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which pixels [size, size] are used, and their zenith angle and azimuth from the sun (degrees)."""
        zenith, azimuth, seen = directions(PICTURE, size, size)
        seen &= zenith <= 90.0 - LEAST_ELEVATION_DEG
        return seen, zenith[seen], azimuth[seen]


def path_traced(sky: HazySky, size: int, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (1/sr) and standard error of the pixels in use, [N, 3]; every pixel is the ray through its centre.

    Mitsuba's variant has to be ``llvm_ad_rgb``: its three channels are the atmosphere's wavelengths.
    """
    import mitsuba as mi

    from atmo_jit.plugins.planet import planet
    from atmo_jit.plugins.rays import trace

    _, zenith, azimuth = sky.pixels(size)
    s, v, a = np.radians(sky.sun_zenith_deg), np.radians(zenith), np.radians(azimuth)
    parts = planet(sky.atmosphere, sun_direction=[np.sin(s), 0.0, np.cos(s)], wavelength_rule="channels")
    medium = parts.pop("air")
    direction = np.stack([np.sin(v) * np.cos(a), np.sin(v) * np.sin(a), np.cos(v)], axis=-1)
    origin = np.broadcast_to([0.0, 0.0, ALTITUDE_M], direction.shape)
    mean, error, _ = trace(
        mi.load_dict({"type": "scene", **parts}), medium, origin, direction, None, samples, seed=seed
    )
    return mean, error


def as_observations(sky: HazySky, size: int, mean: np.ndarray, error: np.ndarray) -> Observations:
    """The picture as a fit takes it.

    A pixel's own standard error is small where its few paths missed the light, and would pull the fit there: noise is
    pooled over pixels of like scattering angle. The channels share their paths and so their noise: three values tell as
    much as one.
    """
    _, zenith, azimuth = sky.pixels(size)
    sun, view = np.radians(sky.sun_zenith_deg), np.radians(zenith)
    angle = np.cos(sun) * np.cos(view) + np.sin(sun) * np.sin(view) * np.cos(np.radians(azimuth))
    sigma = np.empty_like(error)
    order = np.argsort(angle)
    for rows in np.array_split(order, max(1, len(order) // POOLED)):
        sigma[rows] = np.sqrt(mean.shape[1] * np.mean(error[rows] ** 2, axis=0))
    views = {"altitude_m": ALTITUDE_M, "sun_zenith_deg": sky.sun_zenith_deg}
    views |= {"view_zenith_deg": zenith, "azimuth_deg": azimuth}
    arrays = {"radiance": mean, "sigma": sigma, "wavelengths_nm": sky.atmosphere.wavelengths_nm, **views}
    return observations(arrays, "path-traced picture")


def by_tables(sky: HazySky, data: Observations, tolerance: float = 0.01) -> Fit:
    """The fit of scattering and g, from a start that knows neither, with tables of this ``tolerance``."""
    base = sky.atmosphere.replace(dict(zip(NAMES, START, strict=True)))
    free = {NAMES[0]: {"mode": "scale", "min": 1e-7, "max": 1e-3}, NAMES[1]: {"min": -0.5, "max": 0.97}}
    return fit(data, FitConfig(base, free, residual="linear", robust=False, tolerance=tolerance))


class PathTracer:
    """Pictures of the sky by ``prbvolpath``, and derivatives of sums over them."""

    def __init__(self, sky: HazySky, size: int) -> None:
        import mitsuba as mi

        from atmo_jit.plugins.planet import planet

        s = np.radians(sky.sun_zenith_deg)
        # The fisheye's top is the azimuth of the sun.
        parts = planet(sky.atmosphere, sun_direction=[np.sin(s), 0.0, np.cos(s)], wavelength_rule="channels")
        at = [0.0, 0.0, ALTITUDE_M]
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        sensor = {"type": "fisheye", "film": film, "sampler": {"type": "independent"}}
        up = mi.ScalarTransform4f().look_at(origin=at, target=[0.0, 0.0, ALTITUDE_M + 1.0], up=[1.0, 0.0, 0.0])
        sensor["to_world"] = up
        # prbvolpath does not know the medium that a sensor is in: a null sphere around it leads there.
        around = {"type": "sphere", "center": at, "radius": CAPSULE_M, "bsdf": {"type": "null"}}
        around["exterior"] = parts["air"]
        integrator = {"type": "prbvolpath", "max_depth": 64, "rr_depth": 32}
        scene = {"type": "scene", "integrator": integrator, **parts, "around": around, "camera": sensor}
        self._scene = mi.load_dict(scene)
        self._parameters = mi.traverse(self._scene)
        self._names = [next(k for k in self._parameters.keys() if k.endswith(end)) for end in NAMES]

    def gradient(self, values: np.ndarray, weights: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """Derivatives [2] of the sum of ``weights`` [size, size, 3] times the picture, at ``values`` of NAMES."""
        import drjit as dr
        import mitsuba as mi

        for name, value in zip(self._names, values, strict=True):
            self._parameters[name] = type(self._parameters[name])(float(value))
            dr.enable_grad(self._parameters[name])
        self._parameters.update()
        picture = mi.render(self._scene, self._parameters, spp=1, spp_grad=samples, seed=seed, seed_grad=seed + 1)
        dr.backward(dr.sum(picture * mi.TensorXf(weights.astype(np.float32)), axis=None))
        return np.array([float(np.sum(np.array(dr.grad(self._parameters[name])))) for name in self._names])


def refined(
    sky: HazySky, size: int, data: Observations, found: Fit, traced: int, samples: int, renders: int
) -> dict[str, Any]:
    """The fit by tables without their bias: ``traced`` paths for every pixel of the picture at the fit, and ``renders``
    pictures of ``samples`` paths for the derivatives."""
    values, covariance = found.problem.values(found.u), found.errors.covariance
    started = time.perf_counter()
    there = HazySky(*values.tolist(), sky.sun_zenith_deg)
    mean, error = path_traced(there, size, traced, seed=1)
    picture_seconds, started = time.perf_counter() - started, time.perf_counter()
    weight = (mean - found.found.predicted) / data.sigma**2
    samples_used = np.count_nonzero(data.used)
    by_value = [s.slopes(u)[0] for s, u in zip(found.problem.scalars, found.u, strict=True)]
    # Derivatives of the tables, [N, 3, 2], from those of the residuals.
    slopes = (found.found.jacobian[:samples_used] / by_value).reshape(*mean.shape, 2) * data.sigma[..., None]
    by_tables = np.einsum("nc,nck->k", weight, slopes)
    tables_seconds, started = time.perf_counter() - started, time.perf_counter()
    # The channels of a pixel share their paths, and so their errors.
    pull = np.einsum("nc,nck->nk", error / data.sigma**2, slopes)
    tracer, weights = PathTracer(sky, size), np.zeros((size, size, 3))
    weights[sky.pixels(size)[0]] = weight
    gradients = np.array([tracer.gradient(values, weights, samples, seed=1000 + 2 * i) for i in range(renders)])
    spread = np.atleast_2d(np.cov(gradients.T)) / renders if renders > 1 else np.zeros((2, 2))

    def step(gradient: np.ndarray, noise: np.ndarray) -> dict[str, Any]:
        moved, scatter = -covariance @ gradient, covariance @ (pull.T @ pull + noise) @ covariance
        return {"values": (values + moved).tolist(), "noise_of_the_step": np.sqrt(np.diag(scatter)).tolist()}

    return {
        **step(gradients.mean(axis=0), spread),
        "by_tables": step(by_tables, np.zeros((2, 2))) | {"seconds": tables_seconds},
        "paths": int(traced * size**2),
        "seconds_of_picture": picture_seconds,
        "paths_with_derivatives": int(samples * renders * size**2),
        "seconds": time.perf_counter() - started,
    }


def draw(
    sky: HazySky, size: int, data: Observations, found: Fit, refinement: dict[str, Any] | None, path: Path
) -> None:
    """Data, fit, residual, and the ellipses that hold the truth in 68 and 95 % of all cases."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 4)
    used, _, _ = sky.pixels(size)
    away = (found.found.predicted - data.radiance) / data.sigma
    high = float(np.percentile(data.radiance[:, 1], 98))
    for panel, values, title, limits, colours in (
        (panels[0], data.radiance[:, 1], "path-traced, 550 nm", (0.0, high), "viridis"),
        (panels[1], found.found.predicted[:, 1], "fit by tables", (0.0, high), "viridis"),
        (panels[2], away[:, 1], "residual / sigma", (-3.0, 3.0), "RdBu_r"),
    ):
        grid = np.full(used.shape, np.nan)
        grid[used] = values
        figure.colorbar(panel.imshow(grid, cmap=colours, vmin=limits[0], vmax=limits[1]), ax=panel, shrink=0.8)
        panel.set(title=title, xticks=[], yticks=[])
    values, covariance = found.problem.values(found.u), found.errors.covariance
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.linalg.cholesky(covariance) @ np.stack([np.cos(turn), np.sin(turn)])
    for probability in (0.68, 0.95):
        ellipse = values[:, None] + np.sqrt(-2.0 * np.log(1.0 - probability)) * circle
        panels[3].plot(ellipse[0], ellipse[1], color="C0", label=f"{100 * probability:.0f} %")
    panels[3].plot(*values, "o", color="C0", label="tables")
    panels[3].plot(sky.scattering_per_m, sky.g, "k+", markersize=12, label="truth")
    if refinement:
        x, y = refinement["noise_of_the_step"]
        panels[3].errorbar(*refinement["values"], xerr=x, yerr=y, fmt="s", color="C3", label="with path gradients")
    panels[3].set(xlabel="aerosol scattering, 1/m", ylabel="g", title="likelihood")
    panels[3].legend(fontsize=7)
    figure.savefig(path, dpi=110, format="png")


def recover(
    sky: HazySky, size: int, samples: int, refine: int, seed: int = 0, tolerance: float = 0.01
) -> tuple[dict[str, Any], Any]:
    """All of it: the report, and what :func:`draw` needs."""
    started = time.perf_counter()
    mean, error = path_traced(sky, size, samples, seed)
    traced = time.perf_counter() - started
    data = as_observations(sky, size, mean, error)
    found = by_tables(sky, data, tolerance)
    report = result(found)
    truth = np.array([sky.scattering_per_m, sky.g])
    values, errors = found.problem.values(found.u), found.errors.standard_error
    summary: dict[str, Any] = {
        "truth": truth.tolist(),
        "names": NAMES,
        "values": values.tolist(),
        "standard_errors": errors.tolist(),
        "off_in_standard_errors": ((values - truth) / errors).tolist(),
        "reduced_chi_square": report["reduced_chi_square"],
        "pixel_noise": float(np.median(data.sigma / data.radiance)),
        "seconds_of_tracing": traced,
        "seconds_of_fit": found.seconds,
    }
    refinement = None
    if refine:
        refinement = refined(sky, size, data, found, MORE * samples, max(1, samples // 4), refine)
        summary["refined"] = refinement
    return summary, (data, found, refinement)


def _print_refinement(summary: dict[str, Any]) -> None:
    refinement = summary["refined"]
    rows = [("prbvolpath", refinement), ("tables", refinement["by_tables"])]
    for source, step in rows:
        for name, truth, value, noise, error in zip(
            NAMES, summary["truth"], step["values"], step["noise_of_the_step"], summary["standard_errors"], strict=True
        ):
            off = (value - truth) / error
            print(
                f"{name:<22} without bias {value:.5g} ({off:+.1f} sigma), noise of the step {noise:.2g}; "
                f"derivatives by {source}"
            )
    print(
        f"picture at the fit: {refinement['paths']} paths in {refinement['seconds_of_picture']:.1f} s; derivatives: "
        f"{refinement['paths_with_derivatives']} paths in {refinement['seconds']:.1f} s, tables none in "
        f"{refinement['by_tables']['seconds']:.3f} s"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for recover_aerosol.json and .png")
    parser.add_argument("--size", type=int, default=64, help="pixels across the fisheye")
    parser.add_argument("--samples", type=int, default=64, help="paths for each pixel")
    parser.add_argument("--refine", type=int, default=4, help="renders of prbvolpath; 0: none")
    parser.add_argument("--tolerance", type=float, default=0.01, help="of the tables")
    parser.add_argument("--scattering", type=float, default=HazySky.scattering_per_m, help="1/m")
    parser.add_argument("--g", type=float, default=HazySky.g)
    parser.add_argument("--sun-zenith", type=float, default=HazySky.sun_zenith_deg, help="degrees")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    targets = [check_output(given.out / f"recover_aerosol{suffix}", suffix) for suffix in (".json", ".png")]

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register

    register()
    sky = HazySky(given.scattering, given.g, given.sun_zenith)
    summary, parts = recover(sky, given.size, given.samples, given.refine, given.seed, given.tolerance)
    with atomic_outputs(*targets) as (json_part, png_part):
        json_part.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        draw(sky, given.size, *parts, png_part)
    for name, truth, value, error in zip(
        NAMES, summary["truth"], summary["values"], summary["standard_errors"], strict=True
    ):
        off = (value - truth) / error
        print(f"{name:<22} truth {truth:.5g}   tables {value:.5g} +- {error:.2g} ({off:+.1f} sigma)")
    print(f"traced in {summary['seconds_of_tracing']:.1f} s, fitted in {summary['seconds_of_fit']:.2f} s")
    if given.refine:
        _print_refinement(summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
