"""Slow, simple, independent twins of the solver, in NumPy double precision.

Written from the physics and from the contract's JSON, not from ``atmo_jit``: nothing here imports the package, there
are no tables, no interpolation and no single precision, and every integral is Gauss-Legendre quadrature over pieces
on which the integrand is smooth.

Symbols: ``h`` altitude (m), ``mu`` cosine of the view zenith angle, ``mu_s`` cosine of the sun zenith angle, ``nu``
cosine of the angle between view and sun, ``t`` distance along a ray (m), ``R`` ground radius (m). Arrays of rays
have shape [N]; results are [N, W] with W wavelengths. Angles are in degrees where the name says so.

Conventions shared with ``shared/reference`` (checked in ``test_single_scattering.py`` and ``test_column.py``):

* the sun is collimated; sunlight at a point is multiplied by the visible fraction of the disc, ``smoothstep(-sin(z_h)
  a, sin(z_h) a, mu_s - cos(z_h))`` with ``a`` the sun's angular radius and ``z_h`` the zenith angle of the geometric
  horizon, ``sin(z_h) = R / (R + h)`` (Bruneton 2017, ``GetTransmittanceToSun``); ``a = 0`` is a hard shadow;
* ground-reflected light is ``albedo / pi`` times the sun's irradiance on the horizontal ground where the ray ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LADDER = 9
"""Number of altitudes, besides the profile's own kinks, at which rays are cut into pieces."""

HALVINGS = 40
"""At most so many times are pieces of rays halved to a tolerance: 1e-12 of a piece."""

DEEP, LEVELS = 100.0, (1, 2, 3, 4, 6, 8, 10, 13, 16, 20)
"""Scale heights of air from which on rays are cut at these multiples of the scale height too."""

UNDER = (1e-4, 1e-5, 1e-6)
"""Of its altitude: so far under a step down in density rays are cut."""


@dataclass(frozen=True)
class Species:
    """One kind of particle or gas: what it scatters and extincts at density 1, and where it is.

    ``scattering`` and ``extinction`` are [W] in 1/m; ``density(h)`` is dimensionless; ``kinks`` are the altitudes (m)
    where it is not smooth; ``phase(nu)`` has an added last axis [W] and the unit 1/sr (``None``: it only absorbs).
    """

    scattering: Array
    extinction: Array
    density: Callable[[Array], Array]
    kinks: tuple[float, ...]
    phase: Callable[[Array], Array] | None


def _density(entry: Mapping) -> tuple[Callable[[Array], Array], tuple[float, ...]]:
    """Density profile of one constituent's JSON block: (function of altitude, altitudes of its kinks)."""
    if "profile" in entry:
        altitude, value = (np.asarray(entry["profile"][key], float) for key in ("altitude_m", "density"))

        def tabulated(h: Array) -> Array:
            return np.where(h > altitude[-1], 0.0, np.interp(h, altitude, value))

        return tabulated, tuple(altitude)
    if "scale_height_m" in entry:
        return lambda h: np.exp(-h / entry["scale_height_m"]), ()
    center, half_width = entry["center_m"], entry["half_width_m"]
    kinks = (center - half_width, center, center + half_width)
    return lambda h: np.maximum(0.0, 1.0 - np.abs(h - center) / half_width), kinks


