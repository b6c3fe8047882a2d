"""Tables of altitude, view zenith and sun zenith without azimuth: Rayleigh RGB and Mie in one texel.

Two of them: a power about the horizontal, and the same about the horizon of each altitude, where the light changes
most. Phase functions are applied at look-up; what is stored is the mean over azimuths of light without them (orders >=
2 over Rayleigh's). Elek 2009, Rendering Parametrizable Planetary Atmospheres with Multiple Scattering in Real-Time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..atmosphere import Atmosphere
from ..backend import doubles, floats, types
from ..bake.client import scattered_light
from ..bake.error import Error, compare
from ..errors import InputError
from ..mapping import Power3D, texels
from ..phase import CornetteShanks, RayleighPhase
from ..quadrature import half_circle
from ..solved import Sky
from .colour import Channels, channels, described
from .exporter import Clock, Made, Options, only, refuse
from .hillaire import table_files
from .lookup import linear
from .parameters import aerosol, client_parameters, phase_ratio

SIZE = (32, 128, 32)  # altitudes, view cosines, sun cosines
AZIMUTHS = 8
MAPPINGS = {"power": False, "horizon": True}  # about_horizon
HOLDS = (
    "[altitude][view cosine][sun cosine]; rgb: mean over azimuths of (single Rayleigh scattering without its phase "
    "function + orders >= 2 over Rayleigh's); alpha: red of single scattering by aerosols without their phase function"
)


def make(layout: str, air: Atmosphere, options: Options, clock: Clock, progress: Callable[[float], None]) -> Made:
    """Files of the layout."""
    refuse(layout, options, ("mu_s_min", "altitude_m", "sun_zenith_deg", "texels"))
    precision = only(layout, "precision", options.precision, ("half", "float"), "of the EXR files")
    size = options.size or SIZE
    if len(size) != 3 or min(size) < 2 or np.prod(size) > 16 << 20:
        raise InputError(
            f"size: is {'x'.join(map(str, size))}; allowed: three whole numbers >= 2: altitudes, view cosines, suns"
        )
    colours, one = channels(air, options.colour or "samples"), aerosol(air)
    warnings = list(one.warnings)
    sky = Sky(air, options.orders, options.tolerance)
    clock.stage("solve")
    tables, error, constants = {}, {}, {}
    for name, about_horizon in MAPPINGS.items():
        to = Power3D(air.bottom_radius_m, air.top_radius_m, about_horizon=about_horizon)
        tables[name] = table = power_table(sky, colours, to, size, None if one.exact else one.g)
        error[name] = asdict(power_error(table, sky, colours, to, one.g))
        keys = ("altitude", "view", "sun", "about_horizon")
        constants[name] = {key: getattr(to, key) for key in keys}
    clock.stage("bake")
    metadata = {
        "mapping": "x_h = (h / thickness)^altitude; x_mu = 1/2 +- 1/2 |(mu - edge) / range|^view, edge 0 or the cosine "
        "of the horizon, -sqrt(1 - (R / (R + h))^2); x_mu_s = 1/2 +- 1/2 |mu_s|^sun; texel i of n at i / (n - 1)",
        "exponents": constants,
        "size": list(size),
        "units": "W m^-2 nm^-1",
        **described(colours, air),
        "holds": dict.fromkeys(tables, HOLDS),
        "tolerance": options.tolerance,
        "orders": options.orders or "all",
    }
    return Made(
        table_files(tables, precision, warnings, dict.fromkeys(tables, HOLDS)),
        client_parameters(air, colours, -1.0, one.g),
        metadata,
        error,
        warnings,
    )


def power_table(sky: Sky, colours: Channels, to: Power3D, size: tuple[int, int, int], g: float | None) -> np.ndarray:
    """The table [x_h, x_mu, x_mu_s, 4]; ``g``: of the aerosol that stands for others."""
    x_h, x_mu, x_s = (texels(n) for n in size)
    h, mu, _ = to.inverse(x_h[:, None], x_mu[None, :], 0.5)
    _, _, mu_s = to.inverse(0.0, 0.5, x_s)
    ground = (mu < 0.0) & (mu < mapping.horizon(to.bottom, h))
    cosines = floats(np.cos(half_circle(AZIMUTHS)))

    def angle(index: Any, view: Any, cosine: Any) -> Any:
        sines = dr.sqrt(dr.maximum((1.0 - view * view) * (1.0 - cosine * cosine), 0.0))
        return dr.fma(view, cosine, sines * dr.gather(types().Float, cosines, index))

    sine, sin_s = (np.sqrt(np.maximum(1.0 - c * c, 0.0)) for c in (mu, mu_s))
    phi = np.cos(half_circle(AZIMUTHS))
    nu = mu[..., None, None] * mu_s + sine[..., None, None] * sin_s * phi[:, None]
    weight = None
    if g is not None:

        def weight(species: int) -> np.ndarray:
            return phase_ratio(sky.atmosphere, species, g, nu).astype(np.float32)

    heights = h[:, 0]
    parts = [_of_band(band, (heights, mu, ground), mu_s, angle, weight) for band in sky.bands]
    air, mie, higher = (np.concatenate(p, axis=-1) for p in zip(*parts, strict=True))
    smooth = colours.radiance(air) + colours.radiance(higher) / RayleighPhase().value(nu)[..., None].astype(np.float32)
    return np.concatenate([smooth.mean(axis=2), colours.radiance(mie).mean(axis=2)[..., :1]], axis=-1)


def _of_band(band: Any, views: Any, mu_s: np.ndarray, angle: Any, weight: Any) -> list[np.ndarray]:
    some = None if weight is None else lambda species: weight(species)[..., band.optics.indices]
    return scattered_light(band, views, mu_s, angle, AZIMUTHS, some)


def power_radiance(table: np.ndarray, to: Power3D, g: float, h: Any, mu: Any, mu_s: Any, nu: Any) -> np.ndarray:
    """Radiance [..., 3]; single Mie scattering is taken to be grey."""
    found = linear(table, *to.coordinates(h, mu, mu_s))
    peak = found[..., 3:] * CornetteShanks(g).value(nu)[..., None]
    return found[..., :3] * RayleighPhase().value(nu)[..., None] + peak


def power_error(table: np.ndarray, sky: Sky, colours: Channels, to: Power3D, g: float) -> Error:
    """Of the table at random observers and views half a degree or more from the horizon, by day."""
    rng = np.random.default_rng(0)
    count, thickness = 2000, to.top - to.bottom
    altitude, sun = 2.0 + (0.9 * thickness - 2.0) * rng.random(count) ** 3, np.radians(rng.uniform(0.0, 85.0, count))
    view, azimuth = np.arccos(rng.uniform(-1.0, 1.0, count)), rng.uniform(0.0, np.pi, count)
    kept = np.abs(view - np.arccos(mapping.horizon(to.bottom, altitude))) > np.radians(0.5)
    altitude, sun, view, azimuth = (v[kept] for v in (altitude, sun, view, azimuth))
    light = sky.rays(*map(doubles, (altitude, sun, view, azimuth)), ground=False).radiance
    exact = colours.radiance(np.stack([v.numpy() for v in light], axis=-1))
    mu, mu_s = np.cos(view), np.cos(sun)
    nu = mu * mu_s + np.sin(view) * np.sin(sun) * np.cos(azimuth)
    where = {"altitudeM": altitude, "sunZenithDeg": np.degrees(sun), "viewZenithDeg": np.degrees(view)}
    return compare(power_radiance(table, to, g, altitude, mu, mu_s, nu).T, exact.T, where)
