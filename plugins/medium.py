"""The medium plugin ``atmosphere_medium``: its reference page, its parameters and Mitsuba's interface."""

from __future__ import annotations

import threading
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import AtmosphereError, shown

from . import settings
from .air import Air
from .mixture import AirPhase
from .variants import bound
from .wavelengths import Wavelengths


class AtmosphereMedium:
    """
    .. _medium-atmosphere_medium:

    The air of a planet (:monosp:`atmosphere_medium`)
    -------------------------------------------------

    .. pluginparameters::

     * - atmosphere
       - |string|
       - The atmosphere: a preset (``earth``, ``bruneton2008``, ``hillaire2020``, ``mars``), the name of a JSON file, or
         the JSON text itself. (Default: ``earth``)

     * - *any value of the atmosphere* (``mie.phase.g``, ``rayleigh.scattering_per_m``, ``ozone.center_m``, ...)
       - |float| or |string|
       - Replaces the value of that dotted name, as for the emitter ``atmosphere``. Python dicts spell the dots as
         underscores (``mie_phase_g``).
       - |exposed|, |differentiable|

     * - center
       - |point|
       - Centre of the planet in scene units. (Default: straight below the origin, which then is on the ground, +Z up)

     * - scale
       - |float|
       - Scene units per metre. (Default: 1)

     * - wavelength_rule
       - |string|
       - ``channels`` or ``time``, see below. (Default: ``channels``)

     * - channels
       - |string|
       - Indices of the atmosphere's wavelengths that the channels of the variant show, such as ``0, 4, 9``.
         (Default: one for all if the atmosphere has one wavelength; the three of three in rgb variants; the one nearest
         to 555 nm in mono variants)

     * - sample_emitters
       - |bool|
       - As for other media. (Default: true)

    The air between the ground and the top of the atmosphere, as a medium in which light is traced path by path: the
    reference for everything that the package computes otherwise. Densities are evaluated, not stored in voxels; every
    kind of profile and of phase function that an atmosphere file can hold is there. Below the ground and above the top
    there is nothing, so a shape around it may be larger than the air. ``volpath``, ``volpathmis`` and ``prbvolpath``
    render it.

    **Wavelengths.** A picture shows radiance at wavelengths, not colours: with ``channels`` each channel of an rgb
    variant is a wavelength of its own, and light sources are to be given in the same way.
    ``SpectralBasis.srgb_matrix`` makes colours of the picture afterwards. In spectral variants radiance is what the
    emitter ``atmosphere`` gives: interpolated between the atmosphere's wavelengths. With ``time`` every path has
    the wavelength number floor(W * time) of W; :py:func:`atmo_jit.plugins.planet.planet` uses this for scenes in
    the colours of the emitter, in every variant.

    **Majorant.** A ray's majorant is the largest extinction at and above its lowest altitude from where it is, so it
    falls while a path rises. It is the same for all wavelengths of a path.

    **What to observe.** :py:func:`atmo_jit.plugins.planet.planet` places planet, air and sun so that all of this is
    taken care of.

    - The medium must end at a surface (a sphere with a ``null`` BSDF at the top) unless every path has one wavelength.
    - Mitsuba starts rays 9e-5 of the largest coordinate beside the surface that they leave: put the origin near the
      camera.
    - ``prbvolpath`` ignores the medium that a camera is in: put a small ``null`` sphere around the camera, with the
      medium as its ``exterior``, and ``near_clip`` below its radius.
    - ``perspective`` sees no farther than ``far_clip``, 10 km by default, and the sky ends there.
    - ``max_depth`` counts every scattering: use -1 (1000 or so for ``prbvolpath``), and ``rr_depth`` of some tens.

    .. tabs::
        .. code-tab:: xml
            :name: atmosphere-medium

            <shape type="sphere">
                <point name="center" x="0" y="0" z="-6360000"/>
                <float name="radius" value="6420000"/>
                <bsdf type="null"/>
                <medium name="interior" type="atmosphere_medium">
                    <string name="atmosphere" value="earth"/>
                    <float name="mie.phase.g" value="0.76"/>
                </medium>
            </shape>

        .. code-tab:: python

            'type': 'sphere',
            'center': [0, 0, -6360e3],
            'radius': 6420e3,
            'bsdf': {'type': 'null'},
            'interior': {'type': 'atmosphere_medium', 'atmosphere': 'earth', 'mie_phase_g': 0.76}
    """

    def __init__(self, props: Any) -> None:
        if any(isinstance(value, mi.PhaseFunction) for _, value in props.objects()):
            raise AtmosphereError("phase", "a phase function", "none: those of the atmosphere's constituents are used")
        phase = bound(AirPhase, "PhaseFunction")(mi.Properties())
        props["phase"] = phase
        mi.Medium.__init__(self, props)
        atmosphere = _atmosphere(props)
        scale = settings.number(props, "scale", 1.0)
        if not scale > 0.0:
            raise AtmosphereError("scale", shown(scale), "a finite number > 0 (scene units per metre)")
        default = [0.0, 0.0, -atmosphere.bottom_radius_m * scale]
        center = np.array(settings.values(props["center"]) if "center" in props else default, dtype=np.float64)
        if center.shape != (3,) or not np.all(np.isfinite(center)):
            raise AtmosphereError("center", shown(center.tolist()), "a point of three finite numbers (scene units)")
        channels = props.get("channels", None)
        if channels is not None:
            channels = [int(v) for v in np.atleast_1d(settings.values(channels))]
        wavelengths = Wavelengths(atmosphere.wavelengths_nm, props.get("wavelength_rule", "channels"), channels)
        self.air = Air(atmosphere, center, scale, wavelengths)
        phase.use(self.air)
        self.m_is_homogeneous = False
        self.m_has_spectral_extinction = not wavelengths.achromatic
        # What one call of sample_interaction hands on from one of the methods below to the next. Scalar variants call
        # from several threads.
        self._handed = threading.local()

    def traverse(self, callback: Any) -> None:
        mi.Medium.traverse(self, callback)
        for name, value in self.air.values.items():
            callback.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        self.air.update()

    def intersect_aabb(self, ray: Any) -> tuple[Any, Any, Any]:
        hits, near, far, self._handed.lowest = self.air.along(ray)
        return hits, near, far

    def get_majorant(self, mei: Any, active: Any = True) -> Any:
        # Asked outside of sample_interaction, nothing is known of the ray.
        lowest = vars(self._handed).pop("lowest", mi.Float(0.0))
        bound_ = self._handed.bound = self.air.majorant(lowest, mei) * (1.0 / self.air.scale)
        return mi.UnpolarizedSpectrum(bound_)

    def get_scattering_coefficients(self, mei: Any, active: Any = True) -> tuple[Any, Any, Any]:
        bound_ = vars(self._handed).pop("bound", None)
        if bound_ is None:
            bound_ = self.air.majorant(mi.Float(0.0), mei) * (1.0 / self.air.scale)
        value = self.air.pick(mei)
        densities = self.air.densities(self.air.altitude(mei.p))
        sigma_s = sigma_t = mi.UnpolarizedSpectrum(0.0)
        for c, density in zip(self.air.atmosphere.constituents, densities, strict=True):
            if c.phase is not None:
                sigma_s = sigma_s + self.air.scattering(c, value) * density
            sigma_t = sigma_t + self.air.extinction(c, value) * density
        sigma_s, sigma_t = sigma_s * (1.0 / self.air.scale), sigma_t * (1.0 / self.air.scale)
        sigma_s, sigma_t = dr.select(active, sigma_s, 0.0), dr.select(active, sigma_t, 0.0)
        return sigma_s, bound_ - sigma_t, sigma_t

    def to_string(self) -> str:
        return f"AtmosphereMedium[scale = {self.air.scale}, {self.air.atmosphere.to_dict()}]"


def _atmosphere(props: Any) -> Atmosphere:
    """The atmosphere of the properties, with the values that they replace."""
    return settings.described(props, lambda name: str(mi.file_resolver().resolve(name)))