def phase_function(block: Mapping, width: int) -> Callable[[Array], Array]:
    """Phase function of a JSON ``phase`` block, normalised over the sphere; results have an added last axis [width]."""
    kind = block["type"]
    g = np.broadcast_to(np.asarray(block.get("g", 0.0), float), (width,))
    if kind == "rayleigh":
        return lambda nu: np.repeat((3.0 / (16.0 * np.pi) * (1.0 + nu**2))[..., None], width, -1)
    if kind == "isotropic":
        return lambda nu: np.full((*np.shape(nu), width), 1.0 / (4.0 * np.pi))
    if kind == "henyey_greenstein":
        return lambda nu: (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * np.asarray(nu)[..., None]) ** 1.5)
    if kind == "cornette_shanks":
        scale = 3 * (1 - g**2) / (8 * np.pi * (2 + g**2))
        return lambda nu: (
            scale * (1 + np.asarray(nu)[..., None] ** 2) / (1 + g**2 - 2 * g * np.asarray(nu)[..., None]) ** 1.5
        )
    if kind == "legendre":
        moments = np.asarray(block["moments"], float)
        series = (2 * np.arange(moments.size) + 1) / (4 * np.pi) * moments
        return lambda nu: np.repeat(legendre.legval(nu, series)[..., None], width, -1)
    if kind == "tabulated":
        nodes, values = np.asarray(block["cos_theta"], float), np.asarray(block["values"], float)
        ends = np.concatenate([[-1.0], nodes, [1.0]])
        total = 2 * np.pi * np.trapezoid(np.interp(ends, nodes, values), ends)
        return lambda nu: np.repeat((np.interp(nu, nodes, values) / total)[..., None], width, -1)
    raise ValueError(f"phase.type is {kind!r}; the twins know the contract's six")


