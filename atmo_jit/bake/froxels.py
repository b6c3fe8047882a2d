"""Aerial perspective as a table: what the air between an observer and a point adds and takes, over view and distance.

Hillaire 2020, section 5.4: slices lie at squared distances. Every slice is integrated by itself and added to those
before it, so that no two look-ups have to be subtracted. What is stored is light and optical depth per metre of
distance, which are finite and smooth down to no distance at all. Rays go on below the ground, in air as it is there, so
that a view that meets it spoils no neighbour that does not; peaked single scattering is apart, without its phase
function.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..backend import floats, packet, padded, parameter, types
from ..mapping import Hillaire, texels
from ..solved import RayLight, Sky
from .node_light import is_peaked
from .sightlines import Sightlines
from .sunlight import Sunlight

SLICES = 32
FIRST = 0.01  # of the first slice's depth: where the light of no distance at all is measured


class Froxels:
    """Aerial perspective from ``altitude_m`` under a sun at ``sun_zenith`` (rad), to ``reach_m``.

    ``view_zenith``, ``azimuth`` (rad, from the sun's): arrays [rows, columns] of the table's views, of any arrangement;
    neighbours are interpolated. :meth:`frustum` arranges them for a camera.
    """

    def __init__(
        self,
        sky: Sky,
        altitude_m: float,
        sun_zenith: float,
        view_zenith: np.ndarray,
        azimuth: np.ndarray,
        reach_m: float = 128e3,
        slices: int = SLICES,
    ) -> None:
        self.rows, self.columns = view_zenith.shape
        self.slices, self.reach_m = slices, float(reach_m)
        self.altitude_m, self.sun_zenith = float(altitude_m), float(sun_zenith)
        self._reach = parameter(self.reach_m)
        self._mu_s = parameter(np.cos(sun_zenith))
        distance = Hillaire.slice_inverse(texels(slices + 1), self.reach_m)
        distance[0] = FIRST * distance[1]
        mu, sine = np.cos(view_zenith).ravel(), np.sin(view_zenith).ravel()
        across = np.sin(sun_zenith) * np.cos(azimuth).ravel()
        # Cosine of the angle to the sun where it is looked up: interpolated from the views, it would bend the peak.
        self._directions = floats(
            np.stack([sine * np.cos(azimuth).ravel(), sine * np.sin(azimuth).ravel(), mu], axis=-1)
        )
        self._sin_s = parameter(np.sin(sun_zenith))
        self._bands = [
            _Band(band, float(altitude_m), np.cos(sun_zenith), mu, across, distance, self.rows) for band in sky.bands
        ]

    @classmethod
    def frustum(
        cls,
        sky: Sky,
        altitude_m: float,
        sun_zenith: float,
        corners: np.ndarray,
        size: tuple[int, int] = (32, 32),
        reach_m: float = 128e3,
        slices: int = SLICES,
    ) -> Froxels:
        """For a pinhole camera. ``corners`` [2, 2, 3]: directions through the picture's corners, from top to bottom and
        from left to right, with z up and the sun above or below the x axis; ``size``: rows, columns."""
        rows, columns = size
        down, right = texels(rows)[:, None, None], texels(columns)[None, :, None]
        # On the picture's plane: corners as far along the view axis as each other.
        plane = corners / np.sum(corners * corners.sum(axis=(0, 1)), axis=-1, keepdims=True)
        edge = plane[0] + (plane[1] - plane[0]) * down
        d = edge[:, :1] + (edge[:, 1:] - edge[:, :1]) * right
        zenith = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
        azimuth = np.arctan2(d[..., 1], d[..., 0])
        return cls(sky, altitude_m, sun_zenith, zenith, azimuth, reach_m, slices)

    def at(self, v: Any, u: Any, distance: Any) -> RayLight:
        """In-scattered radiance and transmittance to points at ``distance`` (m, to reach_m), at (v, u): 0 in the first
        row and column of views, 1 in the last."""
        t = types()
        distance = dr.minimum(t.Float(distance), self._reach)
        k, fw = _cell(Hillaire.slice(distance, self._reach), self.slices + 1)
        view, fv, fu = self._view(v, u)
        steps = (self.rows * self.columns, self.columns, 1)
        base = k * steps[0] + view
        x, _, z = self.direction(v, u)
        nu = dr.fma(z, self._mu_s, x * self._sin_s)
        radiance, transmittance = [], []
        for band in self._bands:
            light, depth = band.at(base, steps, (fw, fv, fu), nu)
            radiance += [dr.maximum(v, 0.0) * distance for v in light]
            transmittance += [dr.exp(-v * distance) for v in depth]
        return RayLight(radiance, transmittance)

    def direction(self, v: Any, u: Any) -> tuple[Any, Any, Any]:
        """Unit vector of the view at (v, u), z up and the sun above or below the x axis."""
        t = types()
        view, fv, fu = self._view(v, u)

        def read(offset: int) -> list[Any]:
            return [dr.gather(t.Float, self._directions, t.UInt((view + offset) * 3 + axis)) for axis in range(3)]

        x, y, z = _blend(read, (self.columns, 1), (fv, fu))
        scale = dr.rsqrt(dr.fma(x, x, dr.fma(y, y, z * z)))
        return x * scale, y * scale, z * scale

    def _view(self, v: Any, u: Any) -> tuple[Any, Any, Any]:
        """First of the four views about (v, u), and the fractions of row and column."""
        i, fv = _cell(v, self.rows)
        j, fu = _cell(u, self.columns)
        return i * self.columns + j, fv, fu

    @property
    def nbytes(self) -> int:
        """Bytes of the tables."""
        return sum(4 * dr.width(band.values) for band in self._bands) + 4 * dr.width(self._directions)


class _Band:
    """One band's values [slice, view, size]: smooth light and each peak's per metre, optical depth per metre."""

    def __init__(
        self, band: Any, h: float, mu_s: float, mu: np.ndarray, across: np.ndarray, distance: np.ndarray, rows: int
    ) -> None:
        t = types()
        self.optics = optics = band.optics
        self.channels, self.padded = optics.channel_count, padded(optics.channel_count)
        views, slices = len(mu), len(distance)
        start = np.repeat(np.concatenate([[0.0], distance[:-1]]), views)
        stop = np.repeat(distance, views)
        lines = Sightlines(
            optics, np.full(views * slices, h), np.tile(mu, slices), start, stop, ground=False, stretches=1
        )
        ray = dr.arange(t.UInt, views * slices)
        sun, beside = floats(np.full(views * slices, mu_s)), floats(np.tile(across, slices))
        nu = lines.nu(ray, sun, beside)
        dr.eval(ray, sun, beside, nu)
        shape = (slices, views)
        single = lines.single(Sunlight(optics, band.columns), ray, sun, beside, nu)
        smooth = np.zeros((*shape, self.channels))
        if band.source is not None:
            multiple = lines.multiple(band.source, ray, sun, beside, nu)
            dr.eval(multiple)
            for light in multiple:
                smooth = smooth + _channels_last(light, shape)
        self.peaks, groups = [], []
        for k, light in zip(optics.scatterers, single, strict=True):
            if is_peaked(optics.constituents[k]):
                self.peaks.append(k)
                groups.append(_channels_last(light, shape))
            else:
                values = zip(light, optics.phase_values(k, nu), strict=True)
                smooth = smooth + _channels_last([s * p for s, p in values], shape)
        through = lines.transmittance.reshape(*shape, -1)
        before = np.concatenate([np.ones((1, *through.shape[1:])), np.cumprod(through, axis=0)[:-1]])
        depth = np.cumsum(-np.log(np.maximum(through, 1e-38)), axis=0)
        groups = [np.cumsum(before * light, axis=0) for light in (smooth, *groups)] + [depth]
        extra = [(0, 0), (0, 0), (0, self.padded - self.channels)]
        values = np.concatenate([np.pad(g / distance[:, None, None], extra) for g in groups], axis=-1)
        self.size = 1 << (values.shape[-1] - 1).bit_length()
        self.values = floats(np.pad(values, [(0, 0), (0, 0), (0, self.size - values.shape[-1])]))

    def at(self, base: Any, steps: tuple[int, ...], fractions: tuple[Any, ...], nu: Any) -> tuple[list[Any], list[Any]]:
        """Light and optical depth per metre, per channel."""
        t = types()
        values = _blend(lambda o: packet(self.values, t.UInt(base + o), self.size), steps, fractions)
        groups = [values[g * self.padded :][: self.channels] for g in range(2 + len(self.peaks))]
        light = groups[0]
        for k, peak in zip(self.peaks, groups[1:-1], strict=True):
            light = [dr.fma(p, v, s) for p, v, s in zip(self.optics.phase_values(k, nu), peak, light, strict=True)]
        return light, groups[-1]


def _cell(x: Any, count: int) -> tuple[Any, Any]:
    """Cell and fraction of a unit coordinate in ``count`` nodes."""
    t = types()
    x = dr.clip(t.Float(x), 0.0, 1.0) * (count - 1.0)
    i = dr.minimum(t.Int(x), count - 2)
    return i, x - t.Float(i)


def _blend(read: Any, steps: tuple[int, ...], fractions: tuple[Any, ...], offset: int = 0) -> list[Any]:
    """Multilinear interpolation of what ``read(offset)`` returns at the corners of a cell."""
    if not steps:
        return read(offset)
    low, high = (_blend(read, steps[1:], fractions[1:], offset + o) for o in (0, steps[0]))
    return [dr.lerp(a, b, fractions[0]) for a, b in zip(low, high, strict=True)]


def _channels_last(values: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """Floats per channel as one float32 array [*shape, C]."""
    dr.eval(values)
    return np.stack([np.broadcast_to(v.numpy(), np.prod(shape)).reshape(shape) for v in values], axis=-1)
