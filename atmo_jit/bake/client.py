"""The tables of Bruneton's family, at the sizes that clients have built in: transmittance, irradiance, scattering.

Layout and maps are those of ``mapping.Bruneton``; what is stored in them is this package's solution, not the one that
Bruneton's programs would compute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import floats, types
from ..column import column_up
from ..mapping import Bruneton, texels
from ..phase import RayleighPhase
from ..solved import Sky
from .mean_source import MeanSource, view_range
from .sightlines import NODES, Sightlines
from .sunlight import Sunlight

TRANSMITTANCE = (64, 256)  # altitudes, view cosines
IRRADIANCE = (16, 64)  # altitudes, sun cosines
SCATTERING = (32, 128, 8, 32)  # altitudes, view cosines, scattering angles, sun cosines
Block = tuple[slice, Any]  # of altitudes; of suns: a slice or their indices
WHOLE: Block = (slice(None), slice(None))
# Quadrature nodes per piece of a ray for suns below a cosine: the planet's shadow lies across the rays of low suns, and
# leaves little of those of deep ones. With these, as with more, 99 % of all texels are within 0.3 % of the march.
QUADRATURE = ((-0.06, 12), (0.02, 6), (np.inf, NODES))


@dataclass
class BrunetonTables:
    """Float32 arrays [..., W], W m^-2 nm^-1 for the atmosphere's solar irradiance, per sr where that is due.

    ``transmittance`` [x_r, x_mu]; ``irradiance`` [x_r, x_mu_s] of the sky on a horizontal surface; ``rayleigh`` and
    ``mie`` [x_r, row of mu, x_nu, x_mu_s]: single scattering without phase functions, all aerosols together;
    ``higher``: radiance of all orders >= 2. ``size``: texels of the whole scattering tables; ``block``: what of them is
    here.
    """

    mapping: Bruneton
    transmittance: np.ndarray
    irradiance: np.ndarray
    rayleigh: np.ndarray
    mie: np.ndarray
    higher: np.ndarray
    size: tuple[int, int, int, int]
    block: Block

    @property
    def scattering(self) -> np.ndarray:
        """Single Rayleigh scattering + orders >= 2 over Rayleigh's phase function: the clients' scattering.rgb."""
        return self.rayleigh + self.higher_over_rayleigh

    @property
    def higher_over_rayleigh(self) -> np.ndarray:
        """Orders >= 2 over Rayleigh's phase function: the clients' higher_order_scattering.rgb."""
        nu = scattering_nodes(self.mapping, self.size, self.block)[3]
        return self.higher / RayleighPhase().value(nu)[..., None].astype(np.float32)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(v.nbytes for v in (self.transmittance, self.irradiance, self.rayleigh, self.mie, self.higher))


def bruneton_tables(
    sky: Sky,
    mu_s_min: float = -0.5,
    size: tuple[int, int, int, int] = SCATTERING,
    mie_weight: Callable[[int, np.ndarray], np.ndarray] | None = None,
    block: Block = WHOLE,
) -> BrunetonTables:
    """The tables of a solved sky, for suns down to the cosine ``mu_s_min``.

    ``block``: of the scattering tables only these altitudes and suns; their texels are those of the whole.

    ``mie_weight(species, nu)`` [..., W]: a factor to single scattering by an aerosol species, for clients that multiply
    the sum by a phase function that is not its own.
    """
    air = sky.atmosphere
    to = Bruneton(air.bottom_radius_m, air.top_radius_m, mu_s_min)
    h, mu = to.transmittance_inverse(*np.meshgrid(*map(texels, TRANSMITTANCE), indexing="ij"))
    through = []
    for band in sky.bands:

        def columns(optics: Any = band.optics) -> list[Any]:
            return columns_up(optics, h.ravel(), mu.ravel())

        # The same for all atmospheres with these profiles.
        kept = band.field.grid.kept("columns of the transmittance texels", columns)
        through += transmittance_up(band.optics, h.ravel(), mu.ravel(), kept)
    transmittance = np.stack(through, axis=-1).reshape(*TRANSMITTANCE, -1)
    h, mu_s = to.irradiance_inverse(*np.meshgrid(*map(texels, IRRADIANCE), indexing="ij"))
    _, diffuse = sky.irradiance(h.ravel(), np.arccos(mu_s).ravel())
    irradiance = np.stack([e.numpy() for e in diffuse], axis=-1).reshape(*IRRADIANCE, -1)
    parts = [_scattering(band, to, size, mie_weight, block) for band in sky.bands]
    return BrunetonTables(
        to, transmittance, irradiance, *(np.concatenate(p, axis=-1) for p in zip(*parts, strict=True)), size, block
    )


def columns_up(optics: Any, h: np.ndarray, mu: np.ndarray) -> list[Any]:
    """Columns (m) to the top per constituent, by quadrature, of rays that miss the ground: those that fall pass their
    perigee and rise again."""
    lowest = np.maximum(
        h - (optics.atmosphere.bottom_radius_m + h) * mu * mu / (1.0 + np.sqrt((1 - mu) * (1 + mu))), 0.0
    )
    columns = column_up(optics, floats(h), floats(np.abs(mu)))
    whole = column_up(optics, floats(lowest), dr.zeros(types().Float, len(h)))
    falls = floats(mu) < 0.0
    found = [dr.select(falls, 2.0 * w - c, c) for w, c in zip(whole, columns, strict=True)]
    dr.eval(found)
    return found


def transmittance_up(
    optics: Any, h: np.ndarray, mu: np.ndarray, columns: list[Any] | None = None
) -> list[np.ndarray]:
    """Transmittance to the top per channel, of the rays of :func:`columns_up`, or with ``columns`` from there."""
    if not optics.constituents:
        return [np.ones(len(h), dtype=np.float32)] * optics.channel_count
    through = [dr.exp(-d) for d in optics.optical_depths(columns or columns_up(optics, h, mu))]
    dr.eval(through)
    return [v.numpy() for v in through]


def scattering_nodes(
    to: Bruneton, size: tuple[int, int, int, int], block: Block = WHOLE
) -> tuple[np.ndarray, ...]:
    """h, mu, mu_s, nu of the scattering table's texels, [altitude, row, angle, sun] or broadcasting to it."""
    altitudes, rows, angles, suns = size
    h, mu, _ = view_rows(to, altitudes, rows, block[0])
    mu_s = to.sun_inverse(texels(suns))[block[1]]
    nu = to.angle_inverse(texels(angles)[:, None], mu[..., None, None], mu_s)
    return h[:, None, None, None], mu[..., None, None], mu_s, nu


