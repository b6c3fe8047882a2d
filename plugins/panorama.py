"""The sky around one observer as a small table: where its nodes lie, and the radiance there.

Coordinates: ``a``, elevation above the geometric horizon (rad, negative on the ground); ``phi``, azimuth from the sun
in [0, pi] (the sky is symmetric). A direction belongs to the upper or the lower part of the table; nothing is
interpolated across the horizon, so the ground starts with an edge. Nodes crowd where radiance varies: at the horizon
on both sides, and around the sun.

Everything that depends on a Mitsuba variant is elsewhere: this module uses NumPy for positions and the solver's own
Dr.Jit types for radiance, so that a derivative can pass from the parameters into the table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

# Rows above and below the horizon, columns from the sun to its opposite. Interpolation error against the solver at
# random directions: see tests/plugins/test_panorama.py.
ROWS_UP, ROWS_DOWN, COLUMNS = 128, 64, 72
SUN_ROWS, SUN_COLUMNS = 49, 17
# Sampling cells: this many along each side of the four nodes' cell, each of constant density.
SPLIT = 2
CELLS_UP, CELLS_DOWN, CELLS_AROUND = SPLIT * ROWS_UP, SPLIT * ROWS_DOWN, SPLIT * COLUMNS
AUREOLE_RAD = math.radians(1.0)
# A ray this close to the horizon is decided by rounding: the first rows stand this far off it.
EDGE_RAD = 2e-6


@dataclass(frozen=True)
class Warp:
    """A smooth increasing map of [0, length] onto [0, 1] that is steep around its centres.

    u(x) = linear x + sum_k gain_k (asinh((x - centre_k) sharpness_k) + asinh(centre_k sharpness_k)): the spacing of
    nodes grows with the distance from a centre beyond 1 / sharpness and is constant within it.
    """

    length: float
    linear: float
    centres: tuple[float, ...]
    sharpness: tuple[float, ...]
    gains: tuple[float, ...]

    @classmethod
    def around(cls, length: float, *centres: tuple[float, float, float]) -> Warp:
        """Centres as (position, width, share of all nodes); what the shares leave is spread evenly."""
        gains = []
        for position, width, share in centres:
            total = math.asinh((length - position) / width) + math.asinh(position / width)
            gains.append(share / total)
        positions, widths, shares = zip(*centres, strict=True)
        return cls(length, (1.0 - sum(shares)) / length, positions, tuple(1.0 / w for w in widths), tuple(gains))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """u(x), float64."""
        u = self.linear * x
        for centre, sharpness, gain in zip(self.centres, self.sharpness, self.gains, strict=True):
            u = u + gain * (np.arcsinh((x - centre) * sharpness) + math.asinh(centre * sharpness))
        return u

    def nodes(self, count: int) -> np.ndarray:
        """x at ``count`` values of u spread evenly over [0, 1], ends included: bisection in double precision."""
        target = np.linspace(0.0, 1.0, count)
        low, high = np.zeros(count), np.full(count, self.length)
        for _ in range(60):
            middle = 0.5 * (low + high)
            beyond = self(middle) > target
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        x = 0.5 * (low + high)
        x[0], x[-1] = 0.0, self.length
        return x


@dataclass(frozen=True)
class Panorama:
    """Geometry of the table for an observer at ``altitude_m`` and a sun at ``sun_zenith`` (rad)."""

    altitude_m: float
    sun_zenith: float
    dip: float
    up: Warp
    down: Warp
    around: Warp

    @classmethod
    def of(cls, radius_m: float, thickness_m: float, altitude_m: float, sun_zenith: float) -> Panorama:
        """The table of a planet of ``radius_m`` with air up to ``thickness_m``.

        ``dip``: how far the horizon lies below the horizontal, acos(R / (R + h)) without cancellation. From above the
        air the table ends at the top of the limb: the rest of the sky is black.
        """
        distance = math.sqrt(altitude_m * (2.0 * radius_m + altitude_m))
        dip = math.atan2(distance, radius_m)
        horizon = highest = 0.5 * math.pi + dip
        if altitude_m > thickness_m:
            above = altitude_m - thickness_m
            top = radius_m + thickness_m
            highest = max(dip - math.atan2(math.sqrt(above * (2.0 * top + above)), top), 4.0 * EDGE_RAD)
        sun_height = min(max(horizon - sun_zenith, 0.0), highest)
        # Seen from space the air is a thin line on the horizon: two kilometres of it set the scale there, 0.2 degrees
        # near the ground.
        haze = min(math.radians(0.2), 2000.0 / max(distance, 1.0))
        up = Warp.around(highest, (0.0, haze, 0.4), (sun_height, AUREOLE_RAD, 0.25))
        # Below the horizon radiance follows the distance to the ground, which changes on the scale of the dip.
        share = 0.75 if altitude_m < thickness_m else 0.4
        down = Warp.around(0.5 * math.pi - dip, (0.0, max(min(dip / 30.0, haze), 1e-5), share))
        # A degree around the sun is 1 / cos(elevation) degrees of azimuth.
        width = min(AUREOLE_RAD / max(math.sin(sun_zenith), 1e-3), math.radians(60.0))
        return cls(altitude_m, sun_zenith, dip, up, down, Warp.around(math.pi, (0.0, width, 0.55)))

    @property
    def horizon_zenith(self) -> float:
        """Zenith angle of the geometric horizon (rad)."""
        return 0.5 * math.pi + self.dip

    @property
    def sun_height(self) -> float:
        """Elevation of the sun's centre above the horizon (rad); negative after it has set."""
        return self.horizon_zenith - self.sun_zenith

    def rows(self) -> np.ndarray:
        """``a`` at the rows [ROWS_DOWN + 1 + ROWS_UP + 1]: nadir to horizon, then horizon to zenith (or limb)."""
        return np.concatenate([-self.down.nodes(ROWS_DOWN + 1)[::-1], self.up.nodes(ROWS_UP + 1)])

    def columns(self) -> np.ndarray:
        """``phi`` at the table's columns [COLUMNS + 1]."""
        return self.around.nodes(COLUMNS + 1)

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """View zenith and azimuth (rad) of all nodes, float64, by rows; those at the horizon are EDGE_RAD off it."""
        a = self.rows()
        a[ROWS_DOWN], a[ROWS_DOWN + 1] = -EDGE_RAD, EDGE_RAD
        zenith, azimuth = np.meshgrid(self.horizon_zenith - a, self.columns(), indexing="ij")
        return zenith.ravel(), azimuth.ravel()

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of the sampling cells: sine of elevation at the rows (the horizon twice), azimuth at the columns."""
        a = np.concatenate([-self.down.nodes(CELLS_DOWN + 1)[::-1], self.up.nodes(CELLS_UP + 1)])
        return np.sin(a - self.dip), self.around.nodes(CELLS_AROUND + 1)

    def solid_angles(self) -> np.ndarray:
        """Solid angle (sr) of the cells [CELLS_DOWN + CELLS_UP, CELLS_AROUND], both sides of the sun together."""
        sines, azimuths = self.cells()
        heights = np.delete(np.diff(sines), CELLS_DOWN)
        return 2.0 * heights[:, None] * np.diff(azimuths)[None, :]


def cell_means(values: np.ndarray) -> np.ndarray:
    """Means over the sampling cells of values at the nodes, linear in between; no cell spans the horizon."""
    parts = [
        _means(_means(part, CELLS_DOWN if below else CELLS_UP).T, CELLS_AROUND).T
        for below, part in ((True, values[: ROWS_DOWN + 1]), (False, values[ROWS_DOWN + 1 :]))
    ]
    return np.concatenate(parts)


def _means(values: np.ndarray, count: int) -> np.ndarray:
    """Means over ``count`` equal steps along the first axis, ``count`` being SPLIT times the number of intervals."""
    at = (np.arange(count) + 0.5) / SPLIT
    low = at.astype(int)
    part = (at - low)[:, None]
    return (1.0 - part) * values[low] + part * values[low + 1]


def solve_sky(sky: Any, view: Panorama, nodes: Panorama | None = None, parameters: Any = None) -> list[Any]:
    """Radiance at all nodes, ground included: a list of W Dr.Jit Floats of length rows x columns.

    ``nodes``: the panorama whose nodes' directions are meant, if it is another.
    ``parameters``: those of the sky, Dr.Jit arrays by name, whose derivatives the radiance carries.
    """
    zenith, azimuth = (nodes or view).directions()
    radiance = list(sky.rays(*_together(view.altitude_m, view.sun_zenith, zenith, azimuth)).radiance)
    dr.eval(radiance)  # all wavelengths in one kernel
    return _following(radiance, "radiance", sky, _views(view, zenith, azimuth), parameters)


@dataclass(frozen=True)
class Disc:
    """The sun's disc: seen between ``low`` and ``high`` (rad above the horizon), its brightness there relative to an
    unattenuated, even one of angular ``radius`` (rad). ``squeeze``: its vertical over its horizontal diameter.

    ``low`` >= ``high``: it has set. ``brightness`` [SUN_ROWS, SUN_COLUMNS, W]: along elevation from ``low`` to
    ``high``, and along the square of the distance from the centre (0 centre, 1 limb); without limb darkening all
    columns are equal. ``mean`` [W]: the mean over the whole disc times ``squeeze``, which is the fraction of
    the sun's irradiance that arrives.
    """

    radius: float
    low: float
    high: float
    brightness: np.ndarray
    mean: np.ndarray
    squeeze: float = 1.0

    @property
    def solid_angle(self) -> float:
        """Of the whole disc before it is squeezed, also where it has set (sr)."""
        return 4.0 * math.pi * math.sin(0.5 * self.radius) ** 2


def _views(view: Panorama, zenith: np.ndarray, azimuth: np.ndarray) -> dict[str, Any]:
    angles = {"sun_zenith_deg": view.sun_zenith, "view_zenith_deg": zenith, "azimuth_deg": azimuth}
    return {"altitude_m": view.altitude_m, **{name: np.degrees(value) for name, value in angles.items()}}


def _following(values: list[Any], output: str, sky: Any, views: dict[str, Any], parameters: Any) -> list[Any]:
    """The values, with the derivatives of an output of the sky by parameters."""
    if not parameters:
        return values
    from atmo_jit.operation import differentiable

    options = {"tolerance": sky.tolerance, "resolution": sky.resolution}
    moved = differentiable(sky.atmosphere, views, parameters, **options)[output]
    return [dr.replace_grad(value, other) for value, other in zip(values, moved, strict=True)]


def disc_radiance(sky: Any, disc: Disc, view: Panorama, parameters: Any = None) -> list[Any]:
    """Radiance of the disc where ``brightness`` is known: W arrays or, with ``parameters``, W Dr.Jit Floats that carry
    derivatives by them, of length rows x columns."""
    solar = sky.atmosphere.solar_irradiance
    radiance = list(np.moveaxis(disc.brightness * solar / disc.solid_angle, -1, 0).reshape(len(solar), -1))
    if not parameters or disc.high <= disc.low:
        return radiance
    from atmo_jit.backend import floats, types

    t = types()
    elevation = np.linspace(disc.low, disc.high, SUN_ROWS)
    views = _views(view, view.horizon_zenith - elevation, np.zeros(SUN_ROWS))
    row = dr.arange(t.UInt, SUN_ROWS * SUN_COLUMNS) // SUN_COLUMNS
    values = []
    even = [floats(disc.brightness[:, 0, w]) for w in range(len(solar))]
    for w, moved in enumerate(_following(even, "transmittance", sky, views, parameters)):
        size = dr.detach(moved)
        change = dr.select(size > 0.0, moved / dr.select(size > 0.0, size, 1.0), 1.0)
        if "solar_irradiance" in parameters:
            given = parameters["solar_irradiance"]
            of_sun = dr.gather(t.Float, given, min(w, len(given) - 1))
            change = change * (of_sun / dr.maximum(dr.detach(of_sun), 1e-30))
        values.append(floats(radiance[w]) * dr.gather(t.Float, change, row))
    return values


def solve_disc(
    sky: Any, view: Panorama, radius: float, limb_darkening: bool = False, squeeze: float = 1.0
) -> Disc:
    """Transmittance towards the visible part of a disc of angular ``radius`` (rad); dark below the horizon.

    ``squeeze``: see :class:`Disc`. Radiance stays, so that irradiance shrinks with the solid angle.

    Limb darkening after Hestroffer and Magnan, A&A 333 (1998): brightness mu^alpha, alpha = -0.023 + 0.292 / lambda
    (micrometres), scaled so that the disc's irradiance does not change.
    """
    wavelengths = np.asarray(sky.atmosphere.wavelengths_nm)
    half_height = radius * squeeze
    low = max(view.sun_height - half_height, EDGE_RAD)
    high = min(view.sun_height + half_height, view.horizon_zenith)
    if high <= low:
        shape = (SUN_ROWS, SUN_COLUMNS, len(wavelengths))
        return Disc(radius, 1.0, 0.0, np.zeros(shape), np.zeros(len(wavelengths)), squeeze)
    a = np.linspace(low, high, SUN_ROWS)
    light = sky.rays(*_together(view.altitude_m, view.sun_zenith, view.horizon_zenith - a, 0.0))
    dr.eval(light.transmittance)
    transmittance = np.stack([np.broadcast_to(np.array(t), SUN_ROWS) for t in light.transmittance], axis=-1)
    shape = np.ones((SUN_COLUMNS, len(wavelengths)))
    if limb_darkening:
        alpha = np.maximum(-0.023 + 292.0 / wavelengths, 0.0)
        cosine = np.sqrt(1.0 - np.linspace(0.0, 1.0, SUN_COLUMNS))
        shape = cosine[:, None] ** alpha
        shape /= 0.5 * (shape[1:] + shape[:-1]).mean(axis=0)
    # Mean over the disc: chords at equal steps of elevation, the part below the horizon counting as dark.
    edges = np.linspace(low, high, 2 * SUN_ROWS + 1)
    part = _below((edges - view.sun_height) / half_height)
    middle = 0.5 * (edges[1:] + edges[:-1])
    inside = np.stack([np.interp(middle, a, t) for t in transmittance.T], axis=-1)
    mean = squeeze * (inside * np.diff(part)[:, None]).sum(axis=0)
    return Disc(radius, low, high, transmittance[:, None, :] * shape[None, :, :], mean, squeeze)


def _together(*values: Any) -> list[Any]:
    """Arrays and numbers as evaluated Float64 arrays of one width: literals would be compiled into the kernels."""
    from atmo_jit.backend import doubles, types

    count = max(len(np.atleast_1d(v)) for v in values if not dr.is_array_v(v))
    zero = doubles(np.zeros(count))
    return [types().Float64(v) + zero if dr.is_array_v(v) else doubles(np.broadcast_to(v, count)) for v in values]


def _below(y: np.ndarray) -> np.ndarray:
    """Fraction of a unit disc's area below the chord at height ``y`` in [-1, 1]."""
    y = np.clip(y, -1.0, 1.0)
    return 0.5 + (y * np.sqrt(1.0 - y * y) + np.arcsin(y)) / math.pi
