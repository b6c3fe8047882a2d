"""Derivatives of the sky with respect to everything it depends on.

>>> import atmo_jit
>>> views = {"altitude_m": 0.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [0.0, 45.0], "azimuth_deg": 90.0}
>>> at_earth = atmo_jit.linearize("earth", views)
>>> at_earth.jacobian(["mie.scattering_per_m", "mie.phase.g"])["mie.phase.g"].shape  # views, wavelengths
(2, 3)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere
from .backend import doubles, traversing, types
from .optics import on_device
from .parameters import RADII, VIEWS, check_names, described, directions, flat, like, tangent
from .pieces import Pieces
from .sky import Sky
from .views import check_views

OUTPUTS = ("radiance", "transmittance", "sun_irradiance", "sky_irradiance")
SHAPE = ("profiles", "sun_radius")  # of Optics.values: with these, nothing that is kept with a grid serves
RADIUS_STEP = 5e-3  # of the planet's radius, and
THICKNESS_STEP = 2e-2  # of its atmosphere's thickness: the light is nearly linear over them


class Linearization:
    """The sky of an atmosphere for a list of views, and its derivatives there.

    ``value``: what sky returns, by name: radiance, transmittance, sun_irradiance, sky_irradiance, float32 [N, W].
    """

    def __init__(
        self,
        atmosphere: Any,
        views: Mapping[str, Any],
        *,
        tolerance: float = 0.01,
        orders: int | None = None,
        ground: bool = True,
        sun_disc: bool = False,
    ) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)
        self.views = check_views(views)
        self._options = {"ground": ground, "sun_disc": sun_disc}
        self._solving = {"orders": orders, "tolerance": tolerance}
        self._thorough = {"sure": True, "scattering_too": [c.name for c in self.atmosphere.constituents]}
        self.sky = Sky(self.atmosphere, **self._solving, **self._thorough)
        r = self.sky.resolution
        self._degrees, self._phase_degree = r.degrees, r.phase_degree

    @cached_property
    def value(self) -> dict[str, np.ndarray]:
        """See the class."""
        return self._arrays(self._evaluate(self._on_device(), self._view_arrays()))

    def jacobian(self, names: Sequence[str], output: str = "radiance") -> dict[str, np.ndarray]:
        """Derivatives of one output by name: [N, W]; [N, W, n] for the n nodes of a profile.

        Where the description has one number per wavelength, entry [i, w] is by the number of wavelength w: no other
        matters there. Angles of views are in degrees, as their names say. Raises InputError for an unknown name.
        """
        names = check_names(self.atmosphere, names, self.views)
        seeds = [
            (name, direction)
            for name in names
            if name not in RADII
            for direction in ([1.0] if name in VIEWS else directions(self.atmosphere, name))
        ]
        columns: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for (name, _), column in zip(seeds, self._forward(seeds), strict=True):
            columns[name].append(column[output])
        for name in set(names) & set(RADII):
            columns[name].append(self._by_radius(name)[output])
        return {
            name: np.stack(parts, axis=-1) if ".profile." in name else parts[0] for name, parts in columns.items()
        }

    def gradients(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Derivatives of the radiance, [N, W] each, under the names that files have for them.

        ``d_radiance/NAME``: by a number; ``dlog_radiance/NAME``: by the logarithm of a common factor of all numbers of
        a list. Raises InputError for an unknown name.
        """
        found = {}
        for name, values in self.jacobian(names).items():
            value = 1.0 if name in VIEWS else described(self.atmosphere, name)
            if np.ndim(value):
                values = values @ value if ".profile." in name else values * value
            found[f"{'dlog' if np.ndim(value) else 'd'}_radiance/{name}"] = values.astype(np.float32)
        return found

    # ---- how

    def _by_radius(self, name: str) -> dict[str, np.ndarray]:
        """Central differences of solves: all geometry of a solve is made for one planet, in double precision.

        Two things change with a radius: the curvature and, the other radius being fixed, the thickness of the air.
        """
        air = self.atmosphere
        by_thickness = self._difference(air.thickness_m * THICKNESS_STEP, lambda step: {"top_radius_m": step})
        if name == "top_radius_m":
            return by_thickness
        by_curvature = self._difference(air.bottom_radius_m * RADIUS_STEP, lambda step: dict.fromkeys(RADII, step))
        return {output: by_curvature[output] - by_thickness[output] for output in OUTPUTS}

    def _difference(self, step: float, changes: Callable[[float], dict[str, float]]) -> dict[str, np.ndarray]:
        ends = []
        for sign in (1.0, -1.0):
            moved = {name: getattr(self.atmosphere, name) + s for name, s in changes(sign * step).items()}
            other = copy(self)
            other.sky = Sky(
                self.atmosphere.replace(moved), resolution=self.sky.resolution, **self._solving, **self._thorough
            )
            ends.append(other._arrays(other._evaluate(other._on_device(), other._view_arrays())))
        return {output: (ends[0][output] - ends[1][output]) / (2.0 * step) for output in OUTPUTS}

    def _numbers(self) -> list[dict[str, Any]]:
        bands = self.sky.bands
        return [b.optics.numbers(b.optics.atmosphere, self._degrees, self._phase_degree) for b in bands]

    def _on_device(self) -> list[dict[str, Any]]:
        return [on_device(numbers) for numbers in self._numbers()]

    def _view_arrays(self) -> dict[str, Any]:
        return {name: doubles(values) for name, values in self.views.items()}

    def _evaluate(self, values: list[dict[str, Any]], views: dict[str, Any]) -> list[Any]:
        """All outputs, one Float [N] each, in the order of OUTPUTS and wavelengths."""
        sky = self.sky.again(values)
        degree = np.pi / 180.0
        where = [views["altitude_m"], *(views[name] * degree for name in VIEWS[1:4]), views.get("distance_m")]
        rays, _, _ = sky.enter(*where)
        pieces = [Pieces.of(band.optics, rays) for band in sky.bands]
        light = sky.rays(*where, **self._options, pieces=pieces)
        sun, scattered = sky.irradiance(where[0], where[1])
        zero = dr.zeros(types().Float, len(self.views["altitude_m"]))
        return [v + zero for v in (*light.radiance, *light.transmittance, *sun, *scattered)]

    def _arrays(self, outputs: list[Any]) -> dict[str, np.ndarray]:
        stacked = np.stack([v.numpy() for v in outputs], axis=-1)
        return dict(zip(OUTPUTS, np.split(stacked, len(OUTPUTS), axis=-1), strict=True))

    def _forward(self, seeds: list[tuple[str, Any]]) -> list[dict[str, np.ndarray]]:
        """The derivative of all outputs along every seed, a name and a direction."""
        bands = self.sky.bands
        tangents = [
            [tangent(band.optics, *seed, self._degrees, self._phase_degree) for band in bands]
            if seed[0] not in VIEWS
            else None
            for seed in seeds
        ]
        numbers = self._numbers()
        return [
            self._along(numbers, name if of_seed is None else None, of_seed)
            for (name, _), of_seed in zip(seeds, tangents, strict=True)
        ]

    def _along(
        self, numbers: list[dict[str, Any]], view: str | None, tangents: list[list[np.ndarray]] | None
    ) -> dict[str, np.ndarray]:
        """Derivatives of all outputs by an array of views, or along tangents of the numbers of every band."""
        values, views = [on_device(part) for part in numbers], self._view_arrays()
        roots = []
        if view is not None:
            roots = [(array, doubles(np.full(array.shape, float(name == view)))) for name, array in views.items()]
        for part, made, of_band in zip(numbers, values, tangents or [], strict=False):
            along = on_device(like(part, _shaped(of_band)))
            # All of them carry derivatives, also those that are 0: every parameter then shares the same kernels.
            shaped = any(np.any(t) for name in SHAPE for t in flat(like(part, of_band)[name]))
            names = SHAPE if shaped else [name for name in part if name not in (*SHAPE, "radius", "thickness")]
            roots += [pair for name in names for pair in zip(flat(made[name]), flat(along[name]), strict=True)]
        for root, _ in roots:
            dr.enable_grad(root)
        with traversing():
            outputs = self._evaluate(values, views)
            for root, step in roots:
                dr.set_grad(root, step)
            dr.enqueue(dr.ADMode.Forward, *(root for root, _ in roots))
            dr.traverse(dr.ADMode.Forward)
            return self._arrays(dr.grad(outputs))


def _shaped(leaves: list[np.ndarray]) -> list[Any]:
    return [leaf if leaf.ndim else float(leaf) for leaf in leaves]


def linearize(atmosphere: Any, views: Mapping[str, Any], **options: Any) -> Linearization:
    """The sky and its derivatives at an atmosphere, for a list of views: see Linearization, which takes the same."""
    return Linearization(atmosphere, views, **options)


def jacobian(
    atmosphere: Any, views: Mapping[str, Any], names: Sequence[str], **options: Any
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Radiance [N, W] and its derivatives by name (Linearization.jacobian)."""
    at = Linearization(atmosphere, views, **options)
    return at.value["radiance"], at.jacobian(names)
