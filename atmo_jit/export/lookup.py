"""The tables of Bruneton's family as clients read them: linear between texels, in NumPy.

>>> from atmo_jit.export.reader import read
>>> tables = read("tables")  # a folder that `atmo-jit export --layout takram` wrote
>>> tables.rays(2.0, 1.2, 1.4, 0.5)  # altitude (m); sun zenith, view zenith, azimuth (rad): radiance [..., 3]

The maps are those of :class:`atmo_jit.mapping.Bruneton`; the shader snippets print the same ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..mapping import Bruneton, horizon
from ..phase import CornetteShanks, RayleighPhase


@dataclass
class ClientTables:
    """Tables of three channels, as a client holds them, and the constants without which they cannot be read.

    ``transmittance`` [x_r, x_mu, 3] to the top; ``irradiance`` [x_r, x_mu_s, 3] of the sky on a horizontal surface;
    ``scattering`` [x_r, row of mu, x_nu, x_mu_s, 3]: single scattering by air + orders >= 2, over Rayleigh's phase
    function; ``single_mie``, likewise, over Cornette and Shanks' with asymmetry ``g``; ``higher``: orders >= 2 over
    Rayleigh's, or None where the layout does not have it. W m^-2 nm^-1, per sr where that is due.
    """

    mapping: Bruneton
    g: float
    transmittance: np.ndarray
    irradiance: np.ndarray
    scattering: np.ndarray
    single_mie: np.ndarray
    higher: np.ndarray | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """Name and array of every table."""
        names = ("transmittance", "irradiance", "scattering", "single_mie", "higher")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def transmittance_up(self, h: Any, mu: Any) -> np.ndarray:
        """Transmittance to the top [..., 3] of rays (h, mu) that miss the ground."""
        x_r, x_mu = self.mapping.transmittance(np.asarray(h, float), np.asarray(mu, float))
        return linear(self.transmittance, x_r, x_mu)

    def irradiance_on_ground(self, h: Any, mu_s: Any) -> np.ndarray:
        """Irradiance of the sky on a horizontal surface at ``h`` [..., 3]."""
        return linear(self.irradiance, *self.mapping.irradiance(np.asarray(h, float), np.asarray(mu_s, float)))

    def radiance(self, h: Any, mu: Any, mu_s: Any, nu: Any, ground: Any = None) -> np.ndarray:
        """Radiance [..., 3] scattered toward (h, mu); the ground's own is not in it. ``ground``: whether the rays end
        on the ground (by default: those below the horizon)."""
        h, mu, mu_s, nu = np.broadcast_arrays(*(np.asarray(v, float) for v in (h, mu, mu_s, nu)))
        if ground is None:
            ground = (mu < 0.0) & (mu <= horizon(self.mapping.bottom, h))
        altitudes, rows, angles, suns = self.scattering.shape[:4]
        x_r, _ = self.mapping.transmittance(h, np.ones_like(h))
        # The row's texture coordinate, back among texel centres: its two halves meet between two of them.
        row = self.mapping.view_row(self.mapping.view(h, mu, ground), ground, rows) * rows - 0.5
        place = (x_r, row / (rows - 1), self.mapping.angle(nu), self.mapping.sun(mu_s))
        air = linear(self.scattering, *place) * RayleighPhase().value(nu)[..., None]
        return air + linear(self.single_mie, *place) * CornetteShanks(self.g).value(nu)[..., None]

    def rays(self, altitude_m: Any, sun_zenith: Any, view_zenith: Any, azimuth: Any) -> np.ndarray:
        """The same for views (m, rad) from anywhere: those from above the air start where they enter it."""
        h, sun, view, phi = np.broadcast_arrays(
            *(np.asarray(v, float) for v in (altitude_m, sun_zenith, view_zenith, azimuth))
        )
        bottom, thickness = self.mapping.bottom, self.mapping.top - self.mapping.bottom
        mu, mu_s = np.cos(view), np.cos(sun)
        nu = mu * mu_s + np.sin(view) * np.sin(sun) * np.cos(phi)
        r, outside = bottom + h, h > thickness
        excess = np.where(outside, (h - thickness) * (2.0 * bottom + h + thickness), 0.0)
        square = (r * mu) ** 2 - excess
        meets = ~outside | ((mu < 0.0) & (square > 0.0))
        gap = np.where(outside & meets, -r * mu - np.sqrt(np.maximum(square, 0.0)), 0.0)
        at = np.where(outside, self.mapping.top, r)
        cosines = (np.clip(c, -1.0, 1.0) for c in ((r * mu + gap) / at, (r * mu_s + gap * nu) / at, nu))
        found = self.radiance(np.minimum(h, thickness), *cosines)
        return np.where(meets[..., None], found, 0.0)


def linear(table: np.ndarray, *unit: np.ndarray) -> np.ndarray:
    """``table`` [n0, n1, ..., C] read linearly at unit coordinates, held beyond the ends."""
    axes, total = len(unit), 0.0
    places = [np.clip(x, 0.0, 1.0) * (n - 1) for x, n in zip(unit, table.shape, strict=False)]
    first = [np.minimum(p.astype(int), n - 2) for p, n in zip(places, table.shape, strict=False)]
    share = [p - i for p, i in zip(places, first, strict=True)]
    for corner in np.ndindex(*(2,) * axes):
        weight = np.ones_like(share[0])
        for f, c in zip(share, corner, strict=True):
            weight = weight * (f if c else 1.0 - f)
        at = tuple(i + c for i, c in zip(first, corner, strict=True))
        total = total + weight[..., None] * table[at].astype(np.float64)
    return total


def packed(table: np.ndarray, alpha: np.ndarray | None = None, dtype: Any = np.float32) -> np.ndarray:
    """A scattering table as texels [x_r, row of mu, x_nu * suns + x_mu_s, 4] or a flat one [.., .., 4]; the fourth
    channel is ``alpha`` [...] or 1."""
    texture = np.ones((*table.shape[:-1], 4), dtype=dtype)
    texture[..., :3] = table
    if alpha is not None:
        texture[..., 3] = alpha
    return texture.reshape(*table.shape[:2], -1, 4) if table.ndim == 5 else texture


def unpacked(texture: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """The table [*size, 3] of texels, float32."""
    return texture.reshape(*size, -1)[..., :3].astype(np.float32)
