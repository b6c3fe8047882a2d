"""A solved atmosphere: solve once, evaluate many times.

>>> from atmo_jit import Sky
>>> noon = Sky("earth", suns=(0.0, 0.6))
"""

from __future__ import annotations

from collections.abc import Collection
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere
from .backend import doubles, floats, one_at_a_time, types, uints
from .bundle import Bundle
from .column import SunColumns, sun_columns
from .entry import enter
from .errors import InputError
from .field import Field
from .grid import Grid
from .march import Rays, Shells, march
from .multiple_scattering import first_again, orders_again, solve, solve_again
from .optics import MAX_CHANNELS, Optics
from .pieces import Pieces, light_along
from .resolution import Resolution
from .single_scattering import exact_sun_irradiance, ground_light, horizontal_irradiance
from .views import side_by_side

# Share of the usual remainder that is left where derivatives are wanted, and fine ones: those of the light that orders
# left out would add are less exact than that light.
SURE, FINE = 0.03, 0.002


@dataclass
class RayLight:
    """Radiance toward the observer and transmittance along each ray: lists of W Dr.Jit Floats."""

    radiance: list[Any]
    transmittance: list[Any]

    def taken(self, places: np.ndarray) -> RayLight:
        """The rays at ``places`` of these."""
        index = uints(places)

        def take(values: list[Any]) -> list[Any]:
            return [v if dr.width(v) == 1 else dr.gather(type(v), v, index) for v in values]

        return RayLight(take(self.radiance), take(self.transmittance))


class _Band:
    """The solution at up to four wavelengths; ``field`` None: without its light."""

    def __init__(self, optics: Optics, columns: SunColumns, field: Any = None) -> None:
        self.optics, self.columns, self.field = optics, columns, field
        self.source = field if field is not None and field.scatters and optics.scatterers else None


