"""Rays from the nodes of a lattice: what shapes keep of the light that would come along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.backend import floats
from atmo_jit.geometry import UPRIGHT
from atmo_jit.march import point_along, rays_to_boundary, relative_azimuth, visible_sun
from atmo_jit.phase import HenyeyGreenstein
from atmo_jit.spectrum import SpectralBasis

from . import unfolded
from .airlight import LEAST_EXTINCTION, Airlight
from .channels import Channels
from .cornette_shanks import henyey_greenstein_cosine
from .lattice import Lattice
from .open_sky import OpenSky

LEAST_RANGE = 1e-3  # of rate x length of a bounded path, where single precision resolves 1 - exp(-x)
SHORTEST = 1e-3  # m: of paths on which a point is drawn
STEPS = 0.7548776662, 0.5698402910  # of sequences that are even together: 1 / p and 1 / p^2, p^3 = p + 1
PARTS = 2  # of the quadrature of columns


@dataclass
class HiddenRays:
    """Of each ray: ``hidden`` radiance (W), but for what is hidden of light that the air before it scatters once more,
    for each level of the open sky; that is ``factor`` (W) times what the lattice has at ``node`` in the direction
    ``toward``. ``leaves``: the ray meets nothing but sky."""

    hidden: list[list[Any]]
    factor: list[Any]
    node: Any
    toward: Any
    leaves: Any


def trace(
    scene: Any,
    air: Airlight,
    lattice: Lattice,
    open_sky: OpenSky,
    levels: int,
    p: Any,
    d: Any,
    share: Any,
    sampler: Any,
) -> HiddenRays:
    """Rays from points ``p`` in the directions ``d``, evaluated in one kernel; ``levels``: of the open sky; ``share``:
    of the light that the air on the way sends, what is before the one point of it that is asked (a random number)."""
    optics, scale, active = air.bands[0].optics, air.globe.scale, mi.Bool(True)
    h, mu, mu_s, nu = air.globe.cosines(p, d, air.sun)
    line = rays_to_boundary(optics, dr.minimum(h, optics.thickness), mu, mu_s, nu)
    si = scene.ray_intersect(mi.Ray3f(p, d), mi.RayFlags.All, coherent=False, active=active)
    behind = si.is_valid() & (si.t < line.stop * scale)
    near = dr.select(behind, si.t * (1.0 / scale), 0.0)
    lit = behind & ~scene.ray_test(si.spawn_ray(air.sun), behind)
    start, before = dr.zeros(mi.Float, dr.width(near)), [0.0 for _ in optics.constituents]
    amounts = air.columns(line, start, near, before, PARTS)
    through = []
    for band in air.bands:
        through += [dr.select(behind, dr.exp(-depth), 0.0) for depth in band.optics.optical_depths(amounts)]

    # One point of the air on the way.
    _, last = lattice.interval(mi.Ray3f(p, d))
    length = dr.maximum(dr.minimum(dr.select(behind, near, line.stop), last * (1.0 / scale)), SHORTEST)
    rate = dr.maximum(air.guide.largest_extinction(air.guide.densities(h)), LEAST_EXTINCTION)
    rate = dr.maximum(rate, LEAST_RANGE / length)
    whole = 1.0 - dr.exp(-rate * length)
    t = dr.minimum(-dr.log(1.0 - share * whole) / rate, length)
    inverse = whole * dr.exp(rate * t) / rate
    place = mi.Point3f(p + d * (t * scale))
    dark = dr.select(scene.ray_test(mi.Ray3f(place, air.sun)), 1.0, 0.0)
    there, r, sun_mu = point_along(optics, line, t)
    amounts = air.columns(line, start, t, before, PARTS)
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
    node, inside = lattice.node(place, there, sampler, active)
    factor = [dr.select(inside, f, 0.0) for f in factor]

    # What a shape hides, and what its surface sends: diffuse, lit by the sun and by what its slope leaves of sky.
    h, r, mu_s = point_along(optics, line, near)
    mu = dr.clip(dr.fma(optics.radius + line.h, line.mu, near) / r, -UPRIGHT, UPRIGHT)
    n = dr.select(dr.dot(si.sh_frame.n, d) > 0.0, -si.sh_frame.n, si.sh_frame.n)
    facing = dr.select(lit, dr.maximum(dr.dot(n, air.sun), 0.0), 0.0)
    openness = 0.5 + 0.5 * sum(a * b for a, b in zip(n, air.globe.up, strict=True))
    sent = []
    reflectance = _reflectance(air, si, behind)
    for band in air.bands:
        sun = air.sunlit(band, h, mu_s, visible_sun(band.optics, h, r, mu_s))
        sky = band.field.irradiance(h, mu_s, behind, reflected=True)
        for e, s in zip(sun, sky, strict=True):
            sent.append(reflectance[len(sent)] * dr.fma(e, facing, s * openness) * dr.inv_pi)
    azimuth, picks = relative_azimuth(mu, mu_s, line.nu), (sampler.next_1d(), sampler.next_1d())
    hidden = []
    for level in range(levels):
        shown = open_sky.radiance(mi.UInt32(level), h, mu_s, mu, azimuth, *picks, behind)
        parts = zip(through, shown, sent, single, strict=True)
        hidden.append([dr.fma(t, o - s, before) for t, o, s, before in parts])
    toward = unfolded.node(d, sampler, active)
    found = HiddenRays(hidden, factor, node, toward, ~behind & ~line.ground)
    dr.eval(found)
    return found


def _reflectance(air: Airlight, si: Any, active: Any) -> list[Any]:
    """Diffuse reflectance at each wavelength: in RGB that of the channels which the wavelength counts in."""
    atmosphere = air.sky.atmosphere
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


def directions(sun: np.ndarray, g: float, sets: int, about_sun: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [sets, N, 3], ``about_sun`` of each N about the ``sun``, and their weights (sr): one over how many
    there are in a steradian."""
    rng, lobe = np.random.default_rng(1), HenyeyGreenstein(g)
    axis = np.cross(sun, [1.0, 0.0, 0.0] if abs(sun[0]) < 0.9 else [0.0, 1.0, 0.0])
    x = axis / np.linalg.norm(axis)
    frame = np.stack([x, np.cross(sun, x), sun])
    found = []
    for s in range(sets):
        parts = []
        start = [(s * step) % 1.0 for step in STEPS]  # all sets together are even as well
        for n, peaked in ((about_sun, True), (around, False)):
            u, phi = fibonacci(n, *start)
            u = np.array(henyey_greenstein_cosine(mi.Float(g), mi.Float(floats(u)))) if peaked else 1.0 - 2.0 * u
            sine = np.sqrt(np.maximum(1.0 - u * u, 0.0))
            parts.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), u], axis=-1))
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        found.append(np.concatenate([parts[0] @ frame, parts[1] @ turn]))
    w = np.stack(found)
    density = about_sun * np.asarray(lobe.value(np.clip(w @ sun, -1.0, 1.0))) + around * 0.25 / np.pi
    return w, 1.0 / density


def fibonacci(count: int, shift: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers in [0, 1) and angles (rad) that are even together."""
    i = np.arange(count)
    return (i + shift) / count, 2.0 * np.pi * ((i * STEPS[0] + turn) % 1.0)
