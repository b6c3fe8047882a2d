"""Light of order 2 and more that shapes keep from the air, for the integrator ``atmosphere_path``: random walks that
compare the scene with the same planet without shapes.

The solved field is that of a planet without shapes. What a point x of the air scatters once more is its integral over
the directions w of phase function times radiance L(x, w), and along each w the two worlds differ by

- air that a shape keeps the sun from: what it scatters of the sun's own beam, and, by the same rule, what it scatters
  once more;
- a shape in the way: instead of the air and the planet's ground behind there is what the shape's surface sends.

From a point several directions are looked into. What is behind a shape is read from a table of the planet without
shapes (:mod:`.open_sky`): no walk is needed there. In one of the directions a walk goes on by a free path, from point
to point of the air, collecting the light of shaded ones.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from atmo_jit.geometry import UPRIGHT
from atmo_jit.march import Rays, point_along, rays_to_boundary, relative_azimuth, visible_sun
from atmo_jit.phase import HenyeyGreenstein

from .airlight import LEAST_EXTINCTION, STEP, Airlight, Stretch
from .colours import Colours
from .cornette_shanks import at_cosine, henyey_greenstein_cosine

BEFORE = 0.999  # of the way to the planet's ground: from there it is seen whether the sun shines on it
DIRECTIONS = (8, 1)  # looked into from the first point of a walk, and from later ones
LOBE = 0.4  # of the directions, drawn about the ray, and as many about the sun; the others from all around
# Free paths are drawn from a mixture of exponential distributions: these shares of them with these parts of the
# extinction where they begin. Air gets thinner upwards: the first alone draws far points so seldom that a few make
# all of the noise.
MIXTURE = ((0.7, 1.0), (0.2, 0.25), (0.1, 0.0625))
LEAST_RANGE = 1e-3  # of rate x length of a bounded path, where single precision resolves 1 - exp(-x)
WALKS = (2, 1)  # for what the camera sees, and for segments after it, which weigh less
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
    later: Any,
    active: Any,
) -> tuple[list[Any], Any]:
    """Light of order 2 and more on one stretch of a ray (scene units): what is missing of ``part.light`` (radiance, W)
    because of shapes, and what surfaces of shapes add to it by scattering sun and sky into the air (the variant's
    spectrum, after the air ``passed`` of the path).

    An estimate of WALKS walks. ``toward``: direction to the sun; ``most`` scatterings after the one on the ray;
    ``later``: not the first segment of its path."""
    optics, rays = air.bands[0].optics, part.rays
    zero = dr.zeros(mi.Float, dr.width(rays.stop))
    h, _, _ = point_along(optics, rays, zero)
    rate = dr.maximum(air.guide.largest_extinction(air.guide.densities(h)), LEAST_EXTINCTION)
    active = active & (rays.stop > 0.0)
    walk = _Walk(air, scene, toward, passed, colours, ray.wavelengths, most)

    walks = dr.select(later, mi.UInt32(WALKS[1]), mi.UInt32(WALKS[0]))

    def first(left: Any, active: Any) -> tuple[Any, list[Any]]:
        """Where a walk begins, of which ``left`` more follow, and what light that is scattered there is worth."""
        sample = (mi.Float(left) + sampler.next_1d(active)) / mi.Float(walks)  # each walk has a part of the segment
        distance, density = bounded_path(rate, rays.stop, sampler.next_1d(active), sample)
        inverse = 1.0 / (density * mi.Float(walks))
        amounts = air.columns(rays, zero, distance, [0.0 for _ in optics.constituents], FIRST_PARTS)
        worth = [dr.exp(-depth) * inverse for band in air.bands for depth in band.optics.optical_depths(amounts)]
        return ray((part.gap + distance) * air.globe.scale), worth

    def step(left: Any, *state: Any) -> tuple[Any, ...]:
        """One of a walk; where it ends there, and others are ``left``, one begins."""
        p, v, worth, even, missing, surfaces, depth, active, sampler = walk.step(*state)
        anew = ~active & (left > 0)
        left = left - dr.select(anew, mi.UInt32(1), mi.UInt32(0))
        there, new = first(left, anew)
        p, v, even = dr.select(anew, there, p), dr.select(anew, ray.d, v), dr.select(anew, 1.0, even)
        worth = [dr.select(anew, a, b) for a, b in zip(new, worth, strict=True)]
        depth = dr.select(anew, 0, depth)
        return left, p, v, worth, even, missing, surfaces, depth, active | anew, sampler

    p, worth = first(walks - 1, active)
    state = (
        dr.select(active, walks - 1, mi.UInt32(0)),
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
        here = optics.densities(h)
        w, pdf, phase, hit, missing, surfaces = self._around(p, v, h, worth, missing, surfaces, depth, sampler, active)
        _, mu, mu_s, nu = air.globe.cosines(p, w, air.sun)
        line = rays_to_boundary(optics, dr.minimum(h, optics.thickness), mu, mu_s, nu)
        rate = dr.maximum(air.guide.largest_extinction(here), LEAST_EXTINCTION)
        t = free_path(rate, sampler.next_1d(active), sampler.next_1d(active))
        near = dr.minimum(t, line.stop)
        behind = hit < near
        grounded, leaves = line.ground & (t >= line.stop), ~line.ground & (t >= line.stop)
        active = active & ~behind & ~leaves
        way = mi.Ray3f(p, w)
        start = way(near * dr.select(grounded, BEFORE, 1.0) * scale)
        dark = dr.select(self.scene.ray_test(mi.Ray3f(start, self.toward), active), 1.0, 0.0)
        amounts = air.columns(line, dr.zeros(mi.Float, dr.width(t)), near, [0.0 for _ in optics.constituents], PARTS)
        # One over the density of the free path, or over the chance that it is at least so long.
        inverse = 1.0 / dr.select(grounded, chance_beyond(rate, near), path_density(rate, near))

        c, worth, missing = 0, list(worth), list(missing)
        for band in air.bands:
            o = band.optics
            phases = {k: o.phase_values(k, dr.dot(v, w)) for k in o.scatterers}
            sunward = {k: o.phase_values(k, nu) for k in o.scatterers}
            place, r, sun_mu = point_along(o, line, near)
            sun = air.sunlit(band, place, sun_mu, visible_sun(o, place, r, sun_mu))
            single, turned = _scattering(o, o.densities(place), sunward), _scattering(o, here, phases)
            for i, passed in enumerate(o.optical_depths(amounts)):
                worth[c] = worth[c] * turned[i] / pdf * dr.exp(-passed) * inverse
                bright = dr.select(grounded, o.albedo[i] * dr.inv_pi * dr.maximum(sun_mu, 0.0), single[i])
                missing[c] = missing[c] + dr.select(active, worth[c] * dark * bright * sun[i], 0.0)
                c += 1

        even = even * phase / pdf
        even = even * rate * dr.exp(-rate * near) * inverse
        survives = dr.minimum(even, 1.0) * GO_ON
        inverse = 1.0 / dr.maximum(survives, 1e-12)
        depth = depth + 1
        active = active & ~grounded & (depth < self.most)
        active &= sampler.next_1d(active) < survives
        worth = [a * inverse for a in worth]
        return way(near * scale), w, worth, even * inverse, missing, surfaces, depth, active, sampler

    def _around(
        self,
        p: Any,
        v: Any,
        h: Any,
        worth: list[Any],
        missing: list[Any],
        surfaces: Any,
        depth: Any,
        sampler: Any,
        active: Any,
    ) -> tuple[Any, ...]:
        """Look around from a point: what shapes hide is ``missing``, what they send is added to ``surfaces``.

        Returns also a direction to go on in, one over the weight of what comes from there (1/sr), the phase function
        (1/sr) of the air of a middle wavelength, and how far the next shape is (m). Directions are drawn about ``v``,
        about the sun and from all around; one is taken in proportion to light that the sun's beam gives by two
        scatterings, and as much from all around (resampled importance sampling, Talbot et al. 2005)."""
        air, optics = self.air, self.air.bands[0].optics
        g, even, guide = air.asymmetry, 0.25 * dr.inv_pi, air.guide
        lobe, densities, middle = HenyeyGreenstein(g), guide.densities(h), guide.channel_count // 2
        shares = {k: guide.scattering[k][middle] * densities[k] for k in guide.scatterers}
        inverse = 1.0 / dr.maximum(sum(shares.values()), 1e-30)
        here = [band.optics.densities(h) for band in air.bands]
        count = dr.select(depth == 0, float(DIRECTIONS[0]), float(DIRECTIONS[1]))
        count = dr.select(active, count, 0.0)
        # A lattice: neither lobes and angles nor azimuths of the directions clump.
        first, turn = sampler.next_1d(active), sampler.next_1d(active)

        def look(j: Any, total: Any, taken: tuple[Any, ...], missing: list[Any], surfaces: Any, sampler: Any) -> Any:
            turns = dr.fma(j, STEP, turn)
            d, drawn = self._candidate(lobe, v, (j + first) / count, turns - dr.floor(turns))
            _, mu, mu_s, nu = air.globe.cosines(p, d, air.sun)
            own = sum(shares[k] * guide.phase_values(k, dr.dot(d, v))[middle] for k in guide.scatterers) * inverse
            expected = own * (lobe.value(nu) + even)
            share = expected / drawn
            total = total + share
            line = rays_to_boundary(optics, dr.minimum(h, optics.thickness), mu, mu_s, nu)
            si = self.scene.ray_intersect(mi.Ray3f(p, d), mi.RayFlags.All, coherent=False, active=active)
            hit = dr.select(si.is_valid(), si.t * (1.0 / air.globe.scale), dr.inf)
            behind = active & (hit < line.stop)
            hit = dr.select(behind, hit, dr.inf)
            lost, sent = self._hidden(here, v, d, line, hit, si, behind, depth, sampler)
            worths = [w / (drawn * count) for w in worth]
            missing = [dr.fma(a, b, m) for a, b, m in zip(worths, lost, missing, strict=True)]
            reflectance = mi.UnpolarizedSpectrum(si.bsdf().eval_diffuse_reflectance(si, behind))
            onto = [a * b * c for a, b, c in zip(self.passed, worths, sent, strict=True)]
            surfaces = surfaces + dr.select(behind, reflectance * self.colours.of(onto, self.wavelengths), 0.0)
            take = sampler.next_1d(active) * total < share
            taken = tuple(dr.select(take, a, b) for a, b in zip((d, expected, own, hit), taken, strict=True))
            return j + 1.0, total, taken, missing, surfaces, sampler

        zero = dr.zeros(mi.Float, dr.width(h))
        taken = (mi.Vector3f(v), zero + 1.0, zero + 0.0, zero + dr.inf)
        state = (zero + 0.0, zero + 0.0, taken, list(missing), surfaces, sampler)
        state = dr.while_loop(state, lambda j, *_: j < count, look, label="look")
        _, total, (w, expected, own, hit), missing, surfaces, _ = state
        return w, expected * count / dr.maximum(total, 1e-30), own, hit, missing, surfaces

    def _candidate(self, lobe: Any, v: Any, sample: Any, turn: Any) -> tuple[Any, Any]:
        """A direction and its density (1/sr), by two numbers in [0, 1)."""
        u = sample * (1.0 / LOBE)
        about_v, about_sun = u < 1.0, (u >= 1.0) & (u < 2.0)
        sample = dr.select(about_v, u, dr.select(about_sun, u - 1.0, (u - 2.0) * (LOBE / (1.0 - 2.0 * LOBE))))
        cosine = henyey_greenstein_cosine(lobe.g, sample)
        cosine = dr.select(about_v | about_sun, cosine, dr.fma(2.0, sample, -1.0))
        d = mi.Frame3f(dr.select(about_v, v, self.toward)).to_world(at_cosine(cosine, turn))
        lobes = lobe.value(dr.dot(d, v)) + lobe.value(dr.dot(d, self.toward))
        return d, dr.fma(LOBE, lobes, (1.0 - 2.0 * LOBE) * 0.25 * dr.inv_pi)

    def _hidden(
        self,
        here: list[list[Any]],
        v: Any,
        d: Any,
        line: Rays,
        hit: Any,
        si: Any,
        behind: Any,
        depth: Any,
        sampler: Any,
    ) -> tuple[list[Any], list[Any]]:
        """Of light from the direction ``d`` that is scattered (W/m/sr) toward -``v``: what a shape at the distance
        ``hit`` (m) hides, and what a white one sends; 0 where none is ``behind``."""
        air, optics = self.air, self.air.bands[0].optics
        near = dr.select(behind, hit, 0.0)
        lit = behind & ~self.scene.ray_test(si.spawn_ray(self.toward), behind)
        h, r, mu_s = point_along(optics, line, near)
        mu = dr.clip(dr.fma(optics.radius + line.h, line.mu, near) / r, -UPRIGHT, UPRIGHT)
        azimuth = relative_azimuth(mu, mu_s, line.nu)
        picks = sampler.next_1d(behind), sampler.next_1d(behind)
        open_ = air.open_sky.radiance(depth, h, mu_s, mu, azimuth, *picks, behind)
        n = dr.select(dr.dot(si.sh_frame.n, d) > 0.0, -si.sh_frame.n, si.sh_frame.n)
        facing = dr.select(lit, dr.maximum(dr.dot(n, self.toward), 0.0), 0.0)
        openness = 0.5 + 0.5 * sum(a * b for a, b in zip(n, air.globe.up, strict=True))
        amounts = air.columns(line, dr.zeros(mi.Float, dr.width(near)), near, [0.0 for _ in optics.constituents], 1)
        lost, sent = [], []
        for band, densities in zip(air.bands, here, strict=True):
            o = band.optics
            turned = _scattering(o, densities, {k: o.phase_values(k, dr.dot(v, d)) for k in o.scatterers})
            sun = air.sunlit(band, h, mu_s, visible_sun(o, h, r, mu_s))
            sky = band.field.irradiance(h, mu_s, behind, reflected=True)
            for i, passed in enumerate(o.optical_depths(amounts)):
                through = dr.select(behind, turned[i] * dr.exp(-passed), 0.0)
                lost.append(through * open_[len(lost)])
                sent.append(through * dr.fma(sun[i], facing, sky[i] * openness) * dr.inv_pi)
        return lost, sent


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
