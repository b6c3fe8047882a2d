"""The tables of Bruneton's family, at the sizes that clients have built in: transmittance, irradiance, scattering.

Layout and maps are those of ``mapping.Bruneton``; what is stored in them is this package's solution, not the one that
Bruneton's programs would compute.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import floats, types
from ..column import column_up
from ..mapping import Bruneton, texels
from ..phase import RayleighPhase
from ..sky import Sky
from .mean_source import MeanSource, Series, view_range
from .sightlines import Sightlines
from .sunlight import Sunlight

TRANSMITTANCE = (64, 256)  # altitudes, view cosines
IRRADIANCE = (16, 64)  # altitudes, sun cosines
SCATTERING = (32, 128, 8, 32)  # altitudes, view cosines, scattering angles, sun cosines


@dataclass
class BrunetonTables:
    """Float32 arrays [..., W], W m^-2 nm^-1 for the atmosphere's solar irradiance, per sr where that is due.

    ``transmittance`` [x_r, x_mu]; ``irradiance`` [x_r, x_mu_s] of the sky on a horizontal surface; ``rayleigh`` and
    ``mie`` [x_r, row of mu, x_nu, x_mu_s]: single scattering without phase functions, all aerosols together;
    ``higher``: radiance of all orders >= 2.
    """

    mapping: Bruneton
    transmittance: np.ndarray
    irradiance: np.ndarray
    rayleigh: np.ndarray
    mie: np.ndarray
    higher: np.ndarray

    @property
    def scattering(self) -> np.ndarray:
        """Single Rayleigh scattering + orders >= 2 over Rayleigh's phase function: the clients' scattering.rgb."""
        return self.rayleigh + self.higher_over_rayleigh

    @property
    def higher_over_rayleigh(self) -> np.ndarray:
        """Orders >= 2 over Rayleigh's phase function: the clients' higher_order_scattering.rgb."""
        altitudes, rows, angles, suns = self.higher.shape[:4]
        _, mu, mu_s, nu = scattering_nodes(self.mapping, (altitudes, rows, angles, suns))
        return self.higher / RayleighPhase().value(nu)[..., None].astype(np.float32)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(v.nbytes for v in (self.transmittance, self.irradiance, self.rayleigh, self.mie, self.higher))


def bruneton_tables(sky: Sky, mu_s_min: float = -0.5, size: tuple[int, int, int, int] = SCATTERING) -> BrunetonTables:
    """The tables of a solved sky, for suns down to the cosine ``mu_s_min``."""
    air = sky.atmosphere
    to = Bruneton(air.bottom_radius_m, air.top_radius_m, mu_s_min)
    h, mu = to.transmittance_inverse(*np.meshgrid(*map(texels, TRANSMITTANCE), indexing="ij"))
    through = [v for band in sky.bands for v in transmittance_up(band.optics, h.ravel(), mu.ravel())]
    transmittance = np.stack(through, axis=-1).reshape(*TRANSMITTANCE, -1)
    h, mu_s = to.irradiance_inverse(*np.meshgrid(*map(texels, IRRADIANCE), indexing="ij"))
    _, diffuse = sky.irradiance(h.ravel(), np.arccos(mu_s).ravel())
    irradiance = np.stack([e.numpy() for e in diffuse], axis=-1).reshape(*IRRADIANCE, -1)
    parts = [_scattering(band, to, size) for band in sky.bands]
    return BrunetonTables(
        to, transmittance, irradiance, *(np.concatenate(p, axis=-1) for p in zip(*parts, strict=True))
    )


def transmittance_up(optics: Any, h: np.ndarray, mu: np.ndarray) -> list[np.ndarray]:
    """Transmittance to the top per channel, by quadrature, of rays that miss the ground: those that fall pass their
    perigee and rise again."""
    if not optics.constituents:
        return [np.ones(len(h), dtype=np.float32)] * optics.channel_count
    lowest = np.maximum(
        h - (optics.atmosphere.bottom_radius_m + h) * mu * mu / (1.0 + np.sqrt((1 - mu) * (1 + mu))), 0.0
    )
    columns = column_up(optics, floats(h), floats(np.abs(mu)))
    whole = column_up(optics, floats(lowest), dr.zeros(types().Float, len(h)))
    falls = floats(mu) < 0.0
    depths = optics.optical_depths([dr.select(falls, 2.0 * w - c, c) for w, c in zip(whole, columns, strict=True)])
    through = [dr.exp(-d) for d in depths]
    dr.eval(through)
    return [v.numpy() for v in through]


def scattering_nodes(to: Bruneton, size: tuple[int, int, int, int]) -> tuple[np.ndarray, ...]:
    """h, mu, mu_s, nu of the scattering table's texels, [altitude, row, angle, sun] or broadcasting to it."""
    altitudes, rows, angles, suns = size
    h, mu, _ = _views(to, altitudes, rows)
    mu_s = to.sun_inverse(texels(suns))
    nu = to.angle_inverse(texels(angles)[:, None], mu[..., None, None], mu_s)
    return h[:, None, None, None], mu[..., None, None], mu_s, nu


