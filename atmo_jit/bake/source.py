"""The light of later orders that a point of the air scatters toward a direction, as a table: what a march asks of the
field at every piece of a ray, for as many look-ups as one has directions instead of harmonics.

In place of the harmonics of a node stand values in directions, phase functions applied: on zenith angle and azimuth,
equidistant, fine enough for the degree of the field. Between nodes everything is as in :class:`~atmo_jit.field.Field`:
quotients over a reference that falls as twilight does.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..backend import row, table, types
from ..field import Field
from ..harmonics import legendre, pairs

MOST_ZENITHS, MOST_AZIMUTHS = 37, 19
PER_DEGREE = 3  # zenith angles; half as many azimuths, which are those of the half circle


class SourceTable:
    """Drop-in for a solved ``field`` as the source of a march (march.Source)."""

    def __init__(self, field: Field) -> None:
        field.prepare()
        self._field, optics, degree = field, field.optics, field.degree
        self._zeniths = min(PER_DEGREE * degree + 1, MOST_ZENITHS)
        self._azimuths = min(PER_DEGREE * degree // 2 + 1, MOST_AZIMUTHS)
        l_, m = pairs(degree)
        channels, kinds = optics.channel_count, len(optics.scatterers)
        basis = legendre(degree, np.cos(np.linspace(0.0, np.pi, self._zeniths)))[:, None, :]
        basis = basis * np.cos(np.linspace(0.0, np.pi, self._azimuths)[:, None] * m)
        self._count = kinds * channels
        chi = optics.phase_moments(degree).numpy().reshape(degree + 1, -1)[l_, : self._count]
        chi = chi.reshape(len(l_), kinds, channels)
        moments = field.refined_moments()  # [nodes, pairs, channels]
        values = np.empty((len(moments), self._zeniths * self._azimuths, kinds, channels), dtype=np.float32)
        flat = basis.reshape(-1, len(l_)).astype(np.float32)
        for k in range(kinds):
            for c in range(channels):
                values[:, :, k, c] = (moments[:, :, c] * chi[:, k, c]) @ flat.T
        self._table = table(values.reshape(*values.shape[:2], -1))

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        return 4 * dr.width(self._table)

    def scattered(self, h: Any, mu_s: Any, mu: Any, cos_phi: Any, active: Any) -> list[list[Any]]:
        """As :meth:`atmo_jit.field.Field.scattered`."""
        t, channels, solar = types(), self._field.optics.channel_count, self._field.optics.solar
        nodes, weights, scales = self._field.corners(h, mu_s, active)
        x, y = (dr.acos(v) * ((n - 1) / np.pi) for v, n in ((mu, self._zeniths), (cos_phi, self._azimuths)))
        i, j = dr.minimum(t.UInt(x), self._zeniths - 2), dr.minimum(t.UInt(y), self._azimuths - 2)
        fx, fy = x - t.Float(i), y - t.Float(j)
        first, steps = dr.fma(i, self._azimuths, j), (0, 1, self._azimuths, self._azimuths + 1)
        shares = ((1.0 - fx) * (1.0 - fy), (1.0 - fx) * fy, fx * (1.0 - fy), fx * fy)
        sums = [t.Float(0.0)] * self._count
        for corner, (node, weight) in enumerate(zip(nodes, weights, strict=True)):
            place = dr.fma(node, self._zeniths * self._azimuths, first)
            found = [t.Float(0.0)] * self._count
            for step, share in zip(steps, shares, strict=True):
                values = row(self._table, place + step, self._count, active=active)
                found = [dr.fma(share, v, s) for v, s in zip(values, found, strict=True)]
            scale = [weight * s * e for s, e in zip(scales[corner // 2], solar, strict=True)]
            sums = [dr.fma(scale[n % channels], f, s) for n, (f, s) in enumerate(zip(found, sums, strict=True))]
        return [[dr.maximum(s, 0.0) for s in sums[n : n + channels]] for n in range(0, self._count, channels)]
