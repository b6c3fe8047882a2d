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

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.backend import floats, row, row_size, table, uints
from atmo_jit.geometry import UPRIGHT
from atmo_jit.march import point_along, rays_to_boundary, relative_azimuth, visible_sun
from atmo_jit.phase import HenyeyGreenstein
from atmo_jit.spectrum import SpectralBasis

from .airlight import LEAST_EXTINCTION, STEP, Airlight, Stretch
from .channels import Channels
from .cornette_shanks import henyey_greenstein_cosine
from .lattice import Lattice, fibonacci, unfolded_directions, unfolded_node
from .open_sky import OpenSky

SETS, ABOUT_SUN, AROUND = 64, 48, 80  # sets of directions, which nodes take in turn; about the sun, and all around
PASSES = 3  # over all nodes, where orders have no limit
OPEN = 0.02  # of the upper half of its directions, that a node in the air sees the sky in
LEAST_RANGE = 1e-3  # of rate x length of a bounded path, where single precision resolves 1 - exp(-x)
SHORTEST = 1e-3  # m: of paths on which a point is drawn
POINTS = 4  # of each segment, at most, at which the table is read
FULL_DEPTH = 0.25  # optical depth from which a segment gets all of its points
FIRST_PARTS, PARTS = 4, 2  # of the quadrature of columns


