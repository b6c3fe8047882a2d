"""The emitter plugin ``atmosphere``: its reference page, its parameters and Mitsuba's interface."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.solved import Sky

from . import albedo, bounds, settings
from .exposed import array, first, host, single, variables
from .exposed_atmosphere import ExposedAtmosphere
from .light import Light
from .sun_position import Moment

# Farther than any scene: Mitsuba does not tell Python plugins the scene's bounds, and of a shadow ray only the
# direction has to survive the rounding of its end point.
FAR = 1e10
TABLES = {"sky_radiance", "sun_radiance"}
SCALES = {"sun_scale", "sky_scale", "sampling_weight"}


@lru_cache(maxsize=2)
def _solved(atmosphere: Atmosphere) -> Sky:
    """The solved sky; emitters that differ only in sun, place or variant share it."""
    return Sky(atmosphere)


class AtmosphereEmitter:
    """
.. _emitter-atmosphere:

Sun and sky of a planet's atmosphere (:monosp:`atmosphere`)
-----------------------------------------------------------

.. pluginparameters::

 * - atmosphere
   - |string|
   - The atmosphere: a preset (``earth``, ``bruneton2008``, ``hillaire2020``, ``mars``), the name of a JSON file, or
     the JSON text itself. (Default: ``earth``)

 * - altitude
   - |float|
   - Altitude of the observer above the ground in metres, the same for the whole scene. (Default: 1)
   - |exposed|, |differentiable|

 * - *any value of the atmosphere* (``mie.phase.g``, ``rayleigh.scattering_per_m``, ``ozone.center_m``, ...)
   - |float| or |string|
   - Replaces the value of that dotted name. Values per wavelength are one number for all, or numbers separated by
     commas or spaces, or a vector. Python dicts spell the dots as underscores (``mie_phase_g``), because Mitsuba's
     dict loader reserves dots. Derivatives are those of the solved sky (see below).
   - |exposed|, |differentiable| (not ``wavelengths_nm``,
     ``sun_angular_radius_deg`` and tables of phase functions)

 * - wavelengths
   - |string|
   - Describe the atmosphere at other wavelengths (nm, with commas between) than it was given at; ``fast``: at the
     four whose colours are nearly those of forty. The values above are those at the atmosphere's own. (Default: its
     own; three in ``earth``, ``bruneton2008``, ``hillaire2020`` and ``mars``, too few for the colours of twilight)

 * - sun_direction
   - |vector|
   - Direction of the sun in the sky, in world space (No default). It cannot be specified along with one of the
     location/time parameters.
   - |exposed|, |differentiable|

 * - latitude, longitude, timezone
   - |float|
   - Location in degrees, timezone in hours (Default: 35.6894, 139.6917, 9: Tokyo).
   - |exposed|

 * - year, month, day
   - |int|
   - Date (Default: 2010, 7, 10).
   - |exposed|

 * - hour, minute, second
   - |float|
   - Local time (Default: 15, 0, 0).
   - |exposed|

 * - sun_scale, sky_scale
   - |float|
   - Scale factors of the radiance of sun and sky (Default: 1). 0 removes them; ground lit by the sun belongs to the
     sky.
   - |exposed|, |differentiable|

 * - sun_aperture
   - |float|
   - Aperture angle of the sun in degrees, in (0, 180); its irradiance does not change with it. (Default: twice the
     atmosphere's ``sun_angular_radius_deg``: 0.5356. A point, radius 0, is shown 0.01 degrees wide.)

 * - complex_sun
   - |bool|
   - Darken the sun towards its limb (Default: false). The irradiance stays the same.

 * - refraction
   - |bool|
   - Show the sun, and light the air, where the atmosphere's own refraction lifts the sun: half a degree at the
     horizon. ``sun_direction`` or location and time then mean the true place. The disc is flattened to an ellipse,
     of 0.81 of its width where it rests on the horizon of ``earth``. Its radiance stays, so its irradiance is less by
     as much; light in the air and on the planet's ground is not. Rays of view stay straight: the horizon is not
     raised. Where the air is path-traced (``--reference``) the sun is lifted, but round (Default: false).

 * - albedo
   - |spectrum|
   - Albedo of the ground, in [0, 1], constant in space (Default: the atmosphere's ``ground_albedo``, 0.1 for
     ``earth``).
   - |exposed|

 * - to_world
   - |transform|
   - Emitter-to-world transformation. (Default: none, i.e. emitter space = world space)
   - |exposed|

 * - sky_radiance, sun_radiance
   - |tensor|
   - The tables behind the look-ups: sky and ground [rows, columns, channels], sun [rows, columns, channels] (spectral
     variants: [rows, columns, wavelengths, 1], relative to the solar irradiance). Not accepted as input; solving
     again replaces them.
   - |exposed|, |differentiable|

This environment emitter shows what an observer in the air (or above it) sees: scattered sunlight of all orders, the
ground below the horizon, and the sun's disc, dimmed and reddened from limb to limb and cut off where it sets. It
takes the parameters of ``sunsky`` (except ``turbidity``: give the aerosol instead), has its units (W m^-2 sr^-1
nm^-1; a scene modelled in metres), and knows no lowest sun: day, twilight and night are the same computation. Unlike
``sunsky``, it is not black below the horizon.

The local frame is that of ``sunsky``: Z up, X south and Y west (its documentation says that X is north; times of the
day show otherwise). The sun's place comes from the PSA algorithm in double precision, within 0.05 degrees of what
``sunsky`` computes in single precision.

**Colour.** The atmosphere is solved at its own wavelengths. In rgb variants their radiance becomes linear sRGB by one
constant matrix (wavelengths -> XYZ -> sRGB, computed with colour-science when the emitter is loaded), in mono
variants its luminance. In spectral variants radiance is interpolated between the wavelengths (relative to the solar
spectrum, linearly in lambda^-4) and, outside of their range, stays in the ratio to the solar spectrum that it has at
the nearest one; rendered to sRGB this gives the rgb variants' values. In polarised variants the light is unpolarised.

**Derivatives.** Sky, ground and sun follow every number of the atmosphere, through all orders of scattering:
``mi.traverse`` hands them out, and a loss of rendered pixels leads back to them (``mi.ad.Adam`` and the like; one
solver pass in reverse serves all of them). Sampling densities and the places of the tables' nodes are not
differentiated: they do not change what is rendered on average.

**Sampling.** Sun and sky are sampled in proportion to their irradiance, the sky by the luminance of its table.
Particle tracing (``ptracer``) needs the scene's size, which Mitsuba does not tell Python plugins: vectorised variants
use the bounds of all shapes that are loaded; in scalar variants call ``emitter.set_scene(scene)`` first.

.. tabs::
    .. code-tab:: xml
        :name: atmosphere-light

        <emitter type="atmosphere">
            <vector name="sun_direction" value="1, 0, 0.2"/>
            <float name="altitude" value="1500"/>
            <string name="mie.scattering_per_m" value="2e-5, 2e-5, 2e-5"/>
            <float name="mie.phase.g" value="0.76"/>
        </emitter>

    .. code-tab:: python

        'type': 'atmosphere',
        'sun_direction': [1, 0, 0.2],
        'altitude': 1500,
        'mie_scattering_per_m': '2e-5, 2e-5, 2e-5',
        'mie_phase_g': 0.76
"""

    def __init__(self, props: Any) -> None:
        mi.Emitter.__init__(self, props)
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
        given = props.get_texture("albedo") if "albedo" in props else None
        read = None if given is None else lambda nm: albedo.values(given, nm)
        found = settings.read(props, lambda name: str(mi.file_resolver().resolve(name)), read)
        self._limb_darkening, self._refraction = found.limb_darkening, found.refraction
        ground = found.atmosphere.ground_albedo
        grey = float(ground[0]) if np.ptp(ground) == 0.0 else None
        self._albedo = given if given is not None or grey is None else props.get_texture("albedo", grey)
        self._exposed = ExposedAtmosphere(found.atmosphere)
        self._albedo_seen = self._albedo_values()
        self._to_world = mi.Transform4f(props["to_world"].matrix) if "to_world" in props else mi.Transform4f()
        numbers = {"altitude": found.altitude_m, "sun_scale": found.sun_scale, "sky_scale": found.sky_scale}
        self._moment = found.moment is not None
        if found.moment is not None:
            numbers |= {name: getattr(found.moment, name) for name in Moment.names()}
        self._values = {name: array(value) for name, value in numbers.items()}
        self._sun_direction = mi.Vector3f(*found.direction)
        self._sky: Sky | None = None
        self._scene: Any = None
        self._light: Light | None = None
        self._solve()

    # ---- parameters

    def traverse(self, callback: Any) -> None:
        mi.Emitter.traverse(self, callback)
        fixed, free = mi.ParamFlags.NonDifferentiable, mi.ParamFlags.Differentiable
        callback.put("to_world", self._to_world, fixed)
        if self._albedo is not None:
            callback.put("albedo", self._albedo, fixed)
        for name, value in self._values.items():
            callback.put(name, value, free if name in (*SCALES, "altitude") else fixed)
        callback.put("sun_direction", self._sun_direction, mi.ParamFlags.ReadOnly if self._moment else free)
        self._exposed.traverse(callback)
        callback.put("sky_radiance", self._light.sky_table, free)
        callback.put("sun_radiance", self._light.sun_table, free)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        mi.Emitter.parameters_changed(self, list(keys))
        for name in ("sun_scale", "sky_scale", "altitude"):
            settings.not_negative(name, first(self._values[name]))
        # Mitsuba cuts the names of nested objects at their dots ("g" for "mie.phase.g"), so an unknown key means:
        # solve.
        if keys and set(keys) <= TABLES | SCALES:
            self._prepare()
        else:
            self._solve()

    def _albedo_values(self) -> np.ndarray | None:
        return None if self._albedo is None else albedo.values(self._albedo, self._atmosphere.wavelengths_nm)

    def _update_atmosphere(self) -> None:
        """Take over what was written into the exposed parameters since the last time."""
        if self._exposed.update():
            self._sky = None
        reflected = self._albedo_values()
        if reflected is not None and not np.array_equal(reflected, self._albedo_seen):
            self._exposed.atmosphere, self._sky = settings.with_albedo(self._atmosphere, reflected), None
        self._albedo_seen = reflected

    @property
    def _atmosphere(self) -> Atmosphere:
        return self._exposed.atmosphere

    def _local_sun(self) -> Any:
        """The sun's direction in the local frame."""
        if self._moment:
            found = {name: first(self._values[name]) for name in Moment.names()}
            local = mi.Vector3f(*settings.moment_direction(found)[0])
            mi.set_property(self._sun_direction, dr.normalize(self._to_world @ local))
            return local
        settings.unit_vector("sun_direction", host(self._sun_direction))
        return dr.normalize(self._to_world.inverse() @ self._sun_direction)

    def _solve(self) -> None:
        """Solve the atmosphere if it changed, and the tables for the present altitude and sun."""
        settings.turning(host(self._to_world.matrix))
        self._update_atmosphere()
        sun = self._local_sun()
        squeeze = 1.0
        if self._refraction:
            altitude = first(self._values["altitude"])
            sun = mi.Vector3f(*settings.as_seen(self._atmosphere, altitude, sun, host(sun)))
            squeeze = settings.squeeze(self._atmosphere, altitude, host(sun))
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(sun, self._sun_direction)
        if self._sky is None:
            self._sky = _solved(self._atmosphere)
        follows = self._exposed.followed()
        light = Light(self._sky, self._values["altitude"], sun, self._limb_darkening, squeeze, follows)
        if self._light is not None:
            # The tensors that mi.traverse has handed out stay those that are in use.
            for name in ("sky_table", "sun_table"):
                kept = getattr(self._light, name)
                mi.set_property(kept, getattr(light, name))
                setattr(light, name, kept)
        self._light = light
        self._prepare()

    def _prepare(self) -> None:
        self._light.prepare(first(self._values["sun_scale"]), first(self._values["sky_scale"]))
        self._variables = variables(self._light)

    # ---- for the integrator atmosphere_path

    @property
    def sky(self) -> Sky:
        """The solved sky."""
        return self._sky

    @property
    def exposed(self) -> ExposedAtmosphere:
        """The atmosphere's numbers as parameters."""
        return self._exposed

    @property
    def followed_scales(self) -> dict[str, Any]:
        """Those of :attr:`scales` by which derivatives are wanted."""
        return {n: self._values[n] for n in ("sun_scale", "sky_scale") if dr.grad_enabled(self._values[n])}

    @property
    def sky_light(self) -> Light:
        """Sun and sky as tables."""
        return self._light

    @property
    def altitude_m(self) -> float:
        return first(self._values["altitude"])

    @property
    def up(self) -> np.ndarray:
        """The zenith in world space, float64."""
        up = host(self._to_world.matrix).reshape(4, 4)[:3, 2]
        return up / np.linalg.norm(up)

    @property
    def sun(self) -> np.ndarray:
        """Direction towards the sun in world space, float64."""
        turn = host(self._to_world.matrix).reshape(4, 4)[:3, :3]
        sun = turn @ host(self._light.sun)
        return sun / np.linalg.norm(sun)

    @property
    def scales(self) -> tuple[Any, Any]:
        """``sun_scale`` and ``sky_scale``."""
        return single(self._values["sun_scale"]), single(self._values["sky_scale"])

    def world(self, d: Any) -> Any:
        """A direction of the local frame in world space."""
        return dr.normalize(self._to_world @ d)

    def local(self, d: Any) -> Any:
        """A direction of world space in the local frame."""
        return dr.normalize(self._to_world.inverse() @ d)

    # ---- light, in world space

    def _where(self, d: Any) -> Any:
        return self._light.where(self.local(d))

    def _radiance(self, where: Any, wavelengths: Any, active: Any) -> Any:
        return self._light.radiance(where, wavelengths, *self.scales, active)

    # ---- Mitsuba's interface

    def eval(self, si: Any, active: Any = True) -> Any:
        return self._radiance(self._where(-si.wi), si.wavelengths, active)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return self._radiance(self._where(ds.d), it.wavelengths, active)

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return self._light.density(self._where(ds.d), active)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        local = self._light.sample(sample, active)
        where = self._light.where(local)
        ds = mi.DirectionSample3f()
        ds.d = self.world(local)
        ds.n = -ds.d
        ds.dist = FAR
        ds.p = dr.fma(ds.d, FAR, it.p)
        ds.uv, ds.time = sample, it.time
        ds.delta = False
        ds.pdf = self._light.density(where, active)
        ds.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
        inverse = dr.select(ds.pdf > 0.0, dr.rcp(dr.maximum(ds.pdf, 1e-30)), 0.0)
        return ds, self._radiance(where, it.wavelengths, active) * inverse

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> tuple[Any, Any]:
        local = self._light.sample(sample3, active)
        where = self._light.where(local)
        d = -self.world(local)
        wavelengths, weight = self._sample_wavelengths(sample1)
        centre, radius = bounds.sphere(self._scene)
        offset = mi.warp.square_to_uniform_disk_concentric(sample2)
        origin = centre + (mi.Frame3f(d).to_world(mi.Vector3f(offset.x, offset.y, 0.0)) - d) * radius
        inverse = dr.pi * radius**2 * dr.rcp(dr.maximum(self._light.density(where, active), 1e-30))
        return mi.Ray3f(origin, d, time, wavelengths), self._radiance(where, wavelengths, active) * weight * inverse

    def sample_wavelengths(self, si: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        wavelengths, weight = self._sample_wavelengths(sample)
        return wavelengths, self._radiance(self._where(-si.wi), wavelengths, active) * weight

    def _sample_wavelengths(self, sample: Any) -> tuple[Any, Any]:
        """Wavelengths in proportion to what they matter for sRGB, and 1 / density; only spectral variants choose."""
        if not mi.is_spectral:
            return [], 1.0
        shifted = mi.UnpolarizedSpectrum(0.0)
        for i in range(len(shifted)):
            x = sample + i / len(shifted)
            shifted[i] = x - dr.floor(x)
        wavelengths, weight = mi.sample_rgb_spectrum(shifted)
        return wavelengths, mi.depolarizer(weight) if mi.is_polarized else weight

    def set_scene(self, scene: Any) -> None:
        """Tell the emitter the scene that particles are traced in (see the section on sampling)."""
        self._scene = scene

    def sample_position(self, time: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        if not dr.is_jit_v(mi.Float):
            raise NotImplementedError("atmosphere: an emitter at infinity has no positions")
        # Recorded by virtual function calls without being used: no error there, as in Mitsuba's own environments.
        return dr.zeros(mi.PositionSample3f), mi.Float(dr.nan)

    def bbox(self) -> Any:
        """Invalid: the emitter is nowhere in particular."""
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        sun = ", ".join(f"{v:.4f}" for v in host(self._sun_direction))
        elevation = 90.0 - math.degrees(self._light.view.sun_zenith)
        rows = [f"sun_direction = [{sun}]", f"elevation = {elevation:.3f} degrees"]
        rows += [f"{name} = {first(self._values[name]):g}" for name in ("altitude", "sun_scale", "sky_scale")]
        nm = ", ".join(f"{w:g}" for w in self._atmosphere.wavelengths_nm[:8])
        more = ", ..." if len(self._atmosphere.wavelengths_nm) > 8 else ""
        return "AtmosphereEmitter[\n  " + ",\n  ".join([*rows, f"wavelengths_nm = [{nm}{more}]"]) + "\n]"