def view_rows(
    to: Bruneton, altitudes: int, rows: int, some: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """h [altitude], mu [altitude, row] and whether the row's rays meet the ground [row], of ``some`` of the altitudes
    of a scattering table."""
    h, _ = to.transmittance_inverse(texels(altitudes)[some], np.zeros(len(range(altitudes)[some])))
    x = texels(rows // 2)
    ground = np.arange(rows) < rows // 2
    place = np.concatenate([x[::-1], x])
    return h, to.view_inverse(h[:, None], place, np.broadcast_to(ground, (len(h), rows))), ground


def _scattering(
    band: Any,
    to: Bruneton,
    size: tuple[int, int, int, int],
    mie_weight: Callable[[int, np.ndarray], np.ndarray] | None,
    block: Block,
) -> list[np.ndarray]:
    """Rayleigh, Mie and higher orders of one band, [altitude, row, angle, sun, C]."""
    altitudes, rows, angles, suns = size
    views = view_rows(to, altitudes, rows, block[0])

    def angle(index: Any, view: Any, cosine: Any) -> Any:
        return to.angle_inverse(types().Float(index) / (angles - 1.0), view, cosine)

    weight = None
    if mie_weight is not None:
        nu = scattering_nodes(to, size, block)[3]

        def weight(species: int) -> np.ndarray:
            return mie_weight(species, nu)[..., band.optics.indices].astype(np.float32)

    return scattered_light(band, views, to.sun_inverse(texels(suns))[block[1]], angle, angles, weight)


def scattered_light(
    band: Any,
    views: tuple[np.ndarray, np.ndarray, np.ndarray],
    mu_s: np.ndarray,
    angle: Callable[[Any, Any, Any], Any],
    angles: int,
    mie_weight: Callable[[int], np.ndarray] | None = None,
) -> list[np.ndarray]:
    """Single scattering by air and by all aerosols, without phase functions, and orders >= 2 of one band, each
    [A, V, angles, suns, C].

    ``views``: h [A] (m), mu [A, V] and whether the ray ends on the ground [V] or [A, V]; ``mu_s``: ascending [suns];
    ``angle(index, mu, mu_s)``: nu on Dr.Jit arrays; ``mie_weight(species)``: a factor to single scattering by it.
    """
    optics, (h, mu, ground) = band.optics, views
    ground = np.broadcast_to(ground, mu.shape)
    size = (*mu.shape, angles, len(mu_s))
    sunlight = Sunlight(optics, band.columns)
    lines = Sightlines(optics, np.repeat(h, mu.shape[1]), mu.ravel(), ground=ground.ravel())
    higher = _Texels(size, optics.channel_count)
    if band.source is not None:
        edge, end = view_range(optics.atmosphere.bottom_radius_m, optics.atmosphere.thickness_m, h[:, None])
        x = mapping.from_horizon(mapping.half_elevation(mu), edge, np.where(ground, -mapping.STEEPEST, end))
        series = MeanSource(band, mu_s).along(h, np.clip(x, 0.0, 1.0), ~ground, lines.scattering_table)
        lanes = _Lanes(mu, mu_s, slice(0, len(mu_s)), angle, angles)
        # Polynomials swing about 0 where no light is left.
        values = series.at(lanes.ray * len(mu_s) + lanes.sun, lanes.cos_phi)
        higher.put([dr.maximum(v, 0.0) for v in values], lanes.texel)
    # Kernels run while NumPy prepares the next: nothing is fetched before all are under way.
    single = [_Texels(size, optics.channel_count) for _ in optics.scatterers]
    low = 0
    for below, nodes in QUADRATURE:
        some = slice(low, int(np.count_nonzero(mu_s < below)))
        low = some.stop
        if some.start < some.stop:
            finer = lines if nodes == NODES else lines.with_nodes(nodes)
            lanes = _Lanes(mu, mu_s, some, angle, angles)
            light = finer.single(sunlight, lanes.ray, lanes.cosine, lanes.across, lanes.nu)
            for table, values in zip(single, light, strict=True):
                table.put(values, lanes.texel)
    rayleigh = mie = np.zeros((*size, optics.channel_count), dtype=np.float32)
    species = [c.name for c in optics.atmosphere.mie]
    for k, table in zip(optics.scatterers, single, strict=True):
        name, one = optics.constituents[k].name, table.numpy()
        if name == "rayleigh":
            rayleigh = one
        else:
            one = one if mie_weight is None else one * mie_weight(species.index(name))
            mie = mie + one if len(species) > 1 else one
    return [rayleigh, mie, higher.numpy()]


class _Texels:
    """A table [altitude, row, angle, sun, C] that kernels fill."""

    def __init__(self, size: tuple[int, ...], channels: int) -> None:
        self._shape = (*size, channels)
        self._values = dr.zeros(types().Float, int(np.prod(self._shape)))

    def put(self, values: list[Any], texel: Any) -> None:
        """A Float per channel."""
        for c, value in enumerate(values):
            dr.scatter(self._values, value, texel * len(values) + c, mode=dr.ReduceMode.Permute)
        dr.eval(self._values)

    def numpy(self) -> np.ndarray:
        """The table."""
        return self._values.numpy().reshape(self._shape)


class _Lanes:
    """All combinations [altitude, row, some of the suns, angle], flattened, as Dr.Jit arrays: indices of ``ray``,
    ``sun`` and ``texel`` [altitude, row, angle, sun]; sun ``cosine``, ``across`` = sin(sun zenith) cos(azimuth from the
    sun), ``cos_phi``, ``nu``. Angles are next to each other: their rays are in the planet's shadow together."""

    def __init__(
        self, mu: np.ndarray, mu_s: np.ndarray, some: slice, angle: Callable[[Any, Any, Any], Any], angles: int
    ) -> None:
        t, suns = types(), some.stop - some.start
        lane = dr.arange(t.UInt, mu.size * suns * angles)
        index, rest = lane % angles, lane // angles
        self.sun, self.ray = rest % suns + some.start, rest // suns
        self.texel = (self.ray * angles + index) * len(mu_s) + self.sun
        self.cosine = dr.gather(t.Float, floats(mu_s), self.sun)
        view = dr.gather(t.Float, floats(mu), self.ray)
        self.nu = angle(index, view, self.cosine)
        sine, sin_s = (dr.sqrt((1.0 - c) * (1.0 + c)) for c in (view, self.cosine))
        self.across = dr.clip((self.nu - view * self.cosine) / dr.maximum(sine, 1e-9), -sin_s, sin_s)
        self.cos_phi = dr.clip(self.across / dr.maximum(sin_s, 1e-9), -1.0, 1.0)
        dr.eval(self.ray, self.cosine, self.across, self.nu)