def _views(to: Bruneton, altitudes: int, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """h [altitude], mu [altitude, row] and whether the row's rays meet the ground [row]."""
    h, _ = to.transmittance_inverse(texels(altitudes), np.zeros(altitudes))
    x = texels(rows // 2)
    ground = np.arange(rows) < rows // 2
    place = np.concatenate([x[::-1], x])
    return h, to.view_inverse(h[:, None], place, np.broadcast_to(ground, (altitudes, rows))), ground


def _scattering(band: Any, to: Bruneton, size: tuple[int, int, int, int]) -> list[np.ndarray]:
    """Rayleigh, Mie and higher orders of one band, [altitude, row, angle, sun, C]."""
    altitudes, rows, angles, suns = size
    t, optics = types(), band.optics
    h, mu, ground = _views(to, altitudes, rows)
    lines = Sightlines(optics, np.repeat(h, rows), mu.ravel(), ground=np.tile(ground, altitudes))
    mu_s = to.sun_inverse(texels(suns))

    lane = dr.arange(t.UInt, altitudes * rows * angles * suns)
    sun, rest = lane % suns, lane // suns
    ray = rest // angles
    cosine = dr.gather(t.Float, floats(mu_s), sun)
    view = dr.gather(t.Float, floats(mu), ray)
    nu = to.angle_inverse(t.Float(rest % angles) / (angles - 1.0), view, cosine)
    sine, sin_s = (dr.sqrt((1.0 - c) * (1.0 + c)) for c in (view, cosine))
    across = dr.clip((nu - view * cosine) / dr.maximum(sine, 1e-9), -sin_s, sin_s)
    dr.eval(ray, cosine, across, nu)

    def array(values: list[Any]) -> np.ndarray:
        return np.stack([v.numpy() for v in values], axis=-1).reshape(*size, -1)

    blank = np.zeros((*size, optics.channel_count), dtype=np.float32)
    single = lines.single(Sunlight(optics, band.columns), ray, cosine, across, nu)
    rayleigh, mie = blank, blank
    for k, light in zip(optics.scatterers, single, strict=True):
        if optics.constituents[k].name == "rayleigh":
            rayleigh = array(light)
        else:
            mie = mie + array(light)
    if band.source is None:
        return [rayleigh, mie, blank]
    whole = lines.scattering.reshape(altitudes, rows, *lines.scattering.shape[1:])
    edge, end = view_range(to.bottom, to.top - to.bottom, h[:, None])
    x = mapping.from_horizon(mapping.half_elevation(mu), edge, np.where(ground, -mapping.STEEPEST, end))
    series = Series(MeanSource(band, mu_s).along(h, np.clip(x, 0.0, 1.0), ~ground, whole))
    cos_phi = dr.clip(across / dr.maximum(sin_s, 1e-9), -1.0, 1.0)
    higher = series.at(ray * suns + sun, cos_phi)
    dr.eval(higher)
    return [rayleigh, mie, array(higher)]
