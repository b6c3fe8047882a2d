"""The emitter plugin ``atmosphere``: its reference page, its parameters and Mitsuba's interface."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import InputError
from atmo_jit.sky import Sky
from atmo_jit.spectrum import SpectralBasis

from . import albedo, bounds, settings
from .channels import Channels
from .lookup import SkyLookup, SunLookup, number, sun_share, texture
from .panorama import COLUMNS, ROWS_DOWN, ROWS_UP, SUN_COLUMNS, SUN_ROWS, Panorama, solve_disc, solve_sky
from .sun_position import Moment

SKY_SHAPE = (ROWS_DOWN + ROWS_UP + 2, COLUMNS + 1)
SUN_SHAPE = (SUN_ROWS, SUN_COLUMNS)
# Farther than any scene: Mitsuba does not tell Python plugins the scene's bounds, and shadow rays only need the direction to survive rounding.
FAR = 1e10
TABLES = {"sky_radiance", "sun_radiance"}
SCALES = {"sun_scale", "sky_scale", "sampling_weight"}


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
   - |exposed|

 * - *any value of the atmosphere* (``mie.phase.g``, ``rayleigh.scattering_per_m``, ``ozone.center_m``, ...)
   - |float| or |string|
   - Replaces the value of that dotted name. Values per wavelength are one number for all, or numbers separated by
     commas or spaces, or a vector. Python dicts spell the dots as underscores (``mie_phase_g``), because Mitsuba's
     dict loader reserves dots.
   - |exposed|

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
   - Scale factors of the radiance of sun and sky (Default: 1). 0 removes them; ground lit by the sun belongs to the sky.
   - |exposed|, |differentiable|

 * - sun_aperture
   - |float|
   - Aperture angle of the sun in degrees, in (0, 180); its irradiance does not change with it. (Default: twice the
     atmosphere's ``sun_angular_radius_deg``: 0.5356. A point, radius 0, is shown 0.01 degrees wide.)

 * - complex_sun
   - |bool|
   - Darken the sun towards its limb (Default: false). The irradiance stays the same.

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

This environment emitter shows what an observer in the air (or above it) sees: scattered sunlight of all orders, the ground below the
horizon, and the sun's disc, dimmed and reddened from limb to limb and cut off where it sets. It takes the parameters of ``sunsky`` (except ``turbidity``:
give the aerosol instead), has its units (W m^-2 sr^-1 nm^-1; a scene modelled in metres), and knows no lowest sun: day, twilight and
night are the same computation. Unlike ``sunsky``, it is not black below the horizon.

The local frame is that of ``sunsky``: Z up, X south and Y west (its documentation says that X is north; times of the day show otherwise).
The sun's place comes from the PSA algorithm in double precision, within 0.05 degrees of what ``sunsky`` computes in single precision.

**Colour.** The atmosphere is solved at its own wavelengths. In rgb variants their radiance becomes linear sRGB by one constant matrix
(wavelengths -> XYZ -> sRGB, computed with colour-science when the emitter is loaded), in mono variants its luminance. In spectral
variants radiance is interpolated between the wavelengths (relative to the solar spectrum, linearly in lambda^-4) and, outside of their range, stays in
the ratio to the solar spectrum that it has at the nearest one; rendered to sRGB this gives the rgb variants' values.
In polarised variants the light is unpolarised.

**Sampling.** Sun and sky are sampled in proportion to their irradiance, the sky by the luminance of its table. Particle tracing
(``ptracer``) needs the scene's size, which Mitsuba does not tell Python plugins: vectorised variants use the bounds of all shapes that are
loaded; in scalar variants call ``emitter.set_scene(scene)`` first.

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
        self._atmosphere, self._limb_darkening = found.atmosphere, found.limb_darkening
        ground = found.atmosphere.ground_albedo
        grey = float(ground[0]) if np.ptp(ground) == 0.0 else None
        self._albedo = given if given is not None or grey is None else props.get_texture("albedo", grey)
        self._albedo_seen = self._albedo_values()
        self._to_world = mi.Transform4f(props["to_world"].matrix) if "to_world" in props else mi.Transform4f()
        self._moment = found.moment is not None
        self._values = {name: _array(getattr(found, f)) for name, f in (("altitude", "altitude_m"), ("sun_scale",) * 2, ("sky_scale",) * 2)}
        if found.moment is not None:
            self._values |= {name: _array(getattr(found.moment, name)) for name in Moment.names()}
        self._sun_direction = mi.Vector3f(*found.direction)
        self._atmosphere_values = {name: _array(self._given(name)) for name in self._atmosphere.names()}
        self._seen = {name: _host(value) for name, value in self._atmosphere_values.items()}
        self._sky: Sky | None = None
        self._scene: Any = None
        self._solve()

    # ---- parameters

    def traverse(self, callback: Any) -> None:
        mi.Emitter.traverse(self, callback)
        fixed, free = mi.ParamFlags.NonDifferentiable, mi.ParamFlags.Differentiable
        callback.put("to_world", self._to_world, fixed)
        if self._albedo is not None:
            callback.put("albedo", self._albedo, fixed)
        for name, value in self._values.items():
            callback.put(name, value, free if name in SCALES else fixed)
        sun = mi.ParamFlags.ReadOnly if self._moment else free
        callback.put("sun_direction", self._sun_direction, sun)
        for name, value in self._atmosphere_values.items():
            callback.put(name, value, fixed)
        callback.put("sky_radiance", self._sky_table, free)
        callback.put("sun_radiance", self._sun_table, free)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        mi.Emitter.parameters_changed(self, list(keys))
        for name in ("sun_scale", "sky_scale", "altitude"):
            settings.not_negative(name, float(_host(self._values[name])[0]))
        # Mitsuba cuts the names of nested objects at their dots ("g" for "mie.phase.g"), so an unknown key means: solve.
        if not keys or not set(keys) <= TABLES | SCALES:
            self._solve()
        else:
            self._use_tables()

    def _given(self, name: str) -> Any:
        """A value as the description has it: one number stays one number."""
        node: Any = self._atmosphere.to_dict()
        for key in name.split("."):
            node = node[int(key)] if isinstance(node, list) else node[key]
        return node

    def _albedo_values(self) -> Any:
        return None if self._albedo is None else albedo.values(self._albedo, self._atmosphere.wavelengths_nm)

    def _update_atmosphere(self) -> None:
        """Take over what was written into the exposed parameters since the last time."""
        now = {name: _host(value) for name, value in self._atmosphere_values.items()}
        changed = {name: value for name, value in now.items() if not np.array_equal(value, self._seen[name])}
        if changed:
            self._atmosphere = self._atmosphere.replace({n: float(v[0]) if len(v) == 1 else v.tolist() for n, v in changed.items()})
            self._seen, self._sky = now, None
        reflected = self._albedo_values()
        if reflected is not None and not np.array_equal(reflected, self._albedo_seen):
            self._atmosphere, self._sky = settings.with_albedo(self._atmosphere, reflected), None
        self._albedo_seen = reflected

    def _solve(self) -> None:
        """Solve the atmosphere if it changed, and the tables for the present altitude and sun."""
        self._update_atmosphere()
        if self._moment:
            found = {name: float(_host(self._values[name])[0]) for name in Moment.names()}
            local = mi.Vector3f(*settings.moment_direction(found)[0])
            self._sun_direction = dr.normalize(self._to_world @ local)
        else:
            settings.unit_vector("sun_direction", _host(self._sun_direction))
            local = dr.normalize(self._to_world.inverse() @ self._sun_direction)
        if dr.is_jit_v(mi.Float):
            dr.make_opaque(local, self._sun_direction)
        x, y, z = (float(v) for v in _host(local))
        across = math.hypot(x, y)
        heading = (x / across, y / across) if across > 1e-6 else (1.0, 0.0)
        self._sun, self._heading = local, (number(heading[0]), number(heading[1]))

        if self._sky is None:
            self._sky = Sky(self._atmosphere)
            self._channels = Channels(SpectralBasis.of(self._atmosphere))
        altitude = float(_host(self._values["altitude"])[0])
        self._view = Panorama.of(self._atmosphere.bottom_radius_m, self._atmosphere.thickness_m, altitude, math.atan2(across, z))
        self._sky_table = self._channels.tensor(solve_sky(self._sky, self._view), SKY_SHAPE)

        aperture = max(2.0 * self._atmosphere.sun_angular_radius_deg, settings.SMALLEST_SUN_DEG)
        self._disc = solve_disc(self._sky, self._view, math.radians(0.5 * aperture), self._limb_darkening)
        radiance = self._disc.brightness * self._atmosphere.solar_irradiance / self._disc.solid_angle
        self._sun_table = self._channels.tensor(list(np.moveaxis(radiance, -1, 0).reshape(radiance.shape[-1], -1)), SUN_SHAPE)
        self._use_tables()

    def _use_tables(self) -> None:
        """Look-ups and sampling densities for the present tables and scales."""
        for name, table, shape in (("sky_radiance", self._sky_table, SKY_SHAPE), ("sun_radiance", self._sun_table, SUN_SHAPE)):
            if tuple(table.shape[:2]) != shape:
                raise InputError(f"{name}: found a tensor of shape {tuple(table.shape)}; allowed: {shape} x channels")
        self._sky_texture, self._sun_texture = texture(self._sky_table), texture(self._sun_table)
        self._lookup = SkyLookup(self._view, self._channels.node_luminance(self._sky_table))
        self._disc_lookup = SunLookup(self._disc)
        sun = self._disc.mean * self._atmosphere.solar_irradiance
        luminance = float(SpectralBasis.of(self._atmosphere).xyz_matrix[1] @ sun)
        scales = [float(_host(self._values[name])[0]) for name in ("sun_scale", "sky_scale")]
        share = sun_share(max(luminance, 0.0) * scales[0], self._lookup.flux * scales[1], math.cos(self._view.sun_zenith))
        self._share, self._rest = number(share), number(1.0 - share)
        self._share_inverse, self._rest_inverse = number(1.0 / max(share, 1e-9)), number(1.0 / max(1.0 - share, 1e-9))

    # ---- radiance and density in the local frame

    def _local(self, d: Any) -> Any:
        return dr.normalize(self._to_world.inverse() @ d)

    def _where(self, d: Any) -> tuple[Any, Any, Any]:
        """Elevation above the horizon, place in the table, and squared distance from the sun's centre of a local direction."""
        hx, hy = self._heading
        a = self._lookup.elevation(d.z, dr.sqrt(dr.fma(d.x, d.x, d.y * d.y)))
        phi = dr.abs(dr.atan2(hx * d.y - hy * d.x, hx * d.x + hy * d.y))
        return a, self._lookup.place(a, phi), self._disc_lookup.distance2(d, self._sun)

    def _in_disc(self, distance2: Any, active: Any) -> Any:
        return active & (distance2 <= 1.0)

    def _radiance(self, where: tuple[Any, Any, Any], wavelengths: Any, active: Any) -> Any:
        a, place, distance2 = where
        at = self._lookup.node(a, place)
        covered = active & self._lookup.covers(a)
        sky = self._channels.read(self._sky_texture, at.x, at.y, wavelengths, covered) * _single(self._values["sky_scale"])
        seen = self._in_disc(distance2, active) & (a >= 0.0)
        x, y = self._disc_lookup.node(a, distance2)
        sun = self._channels.read(self._sun_texture, x, y, wavelengths, seen) * _single(self._values["sun_scale"])
        total = dr.select(covered, sky, 0.0) + dr.select(seen, sun, 0.0)
        return mi.depolarizer(dr.select(active, total, 0.0))

    def _density(self, where: tuple[Any, Any, Any], active: Any) -> Any:
        a, place, distance2 = where
        sun = dr.select(self._in_disc(distance2, active), self._disc_lookup.density, 0.0)
        sky = dr.select(self._lookup.covers(a), self._lookup.pdf(a, place, active), 0.0)
        pdf = dr.fma(self._share, sun, self._rest * sky)
        return dr.select(active, pdf, 0.0)

    def _sample(self, sample: Any, active: Any) -> Any:
        """A local direction: of the sun's disc with probability ``share``, else of the sky."""
        last = 1.0 - 2.0**-24
        pick = sample.x < self._share
        first = mi.Point2f(dr.minimum(sample.x * self._share_inverse, last), sample.y)
        second = mi.Point2f(dr.clip((sample.x - self._share) * self._rest_inverse, 0.0, last), sample.y)
        z, phi = self._lookup.sample(second, active & ~pick if dr.is_jit_v(mi.Float) else active)
        across = dr.safe_sqrt(dr.fma(-z, z, 1.0))
        sin, cos = dr.sincos(phi)
        hx, hy = self._heading
        sky = mi.Vector3f(across * (cos * hx - sin * hy), across * (cos * hy + sin * hx), z)
        return dr.normalize(dr.select(pick, self._disc_lookup.sample(first, self._sun), sky))

    # ---- Mitsuba's interface

    def eval(self, si: Any, active: Any = True) -> Any:
        return self._radiance(self._where(self._local(-si.wi)), si.wavelengths, active)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return self._radiance(self._where(self._local(ds.d)), it.wavelengths, active)

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return self._density(self._where(self._local(ds.d)), active)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        local = self._sample(sample, active)
        where = self._where(local)
        d = dr.normalize(self._to_world @ local)
        ds = mi.DirectionSample3f()
        ds.d, ds.n = d, -d
        ds.dist = FAR
        ds.p = dr.fma(d, FAR, it.p)
        ds.uv, ds.time = sample, it.time
        ds.delta = False
        ds.pdf = self._density(where, active)
        ds.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
        weight = dr.select(ds.pdf > 0.0, 1.0 / ds.pdf, 0.0) if dr.is_jit_v(mi.Float) else (1.0 / ds.pdf if ds.pdf > 0.0 else 0.0)
        return ds, self._radiance(where, it.wavelengths, active) * weight

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> tuple[Any, Any]:
        local = self._sample(sample3, active)
        where = self._where(local)
        d = -dr.normalize(self._to_world @ local)
        wavelengths, weight = self._sample_wavelengths(sample1)
        centre, radius = bounds.sphere(self._scene)
        offset = mi.warp.square_to_uniform_disk_concentric(sample2)
        origin = centre + (mi.Frame3f(d).to_world(mi.Vector3f(offset.x, offset.y, 0.0)) - d) * radius
        pdf = self._density(where, active) / (dr.pi * radius**2)
        return mi.Ray3f(origin, d, time, wavelengths), self._radiance(where, wavelengths, active) * weight / pdf

    def sample_wavelengths(self, si: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        wavelengths, weight = self._sample_wavelengths(sample)
        return wavelengths, self._radiance(self._where(self._local(-si.wi)), wavelengths, active) * weight

    def _sample_wavelengths(self, sample: Any) -> tuple[Any, Any]:
        """Wavelengths in proportion to what they matter for sRGB, and 1 / density; nothing to choose outside of spectral variants."""
        if not mi.is_spectral:
            return [], 1.0
        shifted = mi.UnpolarizedSpectrum(0.0)
        for i in range(len(shifted)):
            shifted[i] = sample + i / len(shifted)
            shifted[i] -= dr.floor(shifted[i])
        wavelengths, weight = mi.sample_rgb_spectrum(shifted)
        return wavelengths, mi.depolarizer(weight) if mi.is_polarized else weight

    def set_scene(self, scene: Any) -> None:
        """Tell the emitter the scene that particles are traced in (see the section on sampling)."""
        self._scene = scene

    def sample_position(self, time: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        if not dr.is_jit_v(mi.Float):
            raise NotImplementedError("atmosphere: an emitter at infinity has no positions")
        # Recorded by virtual function calls without being used: no error there, as in Mitsuba's own environment emitters.
        return dr.zeros(mi.PositionSample3f), mi.Float(dr.nan)

    def bbox(self) -> Any:
        """Invalid: the emitter is nowhere in particular."""
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        sun = ", ".join(f"{v:.4f}" for v in _host(self._sun_direction))
        rows = [f"sun_direction = [{sun}]", f"elevation = {90.0 - math.degrees(self._view.sun_zenith):.3f} degrees"]
        rows += [f"{name} = {float(_host(self._values[name])[0]):g}" for name in ("altitude", "sun_scale", "sky_scale")]
        nm = ", ".join(f"{w:g}" for w in self._atmosphere.wavelengths_nm[:8])
        more = ", ..." if len(self._atmosphere.wavelengths_nm) > 8 else ""
        return "AtmosphereEmitter[\n  " + ",\n  ".join([*rows, f"wavelengths_nm = [{nm}{more}]"]) + "\n]"


def _array(value: Any) -> Any:
    """An exposed parameter: numbers in an array type that ``mi.traverse`` can write to in every variant."""
    kind = mi.Float if dr.is_jit_v(mi.Float) else dr.scalar.ArrayXf
    return kind([float(v) for v in np.atleast_1d(np.asarray(value, dtype=np.float64))])


def _host(value: Any) -> np.ndarray:
    """The values of a parameter as a flat float64 array."""
    return np.array(dr.detach(value), dtype=np.float64).ravel()


def _single(value: Any) -> Any:
    """An exposed number in the variant's Float."""
    return value if dr.is_jit_v(mi.Float) else value[0]
