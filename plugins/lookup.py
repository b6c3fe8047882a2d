"""The panorama in the types of a Mitsuba variant: look-up and importance sampling of sky and sun.

Textures serve as arrays here because they are the one kind of table that scalar and vectorised variants read alike.
Everything works in the emitter's local frame (Z up) and in the current variant.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .exposed import number, tensor
from .panorama import (
    CELLS_AROUND,
    CELLS_DOWN,
    CELLS_UP,
    COLUMNS,
    ROWS_DOWN,
    ROWS_UP,
    SUN_COLUMNS,
    SUN_ROWS,
    Disc,
    Panorama,
    Warp,
    cell_means,
)

ROWS = ROWS_DOWN + ROWS_UP
CELLS = CELLS_DOWN + CELLS_UP
# Importance of a cell: luminance times 1 at the zenith, falling to this at the horizon, which most surfaces see at a
# worse angle. Surfaces that see the ground find it by sampling their BSDF, since it has no small bright features; it
# gets a small share of the sky's samples at most. Both from the noise on planes of all slopes under ``path``.
HORIZON_IMPORTANCE = 0.5
GROUND_SHARE = 0.015
# Importance of a sun on the horizon, and the sine of the elevation from which it counts in full.
LOW_SUN_IMPORTANCE, FULL_IMPORTANCE_SINE = 0.3, 0.25
# Share of the sky's samples that is spread evenly, so that no direction has density 0 (night, black sky seen from
# space).
EVEN_SHARE = 0.005


def texture(values: Any, *, nearest: bool = False) -> Any:
    """A texture with the given texels [..., channels]: a NumPy array, or a TensorXf, whose gradient it keeps."""
    texels = values if isinstance(values, mi.TensorXf) else tensor(values)
    kind = {1: mi.Texture1f, 2: mi.Texture2f, 3: mi.Texture3f}[len(texels.shape) - 1]
    mode = dr.FilterMode.Nearest if nearest else dr.FilterMode.Linear
    return kind(texels, use_accel=False, migrate=False, filter_mode=mode, wrap_mode=dr.WrapMode.Clamp)


class WarpLookup:
    """A :class:`Warp` with up to two centres in the variant's types."""

    def __init__(self, warp: Warp) -> None:
        pairs = list(zip(warp.centres, warp.sharpness, warp.gains, strict=True))
        self.linear = number(warp.linear)
        self.terms = [(number(s), number(c * s), number(g)) for c, s, g in pairs]
        self.offset = number(sum(g * math.asinh(c * s) for c, s, g in pairs))

    def __call__(self, x: Any) -> Any:
        u = dr.fma(self.linear, x, self.offset)
        for sharpness, shift, gain in self.terms:
            u = dr.fma(gain, dr.asinh(dr.fma(x, sharpness, -shift)), u)
        return dr.clip(u, 0.0, 1.0)


