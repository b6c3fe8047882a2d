"""Sun and sky around one observer in the types of a Mitsuba variant: tables, radiance, density, sampling.

Directions here are unit vectors in the emitter's local frame, Z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from atmo_jit.errors import InputError
from atmo_jit.solved import Sky
from atmo_jit.spectrum import SpectralBasis

from . import settings
from .channels import Channels
from .exposed import first, host, number
from .lookup import SkyLookup, SunLookup, sun_share, texture
from .panorama import COLUMNS, ROWS_DOWN, ROWS_UP, SUN_COLUMNS, SUN_ROWS, Panorama, disc_radiance, solve_disc, solve_sky

SKY_SHAPE = (ROWS_DOWN + ROWS_UP + 2, COLUMNS + 1)
SUN_SHAPE = (SUN_ROWS, SUN_COLUMNS)
# Step of the difference that stands for the table's derivative: the radiance of twilight changes by 1 % over it.
SUN_STEP_RAD = 2e-3
ALTITUDE_STEP_M = 10.0


@dataclass
class Where:
    """What both radiance and density need to know of a direction.

    ``elevation`` above the horizon (rad); ``place`` in the sky's table; ``distance2``, the squared distance from the
    sun's centre, 1 at its limb.
    """

    elevation: Any
    place: tuple[Any, Any, Any]
    distance2: Any


class Light:
    """The light of an atmosphere for an observer at ``altitude`` (m) and a sun in the local direction ``sun``.

    ``squeeze``: vertical over horizontal diameter of the sun's disc.

    ``parameters``: those by which the tables are differentiable, arrays by name (atmo_jit.parameters.parameter_names).
    ``sky_table`` and ``sun_table`` are the tensors that look-ups read; whoever changes them calls :meth:`prepare`.
    """

    def __init__(
        self,
        sky: Sky,
        altitude: Any,
        sun: Any,
        limb_darkening: bool,
        squeeze: float = 1.0,
        parameters: dict[str, Any] | None = None,
    ) -> None:
        self.basis = SpectralBasis.of(sky.atmosphere)
        self.channels = Channels(self.basis)
        (x, y, z), altitude_m = host(sun), first(altitude)
        self.sun = sun
        self.heading = self._heading(math.hypot(x, y))
        air = sky.atmosphere
        self.view = Panorama.of(air.bottom_radius_m, air.thickness_m, altitude_m, math.atan2(math.hypot(x, y), z))
        self.sky_table = self.channels.tensor(solve_sky(sky, self.view, parameters=parameters), SKY_SHAPE)
        if dr.grad_enabled(sun):
            angle = dr.atan2(dr.norm(mi.Vector2f(sun.x, sun.y)), sun.z)
            zenith = self.view.sun_zenith
            self._follow(sky, angle, *({"sun_zenith": zenith + s} for s in (-SUN_STEP_RAD, SUN_STEP_RAD)))
        if dr.grad_enabled(altitude):
            step = max(ALTITUDE_STEP_M, 0.01 * altitude_m)
            self._follow(sky, altitude, {"altitude_m": max(altitude_m - step, 0.0)}, {"altitude_m": altitude_m + step})

        aperture = max(2.0 * air.sun_angular_radius_deg, settings.SMALLEST_SUN_DEG)
        follows = dict(parameters or {}) | ({"altitude_m": altitude} if dr.grad_enabled(altitude) else {})
        self.disc = solve_disc(sky, self.view, math.radians(0.5 * aperture), limb_darkening, squeeze)
        self.sun_table = self.channels.tensor(disc_radiance(sky, self.disc, self.view, follows), SUN_SHAPE)

    def _follow(self, sky: Sky, value: Any, before: dict[str, float], after: dict[str, float]) -> None:
        """Give the sky's table its derivative by where the observer or the sun is, ``value``: a difference of the
        solver's results in the same directions.

        The derivative by the sun's azimuth is in the look-up.
        """
        (first_, last), table = (next(iter(end.values())) for end in (before, after)), self.sky_table
        low, high = (
            self.channels.tensor(solve_sky(sky, replace(self.view, **end), self.view), SKY_SHAPE).array
            for end in (before, after)
        )
        move = dr.replace_grad(mi.Float(0.0), value)
        values = table.array + move * (dr.detach(high - low) / (last - first_))
        self.sky_table = mi.TensorXf(values, table.shape)

    def _heading(self, across: float) -> tuple[Any, Any]:
        """Horizontal unit vector towards the sun; any one where it stands at the zenith."""
        if across < 1e-6:
            return number(1.0), number(0.0)
        if dr.grad_enabled(self.sun):
            scale = dr.rsqrt(dr.fma(self.sun.x, self.sun.x, self.sun.y * self.sun.y))
            return self.sun.x * scale, self.sun.y * scale
        x, y, _ = host(self.sun)
        return number(x / across), number(y / across)

    def prepare(self, sun_scale: float, sky_scale: float) -> None:
        """Look-ups and sampling densities for the present tables, under these scales."""
        tables = (("sky_radiance", self.sky_table, SKY_SHAPE), ("sun_radiance", self.sun_table, SUN_SHAPE))
        for name, table, shape in tables:
            if tuple(table.shape[:2]) != shape:
                raise InputError(f"{name}: found a tensor of shape {tuple(table.shape)}; allowed: {shape} x channels")
        self._sky_texture, self._sun_texture = texture(self.sky_table), texture(self.sun_table)
        self._sky = SkyLookup(self.view, self.channels.node_luminance(self.sky_table))
        self._sun = SunLookup(self.disc, host(self.sun))
        luminance = max(float(self.basis.xyz_matrix[1] @ (self.disc.mean * self.basis.solar_irradiance)), 0.0)
        share = sun_share(luminance * sun_scale, self._sky.flux * sky_scale, math.cos(self.view.sun_zenith))
        self._share, self._rest = number(share), number(1.0 - share)
        self._share_inverse, self._rest_inverse = number(1.0 / max(share, 1e-9)), number(1.0 / max(1.0 - share, 1e-9))

    def where(self, d: Any) -> Where:
        """See :class:`Where`."""
        hx, hy = self.heading
        elevation = self._sky.elevation(d.z, dr.sqrt(dr.fma(d.x, d.x, d.y * d.y)))
        phi = dr.abs(dr.atan2(hx * d.y - hy * d.x, hx * d.x + hy * d.y))
        return Where(elevation, self._sky.place(elevation, phi), self._sun.distance2(d, self.sun))

    def radiance(self, at: Where, wavelengths: Any, sun_scale: Any, sky_scale: Any, active: Any) -> Any:
        """Spectrum that arrives from a direction (a Mueller matrix in polarised variants)."""
        covered = active & self._sky.covers(at.elevation)
        x, y = self._sky.node(at.elevation, at.place)
        sky = self.channels.read(self._sky_texture, x, y, wavelengths, covered) * sky_scale
        seen = active & (at.distance2 <= 1.0) & (at.elevation >= 0.0)
        x, y = self._sun.node(at.elevation, at.distance2)
        sun = self.channels.read(self._sun_texture, x, y, wavelengths, seen) * sun_scale
        return mi.depolarizer(dr.select(covered, sky, 0.0) + dr.select(seen, sun, 0.0))

    def density(self, at: Where, active: Any) -> Any:
        """Density per solid angle (1/sr) of :meth:`sample`."""
        sun = dr.select(at.distance2 <= 1.0, self._sun.density, 0.0)
        sky = dr.select(self._sky.covers(at.elevation), self._sky.pdf(at.elevation, at.place, active), 0.0)
        return dr.select(active, dr.fma(self._share, sun, self._rest * sky), 0.0)

    @property
    def sun_density(self) -> Any:
        """Density per solid angle (1/sr) of directions drawn from the sun's disc."""
        return self._sun.density

    @property
    def sun_squeeze(self) -> Any:
        """Vertical over horizontal diameter of the disc: what is left of its irradiance, as its radiance stays."""
        return self._sun.squeeze

    def sun_pdf(self, d: Any) -> Any:
        """That density in a direction: 0 beside the disc."""
        return dr.select(self._sun.distance2(d, self.sun) <= 1.0, self._sun.density, 0.0)

    def sample_sun(self, sample: Any) -> Any:
        """A direction within the sun's disc."""
        return self._sun.sample(sample, self.sun)

    def sky_pdf(self, d: Any) -> Any:
        """Density per solid angle (1/sr) of :meth:`sample_sky`."""
        at = self.where(d)
        return dr.select(self._sky.covers(at.elevation), self._sky.pdf(at.elevation, at.place, True), 0.0)

    def sample_sky(self, sample: Any, active: Any) -> Any:
        """A direction in proportion to the radiance of the sky without the sun."""
        z, phi = self._sky.sample(sample, active)
        across = dr.safe_sqrt(dr.fma(-z, z, 1.0))
        sin, cos = dr.sincos(phi)
        hx, hy = self.heading
        return mi.Vector3f(across * (cos * hx - sin * hy), across * (cos * hy + sin * hx), z)

    def sample(self, sample: Any, active: Any) -> Any:
        """A direction: of the sun's disc with probability ``share``, else of the sky."""
        last = 1.0 - 2.0**-24
        pick = sample.x < self._share
        first = mi.Point2f(dr.minimum(sample.x * self._share_inverse, last), sample.y)
        second = mi.Point2f(dr.clip((sample.x - self._share) * self._rest_inverse, 0.0, last), sample.y)
        return dr.normalize(dr.select(pick, self.sample_sun(first), self.sample_sky(second, active)))
