"""Light of order 2 and more that shapes keep from the air, for the integrator ``atmosphere_path``: random walks that
compare the scene with the same planet without shapes.

The solved field is that of a planet without shapes. What a point x of the air scatters once more is its integral over
the directions w of phase function times radiance L(x, w), and along each w the two worlds differ by

- air that a shape keeps the sun from: what it scatters of the sun's own beam, and, by the same rule, what it scatters
  once more;
- a shape in the way: instead of the air and the planet's ground behind there is what the shape's surface sends.

One direction and one free path along it are drawn at each scattering, so a walk goes on from point to point of the
air, collecting the light of shaded ones, and ends on a shape, on the ground or in space. What is behind a shape is
the field's, at one more point: no walk is needed there.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from atmo_jit.geometry import UPRIGHT
from atmo_jit.march import Rays, point_along, rays_to_boundary, relative_azimuth, visible_sun
from atmo_jit.phase import HenyeyGreenstein

from .airlight import LEAST_EXTINCTION, Airlight, Stretch
from .colours import Colours
from .cornette_shanks import at_cosine, henyey_greenstein_cosine

BEFORE = 0.999  # of the way to the planet's ground: from there it is seen whether the sun shines on it
# Of directions that are drawn, one is taken: in proportion to light that the sun's beam gives by two scatterings, and
# as much from all around.
CANDIDATES = 8
LOBE = 0.4  # of the candidates, drawn about the ray, and as many about the sun; the others from all around
# Free paths are drawn from a mixture of exponential distributions: these shares of them with these parts of the
# extinction where they begin. Air gets thinner upwards: the first alone draws far points so seldom that a few make
# all of the noise.
MIXTURE = ((0.7, 1.0), (0.2, 0.25), (0.1, 0.0625))
LEAST_RANGE = 1e-3  # of rate x length of a bounded path, where single precision resolves 1 - exp(-x)
WALKS = 6  # for each segment: fewer cost less than the noise that they leave
GO_ON = 0.75  # of the walks, after every scattering, at most
FIRST_PARTS, PARTS = 4, 2  # of the quadrature of columns, on the way to the first point of a walk and to the next


def later_orders(
    air: Airlight,
    scene: Any,
    sampler: Any,
    ray: Any,
    part: Stretch,
    toward: Any,
    passed: list[Any],
    colours: Colours,
    most: int | None,
    active: Any,
) -> tuple[list[Any], Any]:
    """Light of order 2 and more on one stretch of a ray (scene units): what is missing of ``part.light`` (radiance, W)
    because of shapes, and what surfaces of shapes add to it by scattering sun and sky into the air (the variant's
    spectrum, after the air ``passed`` of the path).

    An estimate of WALKS walks. ``toward``: direction to the sun; ``most`` scatterings after the one on the ray."""
    optics, rays = air.bands[0].optics, part.rays
    zero = dr.zeros(mi.Float, dr.width(rays.stop))
    h, _, _ = point_along(optics, rays, zero)
    rate = dr.maximum(air.guide.largest_extinction(air.guide.densities(h)), LEAST_EXTINCTION)
    active = active & (rays.stop > 0.0)
    walk = _Walk(air, scene, toward, passed, colours, ray.wavelengths, most)

    def first(active: Any) -> tuple[Any, list[Any]]:
        """Where a walk begins, and what light that is scattered there is worth."""
        distance, density = bounded_path(rate, rays.stop, sampler.next_1d(active), sampler.next_1d(active))
        inverse = 1.0 / (density * WALKS)
        amounts = air.columns(rays, zero, distance, [0.0 for _ in optics.constituents], FIRST_PARTS)
        worth = [dr.exp(-depth) * inverse for band in air.bands for depth in band.optics.optical_depths(amounts)]
        return ray((part.gap + distance) * air.globe.scale), worth

    def step(left: Any, *state: Any) -> tuple[Any, ...]:
        """One of a walk; where it ends there, and others are ``left``, one begins."""
        p, v, worth, even, missing, surfaces, depth, active, sampler = walk.step(*state)
        anew = ~active & (left > 0)
        there, new = first(anew)
        p, v, even = dr.select(anew, there, p), dr.select(anew, ray.d, v), dr.select(anew, 1.0, even)
        worth = [dr.select(anew, a, b) for a, b in zip(new, worth, strict=True)]
        depth, left = dr.select(anew, 0, depth), left - dr.select(anew, mi.UInt32(1), mi.UInt32(0))
        return left, p, v, worth, even, missing, surfaces, depth, active | anew, sampler

    p, worth = first(active)
    state = (
        dr.select(active, mi.UInt32(WALKS - 1), mi.UInt32(0)),
        p,
        mi.Vector3f(ray.d),
        worth,
        mi.Float(1.0) + zero,
        [zero + 0.0 for _ in worth],
        mi.UnpolarizedSpectrum(0.0) + zero,
        mi.UInt32(0),
        mi.Bool(active),
        sampler,
    )
    state = dr.while_loop(state, lambda *s: s[-2], step, label="walk")
    return state[5], state[6]


class _Walk:
    """What the steps of a walk have in common."""

    def __init__(
        self,
        air: Airlight,
        scene: Any,
        toward: Any,
        passed: list[Any],
        colours: Colours,
        wavelengths: Any,
        most: int | None,
    ) -> None:
        self.air, self.scene, self.toward = air, scene, toward
        self.passed, self.colours, self.wavelengths = passed, colours, wavelengths
        self.most = mi.UInt32(0xFFFFFFFF if most is None else most)

    def step(
        self,
        p: Any,
        v: Any,
        worth: list[Any],
        even: Any,
        missing: list[Any],
        surfaces: Any,
        depth: Any,
        active: Any,
        sampler: Any,
    ) -> tuple[Any, ...]:
        """From a point ``p``, where light is scattered back along ``v``, to one where it was before.

        ``worth`` (W): of light that is scattered at ``p``, ``even``: the same in even air without absorption. Only
        the latter says when a walk ends, so that walks are the same in air that is a little different."""
        air, scale = self.air, self.air.globe.scale
        optics = air.bands[0].optics
        h, _, _, _ = air.globe.cosines(p, v, air.sun)
        w, pdf, phase = self._direction(v, h, sampler, active)
        _, mu, mu_s, nu = air.globe.cosines(p, w, air.sun)
        here = optics.densities(h)
        line = rays_to_boundary(optics, dr.minimum(h, optics.thickness), mu, mu_s, nu)
        rate = dr.maximum(air.guide.largest_extinction(here), LEAST_EXTINCTION)
        t = free_path(rate, sampler.next_1d(active), sampler.next_1d(active))
        way = mi.Ray3f(p, w)
        way.maxt = t * scale
        si = self.scene.ray_intersect(way, mi.RayFlags.All, coherent=False, active=active)
        # In the world without shapes light comes from ``far``, in this one from ``near``.
        far = dr.minimum(t, line.stop)
        behind = active & si.is_valid() & (si.t < far * scale)
        near = dr.select(behind, si.t * (1.0 / scale), far)
        grounded, leaves = line.ground & (t >= line.stop), ~line.ground & (t >= line.stop)

        start = way(near * dr.select(grounded, BEFORE, 1.0) * scale)
        start = dr.select(behind, si.spawn_ray(self.toward).o, start)
        dark = dr.select(self.scene.ray_test(mi.Ray3f(start, self.toward), active & (behind | ~leaves)), 1.0, 0.0)
        amounts = air.columns(line, dr.zeros(mi.Float, dr.width(t)), near, [0.0 for _ in optics.constituents], PARTS)
        beyond = air.columns(line, near, far, amounts, PARTS)
        # One over the density of the free path, or over the chance that it is at least so long.
        near_inverse = 1.0 / dr.select(behind | grounded, chance_beyond(rate, near), path_density(rate, near))
        far_inverse = 1.0 / dr.select(grounded, chance_beyond(rate, far), path_density(rate, far))
        n = dr.select(dr.dot(si.sh_frame.n, w) > 0.0, -si.sh_frame.n, si.sh_frame.n)
        facing = dr.maximum(dr.dot(n, self.toward), 0.0) * (1.0 - dark)
        openness = 0.5 + 0.5 * sum(a * b for a, b in zip(n, air.globe.up, strict=True))

        onto, c = [], 0
        worth, missing = list(worth), list(missing)
        for band, source in zip(air.bands, air.sources, strict=True):
            o = band.optics
            phases = {k: o.phase_values(k, dr.dot(v, w)) for k in o.scatterers}
            sunward = {k: o.phase_values(k, nu) for k in o.scatterers}
            sun, sky, single = self._light(band, line, near, sunward, behind)
            far_sun, far_sky, air_light = self._light(band, line, far, sunward, behind & grounded)
            more = self._later(band, source, line, far, behind & ~grounded & ~leaves & (depth + 1 < self.most))
            _, _, mu_s = point_along(o, line, far)
            upright = dr.maximum(mu_s, 0.0)
            turned = _scattering(o, here, phases)
            ends = zip(o.optical_depths(amounts), o.optical_depths(beyond), strict=True)
            for i, (depth_near, depth_far) in enumerate(ends):
                a = worth[c] * turned[i] / pdf
                through = a * dr.exp(-depth_near) * near_inverse
                ground = o.albedo[i] * dr.inv_pi
                # Nothing in the way: what differs is the sun's own light.
                shaded = through * dark * dr.select(grounded, ground * sun[i] * upright, single[i])
                there = dr.select(grounded, ground * dr.fma(far_sun[i], upright, far_sky[i]), air_light[i] + more[i])
                hidden = a * dr.exp(-depth_far) * far_inverse * dr.select(leaves, 0.0, there)
                shaded = dr.select(leaves, 0.0, shaded)
                missing[c] = missing[c] + dr.select(active, dr.select(behind, hidden, shaded), 0.0)
                onto.append(self.passed[c] * through * dr.fma(sun[i], facing, sky[i] * openness) * dr.inv_pi)
                worth[c] = through
                c += 1
        reflectance = mi.UnpolarizedSpectrum(si.bsdf().eval_diffuse_reflectance(si, behind))
        surfaces = surfaces + dr.select(behind, reflectance * self.colours.of(onto, self.wavelengths), 0.0)

        even = even * phase / pdf
        even = even * rate * dr.exp(-rate * near) * near_inverse
        survives = dr.minimum(even, 1.0) * GO_ON
        inverse = 1.0 / dr.maximum(survives, 1e-12)
        depth = depth + 1
        active = active & ~behind & ~grounded & ~leaves & (depth < self.most)
        active &= sampler.next_1d(active) < survives
        worth = [a * inverse for a in worth]
        return way(near * scale), w, worth, even * inverse, missing, surfaces, depth, active, sampler

    def _direction(self, v: Any, h: Any, sampler: Any, active: Any) -> tuple[Any, Any, Any]:
        """A direction, one over the weight of what comes from there (1/sr), and the phase function (1/sr) of the air at
        the altitude ``h`` of a middle wavelength.

        The best of CANDIDATES, drawn about ``v``, about the sun and from all around (resampled importance sampling,
        Talbot et al. 2005)."""
        g, even, guide = self.air.asymmetry, 0.25 * dr.inv_pi, self.air.guide
        lobe, densities, c = HenyeyGreenstein(g), guide.densities(h), guide.channel_count // 2
        shares = {k: guide.scattering[k][c] * densities[k] for k in guide.scatterers}
        inverse = 1.0 / dr.maximum(sum(shares.values()), 1e-30)
        w, worth, total, phase = mi.Vector3f(0.0), mi.Float(0.0), mi.Float(0.0), mi.Float(0.0)
        for _ in range(CANDIDATES):
            u = sampler.next_1d(active) * (1.0 / LOBE)
            about_v, about_sun = u < 1.0, (u >= 1.0) & (u < 2.0)
            sample = dr.select(about_v, u, dr.select(about_sun, u - 1.0, (u - 2.0) * (LOBE / (1.0 - 2.0 * LOBE))))
            cosine = dr.select(about_v | about_sun, henyey_greenstein_cosine(g, sample), 2.0 * sample - 1.0)
            d = mi.Frame3f(dr.select(about_v, v, self.toward)).to_world(at_cosine(cosine, sampler.next_1d(active)))
            ahead, sunward = lobe.value(dr.dot(d, v)), lobe.value(dr.dot(d, self.toward))
            drawn = LOBE * (ahead + sunward) + (1.0 - 2.0 * LOBE) * even
            own = sum(shares[k] * guide.phase_values(k, dr.dot(d, v))[c] for k in guide.scatterers) * inverse
            expected = own * (sunward + even)
            share = expected / drawn
            total += share
            take = sampler.next_1d(active) * total < share
            w, worth, phase = (dr.select(take, a, b) for a, b in ((d, w), (expected, worth), (own, phase)))
        return w, worth * CANDIDATES / dr.maximum(total, 1e-30), phase

    def _light(
        self, band: Any, line: Rays, distance: Any, sunward: dict[int, list[Any]], active: Any
    ) -> tuple[list[Any], list[Any], list[Any]]:
        """At a distance (m) of a line, of one band: irradiance by the sun across its direction and by the sky on
        level ground (W), and what the air there scatters of the sun's (W/m)."""
        o = band.optics
        h, r, mu_s = point_along(o, line, distance)
        sun = self.air.sunlit(band, h, mu_s, visible_sun(o, h, r, mu_s))
        scattering = _scattering(o, o.densities(h), sunward)
        sky = band.field.irradiance(h, mu_s, active, reflected=True)
        return sun, sky, [s * e for s, e in zip(scattering, sun, strict=True)]

    def _later(self, band: Any, source: Any, line: Rays, distance: Any, active: Any) -> list[Any]:
        """What the air scatters there of scattered light (W/m), 0 where not ``active``."""
        o = band.optics
        h, r, mu_s = point_along(o, line, distance)
        mu = dr.clip(dr.fma(o.radius + line.h, line.mu, distance) / r, -UPRIGHT, UPRIGHT)
        found = source.scattered(h, mu_s, mu, relative_azimuth(mu, mu_s, line.nu), active)
        light = _scattering(o, o.densities(h), dict(zip(o.scatterers, found, strict=True)))
        return [dr.select(active, value, 0.0) for value in light]


