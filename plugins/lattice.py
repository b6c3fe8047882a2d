"""Where what shapes do to the air is known: nodes in the air among and above them, and directions on the sphere."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.backend import floats, row, row_size, table, types

from . import unfolded
from .globe import Globe

NODES = (34, 34, 14)  # along two level axes and up, at most
MOST_NUMBERS = 5e7  # by node, direction and wavelength: more wavelengths have fewer nodes
BINS = 512  # of the density of nodes along an axis
EVEN = 0.1  # of the nodes along a level axis that are spread evenly; the others stand near relief
NEAR = 0.2  # of the height of all shapes: so near relief nodes are as dense as at it
FALL = 1.5  # power of the distance to relief that the density falls with
FLAT = 0.01  # sine of a slope, up to which the extent of a shape does not count: that of a floor
PROBES = 1 << 16  # rays that look for shapes
AROUND = 2.0  # of the size of all shapes, the air beside them
FREE_PATHS = 3.0  # of light in the densest air: neither it nor their shadow matters farther off


class Lattice:
    """At most NODES in the air among, above and beside the shapes of a ``scene`` and in their shadow: denser near
    relief, and towards the lowest air.

    Places are (a, b, h): metres along two level axes from the anchor of ``globe``, and altitude (m). Along each axis
    the number of nodes below a place is a piecewise linear function of it. ``sun``: unit vector towards it;
    ``reach`` (m): a free path in the densest air. Shapes ``deepest`` (m) below the planet's ground do not count.
    ``found``: whether any was met."""

    def __init__(
        self, scene: Any, globe: Globe, deepest: float, sun: np.ndarray, reach: float, wavelengths: int
    ) -> None:
        numbers = float(np.prod(NODES)) * unfolded.COUNT * row_size(wavelengths)
        self.shape = tuple(max(int(n * min((MOST_NUMBERS / numbers) ** (1.0 / 3.0), 1.0)), 4) for n in NODES)
        self._globe = globe
        up = np.array(globe.up)
        east = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [0.0, 0.0, 1.0], up)
        self._axes = np.stack([east / np.linalg.norm(east), np.cross(up, east / np.linalg.norm(east))])
        places, relief = self._probed(scene, deepest)
        self.found = len(relief) > 0
        if not self.found:
            return
        steep = relief > FLAT
        steep = places[steep] if steep.any() else places
        low, high = steep.min(axis=0), steep.max(axis=0)
        low[2], high[2] = max(low[2], 0.0), max(high[2], 0.0)
        # The air beside and above them changes as well, the more so in their shadow.
        tall, wide = float(high[2] - low[2]), float(np.max(high - low))
        beside, above = min(AROUND * wide, FREE_PATHS * reach), min(max(AROUND * tall, 0.01 * wide), FREE_PATHS * reach)
        shadow = -(self._axes @ sun) * tall / max(float(sun @ up), 1e-3)
        shadow *= min(1.0, FREE_PATHS * reach / max(float(np.linalg.norm(shadow)), 1e-3))
        low[:2] -= np.maximum(beside, -shadow)
        high[:2] += np.maximum(beside, shadow)
        high[2] = min(high[2] + above, globe.thickness)
        self._low, self._size = low, high - low
        even = np.linspace(0.0, 1.0, BINS + 1)
        middle = 0.5 * (even[1:] + even[:-1])
        warps = []
        for axis in range(2):
            share, _ = np.histogram(places[:, axis], BINS, (low[axis], high[axis]), weights=relief)
            gap = np.abs(middle[:, None] - middle) * self._size[axis]
            share = (1.0 / (NEAR * tall + gap)) ** FALL @ share
            total = share.sum()
            share = np.full(BINS, 1.0) if total <= 0.0 else EVEN / BINS + (1.0 - EVEN) * share / total
            warps.append(np.concatenate([[0.0], np.cumsum(share)]) / share.sum())
        warps.append(np.sqrt(even))
        self._warps = table(np.stack([warp * count for warp, count in zip(warps, self.shape, strict=True)]).ravel())
        lines = [np.interp((np.arange(n) + 0.5) / n, warp, even) for warp, n in zip(warps, self.shape, strict=True)]
        self.lines = [size * v for size, v in zip(self._size, lines, strict=True)]
        a, b, self.h = (low[i] + self._size[i] * v for i, v in enumerate(np.meshgrid(*lines, indexing="ij")))
        self.h = self.h.ravel()
        self.count = self.h.size
        points = self._points(a.ravel(), b.ravel(), self.h)
        gaps = [np.gradient(v) for v in self.lines]
        gaps = [v.ravel() for v in np.meshgrid(*gaps, indexing="ij")]
        self._nodes = table(np.column_stack([points, *gaps]).astype(np.float32))

    def _probed(self, scene: Any, deepest: float) -> tuple[np.ndarray, np.ndarray]:
        """Places [N, 3] where rays from all over the box about the shapes meet one, and the sine of its slope."""
        rng = np.random.default_rng(0)
        box = scene.bbox()
        low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
        start = low + (high - low) * rng.random((PROBES, 3))
        d = rng.normal(size=(PROBES, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(*(floats(v) for v in start.T)), mi.Vector3f(*(floats(v) for v in d.T)))
        si = scene.ray_intersect(ray)
        q, z = self._globe.relative(si.p)
        met = np.array(si.is_valid() & (self._globe.altitude(si.p) > -deepest))
        q, normal = np.array(q).T, np.array(si.n).T
        places = np.column_stack([q @ self._axes.T, np.array(self._globe.altitude(si.p))])[met]
        return places, np.linalg.norm(np.cross(normal, self._globe.up), axis=1)[met]

    def _points(self, a: np.ndarray, b: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Scene points [N, 3] of places."""
        radius, flat = self._globe.radius, a * a + b * b
        z = (h * (2.0 * radius + h) - flat) / (np.sqrt(np.maximum((radius + h) ** 2 - flat, 0.0)) + radius)
        away = a[:, None] * self._axes[0] + b[:, None] * self._axes[1] + z[:, None] * np.array(self._globe.up)
        return np.array(self._globe.anchor) + away * self._globe.scale

    def around(self, node: Any, scene: Any, sampler: Any) -> Any:
        """Points about nodes, at most half the way to the next, with nothing between."""
        p = mi.Point3f(*row(self._nodes, node, 3, 6))
        gaps = row(self._nodes, node, 6)[3:]
        steps = [gap * (sampler.next_1d() + sampler.next_1d() - 1.0) * self._globe.scale for gap in gaps]
        axes = (*self._axes, self._globe.up)
        offset = sum(mi.Vector3f(*(float(v) for v in axis)) * step for axis, step in zip(axes, steps, strict=True))
        length = dr.norm(offset)
        d = offset * (1.0 / dr.maximum(length, 1e-30))
        si = scene.ray_intersect_preliminary(mi.Ray3f(p, d), coherent=False)
        return p + d * dr.select(si.t < length, si.t * sampler.next_1d(), length)

    def interval(self, ray: Any) -> tuple[Any, Any]:
        """First and last distance (scene units) of a ray between the planes about the nodes; none: last < first."""
        globe = self._globe
        q, z = globe.relative(ray.o)
        axes = [mi.Vector3f(*(float(v) for v in axis)) for axis in (*self._axes, globe.up)]
        far = np.max(np.abs([self._low[:2], self._low[:2] + self._size[:2]]), axis=0)
        sag = float(far @ far) / (2.0 * globe.radius)
        low, high = self._low - [0.0, 0.0, sag], self._low + self._size
        first, last = mi.Float(0.0), mi.Float(dr.inf)
        for i, axis in enumerate(axes):
            at, speed = (z if i == 2 else dr.dot(q, axis)), dr.dot(ray.d, axis)
            inverse = 1.0 / dr.select(dr.abs(speed) > 1e-6, speed, dr.copysign(mi.Float(1e-6), speed))
            ends = [(float(bound[i]) - at) * inverse for bound in (low, high)]
            first, last = dr.maximum(first, dr.minimum(*ends)), dr.minimum(last, dr.maximum(*ends))
        return first * globe.scale, last * globe.scale

    def node(self, p: Any, h: Any, sampler: Any, active: Any) -> tuple[Any, Any]:
        """One of the eight nodes about a point of altitude ``h`` (m), the nearer one more often, so that its mean
        interpolates; and whether the point lies among nodes."""
        q, _ = self._globe.relative(p)
        place = [dr.dot(q, mi.Vector3f(*(float(v) for v in axis))) for axis in self._axes] + [h]
        index, inside = mi.UInt32(0), mi.Bool(True)
        for i, count in enumerate(self.shape):
            x = (place[i] - float(self._low[i])) * (BINS / float(self._size[i]))
            inside &= (x >= 0.0) & (x <= BINS)
            x = dr.clip(x, 0.0, BINS)
            bin_ = dr.minimum(mi.UInt32(x), BINS - 1)
            below, above = (
                dr.gather(types().Float, self._warps, bin_ + (i * (BINS + 1) + step), active) for step in (0, 1)
            )
            x = dr.lerp(below, above, x - mi.Float(bin_)) - 0.5 + sampler.next_1d(active)
            index = index * count + dr.minimum(mi.UInt32(dr.maximum(x, 0.0)), count - 1)
        return index, inside
