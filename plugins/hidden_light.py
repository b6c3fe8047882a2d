"""Light of order 2 and more that shapes keep from the air, for the integrator ``atmosphere_path``: a table of the
scene, made once.

The solved field is that of a planet without shapes. What a point x of the air scatters once more is its integral over
the directions w of phase function times radiance L(x, w), and along each w the two worlds differ by

- air that a shape keeps the sun from: what it scatters of the sun's own beam, and, by the same rule, what it scatters
  once more;
- a shape in the way: instead of the air and the planet's ground behind there is what the shape's surface sends.

From every node of a :class:`~.lattice.Lattice` rays go in some directions, and one point of the air before what they
meet is asked whether it sees the sun. What is hidden at that point of scattered light follows from the table itself, so
that each pass over all nodes adds an order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from threadpoolctl import threadpool_limits

from atmo_jit.backend import aligned, floats, row, table, table_of, types, uints
from atmo_jit.march import point_along

from . import unfolded
from .airlight import LEAST_EXTINCTION, STEP, Airlight, Stretch
from .hidden_rays import LEAST_RANGE, STEPS, HiddenRays, directions, trace
from .lattice import Lattice
from .open_sky import OpenSky

SETS, ABOUT_SUN, AROUND = 32, 96, 160  # sets of directions, which nodes take in turn; about the sun, and all around
EXACT = 1e-4  # of the largest value of a phase function: it has no more moments than those that bring it so near
PASSES = 3  # over all nodes, where orders have no limit
OPEN = 0.02  # of the upper half of its directions, that a node in the air sees the sky in
POINTS = 4  # of each segment, at most, at which the table is read
FULL_DEPTH = 0.25  # optical depth from which a segment gets all of its points
FIRST_PARTS = 4  # of the quadrature of columns


@dataclass
class Phases:
    """Phase functions times weights of directions, such that the sum over directions is 1: matrices by which light
    from the directions of a set becomes that which goes on in those of :mod:`.unfolded`.

    ``moments``: of each scatterer, [sets, directions, 9] those of degree 2 at most, where they are all that its phase
    function has, and light is multiplied by them first; ``rows``: [sets, numbers of all scatterers, COUNT]."""

    moments: list[np.ndarray | None]
    rows: np.ndarray


class HiddenLight:
    """What shapes take (W, less what they add) from the radiance that the air around them scatters once more, per unit
    of its scattering coefficient: by node of the ``lattice`` and direction in which the light goes on.

    ``open_sky``: of the same air; ``most``: scatterings in it (None: no limit).

    Nodes with the same set of directions lie together in the table: their rows are one product of matrices."""

    def __init__(self, scene: Any, air: Airlight, lattice: Lattice, open_sky: OpenSky, most: int | None) -> None:
        self._air, self._lattice = air, lattice
        count, of_set = lattice.count, np.random.default_rng(2).permutation(np.arange(lattice.count) % SETS)
        order = np.argsort(of_set, kind="stable")
        rows = np.argsort(order)  # of nodes
        ends = np.searchsorted(of_set[order], np.arange(SETS + 1))
        sun, g = np.array(air.sun).ravel(), float(np.array(air.asymmetry).ravel()[0])
        w, weights = directions(sun, g, SETS, ABOUT_SUN, AROUND)
        per_node = w.shape[1]
        lane = dr.arange(mi.UInt32, count * per_node)
        node, j = dr.gather(mi.UInt32, uints(order), lane // per_node), lane % per_node
        chosen = dr.gather(mi.UInt32, uints(of_set), node) * per_node + j
        d = mi.Vector3f(*row(table(w.astype(np.float32)), chosen, 3))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, count * per_node)
        levels = 1 if most is None else min(PASSES, most)
        p = lattice.around(node, scene, sampler)
        share = dr.gather(mi.Float, floats(np.random.default_rng(3).random(count)), node) + j * STEPS[1]
        share -= dr.floor(share)
        rays = trace(scene, air, lattice, open_sky, max(levels, 1), p, d, share, sampler)
        upper = (w @ np.array(air.globe.up) > 0.0)[of_set[order]]
        sees = (np.array(rays.leaves).reshape(count, per_node) & upper).sum(axis=1) > OPEN * upper.sum(axis=1)
        self._rows = uints(rows[nearest(sees[rows].reshape(lattice.shape), lattice.lines)])
        phases, shares = self._phases(w, weights), self._shares(lattice.h[order])
        parts = list(zip(ends[:-1], ends[1:], strict=True))
        entry = dr.arange(types().UInt, count * unfolded.COUNT)
        planes = [aligned((count, unfolded.COUNT)) for _ in range(air.count)]
        self._table = None
        for n in range(PASSES) if most is None else range(levels):
            light = self._arriving(rays, 0 if most is None else levels - 1 - n).reshape(air.count, count, per_node)
            self._table = None  # its memory serves the next one
            # More threads would wait for each other: these matrices are small.
            with threadpool_limits(limits=1, user_api="blas"):
                scatter(light, phases, shares, parts, planes)
            self._table = table_of([types().Float(plane.ravel()) for plane in planes], entry)

    def _arriving(self, rays: HiddenRays, level: int) -> np.ndarray:
        """Radiance (W) that shapes keep from nodes: [W, rays]."""
        light = rays.hidden[level]
        if self._table is not None:
            again = self._at(self._table, rays.node, rays.toward, True)
            light = [dr.fma(f, m, v) for f, m, v in zip(rays.factor, again, light, strict=True)]
            dr.eval(light)
        return np.stack(light)

    def _at(self, known: Any, node: Any, toward: Any, active: Any) -> list[Any]:
        """What the table has (W) at nodes, or those that stand for them."""
        index = dr.fma(dr.gather(types().UInt, self._rows, node, active), unfolded.COUNT, toward)
        return row(known, index, self._air.count, active=active)

    def _phases(self, w: np.ndarray, weights: np.ndarray) -> list[Phases]:
        """Of each wavelength."""
        cosine = np.clip(w.astype(np.float32) @ unfolded.directions().T.astype(np.float32), -1.0, 1.0)
        where, few = floats(cosine), floats(np.linspace(-1.0, 1.0, 64))
        of_weights = weights[..., None].astype(np.float32)
        moments = np.concatenate([w, w * w, w * np.roll(w, 1, axis=-1)], axis=-1) * weights[..., None]
        apart = np.linalg.pinv(moments)
        known: dict[Any, Any] = {}  # most phase functions are the same at all wavelengths

        def of(k: int, optics: Any, c: int) -> tuple[bytes, np.ndarray | None, np.ndarray]:
            key = np.array(optics.phase_values(k, few)[c] + mi.Float(0.0)).tobytes()
            if key not in known:
                value = np.array(optics.phase_values(k, where)[c] + mi.Float(0.0)).reshape(cosine.shape) * of_weights
                value = unfolded.sharpened(value / value.sum(axis=1, keepdims=True))
                few_rows = (apart @ value).astype(np.float32)
                exact = np.abs(moments @ few_rows - value).max() < EXACT * np.abs(value).max()
                known[key] = (key, moments.astype(np.float32), few_rows) if exact else (key, None, value)
            return known[key]

        found = []
        for band in self._air.bands:
            for c in range(band.optics.channel_count):
                keys, left, right = zip(*(of(k, band.optics, c) for k in band.optics.scatterers), strict=True)
                if keys not in known:
                    known[keys] = Phases(list(left), np.concatenate(right, axis=1))
                found.append(known[keys])
        return found

    def _shares(self, h: np.ndarray) -> np.ndarray:
        """What each scatterer has of the scattering at altitudes: [scatterers, W, N, 1]."""
        found = []
        for band in self._air.bands:
            o = band.optics
            here = o.densities(floats(h))
            channels = range(o.channel_count)
            found.append([[np.array(o.scattering[k][c] * here[k]) for c in channels] for k in o.scatterers])
        shares = np.concatenate(found, axis=1)
        return (shares / np.maximum(shares.sum(axis=0), 1e-30)).astype(np.float32)[..., None]

    def missing(self, ray: Any, part: Stretch, sampler: Any, active: Any) -> list[Any]:
        """Light (radiance, W) that is missing from a stretch of a ray (scene units)."""
        air, optics, rays, scale = self._air, self._air.bands[0].optics, part.rays, self._air.globe.scale
        first, last = (v * (1.0 / scale) - part.gap for v in self._lattice.interval(ray))
        first, last = dr.clip(first, 0.0, rays.stop), dr.clip(last, 0.0, rays.stop)
        length = dr.select(active, dr.maximum(last - first, 0.0), 0.0)
        before = [0.0 for _ in optics.constituents]
        amounts = air.columns(rays, dr.zeros(mi.Float, dr.width(first)), first, before, FIRST_PARTS)
        h, _, _ = point_along(optics, rays, first)
        rate = dr.maximum(air.guide.largest_extinction(air.guide.densities(h)), LEAST_EXTINCTION)
        rate = dr.maximum(rate, LEAST_RANGE / length)
        whole = 1.0 - dr.exp(-rate * length)
        count = dr.select(length > 0.0, dr.clip(dr.ceil(POINTS * whole / FULL_DEPTH), 1.0, float(POINTS)), 0.0)
        sample = sampler.next_1d(active)

        def point(i: Any, d: Any, amounts: list[Any], sums: list[Any], sampler: Any) -> tuple[Any, ...]:
            jitter = sample + i * STEP
            left = dr.fma((i + (jitter - dr.floor(jitter))) / count, -whole, 1.0)
            there = dr.minimum(first - dr.log(left) / rate, first + length)
            amounts = air.columns(rays, d, there, amounts, 1)
            h, _, _ = point_along(optics, rays, there)
            node, inside = self._lattice.node(ray((part.gap + there) * scale), h, sampler, active)
            hidden = self._at(self._table, node, unfolded.node(ray.d, sampler, active), active & inside)
            weight, new = dr.select(inside, whole / (rate * left * count), 0.0), []
            for band in air.bands:
                o = band.optics
                here = o.densities(h)
                for c, depth in enumerate(o.optical_depths(amounts)):
                    scattering = sum(o.scattering[k][c] * here[k] for k in o.scatterers)
                    new.append(weight * scattering * dr.exp(-depth) * hidden[len(new)])
            return i + 1.0, there, amounts, [a + b for a, b in zip(sums, new, strict=True)], sampler

        zero = dr.zeros(mi.Float, dr.width(first))
        state = (zero + 0.0, first + 0.0, amounts, [zero + 0.0 for _ in range(air.count)], sampler)
        return dr.while_loop(state, lambda i, *_: i < count, point, label="hidden")[3]


def scatter(
    light: np.ndarray,
    phases: list[Phases],
    shares: np.ndarray,
    parts: list[tuple[int, int]],
    scattered: list[np.ndarray],
) -> None:
    """Light [W, rows, directions] ``scattered`` once more, W times [rows, COUNT]; ``shares``: what each scatterer has
    of the scattering, [scatterers, W, rows, 1]; ``parts``: first and last row of each set."""
    for c, phase in enumerate(phases):
        for s, (first, last) in enumerate(parts):
            of_kinds = [light[c, first:last] * share[c, first:last] for share in shares]
            of_kinds = [v if m is None else v @ m[s] for v, m in zip(of_kinds, phase.moments, strict=True)]
            np.matmul(np.concatenate(of_kinds, axis=1), phase.rows[s], out=scattered[c][first:last])


def nearest(known: np.ndarray, lines: list[np.ndarray]) -> np.ndarray:
    """Flat index of a ``known`` node for every node: itself, or the nearest, along the ``lines`` (m) of the nodes."""
    found = np.arange(known.size).reshape(known.shape)
    distance = np.where(known, 0.0, np.inf)
    changed = True
    while changed:
        changed = False
        for axis, line in enumerate(lines):
            gap = np.diff(line).reshape([-1 if a == axis else 1 for a in range(3)])
            for to, of in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
                at, there = ((slice(None),) * axis + (part,) for part in (to, of))
                takes = distance[there] + gap < distance[at]
                found[at] = np.where(takes, found[there], found[at])
                distance[at] = np.where(takes, distance[there] + gap, distance[at])
                changed |= bool(takes.any())
    return found.ravel()