class Sky:
    """The solved sky of an atmosphere: all sun angles, altitudes and directions. Solve once, evaluate many times.

    ``atmosphere``: an Atmosphere or what Atmosphere.load takes. ``orders``: scattering and reflection events counted
    (1: single scattering and directly lit ground only; None: all). ``tolerance``: relative error aimed at, from which
    the resolution follows unless it is given. ``suns``: range of sun zenith angles (radians, at the observer) that will
    be asked for; light under other suns is not solved. ``layout``: an atmosphere like this one whose nodes are used, so
    that atmospheres close to each other differ by nothing but their light. ``held``: the solution itself, as
    :attr:`held` gave it for the same arguments; nothing is solved then. ``scattering_too``: see Optics; ``sure``: more
    orders are solved, for derivatives; ``fine``: see Resolution.suited. Raises AtmosphereError, LLVMError,
    InputError.
    """

    @one_at_a_time
    def __init__(
        self,
        atmosphere: Any,
        orders: int | None = None,
        tolerance: float = 0.01,
        resolution: Resolution | None = None,
        suns: tuple[float, float] | None = None,
        layout: Atmosphere | None = None,
        held: list[dict[str, Any]] | None = None,
        *,
        scattering_too: Collection[str] = (),
        sure: bool = False,
        fine: bool = False,
    ) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)
        self.layout = layout or self.atmosphere
        if orders is not None and (isinstance(orders, bool) or not isinstance(orders, int) or orders < 1):
            raise InputError(f"orders: is {orders!r}; must be a whole number >= 1, or None for all")
        if not 0.0 < tolerance < 1.0:
            raise InputError(f"tolerance: is {tolerance!r}; must be a number between 0 and 1")
        self.orders, self.tolerance, self.suns = orders, tolerance, suns
        self.resolution = resolution or Resolution.suited(self.atmosphere, tolerance, fine=fine)
        count = len(self.atmosphere.wavelengths_nm)
        bands = [np.arange(i, min(i + MAX_CHANNELS, count)) for i in range(0, count, MAX_CHANNELS)]
        remainder = (FINE if fine else SURE) * tolerance if sure else tolerance
        self._bands: list[_Band] = []
        for band, values in zip(bands, held or [None] * len(bands), strict=True):
            optics = Optics(self.atmosphere, band, scattering_too)
            if values is None:
                columns = sun_columns(optics, self.grid)
                field = solve(optics, columns, self.grid, self.resolution, orders, remainder, noting=sure)
            else:
                columns = SunColumns(optics, self.resolution.columns, values["columns"])
                degree = self.resolution.first_degree
                field = Field.of(optics, columns, self.grid, degree, values, scatters=orders != 1)
            self._bands.append(_Band(optics, columns, field))

    @property
    def grid(self) -> Grid:
        """The nodes that it is solved on."""
        return Grid.of(self.layout, self.resolution, self.suns, self.atmosphere)

    def unlit(self, atmosphere: Atmosphere | None = None) -> Sky:
        """This sky without its light, which ``again`` and its like do not ask for: what is kept for long holds no
        tables of one solve. ``atmosphere``: one of the same make-up with other profiles, met on the same nodes."""
        other = copy(self)
        other._bands = [_Band(band.optics, band.columns) for band in self._bands]
        if atmosphere is not None:
            other.atmosphere = atmosphere
            for band in other._bands:
                names = [band.optics.constituents[k].name for k in band.optics.scatterers]
                band.optics = Optics(atmosphere, band.optics.indices, names)
        return other

    def columns_again(self, values: list[dict[str, Any]], known: list[Any] | None = None) -> list[Any]:
        """The tables of SunColumns for other ``values`` (Optics.values) of the bands, which may carry derivatives;
        ``known``: their numbers."""
        tables = []
        for i, (band, new) in enumerate(zip(self._bands, values, strict=True)):
            optics = band.optics.with_values(new)
            tables.append(sun_columns(optics, self.grid, known=known[i] if known else None).table)
        return tables

    def first_again(
        self, values: list[dict[str, Any]], columns: list[Any], known: list[dict[str, Any] | None] | None = None
    ) -> list[Any]:
        """The light of order 1, per band; ``columns``, ``known``: see orders_again."""
        lights = []
        for i, (band, new) in enumerate(zip(self._bands, values, strict=True)):
            optics, grid = band.optics.with_values(new), self.grid
            toward_sun = sun_columns(optics, grid, columns[i])
            lights.append(first_again(optics, toward_sun, grid, self.resolution, known and known[i]))
        return lights

    def orders_again(
        self,
        values: list[dict[str, Any]],
        shares: list[Any],
        columns: list[Any],
        known: list[dict[str, Any] | None] | None = None,
        first: list[Any] | None = None,
    ) -> list[dict[str, Any]]:
        """The light of the orders for other ``values``, which may carry derivatives, as many as there are ``shares``;
        ``columns``: see columns_again; ``known`` (Field): from a solve for these values; ``first``: see first_again."""
        first = first or self.first_again(values, columns, known)
        done = []
        for i, (band, new) in enumerate(zip(self._bands, values, strict=True)):
            optics, grid = band.optics.with_values(new), self.grid
            toward_sun = sun_columns(optics, grid, columns[i])
            of_solve = known and known[i]
            done.append(orders_again(optics, toward_sun, grid, self.resolution, shares[i], of_solve, first[i]))
        return done

    def again(
        self,
        values: list[dict[str, Any]],
        shares: list[Any],
        columns: list[Any] | None = None,
        orders: list[dict[str, Any]] | None = None,
    ) -> Sky:
        """The sky for other ``values`` (Optics.values) of its bands, which may carry derivatives, with the ``shares``
        of orders (Field) of a sky that was solved, on the same nodes; ``columns``, ``orders``: see columns_again and
        orders_again."""
        other, other._bands = copy(self), []
        tables = columns or self.columns_again(values)
        orders = orders or self.orders_again(values, shares, tables)
        for band, new, table, of_orders, done in zip(self._bands, values, tables, shares, orders, strict=True):
            optics = band.optics.with_values(new)
            columns = sun_columns(optics, self.grid, table)
            field = solve_again(optics, columns, self.grid, self.resolution, of_orders, self.orders, done)
            other._bands.append(_Band(field.optics, columns, field))
        return other

    def looked_up(self, values: list[dict[str, Any]], columns: list[Any], tables: list[dict[str, Any]]) -> Sky:
        """The sky for ``values`` of the bands, with the ``tables`` of its fields alone (Field.tables), all of which may
        carry derivatives; ``columns``: see columns_again."""
        other, other._bands = copy(self), []
        for band, new, table, of_field in zip(self._bands, values, columns, tables, strict=True):
            optics, grid = band.optics.with_values(new), self.grid
            toward_sun, degree = sun_columns(optics, grid, table), self.resolution.first_degree
            field = Field.of_tables(optics, toward_sun, grid, degree, of_field, scatters=self.orders != 1)
            other._bands.append(_Band(optics, toward_sun, field))
        return other

    @property
    def bands(self) -> list[_Band]:
        """The solution at up to four wavelengths each, its look-up tables made: what tables are baked from."""
        for band in self._bands:
            band.field.prepare()
        return self._bands

    @property
    def solutions(self) -> list[_Band]:
        """The same, as they are."""
        return self._bands

    @property
    def held(self) -> list[dict[str, Any]]:
        """All numbers of the solution, per band: Floats by name."""
        return [{"columns": band.columns.table, **band.field.held} for band in self._bands]

    @one_at_a_time
    def rays(
        self,
        altitude_m: Any,
        sun_zenith: Any,
        view_zenith: Any,
        azimuth: Any,
        distance_m: Any = None,
        *,
        ground: bool = True,
        sun_disc: bool = False,
        pieces: list[Pieces | None] | None = None,
        shells: Shells | None = None,
    ) -> RayLight:
        """Radiance and transmittance of rays.

        Angles in radians, arrays of one width: NumPy's, which are reordered for speed, or Dr.Jit's (Float64 keeps
        views from far out in space exact; Float works too).
        ``azimuth`` is the view's minus the sun's. ``distance_m``: stop there (aerial perspective). ``ground=False``
        leaves the ground's own radiance out; ``sun_disc=True`` adds the sun, a uniform disc of the atmosphere's
        ``sun_angular_radius_deg`` (nothing for a point sun). ``pieces``: those of the rays (pieces.Pieces), per band;
        derivatives then pass through. ``shells``: those of march.march, of an atmosphere close to this one, where they
        cannot be made because the rays are being recorded.
        """
        given = (altitude_m, sun_zenith, view_zenith, azimuth, *([] if distance_m is None else [distance_m]))
        usual = pieces is None and all(isinstance(v, np.ndarray) and v.ndim == 1 for v in given)
        if usual and len({v.size for v in given}) == 1:
            air = self.atmosphere
            order = side_by_side(air.bottom_radius_m, air.thickness_m, altitude_m, view_zenith)
            light = self.rays(*(doubles(v[order]) for v in given), ground=ground, sun_disc=sun_disc)
            return light.taken(np.argsort(order))
        recorded = pieces is not None or shells is not None
        exact = not recorded and self._bands[0].optics.exact is not None
        views = (altitude_m, sun_zenith, view_zenith, azimuth, distance_m)
        rays, meets_air, passes = self.enter(*views, exact=exact, recorded=recorded)
        radiance, transmittance = [], []
        disc = self._disc(rays, passes) if sun_disc else None
        for i, band in enumerate(self._bands):
            optics = band.optics
            band.field.prepare()
            if pieces is None:
                light = march(optics.exact if exact else optics, band.columns, rays, source=band.source, shells=shells)
            else:
                light = light_along(optics, band.columns, rays, pieces[i], source=band.source)
            dr.eval(light.single, light.multiple, light.transmittance)
            for c in range(optics.channel_count):
                light.single[c] = light.single[c] + light.multiple[c]
            if ground:
                for c, glow in enumerate(ground_light(optics, band.columns, rays.single(), band.field)):
                    light.single[c] = dr.fma(light.transmittance[c], glow, light.single[c])
            transmittance += [dr.select(meets_air, value, 1.0) for value in light.transmittance]
            radiance += [dr.select(meets_air, value, 0.0) for value in light.single]
            if disc is not None:
                for c, solar in enumerate(optics.solar, len(radiance) - optics.channel_count):
                    radiance[c] = dr.fma(disc * solar, transmittance[c], radiance[c])
        return RayLight(radiance, transmittance)

    @one_at_a_time
    def table(
        self, altitude_m: Any, view_zenith: Any, sun_zenith: Any, azimuth: Any, *, ground: bool = True
    ) -> RayLight:
        """Radiance for every combination of P views, S suns and A azimuths, far faster than ray by ray (bundle.py).

        ``altitude_m`` (0 to the top of the air) and ``view_zenith`` [P]: where rays start, and their zenith angle
        there; ``sun_zenith`` [S] at the start, ``azimuth`` [A] of the view minus that of the sun, or [P, S, A];
        radians. Radiance comes as W Floats [P, S, A] flattened, transmittance as W Floats [P].
        """
        view, height, sun = (np.atleast_1d(np.asarray(v, float)) for v in (view_zenith, altitude_m, sun_zenith))
        height, view = np.broadcast_arrays(height, view)
        top = self.atmosphere.thickness_m
        if height.ndim != 1 or sun.ndim != 1 or height.min() < 0.0 or height.max() > top:
            raise InputError(f"altitude_m: lists of altitudes from 0 to {top:g} m, the top of the air, are allowed")
        cosines = np.cos(np.asarray(azimuth, float))
        if cosines.ndim > 1 and cosines.shape[:2] != (len(height), len(sun)):
            raise InputError(f"azimuth: has shape {cosines.shape}; must be [A] or [{len(height)}, {len(sun)}, A]")
        cosines = floats(np.broadcast_to(cosines, (len(height), len(sun), cosines.shape[-1])))
        radiance, transmittance = [], []
        for band in self._bands:
            bundle = self._bundle(band, height, np.cos(view))
            radiance += bundle.radiance(band.optics, band.columns, band.field, sun, cosines, ground=ground)
            transmittance += bundle.transmittance(band.optics)
        return RayLight(radiance, transmittance)

    @staticmethod
    def _bundle(band: _Band, h: np.ndarray, mu: np.ndarray) -> Bundle:
        """The paths of the last table, as long as the same are asked for."""
        key, grid = (h.tobytes(), mu.tobytes()), band.field.grid
        last = grid.kept("last bundle", dict)
        if key not in last:
            last.clear()
            last[key] = Bundle(grid, h, mu)
        return last[key]

    @one_at_a_time
    def irradiance(self, altitude_m: Any, sun_zenith: Any) -> tuple[list[Any], list[Any]]:
        """Irradiance of the sun and of the sky (scattered light) on a horizontal surface facing up at ``altitude_m``:
        lists of W Floats."""
        t = types()
        exact = t.Float64(altitude_m), dr.cos(t.Float64(sun_zenith))
        h, mu_s = (t.Float(v) for v in exact)
        h = dr.minimum(h + 0.0 * mu_s, self._bands[0].optics.thickness)
        dr.make_opaque(h, mu_s)
        sun, sky = [], []
        for band in self._bands:
            band.field.prepare()
            direct, scattered = horizontal_irradiance(band.optics, band.columns, band.field, h, mu_s)
            if band.optics.exact is not None and not dr.grad_enabled(exact):
                altitude = dr.minimum(exact[0] + 0.0 * exact[1], band.optics.exact.thickness)
                direct = exact_sun_irradiance(band.optics.exact, band.columns, altitude, exact[1] + 0.0 * altitude)
            sun += direct
            sky += [dr.select(h < band.optics.thickness, value, 0.0) for value in scattered]
        return sun, sky

    def enter(self, *views: Any, exact: bool = False, recorded: bool = True) -> tuple[Rays, Any, Any]:
        """Rays where they enter the atmosphere (entry.enter)."""
        optics = self._bands[0].optics
        return enter(optics.exact if exact else optics, *views, exact=exact, recorded=recorded)

    def _disc(self, rays: Rays, passes: Any) -> Any:
        """Radiance of the unattenuated solar disc per unit irradiance (1/sr), on the rays that meet it; uniform."""
        radius = np.deg2rad(self.atmosphere.sun_angular_radius_deg)
        if radius == 0.0:
            return dr.zeros(types().Float, 1)
        solid_angle = 4.0 * np.pi * np.sin(0.5 * radius) ** 2
        return dr.select(passes & (1.0 - rays.nu <= 2.0 * np.sin(0.5 * radius) ** 2), 1.0 / solid_angle, 0.0)