class SkyLookup:
    """Coordinates of a direction in the table, and sampling of directions in proportion to radiance.

    ``luminance`` [rows, columns]: of the table's nodes, float64, any unit.
    """

    def __init__(self, view: Panorama, luminance: np.ndarray) -> None:
        self.dip = number(view.dip)
        # A little beyond the zenith where the table covers the whole sky: rounding must not cut it off there.
        self.highest = number(view.up.length if view.up.length < view.horizon_zenith else 4.0)
        self.up, self.down, self.around = WarpLookup(view.up), WarpLookup(view.down), WarpLookup(view.around)
        sines, azimuths = view.cells()
        self.sines = texture(sines[:, None])
        self.azimuths = texture(azimuths[:, None])
        solid = view.solid_angles()
        weight, self.flux = importance(view, luminance)
        total = weight.sum()
        probability = weight / total if total > 0.0 else np.zeros_like(weight)
        even = EVEN_SHARE if total > 0.0 else 1.0
        probability = (1.0 - even) * probability + even * solid / solid.sum()
        rows = probability.sum(axis=1)
        self.row_steps = Steps(rows)
        self.column_steps = Steps(probability / rows[:, None])
        self.density = texture((probability / solid)[..., None], nearest=True)

    def elevation(self, z: Any, across: Any) -> Any:
        """Elevation above the horizon (rad) of a direction with height ``z`` and horizontal length ``across``."""
        return dr.atan2(z, across) + self.dip

    def covers(self, a: Any) -> Any:
        """Whether the table has this elevation; the sky above the limb, seen from space, is black."""
        return a <= self.highest

    def place(self, a: Any, phi: Any) -> tuple[Any, Any, Any]:
        """Column, row below the horizon and row above it: fractions in [0, 1] from the sun or from the horizon."""
        height = dr.abs(a)
        return self.around(phi), self.down(height), self.up(height)

    def node(self, a: Any, place: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        """Texture coordinates (column, row) for interpolation between nodes."""
        u, down, up = place
        row = dr.select(a >= 0.0, dr.fma(up, ROWS_UP, ROWS_DOWN + 1.5), dr.fma(down, -ROWS_DOWN, ROWS_DOWN + 0.5))
        return dr.fma(u, COLUMNS, 0.5) / (COLUMNS + 1), row / (ROWS + 2)

    def pdf(self, a: Any, place: tuple[Any, Any, Any], active: Any) -> Any:
        """Density per solid angle (1/sr) of :meth:`sample`."""
        u, down, up = place
        row = dr.select(
            a >= 0.0,
            dr.minimum(dr.fma(up, CELLS_UP, CELLS_DOWN), CELLS - 0.01),
            dr.clip(dr.fma(down, -CELLS_DOWN, CELLS_DOWN), 0.0, CELLS_DOWN - 0.01),
        )
        column = dr.minimum(u * CELLS_AROUND, CELLS_AROUND - 0.01)
        return self.density.eval(mi.Point2f(column / CELLS_AROUND, row / CELLS), active)[0]

    def sample(self, sample: Any, active: Any) -> tuple[Any, Any]:
        """Sine of the elevation above the horizontal, and azimuth from the sun in [-pi, pi]: even within a cell."""
        row, up = self.row_steps.find(sample.y, 0.5, active)
        column, along = self.column_steps.find(sample.x, (row + 0.5) / CELLS, active)
        left = along < 0.5
        along = dr.select(left, dr.fma(-2.0, along, 1.0), dr.fma(2.0, along, -1.0))
        # The rows at the horizon stand twice among the nodes: cells above it begin one node later.
        at = row + up + dr.select(row >= CELLS_DOWN, 1.5, 0.5)
        phi = self.azimuths.eval((column + along + 0.5) / (CELLS_AROUND + 1), active)[0]
        return self.sines.eval(at / (CELLS + 2), active)[0], dr.select(left, -phi, phi)


class Steps:
    """Inversion of cumulative probabilities: one distribution, or one per row of an array [rows, count].

    Mitsuba's own two-dimensional distribution is closed to ``dr.freeze`` in Python.
    """

    def __init__(self, probability: np.ndarray) -> None:
        self.count = probability.shape[-1]
        sums = np.cumsum(np.atleast_2d(probability), axis=1)
        sums = np.concatenate([np.zeros((len(sums), 1)), sums / sums[:, -1:]], axis=1)
        # Bounds of each step side by side, so that the step found is read in one go.
        self.bounds = texture(np.stack([sums[:, :-1], sums[:, 1:]], axis=-1), nearest=True)

    def find(self, sample: Any, row: Any, active: Any) -> tuple[Any, Any]:
        """The step that ``sample`` in [0, 1) falls into, as a Float, and the fraction of it that lies below.

        ``row``: texture coordinate of the distribution.
        """
        found = mi.Float(0.0) + 0.0 * sample
        width = 1 << (self.count - 1).bit_length()
        while width > 1:
            width //= 2
            next_one = found + width
            low = self.bounds.eval(mi.Point2f((next_one + 0.5) / self.count, row), active)[0]
            found = dr.select((next_one < self.count) & (low <= sample), next_one, found)
        low, high = self.bounds.eval(mi.Point2f((found + 0.5) / self.count, row), active)
        return found, dr.clip((sample - low) / dr.maximum(high - low, 1e-30), 0.0, 1.0)


def importance(view: Panorama, luminance: np.ndarray) -> tuple[np.ndarray, float]:
    """Sampling weights of the cells, and their sum, which competes with the sun in :func:`sun_share`."""
    flux = cell_means(np.maximum(luminance, 0.0)) * view.solid_angles()
    sines = np.delete(0.5 * (view.cells()[0][1:] + view.cells()[0][:-1]), CELLS_DOWN)[:, None]
    weight = flux * (HORIZON_IMPORTANCE + (1.0 - HORIZON_IMPORTANCE) * np.clip(sines, 0.0, 1.0))
    above, below = weight[CELLS_DOWN:].sum(), weight[:CELLS_DOWN].sum()
    if above > 0.0 and below > GROUND_SHARE * above:
        weight[:CELLS_DOWN] *= GROUND_SHARE * above / below
    return weight, float(weight.sum())


class SunLookup:
    """The disc in the variant's types: is a direction inside, where in the table, and even sampling of it.

    ``sun``: direction of its centre, a plain array. A squeezed disc is an ellipse in Lambert's equal-area projection
    about its centre, in which distances from there are chords: sampling it evenly is exact for discs of any size.
    """

    def __init__(self, disc: Disc, sun: np.ndarray) -> None:
        self.low = number(disc.low)
        self.scale = number(1.0 / max(disc.high - disc.low, 1e-9))
        self.half_chord = number(math.sin(0.5 * disc.radius))
        self.inverse_chord2 = number(1.0 / (2.0 * math.sin(0.5 * disc.radius)) ** 2)
        self.density = number(1.0 / (disc.squeeze * disc.solid_angle))
        self.squeezed = disc.squeeze != 1.0
        self.squeeze = number(disc.squeeze) if self.squeezed else 1.0
        if self.squeezed:
            x, y, z = (float(v) for v in sun)
            across = math.hypot(x, y)
            hx, hy = (x / across, y / across) if across > 0.0 else (1.0, 0.0)
            self.right = tuple(number(v) for v in (-hy, hx, 0.0))
            self.up = tuple(number(v) for v in (-hx * z, -hy * z, across))
            self.stretch = number(1.0 / disc.squeeze**2 - 1.0)

    def distance2(self, d: Any, sun: Any) -> Any:
        """Squared distance of ``d`` from the centre, 1 at the limb: by the chord, as single precision loses 1 - cos."""
        offset = d - sun
        chord2 = dr.squared_norm(offset)
        if self.squeezed:
            height = dr.dot(offset, mi.Vector3f(*self.up))
            projected2 = height * height / dr.maximum(dr.fma(chord2, -0.25, 1.0), 1e-6)  # 0 / 0 opposite the sun
            chord2 = dr.fma(self.stretch, projected2, chord2)
        return chord2 * self.inverse_chord2

    def node(self, a: Any, distance2: Any) -> tuple[Any, Any]:
        """Texture coordinates (distance, elevation) between the first and the last texel's centre."""
        x, y = dr.clip(distance2, 0.0, 1.0), dr.clip((a - self.low) * self.scale, 0.0, 1.0)
        return dr.fma(x, SUN_COLUMNS - 1, 0.5) / SUN_COLUMNS, dr.fma(y, SUN_ROWS - 1, 0.5) / SUN_ROWS

    def sample(self, sample: Any, sun: Any) -> Any:
        """A direction within the disc, even in solid angle."""
        if self.squeezed:
            sin_phi, cos_phi = dr.sincos(2.0 * dr.pi * sample.y)
            s = self.half_chord * dr.sqrt(sample.x)
            x, y = s * cos_phi, s * sin_phi * self.squeeze
            s2 = dr.fma(x, x, y * y)
            stretch = 2.0 * dr.sqrt(1.0 - s2)
            frame = mi.Frame3f(mi.Vector3f(*self.right), mi.Vector3f(*self.up), sun)
            return frame.to_world(mi.Vector3f(stretch * x, stretch * y, dr.fma(-2.0, s2, 1.0)))
        s = self.half_chord * dr.sqrt(sample.x)  # sine of half the angle from the centre
        sine = 2.0 * s * dr.sqrt(dr.fma(-s, s, 1.0))
        sin_phi, cos_phi = dr.sincos(2.0 * dr.pi * sample.y)
        return mi.Frame3f(sun).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, dr.fma(-2.0 * s, s, 1.0)))


def sun_share(sun: float, sky: float, sine: float) -> float:
    """Probability of sampling the sun, given the luminous irradiance across its beam, the sky's flux and the sine of
    its elevation.

    Below 15 degrees the sun counts for less: surfaces that face it have noise to spare, the ground does not. 0
    without a sun.
    """
    high = min(max(sine, 0.0) / FULL_IMPORTANCE_SINE, 1.0)
    weight = sun * (LOW_SUN_IMPORTANCE + (1.0 - LOW_SUN_IMPORTANCE) * high)
    return weight / (weight + sky) if weight > 0.0 else 0.0