def _scattering(optics: Any, densities: list[Any], factors: dict[int, list[Any]]) -> list[Any]:
    """Scattering coefficient (1/m) times factor, summed over the scatterers: [channel]."""
    return [
        sum(optics.scattering[k][c] * densities[k] * factors[k][c] for k in optics.scatterers)
        for c in range(optics.channel_count)
    ]


def free_path(rate: Any, pick: Any, sample: Any) -> Any:
    """A length (m) of the density :func:`path_density`, by two random numbers; ``rate``: extinction (1/m) where it
    begins."""
    return -dr.log(1.0 - sample) / (rate * _picked(pick, [part for _, part in MIXTURE]))


def path_density(rate: Any, length: Any) -> Any:
    """Density (1/m) of free paths: a mixture of exponential distributions."""
    return sum(share * part * rate * dr.exp(-part * rate * length) for share, part in MIXTURE)


def chance_beyond(rate: Any, length: Any) -> Any:
    """Chance that a free path is at least so long."""
    return sum(share * dr.exp(-part * rate * length) for share, part in MIXTURE)


def bounded_path(rate: Any, length: Any, pick: Any, sample: Any) -> tuple[Any, Any]:
    """A distance (m) in [0, ``length``] by the same mixture, of each part what lies there, and its density (1/m)."""
    rates = [dr.maximum(part * rate, LEAST_RANGE / length) for _, part in MIXTURE]
    inside = [1.0 - dr.exp(-r * length) for r in rates]
    chosen, chance = (_picked(pick, values) for values in (rates, inside))
    distance = dr.minimum(-dr.log(1.0 - sample * chance) / chosen, length)
    parts = zip(MIXTURE, rates, inside, strict=True)
    return distance, sum(share * r * dr.exp(-r * distance) / whole for (share, _), r, whole in parts)


def _picked(pick: Any, values: list[Any]) -> Any:
    """Of values, one for each part of the MIXTURE, that of the part which a random number picks."""
    found, above = values[-1], 1.0 - MIXTURE[-1][0]
    for (share, _), value in reversed(list(zip(MIXTURE[:-1], values[:-1], strict=True))):
        found, above = dr.select(pick < above, value, found), above - share
    return found
