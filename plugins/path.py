"""The integrator plugin ``atmosphere_path``: surfaces in the light of sun and sky, with air in between."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import AtmosphereError, InputError, shown
from atmo_jit.solved import Sky

from . import settings
from .airlight import Airlight
from .colours import Colours
from .exposed_atmosphere import ExposedAtmosphere
from .followed import FollowedPictures
from .globe import Globe
from .near_ground import near_ground
from .shaded import DEEPEST_M, ShadedAir, inscatter, lit
from .skylight import Skylight
from .volpath import mis_weight, unpolarized

SKY_SHARE = 0.5  # of the directions at a surface that are drawn from the sky instead of the BSDF
AOVS = ("inscatter", "transmittance")


class AtmospherePath(FollowedPictures):
    """
    .. _integrator-atmosphere_path:

    Path tracer with aerial perspective (:monosp:`atmosphere_path`)
    ---------------------------------------------------------------

    .. pluginparameters::

     * - atmosphere
       - |string|
       - The atmosphere: a preset, the name of a JSON file, or the JSON text itself. Values of the atmosphere may be
         replaced by their dotted names and described at other ``wavelengths``, as for the emitter. (Default:
         that of the scene's emitter ``atmosphere``)
     - |exposed|, |differentiable|, all its numbers, where it is given here

     * - center
       - |point|
       - Centre of the planet in scene units. (Default: so that the scene's origin is at the emitter's ``altitude``)

     * - scale
       - |float|
       - Scene units per metre. (Default: 1)

     * - max_depth
       - |int|
       - As for ``path``: 1 = what is seen directly, 2 = one reflection by a surface; -1 = no limit. Light that the air
         scatters has all orders whatever this is. (Default: -1)

     * - rr_depth
       - |int|
       - From this depth on, paths that carry little light are ended by chance. (Default: 5)

     * - hide_emitters
       - |bool|
       - Leave out what is behind all shapes: sky, sun, the planet's ground. (Default: false)

     * - orders
       - |int|
       - How often light is scattered in the air or reflected by the planet's ground, at most. (Default: no limit)

     * - shaft_samples
       - |int|
       - Points of each segment, at most, at which it is found out whether shapes keep the sun from the air: shafts of
         light and shadow. 0 leaves them out, and with them all that shapes keep from the air. (Default: 8)

     * - aovs
       - |string|
       - ``inscatter``, ``transmittance`` or both, separated by a comma: light scattered into the camera's ray by the
         air in front of what it meets, and the transmittance of that air (of white sunlight). (Default: none)

    Renders any scene that has one emitter :ref:`atmosphere <emitter-atmosphere>`. Surfaces are lit by the sun, by the
    sky as it is at their own place and altitude, by each other and by the scene's other lamps; on the way from each
    surface to the next, and to the camera, the air takes its part of the light and adds what it scatters. That is
    integrated along every segment (never a difference of two look-ups), less the sunlight that shapes keep from it:
    where a segment may be in the shadow of the box around all shapes, rays to the sun are traced from some of its
    points, more where it scatters more. Scenes too small for that to matter skip it. Light of higher orders
    that shapes keep from the air, less what their surfaces add, is a table that is made once, with 4.1 million rays
    from 16 thousand points among, above and beside the shapes; it is made again when air or shapes change. Pictures
    have no noise from it, but a bias close to shapes that hide most of the light (docs/method.md, docs/gallery.md).
    Two things in it are simplified: surfaces count as diffuse, and of the sky they see what their slope leaves of it,
    whatever else is in the way.

    Behind the shapes is the planet's own ground, with the atmosphere's ``ground_albedo``, on which shapes cast shadows
    of the sun (but do not occlude the sky). Cameras may be in the air or in space.

    **Derivatives.** A picture follows every number of the atmosphere but the two radii, and the emitter's ``sun_scale``
    and ``sky_scale``, through ``mi.render(scene, params)`` with ``dr.forward`` and ``dr.backward``. Each number takes
    two more pictures, of the same paths in air a little before and after it; in reverse too. Reflectances, shapes and
    the sun's place are refused.

    Reflectances are colours, air is a matter of wavelengths: each path carries one factor for every channel and one
    for every wavelength, and the picture is what the rule of the emitter makes of both. Vectorised, unpolarised
    variants only. Media, and ``null`` surfaces with them, are not supported.

    .. tabs::
        .. code-tab:: xml
            :name: atmosphere-path

            <integrator type="atmosphere_path">
                <integer name="max_depth" value="6"/>
            </integrator>

        .. code-tab:: python

            'type': 'atmosphere_path',
            'max_depth': 6
    """

    def __init__(self, props: Any) -> None:
        mi.SamplingIntegrator.__init__(self, props)
        if not dr.is_jit_v(mi.Float) or mi.is_polarized:
            raise AtmosphereError("variant", mi.variant(), "an llvm_ad_* or cuda_ad_* variant that is not polarised")
        self.max_depth, self.rr_depth = int(props.get("max_depth", -1)), int(props.get("rr_depth", 5))
        if self.max_depth < -1:
            raise AtmosphereError("max_depth", shown(self.max_depth), "a whole number >= 0, or -1 for no limit")
        self.hide_emitters = bool(props.get("hide_emitters", False))
        self.shaft_samples = int(props.get("shaft_samples", 8))
        if self.shaft_samples < 0:
            raise AtmosphereError("shaft_samples", shown(self.shaft_samples), "a whole number >= 0")
        self.scale = settings.number(props, "scale", 1.0)
        if self.scale <= 0.0:
            raise AtmosphereError("scale", shown(self.scale), "a number > 0")
        self.center = np.array(props["center"], dtype=np.float64) if "center" in props else None
        self.orders = int(props["orders"]) if "orders" in props else None
        self.exposed: ExposedAtmosphere | None = None  # of its own
        if "atmosphere" in props:
            found = settings.described(props, lambda name: str(mi.file_resolver().resolve(name)))
            self.exposed = ExposedAtmosphere(found)
        self.aovs = [name.strip() for name in str(props.get("aovs", "")).split(",") if name.strip()]
        for name in self.aovs:
            if name not in AOVS:
                raise AtmosphereError("aovs", shown(name), f"{' and '.join(AOVS)}, separated by a comma")
        self._held: tuple[Any, ...] | None = None
        self._shaded = ShadedAir(self.orders)

    # ---- parameters

    def traverse(self, callback: Any) -> None:
        mi.SamplingIntegrator.traverse(self, callback)
        if self.exposed is not None:
            self.exposed.traverse(callback)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        mi.SamplingIntegrator.parameters_changed(self, list(keys))
        if self.exposed is not None and self.exposed.update():
            self._held = None

    # ---- light

    def aov_names(self) -> list[str]:
        count = len(mi.UnpolarizedSpectrum(0.0))
        letters = "RGB" if mi.is_rgb else [str(i) for i in range(count)]
        return [f"{name}.{letter}" for name in self.aovs for letter in letters[:count]]

    @dr.syntax
    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> tuple[Any, Any, list[Any]]:
        light, air, colours = self._parts(scene)
        shades = self.shaft_samples > 0 and self._shaded.matters(scene, air)
        hidden = self._shaded.later_orders(scene, air, skies=self._moving is None) if shades else None
        lamps = [e for e in scene.emitters() if e is not light.emitter]
        lamp_list = light.pointers(lamps)
        context = mi.BSDFContext()
        most = mi.UInt32(0xFFFFFFFF if self.max_depth < 0 else self.max_depth)

        # Cameras do not see beyond their far_clip, but skies end nowhere.
        ray = mi.Ray3f(dr.detach(ray.o), dr.detach(ray.d), ray.time, ray.wavelengths)
        depth = mi.UInt32(0)
        result = mi.UnpolarizedSpectrum(0.0)
        reflected = mi.UnpolarizedSpectrum(1.0)  # by the surfaces of the path, for each channel
        passed = [mi.Float(1.0) for _ in range(air.count)]  # the air of the path, for each wavelength
        active = mi.Bool(active)
        seen = mi.Bool(False)
        last_pdf = mi.Float(1.0)
        alone = mi.Bool(True)  # light met by chance is not also connected to
        last = dr.zeros(mi.Interaction3f)
        first_light = mi.UnpolarizedSpectrum(0.0)
        first_passed = mi.UnpolarizedSpectrum(1.0)

        while dr.hint(active, label="atmosphere_path"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
            surface = active & si.is_valid() & (air.globe.altitude(si.p) > -DEEPEST_M)
            part = air.along(ray, dr.select(surface, si.t, dr.inf))
            shows = active & (surface | (depth > 0) | ~mi.Bool(self.hide_emitters))

            grounded = active & part.ground & ~surface
            scattered = part.light
            if dr.hint(shades, mode="scalar"):
                scattered = inscatter(scene, sampler, ray, part, light, air, hidden, self.shaft_samples, active)
            sun_seen = lit(scene, ray(part.distance), light.toward_sun(sampler.next_2d(grounded)), grounded)
            disc = light.sun_pdf(ray.d) * dr.select(alone, 1.0, mis_weight(last_pdf, light.sun_pdf(ray.d)))
            disc = dr.select(active & ~surface & ~grounded, disc * light.sun_squeeze, 0.0)
            ground = air.on_ground(ray(part.distance), sun_seen)
            arriving = light.sum(passed, scattered, part.transmittance, ground, grounded, disc)
            result += dr.select(shows, reflected * colours.of(arriving, ray.wavelengths), 0.0)
            seen |= shows
            passed = products(passed, part.transmittance)
            if dr.hint(len(self.aovs) > 0, mode="scalar"):
                start = depth == 0
                first_light = dr.select(start, colours.of(scattered, ray.wavelengths), first_light)
                first_passed = dr.select(start, colours.white(part.transmittance, ray.wavelengths), first_passed)

            # Lamps that the ray meets.
            white = colours.white(passed, ray.wavelengths)
            if dr.hint(len(lamps) > 0, mode="scalar"):
                emitter = si.emitter(scene, active)
                shines = shows & light.is_lamp(emitter) & (surface | ~si.is_valid())
                ds = mi.DirectionSample3f(scene, si, last)
                chance = emitter.pdf_direction(last, ds, shines & ~alone) * (1.0 / len(lamps))
                share = dr.select(alone, 1.0, mis_weight(last_pdf, chance))
                emitted = unpolarized(emitter.eval(si, shines))
                result += dr.select(shines, reflected * white * emitted * share, 0.0)

            # At the surface: the sun and one lamp.
            active = surface & (depth + 1 < most)
            bsdf = si.bsdf(ray)
            smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            toward = light.toward_sun(sampler.next_2d(smooth))
            facing = smooth & ~scene.ray_test(si.spawn_ray(toward), smooth)
            wo = si.to_local(toward)
            value, pdf = bsdf.eval_pdf(context, si, wo, facing)
            mixed = light.mixed_pdf(pdf, toward)
            weight = mis_weight(light.sun_density, mixed) * light.sun_scale * light.sun_squeeze
            sunlight = colours.of(products(air.sunlight(si.p, toward), passed), ray.wavelengths)
            gain = reflected * unpolarized(value) * sunlight * weight
            result += dr.select(facing, gain, 0.0)
            if dr.hint(len(lamps) > 0, mode="scalar"):
                chosen = dr.minimum(mi.UInt32(sampler.next_1d(smooth) * len(lamps)), len(lamps) - 1)
                lamp = dr.gather(mi.EmitterPtr, lamp_list, chosen, smooth)
                ds, radiance = lamp.sample_direction(si, sampler.next_2d(smooth), smooth)
                connects = smooth & (ds.pdf > 0.0) & dr.isfinite(ds.pdf)
                connects &= ~scene.ray_test(si.spawn_ray_to(ds.p), connects)
                value, pdf = bsdf.eval_pdf(context, si, si.to_local(ds.d), connects)
                other = dr.select(ds.delta, 0.0, light.mixed_pdf(pdf, ds.d))
                radiance = unpolarized(radiance) * mis_weight(ds.pdf * (1.0 / len(lamps)), other) * len(lamps)
                result += dr.select(connects, reflected * white * unpolarized(value) * radiance, 0.0)

            # Go on, to where the BSDF or the sky says.
            bs, bsdf_weight = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
            by_sky = smooth & (sampler.next_1d(active) < SKY_SHARE)
            delta = ~by_sky & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            d = dr.select(by_sky, light.sample_sky(sampler.next_2d(active), by_sky), si.to_world(bs.wo))
            value, pdf = bsdf.eval_pdf(context, si, si.to_local(d), smooth & ~delta)
            last_pdf = light.mixed_pdf(pdf, d)
            chosen_weight = dr.select(
                delta,
                unpolarized(bsdf_weight) * dr.select(smooth, 1.0 / (1.0 - SKY_SHARE), 1.0),
                dr.select(last_pdf > 0.0, unpolarized(value) / last_pdf, 0.0),
            )
            # A BSDF without smooth part that drew no delta has drawn nothing.
            reflected *= chosen_weight
            alone = delta
            ray = si.spawn_ray(d)
            last = mi.Interaction3f(si)
            depth += 1
            carried = dr.max(reflected) * dr.max(dr.abs(colours.white(passed, ray.wavelengths)))
            active &= dr.max(reflected) > 0.0
            ends = depth >= self.rr_depth
            survives = dr.minimum(carried, 0.95)
            active &= ~ends | (sampler.next_1d(active) < survives)
            reflected *= dr.select(ends, 1.0 / dr.maximum(survives, 1e-12), 1.0)

        aovs = []
        for name in self.aovs:
            values = first_light if name == "inscatter" else first_passed
            aovs += [values[i] for i in range(len(values))]
        return mi.Spectrum(result), seen, aovs

    def _parts(self, scene: Any) -> tuple[Skylight, Airlight, Colours]:
        """The light of the scene's emitter, its air and the colours of both, made again where the emitter changed."""
        if self._moving is not None:
            return self._moving
        emitter = self._emitter(scene)
        key = id(emitter), id(emitter.sky_light), id(emitter.sky)
        if self._held is None or self._held[0] != key:
            sky = emitter.sky
            air = self.exposed.atmosphere if self.exposed else sky.atmosphere
            resolution = near_ground(air)
            if self.exposed is not None or self.orders is not None or resolution != sky.resolution:
                sky = Sky(air, self.orders, resolution=resolution)
            self._held = key, emitter, self._made(emitter, sky)  # the emitter, so that no other gets its id
        self._held[2][0].refresh()
        return self._held[2]

    def _emitter(self, scene: Any) -> Any:
        found = [e for e in scene.emitters() if hasattr(e, "sky_light")]
        if len(found) != 1:
            raise InputError(f"atmosphere_path: the scene has {len(found)} emitters of type atmosphere; must be one")
        return found[0]

    def _made(self, emitter: Any, sky: Sky) -> tuple[Skylight, Airlight, Colours]:
        center = self.center
        if center is None:
            distance = sky.atmosphere.bottom_radius_m + emitter.altitude_m
            center = -distance * self.scale * emitter.up
        air = Airlight(sky, Globe(sky.atmosphere, center, self.scale), emitter.sun)
        return Skylight(emitter, air.solar, SKY_SHARE), air, Colours(sky.atmosphere)

    def to_string(self) -> str:
        return f"AtmospherePath[max_depth = {self.max_depth}, shaft_samples = {self.shaft_samples}]"


def products(one: list[Any], other: list[Any]) -> list[Any]:
    """Wavelength by wavelength."""
    return [a * b for a, b in zip(one, other, strict=True)]
