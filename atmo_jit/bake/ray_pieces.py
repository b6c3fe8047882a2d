"""View rays cut into pieces for a quadrature: geometry, densities and columns, in double precision.

Nothing here depends on how much the matter scatters or absorbs, except how finely thick shells are cut. So what is made
for a few rays is kept, and serves the next atmosphere with the same profiles. Rays and pieces are NumPy's; the nodes in
them, which are many, are made by a kernel.
"""

from __future__ import annotations

from typing import Any, ClassVar

import drjit as dr
import numpy as np

from ..backend import doubles, floats, stored, types, uints
from ..grid import profile_key
from ..kept import Remembered
from ..march import MAX_TURN
from ..optics import Optics
from ..quadrature import gauss_legendre, running_integral

MAX_DEPTH = 1.0  # optical depth of a piece
LONGEST = 32  # pieces into which one shell is cut at most
REMEMBERED, FEW = 6, 1000  # sets of rays that are kept; of at most so many rays each
X, W = gauss_legendre(4)  # the quadrature of columns


class Rays:
    """Rays from altitude ``h`` (m, also above the air) at zenith cosine ``mu``, cut at the shells of the air; arguments
    as for :class:`.sightlines.Sightlines`.

    Attributes [R]: ``start``, ``stop``, ``middle`` (m): distances to the ends and to the perigee of the ray's line;
    ``ground``: the ray ends there; ``ends``: table of cosine and sine of the turn at the end, sine and cosine at the
    start.
    """

    _known: ClassVar[Remembered] = Remembered(REMEMBERED)

    @classmethod
    def of(cls, optics: Optics, h: np.ndarray, mu: np.ndarray, *rest: Any) -> Rays:
        """The same object for the same rays in air of the same profiles."""
        if len(h) > FEW:
            return cls(optics, h, mu, *rest)
        air = optics.atmosphere
        key = (
            types().__name__,
            air.bottom_radius_m,
            air.thickness_m,
            air.sun_angular_radius_deg,
            optics.breaks_m.tobytes(),
            *(profile_key(c.profile) for c in optics.constituents),
            *(np.asarray(v).tobytes() if v is not None else None for v in (h, mu, *rest)),
        )
        return cls._known.of(key, lambda: cls(optics, h, mu, *rest))

    def __init__(
        self,
        optics: Optics,
        h: np.ndarray,
        mu: np.ndarray,
        start: np.ndarray | None = None,
        stop: np.ndarray | None = None,
        ground: np.ndarray | bool | None = None,
    ) -> None:
        t = types()
        self._air, self._profiles = optics.atmosphere, [c.profile for c in optics.constituents]
        numbers = [[t.Float64(number) for number in of_part] for of_part in optics.profiles]
        dr.eval(numbers)
        self._device_profiles = [type(p)(*n) for p, n in zip(self._profiles, numbers, strict=True)]
        self.mu = mu
        radius, top = self._air.bottom_radius_m, self._air.top_radius_m
        self.r = r = radius + h
        # Altitude first, as in geometry.py: b is the ray's least distance from the centre, on its whole line.
        self.sine = sine = np.sqrt((1.0 - mu) * (1.0 + mu))
        self.middle = middle = -r * mu
        levels = optics.breaks_m
        lowest = h - r * mu * mu / (1.0 + sine)
        half = np.sqrt(np.maximum((levels - lowest[:, None]) * (2.0 * radius + levels + lowest[:, None]), 0.0))
        meets = half[:, -1] > 0.0
        hits = (mu < 0.0) & (lowest < 0.0) if ground is None else np.broadcast_to(ground, mu.shape)
        end = np.where(hits, np.maximum(middle - half[:, 0], 0.0), middle + half[:, -1])
        begin = np.maximum(middle - half[:, -1], 0.0) if np.any(r > top) else np.zeros_like(h)
        end = np.where(meets & (end > begin), end, begin)
        self.start = begin if start is None else np.clip(start, begin, end)
        self.stop = end if stop is None else np.clip(stop, self.start, end)
        self.ground = hits & (self.stop >= end) & (end >= begin)
        # Shells passed on the way down, from the top on; what lies below the ground, where a ray is told to go on
        # through it; the shells on the way up.
        bounds = np.concatenate([middle[:, None] - half[:, ::-1], middle[:, None] + half], axis=1)
        near, far = (np.clip(d, self.start[:, None], self.stop[:, None]) for d in (bounds[:, :-1], bounds[:, 1:]))
        ray, shell = np.nonzero(far > near)
        self._shells = ray, near[ray, shell], far[ray, shell]
        length = self._shells[2] - self._shells[1]
        density = self.densities(ray, self._shells[1] + length * X[:, None])
        self._columns = np.einsum("g,kgp->kp", W, density) * length
        there = self._altitude(np.arange(len(mu)), self.stop)[1]
        self._buffers = [doubles(v) for v in (r, mu, sine)]
        self.ends = floats(np.column_stack([(r + self.stop * mu) / there, self.stop * sine / there, sine, mu]))
        self._pieces: dict[bytes, Pieces] = {}

    def pieces(self, extinction: np.ndarray) -> Pieces:
        """The rays cut so that the optical depth of a piece is at most MAX_DEPTH and its turn about the planet's centre
        MAX_TURN; ``extinction`` [constituent, C]."""
        depth = (extinction.T @ self._columns).max(axis=0, initial=0.0)
        turn = (self._shells[2] - self._shells[1]) / self._air.bottom_radius_m
        parts = np.clip(np.ceil(np.maximum(depth / MAX_DEPTH, turn / MAX_TURN)), 1, LONGEST).astype(int)
        key = parts.tobytes()
        if key not in self._pieces:
            self._pieces = {key: Pieces(self, *self._shells, parts)}
        return self._pieces[key]

    def densities(self, ray: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Of every constituent at points on rays, [constituent, ...]."""
        h = self._altitude(ray, distance)[0]
        found = [np.asarray(profile.density(h)) for profile in self._profiles]
        return np.array(found).reshape(len(self._profiles), *h.shape)

    def at(self, ray: Any, distance: Any, half: Any) -> tuple[Any, list[Any]]:
        """Table of points on rays, and the density of every constituent there, evaluated; Dr.Jit arrays, ``distance``
        and half the stretch that a point stands for, ``half``, in double precision (m).

        Per point: square root of the unit altitude, horizon cosine, 1 / (1 - horizon), cosine and sine of the turn
        about the planet's centre, the ray's zenith cosine there, half the stretch over r, half the disc's height in
        cosines.
        """
        t, air = types(), self._air
        radius, thickness = (dr.opaque(t.Float64, v, 1) for v in (air.bottom_radius_m, air.thickness_m))
        disc = dr.opaque(t.Float64, np.deg2rad(air.sun_angular_radius_deg) * air.bottom_radius_m, 1)
        r, mu, sine = (dr.gather(t.Float64, v, ray) for v in self._buffers)
        there = dr.sqrt(dr.maximum(r * r + distance * (2.0 * r * mu + distance), 0.0))
        h = dr.maximum(there - radius, 0.0)
        horizon = -dr.sqrt(h * (2.0 * radius + h)) / there
        columns = [
            dr.sqrt(dr.minimum(h / thickness, 1.0)),
            horizon,
            1.0 / (1.0 - horizon),
            (r + distance * mu) / there,
            distance * sine / there,
            dr.clip((r * mu + distance) / there, -1.0, 1.0),
            half / there,
            dr.maximum(disc / there, 1e-7),
        ]
        densities = [profile.density(h) for profile in self._device_profiles]
        dr.schedule(densities)
        return stored([t.Float(c) for c in columns], dr.arange(t.UInt, dr.width(ray)), len(columns)), densities

    def _altitude(self, ray: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Altitude and radius (m) of points on rays, [..., len(ray)]."""
        r, mu = self.r[ray], self.mu[ray]
        there = np.sqrt(np.maximum(r * r + distance * (2.0 * r * mu + distance), 0.0))
        return np.maximum(there - self._air.bottom_radius_m, 0.0), there


class Pieces:
    """Pieces of rays, ray by ray: ``total`` [constituent, R]: columns of the rays; ``from_start`` [constituent, P]:
    columns up to the pieces."""

    def __init__(self, rays: Rays, ray: np.ndarray, near: np.ndarray, far: np.ndarray, parts: np.ndarray) -> None:
        self.rays = rays
        which = np.repeat(np.arange(len(ray)), parts)
        place = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
        self.step = (far - near)[which] / parts[which]
        self.ray, self.near = ray[which], near[which] + place * self.step
        self.density = rays.densities(self.ray, self.near + self.step * X[:, None])
        column = np.einsum("g,kgp->kp", W, self.density) * self.step
        first = np.searchsorted(self.ray, np.arange(len(rays.mu) + 1))
        self.total = sums(column.T, first).T
        before = np.cumsum(column, axis=1) - column
        self.from_start = before - before[:, first[self.ray]] if len(self.ray) else before
        self._nodes: dict[Any, Nodes] = {}

    def nodes(self, seen: np.ndarray, count: int) -> Nodes:
        """Gauss-Legendre nodes, ``count`` in each of the pieces that are ``seen``."""
        key = seen.tobytes(), count
        if key not in self._nodes:
            self._nodes = {key: Nodes(self, seen, count)}
        return self._nodes[key]


class Nodes:
    """Nodes in pieces, piece by piece. NumPy: ``ray`` [P]; ``distance`` [P, node] (m); ``first`` [R + 1]: pieces of
    each ray. Dr.Jit, evaluated: ``ray_of_piece``, ``first_piece`` and ``first_node``, the same of pieces and of nodes;
    ``table`` and ``densities``: Rays.at; ``place`` (distance), ``columns`` from the start of the ray (per constituent)
    and ``length`` (weight) in double precision (m)."""

    def __init__(self, pieces: Pieces, seen: np.ndarray, count: int) -> None:
        t, self.rays = types(), pieces.rays
        rays = self.rays
        x, w = gauss_legendre(count)
        self.ray, near, step = pieces.ray[seen], pieces.near[seen], pieces.step[seen]
        self.distance = near[:, None] + step[:, None] * x
        self.first = np.searchsorted(self.ray, np.arange(len(rays.mu) + 1))
        self.ray_of_piece, self.first_piece = uints(self.ray), uints(self.first)
        self.first_node = uints(self.first * count)
        if not len(self.ray):  # no ray meets air
            nothing = [t.Float64()] * len(pieces.density)
            self.length, self.columns, self.densities, self.table = t.Float64(), nothing, nothing, t.Float()
            self.place = t.Float64()
            return
        lane = dr.arange(t.UInt, self.distance.size)
        piece = lane // count
        node = lane - piece * count

        def of_piece(values: np.ndarray) -> Any:
            return dr.gather(t.Float64, doubles(values), piece)

        def of_node(values: np.ndarray) -> Any:
            return dr.gather(t.Float64, doubles(values), node)

        step = of_piece(step)
        self.length = of_node(w) * step
        running = [of_node(share) for share in running_integral(4, tuple(x)).T]
        self.columns = [
            dr.fma(step, sum(a * of_piece(d) for a, d in zip(running, density, strict=True)), of_piece(before))
            for density, before in zip(pieces.density[..., seen], pieces.from_start[:, seen], strict=True)
        ]
        self.place = dr.fma(step, of_node(x), of_piece(near))
        dr.schedule(self.length, self.columns, self.place)
        ray, half = dr.gather(t.UInt, self.ray_of_piece, piece), (0.5 / count) * step
        self.table, self.densities = rays.at(ray, self.place, half)


def sums(values: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Sums [R, ...] of ``values`` [P, ...] from each of ``first`` [R + 1] up to the next, none from differences."""
    total = np.zeros((len(first) - 1, *values.shape[1:]))
    some = np.flatnonzero(np.diff(first))
    if len(some):
        total[some] = np.add.reduceat(values, first[some])
    return total
