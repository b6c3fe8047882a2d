"""The air of ``atmosphere_medium``: coefficients, densities and majorants at points of the scene, and which
wavelength is whose. The medium and its phase function share one :class:`Air`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere, Constituent
from atmo_jit.phase import CornetteShanks, HenyeyGreenstein
from atmo_jit.profile import Exponential, Profile, Tent

from .cornette_shanks import density
from .exposed import array, host
from .globe import Globe
from .wavelengths import Wavelengths

# Cells of the majorant's table, spaced by the square root of altitude: 0.2 m at the ground of the earth, 230 m at its
# top.
MAJORANT_CELLS = 512
# The majorant is this much larger than the largest extinction, so that rounding of altitudes never turns null
# collisions negative.
MAJORANT_MARGIN = 1e-4
# The values of a description that are exposed; all of them are differentiable.
EXPOSED = (
    "scattering_per_m",
    "single_scattering_albedo",
    "absorption_per_m",
    "scale_height_m",
    "center_m",
    "half_width_m",
    "phase.g",
)


class Air(Globe):
    """Coefficients of an atmosphere in the scene.

    ``center``: the planet's centre in scene units, float64 [3]; ``scale``: scene units per metre. Points, directions
    and distances are in scene units; altitudes in metres; coefficients per metre."""

    def __init__(self, atmosphere: Atmosphere, center: np.ndarray, scale: float, wavelengths: Wavelengths) -> None:
        super().__init__(atmosphere, center, scale)
        self.atmosphere, self.wavelengths = atmosphere, wavelengths
        self.values: dict[str, Any] = {}
        for name in atmosphere.names():
            if any(name.endswith(f".{leaf}") for leaf in EXPOSED):
                self.values[name] = array(given(atmosphere, name))
        self._seen = {name: host(value) for name, value in self.values.items()}
        self.update()

    def update(self) -> None:
        """Take over what was written into ``values``."""
        now = {name: host(value) for name, value in self.values.items()}
        changed = {name: value for name, value in now.items() if not np.array_equal(value, self._seen[name])}
        if changed:
            found = {n: float(v[0]) if len(v) == 1 else v.tolist() for n, v in changed.items()}
            self.atmosphere, self._seen = self.atmosphere.replace(found), now
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(*self.values.values())
        self.fixed = {name: self.wavelengths.fixed(value) for name, value in self.values.items()}
        self.majorants = self._majorant_table()

    # ---- coefficients

    def densities(self, h: Any) -> list[Any]:
        """Relative density of each constituent at altitude ``h`` (m); 0 below the ground (:mod:`.planet` says why)."""
        above = dr.maximum(h, 0.0)
        found = [mi.Float(self._profile(c).density(above)) for c in self.atmosphere.constituents]
        return [dr.select((h >= 0.0) & (h <= self.thickness), density, 0.0) for density in found]

    def _profile(self, c: Constituent) -> Profile:
        """The profile with the exposed values, which may carry gradients."""
        if not dr.is_jit_v(mi.Float):
            return c.profile
        if isinstance(c.profile, Exponential):
            return Exponential(self.values[f"{c.name}.scale_height_m"])
        if isinstance(c.profile, Tent):
            return Tent(self.values[f"{c.name}.center_m"], self.values[f"{c.name}.half_width_m"])
        return c.profile

    def pick(self, interaction: Any) -> Callable[[str], Any]:
        """The function that gives the value of a dotted name, as an unpolarised spectrum, at the interaction's
        wavelengths.
        """
        chosen = self.wavelengths.choose(interaction)

        def value(name: str) -> Any:
            attached = dr.grad_enabled(self.values[name])
            return self.wavelengths.read(self.values[name], None if attached else self.fixed[name], chosen)

        return value

    def scattering(self, c: Constituent, value: Callable[[str], Any]) -> Any:
        """Scattering coefficient (1/m) where the density is 1."""
        return value(f"{c.name}.scattering_per_m")

    def extinction(self, c: Constituent, value: Callable[[str], Any]) -> Any:
        """Extinction coefficient (1/m) where the density is 1."""
        albedo, absorption = f"{c.name}.single_scattering_albedo", f"{c.name}.absorption_per_m"
        if c.phase is None:
            return value(absorption)
        if albedo in self.values:
            return self.scattering(c, value) / value(albedo)
        return self.scattering(c, value) + (value(absorption) if absorption in self.values else 0.0)

    def asymmetry(self, c: Constituent, value: Callable[[str], Any]) -> Any:
        """g of a constituent's phase function, None where it has none."""
        has = isinstance(c.phase, (CornetteShanks, HenyeyGreenstein))
        return value(f"{c.name}.phase.g") if has else None

    def phase_value(self, c: Constituent, g: Any, nu: Any) -> Any:
        """Phase function of a constituent (1/sr), a number or a spectrum."""
        if g is None:
            return mi.Float(c.phase.value(nu))
        if self.wavelengths.uniform(f"{c.name}.phase.g", self.values):
            return density(type(c.phase), g[0], nu)
        return mi.UnpolarizedSpectrum(*(density(type(c.phase), g[i], nu) for i in range(len(g))))

    # ---- majorants

    def _majorant_table(self) -> Any:
        """Bounds [rows * MAJORANT_CELLS] of the extinction at and above each cell's altitudes, one row per choice of
        wavelength.
        """
        edges = self.thickness * np.linspace(0.0, 1.0, MAJORANT_CELLS + 1) ** 2
        bound = 0.0
        for c in self.atmosphere.constituents:
            bound = bound + largest(c.profile, edges)[:, None] * c.extinction_per_m
        above = np.maximum.accumulate(bound[::-1], axis=0)[::-1]
        rows = np.stack([above[:, list(row)].max(axis=1) for row in self.wavelengths.rows])
        table = (rows * (1.0 + MAJORANT_MARGIN)).ravel()
        return mi.Float(table.tolist()) if dr.is_jit_v(mi.Float) else table

    def majorant(self, lowest: Any, interaction: Any) -> Any:
        """Bound of the extinction (1/m) at and above the altitude ``lowest`` (m), the same for all channels,
        detached.
        """
        x = dr.sqrt(dr.detach(lowest) * (1.0 / self.thickness)) * MAJORANT_CELLS
        cell = dr.minimum(mi.UInt32(x), MAJORANT_CELLS - 1)
        index = cell + self.wavelengths.row(interaction) * MAJORANT_CELLS
        return (
            dr.gather(mi.Float, self.majorants, index) if dr.is_jit_v(mi.Float) else float(self.majorants[int(index)])
        )


def largest(profile: Profile, edges: np.ndarray) -> np.ndarray:
    """Upper bounds of a density between neighbouring altitudes: it is monotone between its kinks."""
    kinks = np.array([k for k in profile.kinks_m if edges[0] < k < edges[-1]])
    points = np.concatenate([edges, np.nextafter(edges, -np.inf), kinks, np.nextafter(kinks, -np.inf)])
    cell = np.clip(np.searchsorted(edges, points, side="right") - 1, 0, len(edges) - 2)
    result = np.zeros(len(edges) - 1)
    np.maximum.at(result, cell, profile.density(points))
    # The upper edge belongs to the cell too (a step there counts in the next one).
    np.maximum.at(result, np.arange(len(result)), profile.density(edges[1:]))
    return result


def given(atmosphere: Atmosphere, name: str) -> Any:
    """A value as the description has it: one number stays one number."""
    node: Any = atmosphere.to_dict()
    for key in name.split("."):
        node = node[int(key)] if isinstance(node, list) else node[key]
    return node
