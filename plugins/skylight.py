"""The sun and the sky of an emitter ``atmosphere`` as the integrator ``atmosphere_path`` uses them: directions to the
sun, and directions drawn where the sky is bright.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi


class Skylight:
    """``solar``: irradiance at the top of the air (W). ``sky_share``: of the directions at smooth surfaces that
    :meth:`sample_sky` draws."""

    def __init__(self, emitter: Any, solar: list[Any], sky_share: float) -> None:
        self.emitter, self.solar, self._share = emitter, solar, sky_share
        self.refresh()

    def refresh(self) -> None:
        """Take over the emitter's scales and tables."""
        self.sun_scale, self.sky_scale = self.emitter.scales
        self._light = self.emitter.sky_light
        self.sun_density, self.sun_squeeze = self._light.sun_density, self._light.sun_squeeze

    def moved(self, solar: list[Any], sun_scale: float, sky_scale: float) -> Skylight:
        """The same for another solar irradiance and scales that are larger by so much."""
        other = copy(self)
        other.solar = solar
        other.sun_scale, other.sky_scale = self.sun_scale + sun_scale, self.sky_scale + sky_scale
        return other

    @staticmethod
    def pointers(lamps: list[Any]) -> Any:
        """The lamps as an array."""
        found = dr.zeros(mi.EmitterPtr, max(len(lamps), 1))
        for i, lamp in enumerate(lamps):
            dr.scatter(found, mi.EmitterPtr(lamp), mi.UInt32(i))
        dr.eval(found)
        return found

    def is_lamp(self, emitter: Any) -> Any:
        """Whether an emitter is there, and not that of sun and sky."""
        return (emitter != None) & (emitter != mi.EmitterPtr(self.emitter))  # noqa: E711

    def toward_sun(self, sample: Any) -> Any:
        """A direction to the sun's disc, even in solid angle."""
        return self.emitter.world(self._light.sample_sun(sample))

    def sun_pdf(self, d: Any) -> Any:
        """Density (1/sr) of :meth:`toward_sun`: times ``sun_squeeze`` the radiance of a sun that would have
        irradiance 1 if it were round."""
        return self._light.sun_pdf(self.emitter.local(d))

    def sample_sky(self, sample: Any, active: Any) -> Any:
        """A direction in proportion to the sky's luminance."""
        return self.emitter.world(self._light.sample_sky(sample, active))

    def mixed_pdf(self, bsdf_pdf: Any, d: Any) -> Any:
        """Density (1/sr) of directions drawn from BSDF or sky."""
        sky = self._light.sky_pdf(self.emitter.local(d))
        return dr.lerp(bsdf_pdf, sky, self._share)

    def sum(
        self,
        passed: list[Any],
        inscatter: list[Any],
        transmittance: list[Any],
        ground: list[Any],
        grounded: Any,
        disc: Any,
    ) -> list[Any]:
        """Radiance (W) that comes through air of which ``passed`` is left: scattered there, from the planet's ground
        where the ray is ``grounded``, and from the sun, of which ``disc`` is seen (1/sr)."""
        found = []
        for a, s, t, g, e in zip(passed, inscatter, transmittance, ground, self.solar, strict=True):
            behind = dr.select(grounded, g * self.sky_scale, e * disc * self.sun_scale)
            found.append(a * dr.fma(t, behind, s * self.sky_scale))
        return found