class HiddenLight:
    """What shapes take (W, less what they add) from the radiance that the air around them scatters once more, per unit
    of its scattering coefficient: by node of the ``lattice`` and direction in which the light goes on.

    ``open_sky``: of the same air; ``sun``: unit vector towards it; ``most``: scatterings in it (None: no limit)."""

    def __init__(self, scene: Any, air: Airlight, lattice: Lattice, open_sky: OpenSky, most: int | None) -> None:
        self._air, self._lattice, self._open_sky = air, lattice, open_sky
        count = lattice.count
        self._directions, weights = directions(np.array(air.sun).ravel(), float(np.array(air.asymmetry).ravel()[0]))
        per_node = self._directions.shape[1]
        self._sets = np.random.default_rng(2).permutation(np.arange(count) % SETS)
        lane = dr.arange(mi.UInt32, count * per_node)
        node, j = lane // per_node, lane % per_node
        chosen = dr.gather(mi.UInt32, uints(self._sets), node) * per_node + j
        d = mi.Vector3f(*row(table(self._directions.astype(np.float32)), chosen, 3))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, count * per_node)
        ray = self._ray(scene, lattice.around(node, scene, sampler), d, sampler)
        phases = self._phases(weights)
        shares = self._shares(lattice.h)
        stands_for = self._standing(np.array(ray["leaves"]).reshape(count, per_node))
        near = dr.gather(mi.UInt32, uints(stands_for), ray["node"])
        index = dr.fma(near, len(unfolded_directions()), ray["toward"])
        lit, known = [], None
        for n in range(PASSES) if most is None else range(max(most - PASSES, 0), most):
            if not lit or most is not None:
                lit = self._hidden(ray, 0 if most is None else most - 1 - n)
            light = lit
            if known is not None:
                again = row(floats(known), index, air.count)
                light = [dr.fma(f, m, v) for f, m, v in zip(ray["factor"], again, lit, strict=True)]
            dr.eval(light)
            known = self._scattered(np.stack(light).reshape(air.count, count, per_node), phases, shares)
        self._table = floats(known[stands_for])

    def _standing(self, leaves: np.ndarray) -> np.ndarray:
        """For each node one that is in the air, near it: itself where it sees the sky in OPEN of its upper half."""
        upper = (self._directions @ np.array(self._air.globe.up) > 0.0)[self._sets]
        known = (leaves & upper).sum(axis=1) > OPEN * upper.sum(axis=1)
        return nearest(known.reshape(self._lattice.shape), self._lattice.lines)

    def _ray(self, scene: Any, p: Any, d: Any, sampler: Any) -> dict[str, Any]:
        """Of rays from nodes: what is known of each whatever the order."""
        air, optics = self._air, self._air.bands[0].optics
        scale, active = air.globe.scale, mi.Bool(True)
        h, mu, mu_s, nu = air.globe.cosines(p, d, air.sun)
        line = rays_to_boundary(optics, dr.minimum(h, optics.thickness), mu, mu_s, nu)
        si = scene.ray_intersect(mi.Ray3f(p, d), mi.RayFlags.All, coherent=False, active=active)
        behind = si.is_valid() & (si.t < line.stop * scale)
        near = dr.select(behind, si.t * (1.0 / scale), 0.0)
        lit = behind & ~scene.ray_test(si.spawn_ray(air.sun), behind)
        amounts = air.columns(line, dr.zeros(mi.Float, dr.width(near)), near, [0.0 for _ in optics.constituents], PARTS)
        through = []
        for band in air.bands:
            through += [dr.select(behind, dr.exp(-depth), 0.0) for depth in band.optics.optical_depths(amounts)]

        # One point of the air on the way.
        _, last = self._lattice.interval(mi.Ray3f(p, d))
        length = dr.maximum(dr.minimum(dr.select(behind, near, line.stop), last * (1.0 / scale)), SHORTEST)
        rate = dr.maximum(air.guide.largest_extinction(air.guide.densities(h)), LEAST_EXTINCTION)
        rate = dr.maximum(rate, LEAST_RANGE / length)
        whole = 1.0 - dr.exp(-rate * length)
        t = dr.minimum(-dr.log(1.0 - sampler.next_1d() * whole) / rate, length)
        inverse = whole * dr.exp(rate * t) / rate
        place = mi.Point3f(p + d * (t * scale))
        dark = dr.select(scene.ray_test(mi.Ray3f(place, air.sun)), 1.0, 0.0)
        there, r, sun_mu = point_along(optics, line, t)
        amounts = air.columns(line, dr.zeros(mi.Float, dr.width(t)), t, [0.0 for _ in optics.constituents], PARTS)
        shining = dark * visible_sun(optics, there, r, sun_mu)
        single, factor = [], []
        for band in air.bands:
            o = band.optics
            here = o.densities(there)
            sunward = {k: o.phase_values(k, nu) for k in o.scatterers}
            sun = air.sunlit(band, there, sun_mu, shining)
            for c, depth in enumerate(o.optical_depths(amounts)):
                seen = dr.exp(-depth) * inverse
                single.append(seen * sun[c] * sum(o.scattering[k][c] * here[k] * sunward[k][c] for k in o.scatterers))
                factor.append(seen * sum(o.scattering[k][c] * here[k] for k in o.scatterers))
        node, inside = self._lattice.node(place, there, sampler, active)
        toward = unfolded_node(d, sampler, active)
        factor = [dr.select(inside, f, 0.0) for f in factor]

        # What a shape hides, and what its surface sends: diffuse, lit by the sun and by what its slope leaves of sky.
        h, r, mu_s = point_along(optics, line, near)
        mu = dr.clip(dr.fma(optics.radius + line.h, line.mu, near) / r, -UPRIGHT, UPRIGHT)
        n = dr.select(dr.dot(si.sh_frame.n, d) > 0.0, -si.sh_frame.n, si.sh_frame.n)
        facing = dr.select(lit, dr.maximum(dr.dot(n, air.sun), 0.0), 0.0)
        openness = 0.5 + 0.5 * sum(a * b for a, b in zip(n, air.globe.up, strict=True))
        sent, c = [], 0
        reflectance = self._reflectance(si, behind)
        for band in air.bands:
            sun = air.sunlit(band, h, mu_s, visible_sun(band.optics, h, r, mu_s))
            sky = band.field.irradiance(h, mu_s, behind, reflected=True)
            for e, s in zip(sun, sky, strict=True):
                sent.append(reflectance[c] * dr.fma(e, facing, s * openness) * dr.inv_pi)
                c += 1
        found = {
            "leaves": ~behind & ~line.ground,
            "behind": behind,
            "through": through,
            "single": single,
            "factor": factor,
            "node": node,
            "toward": toward,
            "sent": sent,
            "h": h,
            "mu_s": mu_s,
            "mu": mu,
            "azimuth": relative_azimuth(mu, mu_s, line.nu),
            "picks": (sampler.next_1d(), sampler.next_1d()),
        }
        dr.eval(found)
        return found

    def _hidden(self, ray: dict[str, Any], level: int) -> list[Any]:
        """Radiance (W) that shapes keep from nodes, but for what is hidden of light that the air before them scatters
        once more; ``level``: of the open sky."""
        open_ = self._open_sky.radiance(
            mi.UInt32(level), *(ray[k] for k in ("h", "mu_s", "mu", "azimuth")), *ray["picks"], ray["behind"]
        )
        parts = zip(ray["through"], open_, ray["sent"], ray["single"], strict=True)
        return [dr.fma(t, o - s, single) for t, o, s, single in parts]

    def _reflectance(self, si: Any, active: Any) -> list[Any]:
        """Diffuse reflectance at each wavelength: in RGB that of the channels which the wavelength counts in."""
        atmosphere = self._air.sky.atmosphere
        if mi.is_spectral:
            found, size = [], len(mi.UnpolarizedSpectrum(0.0))
            nm = list(atmosphere.wavelengths_nm)
            for i in range(0, len(nm), size):
                some = nm[i : i + size]
                si.wavelengths = type(si.wavelengths)(*(float(v) for v in some + [some[-1]] * (size - len(some))))
                values = mi.UnpolarizedSpectrum(si.bsdf().eval_diffuse_reflectance(si, active))
                found += [values[k] for k in range(len(some))]
            return found
        values = mi.UnpolarizedSpectrum(si.bsdf().eval_diffuse_reflectance(si, active))
        shares = np.abs(Channels(SpectralBasis.of(atmosphere)).matrix)
        shares = shares / np.maximum(shares.sum(axis=0), 1e-30)
        return [sum(float(s) * values[c] for c, s in enumerate(column)) for column in shares.T]

    def _phases(self, weights: np.ndarray) -> list[np.ndarray]:
        """Of each wavelength: phase function times weight, [sets, scatterers x directions, directions of light], so
        that the sum over directions is 1."""
        cosine = np.clip(self._directions @ unfolded_directions().T, -1.0, 1.0)
        found: list[np.ndarray] = []
        for band in self._air.bands:
            for c in range(band.optics.channel_count):
                of_kinds = []
                for k in band.optics.scatterers:
                    value = band.optics.phase_values(k, floats(cosine))[c] + mi.Float(0.0)
                    share = np.array(value, dtype=np.float32).reshape(cosine.shape) * weights[..., None]
                    of_kinds.append((share / share.sum(axis=1, keepdims=True)).astype(np.float32))
                found.append(np.concatenate(of_kinds, axis=1))
        return found

    def _shares(self, h: np.ndarray) -> np.ndarray:
        """What each scatterer has of the scattering at altitudes: [scatterers, N, W]."""
        found = []
        for band in self._air.bands:
            o = band.optics
            here = o.densities(floats(h))
            values = [[np.array(o.scattering[k][c] * here[k]) for c in range(o.channel_count)] for k in o.scatterers]
            found.append(np.moveaxis(np.array(values), 1, -1))
        found = np.concatenate(found, axis=-1)
        return (found / np.maximum(found.sum(axis=0), 1e-30)).astype(np.float32)

    def _scattered(self, light: np.ndarray, phases: list[np.ndarray], shares: np.ndarray) -> np.ndarray:
        """Light [W, nodes, directions] scattered once more: rows of a table, [nodes, directions of light, W]."""
        wavelengths, count, _ = light.shape
        found = np.zeros((count, phases[0].shape[-1], row_size(wavelengths)), dtype=np.float32)
        for s in range(SETS):
            own = np.flatnonzero(self._sets == s)
            for c in range(wavelengths):
                of_kinds = [light[c, own] * share[own, None, c] for share in shares]
                found[own, :, c] = np.concatenate(of_kinds, axis=1) @ phases[c][s]
        return found

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
            index = node * len(unfolded_directions()) + unfolded_node(ray.d, sampler, active)
            hidden = row(self._table, index, air.count, active=active & inside)
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


def directions(sun: np.ndarray, g: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [SETS, N, 3], some about the ``sun``, and their weights (sr): one over how many there are in a
    steradian."""
    rng, lobe = np.random.default_rng(1), HenyeyGreenstein(g)
    axis = np.cross(sun, [1.0, 0.0, 0.0] if abs(sun[0]) < 0.9 else [0.0, 1.0, 0.0])
    x = axis / np.linalg.norm(axis)
    frame = np.stack([x, np.cross(sun, x), sun])
    found = []
    for _ in range(SETS):
        parts = []
        for n in (ABOUT_SUN, AROUND):
            u, phi = fibonacci(n, *rng.random(2))
            u = np.array(henyey_greenstein_cosine(mi.Float(g), mi.Float(u))) if n == ABOUT_SUN else 1.0 - 2.0 * u
            sine = np.sqrt(np.maximum(1.0 - u * u, 0.0))
            parts.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), u], axis=-1))
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        found.append(np.concatenate([parts[0] @ frame, parts[1] @ turn]))
    w = np.stack(found)
    density = ABOUT_SUN * np.asarray(lobe.value(np.clip(w @ sun, -1.0, 1.0))) + AROUND * 0.25 / np.pi
    return w, 1.0 / density


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