class Twin:
    """The atmosphere of one contract JSON block (a ``dict``, not a preset's name), integrated by brute force.

    ``nodes`` is the number of Gauss-Legendre nodes on each smooth piece of a view ray, ``sun_nodes`` that on each
    piece of the way from a point to the sun. ``tolerance``: pieces of view rays are halved until that changes single
    scattering by less, relative to the ray's.
    """

    def __init__(self, spec: Mapping, nodes: int = 6, sun_nodes: int = 6, tolerance: float | None = None):
        self.tolerance = tolerance
        self.wavelengths_nm = np.atleast_1d(np.asarray(spec["wavelengths_nm"], float))
        self.width = self.wavelengths_nm.size
        self.solar = self._per_wavelength(spec["solar_irradiance"])
        self.albedo = self._per_wavelength(spec["ground_albedo"])
        self.radius, self.top = float(spec["bottom_radius_m"]), float(spec["top_radius_m"] - spec["bottom_radius_m"])
        self.disc = np.radians(float(spec.get("sun_angular_radius_deg", 0.0)))
        self.species = tuple(self._species(spec))
        self.kinks = np.array(
            sorted({kink for s in self.species for kink in s.kinks if 0 < kink < self.top} | {self.top})
        )
        below, above = 1.0 - 1e-9, 1.0 + 1e-9
        rungs = np.r_[1e-4, 1e-3, (np.arange(LADDER + 1) / LADDER) ** 2.2]
        blocks = [spec.get("rayleigh") or {}, *(m if isinstance(m := spec.get("mie") or [], Sequence) else [m])]
        heights = [block["scale_height_m"] for block in blocks if "scale_height_m" in block]
        levels = [n * height for height in heights for n in LEVELS if self.top > max(DEEP, n) * height]
        # Into the top of a thick layer a low sun shines some millionths of the altitude deep.
        ends = [k for k in self.kinks if any(s.density(k * below) > s.density(k * above) + 0.01 for s in self.species)]
        under = [k * (1.0 - part) for k in ends for part in UNDER]
        self.ladder = np.unique([*(self.top * rungs), *self.kinks, *levels, *under])
        self.view_rule, self.sun_rule = (legendre.leggauss(count) for count in (nodes, sun_nodes))

    def _per_wavelength(self, value: ArrayLike) -> Array:
        return np.array(np.broadcast_to(np.asarray(value, float), (self.width,)))

    def _species(self, spec: Mapping):
        mie = spec.get("mie") or []
        blocks = [spec.get("rayleigh"), *(mie if isinstance(mie, Sequence) else [mie]), spec.get("ozone")]
        for block in blocks:
            if not block:
                continue
            density, kinks = _density(block)
            scattering = self._per_wavelength(block.get("scattering_per_m", 0.0))
            extinction = scattering / self._per_wavelength(block.get("single_scattering_albedo", 1.0))
            extinction = extinction + self._per_wavelength(block.get("absorption_per_m", 0.0))
            rayleigh_like = block is spec.get("rayleigh")
            phase = {"type": "rayleigh"} if rayleigh_like and "phase" not in block else block.get("phase")
            yield Species(scattering, extinction, density, kinks, phase_function(phase, self.width) if phase else None)

    # --- geometry ---

    def altitude(self, h: Array, mu: Array, t: Array) -> Array:
        """Altitude after distance ``t`` along a ray, written as h plus a difference so that metres survive."""
        r = self.radius + h
        step = t * (2 * r * mu + t)
        return h + step / (r + np.sqrt(np.maximum(r * r + step, 0.0)))

    def crossings(self, h: Array, mu: Array, level: ArrayLike) -> tuple[Array, Array]:
        """Both distances (first, second) at which rays cross the sphere at altitude ``level``; NaN: they miss it."""
        r, q = self.radius + h, np.asarray(level) - h
        half = r * mu
        with np.errstate(invalid="ignore"):
            root = np.sqrt(half * half + q * (2 * r + q))
        constant = -q * (2 * r + q)  # the product of both roots; the larger one by addition, the smaller by division
        large = np.where(half > 0, -half - root, -half + root)
        with np.errstate(invalid="ignore", divide="ignore"):
            small = np.where(large == 0, 0.0, constant / large)
        return np.minimum(small, large), np.maximum(small, large)

    def hits_ground(self, h: Array, mu: Array) -> NDArray[np.bool_]:
        """Whether a ray reaches the ground."""
        return (mu < 0) & (mu * mu * (self.radius + h) ** 2 > h * (2 * self.radius + h))

    def limits(self, h: Array, mu: Array) -> tuple[Array, Array]:
        """Distances at which rays enter and leave the air (at the top or on the ground); equal where they miss it."""
        first, second = self.crossings(h, mu, self.top)
        enter, leave = (np.maximum(np.nan_to_num(edge), 0.0) for edge in (first, second))
        ground = np.nan_to_num(self.crossings(h, mu, 0.0)[0])
        return enter, np.where(self.hits_ground(h, mu), np.maximum(ground, 0.0), leave)

    def _cuts(self, h: Array, mu: Array, start: Array, stop: Array) -> Array:
        """Sorted distances [N, K] in [start, stop] that cut rays at the ladder's altitudes and at the perigee."""
        first, second = self.crossings(h[:, None], mu[:, None], self.ladder)
        perigee = -(self.radius + h) * mu
        cuts = np.column_stack([start, first, second, perigee, stop])
        cuts = np.where(np.isnan(cuts), start[:, None], cuts)
        return np.sort(np.clip(cuts, start[:, None], stop[:, None]), axis=1)

    @staticmethod
    def _points(cuts: Array, rule: tuple[Array, Array]) -> tuple[NDArray[np.intp], Array, Array]:
        """Nodes of every piece that has a length: (ray index, distance, weight), flat, in order along each ray."""
        length = np.diff(cuts, axis=1)
        ray, piece = np.nonzero(length > 0)
        x, w = rule
        left, size = cuts[ray, piece][:, None], length[ray, piece][:, None]
        return np.repeat(ray, x.size), (left + size * (x + 1) / 2).ravel(), (size * w / 2).ravel()

    # --- columns and transmittance ---

    def columns(self, h: ArrayLike, mu: ArrayLike, start: ArrayLike = 0.0, stop: ArrayLike | None = None) -> Array:
        """Column density [N, species] (m, density 1 at the profile's own reference) of rays between two distances.

        ``stop=None`` goes to the end of the air. Outside the air the density is 0; a ray that meets the ground is
        not cut there.
        """
        h, mu, start = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, float)) for v in (h, mu, start)))
        first, second = (np.nan_to_num(edge) for edge in self.crossings(h, mu, self.top))
        stop = np.broadcast_to(second if stop is None else np.asarray(stop, float), h.shape)
        begin = np.clip(start, np.maximum(first, 0.0), np.maximum(second, 0.0))
        end = np.maximum(begin, np.minimum(stop, second))
        ray, t, weight = self._points(self._cuts(h, mu, begin, end), self.sun_rule)
        at = self.altitude(h[ray], mu[ray], t)
        amounts = [np.bincount(ray, weight * s.density(at), h.size) for s in self.species]
        return np.array(amounts).reshape(len(self.species), h.size).T

    def optical_depth(self, columns: Array) -> Array:
        """Optical depth [N, W] of column densities [N, species]."""
        return columns @ np.array([s.extinction for s in self.species]).reshape(-1, self.width)

    def transmittance(self, h: ArrayLike, mu: ArrayLike, distance: ArrayLike | None = None) -> Array:
        """Transmittance [N, W] along view rays, to the ground, the top or ``distance``, whichever comes first."""
        h, mu = (np.atleast_1d(np.asarray(v, float)) for v in np.broadcast_arrays(h, mu))
        end = self.limits(h, mu)[1]
        end = end if distance is None else np.minimum(end, distance)
        return np.exp(-self.optical_depth(self.columns(h, mu, 0.0, end)))

    # --- the sun ---

    def disc_edges(self, h: Array) -> tuple[Array, Array]:
        """(cos of the horizon's zenith angle, half width in mu_s of the disc's setting) at altitude ``h``."""
        sine = self.radius / (self.radius + h)
        return -np.sqrt(h * (2 * self.radius + h)) / (self.radius + h), sine * self.disc

    def visible_fraction(self, h: Array, mu_s: Array) -> Array:
        """Fraction of the sun's disc above the geometric horizon (smoothstep of mu_s; a step for a point sun)."""
        horizon, half = self.disc_edges(h)
        if self.disc == 0:
            return (mu_s >= horizon).astype(float)
        x = np.clip((mu_s - horizon + half) / (2 * half), 0.0, 1.0)
        return x * x * (3 - 2 * x)

    def sun_transmittance(self, h: ArrayLike, mu_s: ArrayLike) -> Array:
        """Transmittance [N, W] from points to the sun times the visible fraction of its disc."""
        h, mu_s = (np.atleast_1d(np.asarray(v, float)) for v in np.broadcast_arrays(h, mu_s))
        visible = self.visible_fraction(h, mu_s)
        out = np.zeros((h.size, self.width))
        lit = visible > 0
        # While the centre of the disc is below the horizon, its visible limb shines along the horizon.
        mu = np.maximum(mu_s[lit], self.disc_edges(h[lit])[0])
        out[lit] = visible[lit, None] * np.exp(-self.optical_depth(self.columns(h[lit], mu)))
        return out

    def sun_irradiance(self, h: ArrayLike, mu_s: ArrayLike) -> Array:
        """Direct irradiance [N, W] on a horizontal surface facing up: the mean of max(mu, 0) over the sun's disc."""
        h, mu_s = (np.atleast_1d(np.asarray(v, float)) for v in np.broadcast_arrays(h, mu_s))
        mu = np.maximum(mu_s, self.disc_edges(h)[0])
        through = np.exp(-self.optical_depth(self.columns(h, mu)))
        ring, weight = np.polynomial.legendre.leggauss(400)
        across = np.maximum(mu_s[:, None] + self.disc * ring, 0.0)
        cosine = across @ (weight * np.sqrt(1.0 - ring**2)) * 2.0 / np.pi
        return self.solar * through * (cosine if self.disc > 0 else np.maximum(mu_s, 0.0))[:, None]

    # --- single scattering ---

    def _perigee_cuts(self, h: Array, mu: Array, mu_s: Array, nu: Array, cuts: Array) -> Array:
        """Distances [N, 2 K] at which the way to the sun just touches a kink of the profiles: there its column has a
        root's edge.

        Those points lie on cylinders about the sun's direction, |x|^2 - (x.s)^2 = (R + kink)^2, so that t solves a
        quadratic.
        """
        r, level = (self.radius + h)[:, None], self.radius + self.kinks
        a = np.maximum(1 - nu * nu, 1e-14)[:, None]
        b = r * (mu - mu_s * nu)[:, None]
        c = (r * np.sqrt(1 - mu_s * mu_s)[:, None] - level) * (r * np.sqrt(1 - mu_s * mu_s)[:, None] + level)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(b * b - a * c)
        edges = np.column_stack([(-b - root) / a, (-b + root) / a])
        start, stop = cuts[:, :1], cuts[:, -1:]
        return np.clip(np.where(np.isnan(edges), start, edges), start, stop)

    def _sun_cuts(self, h: Array, mu: Array, mu_s: Array, nu: Array, cuts: Array, samples: int = 12) -> Array:
        """Distances where rays meet the edges of the ground's shadow (both limbs of the disc), found by bisection."""

        def edge(t: Array, ray: NDArray[np.intp], side: int) -> Array:
            at = self.altitude(h[ray], mu[ray], t)
            local = ((self.radius + h[ray]) * mu_s[ray] + t * nu[ray]) / (self.radius + at)
            horizon, half = self.disc_edges(np.maximum(at, 0.0))
            return local - horizon + side * half

        steps = cuts[:, :-1, None] + np.diff(cuts, axis=1)[..., None] * np.arange(samples) / samples
        steps = np.column_stack([steps.reshape(len(h), -1), cuts[:, -1]])
        every = np.repeat(np.arange(len(h)), steps.shape[1])
        found = [cuts, self._perigee_cuts(h, mu, mu_s, nu, cuts)]
        for side in (-1, 0, 1) if self.disc > 0 else (0,):
            value = edge(steps.ravel(), every, side).reshape(steps.shape)
            ray, i = np.nonzero((value[:, :-1] > 0) != (value[:, 1:] > 0))
            low, high, rising = steps[ray, i], steps[ray, i + 1], value[ray, i] < 0
            for _ in range(50):
                middle = (low + high) / 2
                after = (edge(middle, ray, side) > 0) == rising
                low, high = np.where(after, low, middle), np.where(after, middle, high)
            extra = np.repeat(cuts[:, :1], 6, axis=1)
            slot = np.arange(ray.size) - np.searchsorted(ray, ray)
            extra[ray[slot < 6], slot[slot < 6]] = ((low + high) / 2)[slot < 6]
            found.append(extra)
        return np.sort(np.column_stack(found), axis=1)

    def single_scattering(
        self,
        h: ArrayLike,
        mu: ArrayLike,
        mu_s: ArrayLike,
        nu: ArrayLike,
        distance: ArrayLike | None = None,
        block: int = 256,
    ) -> Array:
        """Radiance [N, W] of sunlight scattered once between a ray's start and its end (or ``distance``, m)."""
        h, mu, mu_s, nu = (np.ravel(v).astype(float) for v in np.broadcast_arrays(h, mu, mu_s, nu))
        limit = np.broadcast_to(np.inf if distance is None else np.asarray(distance, float), h.shape)
        parts = [slice(i, i + block) for i in range(0, h.size, block)]
        return np.concatenate([self._single(h[p], mu[p], mu_s[p], nu[p], limit[p]) for p in parts])

    def _single(self, h: Array, mu: Array, mu_s: Array, nu: Array, limit: Array) -> Array:
        enter, leave = self.limits(h, mu)
        leave = np.maximum(enter, np.minimum(leave, limit))
        cuts = self._sun_cuts(h, mu, mu_s, nu, self._cuts(h, mu, enter, leave))
        ray, piece = np.nonzero(np.diff(cuts, axis=1) > 0)
        near, far = cuts[ray, piece], cuts[ray, piece + 1]
        out = np.zeros((h.size, self.width))

        def light(ray: NDArray[np.intp], near: Array, far: Array) -> Array:
            return self._of_pieces((h, mu, mu_s, nu), enter, ray, near, far)

        whole = light(ray, near, far)
        np.add.at(out, ray, whole)
        for _ in range(HALVINGS if self.tolerance else 0):
            middle = (near + far) / 2
            halves = light(np.tile(ray, 2), np.r_[near, middle], np.r_[middle, far]).reshape(2, -1, self.width)
            off = halves.sum(axis=0) - whole
            np.add.at(out, ray, off)
            again = (np.abs(off) > self.tolerance * np.abs(out[ray])).any(axis=1)
            if not again.any():
                break
            near, far = np.r_[near[again], middle[again]], np.r_[middle[again], far[again]]
            ray, whole = np.tile(ray[again], 2), halves[:, again].reshape(-1, self.width)
        return self.solar * out

    def _of_pieces(
        self, rays: tuple[Array, ...], enter: Array, ray: NDArray[np.intp], near: Array, far: Array
    ) -> Array:
        """Radiance [pieces, W] per unit of solar irradiance that comes from pieces of rays (h, mu, mu_s, nu)."""
        h, mu, mu_s, nu = (v[ray] for v in rays)
        before = self.columns(h, mu, enter[ray], near)
        piece, t, weight = self._points(np.column_stack([near, far]), self.view_rule)
        h, mu, mu_s, nu = (v[piece] for v in (h, mu, mu_s, nu))
        at = np.maximum(self.altitude(h, mu, t), 0.0)
        local = np.clip(((self.radius + h) * mu_s + t * nu) / (self.radius + at), -1, 1)
        lit = self.visible_fraction(at, local) > 0
        piece, t, weight, at, local, h, mu, nu = (v[lit] for v in (piece, t, weight, at, local, h, mu, nu))
        through = before[piece] + self.columns(h, mu, near[piece], t)
        seen = self.sun_transmittance(at, local) * np.exp(-self.optical_depth(through))
        source = np.zeros_like(seen)
        for s in self.species:
            if s.phase is not None:
                source += s.scattering * s.phase(nu) * (weight * s.density(at))[:, None] * seen
        return np.column_stack([np.bincount(piece, source[:, w], near.size) for w in range(self.width)])

    def ground_direct(
        self, h: ArrayLike, mu: ArrayLike, mu_s: ArrayLike, nu: ArrayLike, distance: ArrayLike | None = None
    ) -> Array:
        """Radiance [N, W] of sunlight reflected once by the Lambertian ground where view rays end on it, else 0."""
        h, mu, mu_s, nu = (np.ravel(v).astype(float) for v in np.broadcast_arrays(h, mu, mu_s, nu))
        end = self.limits(h, mu)[1]
        reached = self.hits_ground(h, mu) & (end <= (np.inf if distance is None else np.asarray(distance)))
        local = np.clip(((self.radius + h) * mu_s + end * nu) / self.radius, -1, 1)
        light = self.albedo / np.pi * self.sun_irradiance(np.zeros_like(h), local)
        return np.where(reached[:, None], light * self.transmittance(h, mu), 0.0)

    def sky_irradiance(self, h: float, mu_s: float, zeniths: int = 24, azimuths: int = 16) -> Array:
        """Irradiance [W] of singly scattered light on a horizontal surface facing up.

        Zenith angles by Gauss-Legendre in x with mu = x^2 (dense at the horizon), azimuths by Gauss-Legendre over the
        half circle.
        """
        x, wx = legendre.leggauss(zeniths)
        x, wx = (x + 1) / 2, wx / 2
        a, wa = legendre.leggauss(azimuths)
        a, wa = np.pi * (a + 1) / 2, np.pi * wa / 2
        mu = np.repeat(x * x, azimuths)
        weight = np.outer(wx * 2 * x * x * x, 2 * wa).ravel()
        nu = mu * mu_s + np.sqrt((1 - mu**2) * max(0.0, 1 - mu_s**2)) * np.tile(np.cos(a), zeniths)
        return weight @ self.single_scattering(h, mu, mu_s, nu)


def cosines(
    sun_zenith_deg: ArrayLike, view_zenith_deg: ArrayLike, azimuth_deg: ArrayLike
) -> tuple[Array, Array, Array]:
    """(mu, mu_s, nu) of views given as the contract gives them; azimuth 0 is towards the sun."""
    sun, view, azimuth = (np.radians(np.asarray(v, float)) for v in (sun_zenith_deg, view_zenith_deg, azimuth_deg))
    nu = np.cos(view) * np.cos(sun) + np.sin(view) * np.sin(sun) * np.cos(azimuth)
    return np.cos(view), np.cos(sun), np.clip(nu, -1, 1)
