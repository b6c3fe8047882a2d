"""The integrator plugin ``atmosphere_volpath``: paths of light through the air of one planet."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from atmo_jit.errors import AtmosphereError, shown

from .flight import Airway, flight
from .guide import Guide

CANDIDATES = 4
# What light at a surface is worth beside light that scatters before it, for the choice between the two: a white
# surface sends 1/pi of it in every direction, air 1/(4 pi). Any positive numbers leave the mean as it is.
LAMBERTIAN, LOBE_WORTH, BLACK_WORTH = 4.0, 1.0, 0.1


class AtmosphereVolpath:
    """
    .. _integrator-atmosphere_volpath:

    Volumetric path tracer for air (:monosp:`atmosphere_volpath`)
    -------------------------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - As for ``volpath``: 1 = light seen directly, 2 = scattered once; -1 = no limit. (Default: -1)

     * - rr_depth
       - |int|
       - From this depth on, paths that carry little light are ended by chance. (Default: 2)

     * - hide_emitters
       - |bool|
       - Leave out light seen directly. (Default: false)

    Renders scenes in one :ref:`atmosphere_medium <medium-atmosphere_medium>`, which the sensor or a shape names. The
    mean is that of ``volpath``, without bias; the noise at equal time is a fraction of it:

    - A flight always scatters in the air unless a surface ends it, and there with a probability in proportion to what
      either is worth; light that would fly out unscattered costs no path.
    - Points of scattering are drawn in proportion to transmittance times scattering of all wavelengths of the path
      together, and transmittance is integrated instead of estimated (:mod:`.flight`).
    - The sun is connected to from every point.

    Surfaces may have any BSDF and light sources may be of any kind; ``null`` surfaces and other media are not
    supported: ``volpath`` renders those. Vectorised, unpolarised variants only.

    .. tabs::
        .. code-tab:: xml
            :name: atmosphere-volpath

            <integrator type="atmosphere_volpath"/>

        .. code-tab:: python

            'type': 'atmosphere_volpath'
    """

    def __init__(self, props: Any) -> None:
        mi.SamplingIntegrator.__init__(self, props)
        if not dr.is_jit_v(mi.Float) or mi.is_polarized:
            raise AtmosphereError("variant", mi.variant(), "an llvm_ad_* or cuda_ad_* variant that is not polarised")
        self.max_depth = int(props.get("max_depth", -1))
        if self.max_depth < -1:
            raise AtmosphereError("max_depth", shown(self.max_depth), "a whole number >= 0, or -1 for no limit")
        self.rr_depth = int(props.get("rr_depth", 2))
        self.guided = bool(props.get("guided", False))
        self._guide, self._guide_key = None, None
        self.hide_emitters = bool(props.get("hide_emitters", False))

    @dr.syntax
    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> tuple[Any, Any, list[Any]]:
        air_medium = medium_of(scene, medium)
        air, phase = air_medium.air, air_medium.phase_function()
        guide = self._guide_of(scene, air)
        context, bsdf_context = mi.PhaseFunctionContext(sampler), mi.BSDFContext()
        most = mi.UInt32(0xFFFFFFFF if self.max_depth < 0 else self.max_depth)

        ray = mi.Ray3f(dr.detach(ray))
        way = Airway(air, ray)
        depth = mi.UInt32(0)
        result = mi.UnpolarizedSpectrum(0.0)
        worth = mi.UnpolarizedSpectrum(1.0)  # of light that arrives along the ray
        first = mi.Float(1.0)
        active = mi.Bool(active)
        seen = mi.Bool(False)
        last = dr.zeros(mi.Interaction3f)
        last_pdf = mi.Float(1.0)
        alone = mi.Bool(True)  # light met by chance is not also connected to

        while dr.hint(active, label="atmosphere_volpath"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
            surface = active & si.is_valid()
            f = flight(air, ray, dr.select(surface, si.t, dr.inf))
            guided = guide.along(way, f, ray) if guide is not None else None
            fly = way.fly(f, worth, sampler.next_1d(active), sampler.next_1d(active), guided)

            # What shines at the end of the flight.
            emitter = si.emitter(scene, active)
            ds = mi.DirectionSample3f(scene, si, last)
            shines = active & (emitter != None)  # noqa: E711
            if dr.hint(self.hide_emitters, mode="scalar"):
                shines &= depth > 0
            chance = scene.pdf_emitter_direction(last, ds, shines & ~alone)
            share = dr.select(alone, 1.0, mis_weight(last_pdf, chance))
            emitted = unpolarized(emitter.eval(si, shines))
            result += dr.select(shines & ~f.shadowed, worth * fly.transmittance * emitted * share, 0.0)

            # Scatter in the air or fly on to the surface.
            active &= depth + 1 < most
            bsdf = si.bsdf()
            reflectance = unpolarized(bsdf.eval_diffuse_reflectance(si, surface))
            reflectance = dr.maximum(LAMBERTIAN * reflectance, dr.select(has_lobe(bsdf), LOBE_WORTH, BLACK_WORTH))
            if dr.hint(guide is not None, mode="scalar"):
                reflectance *= guide.irradiance(ray, si.p) * (0.25 * dr.inv_pi)
            behind = dr.select(surface, dr.mean(worth * fly.transmittance * reflectance), 0.0)
            here = fly.total * (1.0 / len(worth))
            probability = dr.select(here > 0.0, here / (here + behind), 0.0)
            in_air = active & (sampler.next_1d(active) < probability)
            on_surface = active & surface & ~in_air
            active &= in_air | on_surface
            worth *= dr.select(
                in_air, fly.weight / probability, fly.transmittance / dr.maximum(1.0 - probability, 1e-7)
            )

            mei = dr.zeros(mi.MediumInteraction3f)
            mei.t = (f.start + fly.distance) * air.scale
            mei.p, mei.wi, mei.time = ray(mei.t), -ray.d, ray.time
            mei.wavelengths, mei.sh_frame = ray.wavelengths, mi.Frame3f(mei.wi)
            point = dr.zeros(mi.Interaction3f)
            point.t, point.time, point.wavelengths = dr.select(in_air, mei.t, si.t), ray.time, ray.wavelengths
            point.p, point.n = dr.select(in_air, mei.p, si.p), dr.select(in_air, mi.Normal3f(0.0), si.n)

            # Connect to a light.
            smooth = on_surface & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            connects = in_air | smooth
            ds, light = scene.sample_emitter_direction(point, sampler.next_2d(connects), False, connects)
            # A point that touches a lamp has a density of infinity or none.
            connects &= (ds.pdf > 0.0) & dr.isfinite(ds.pdf) & dr.isfinite(dr.sum(unpolarized(light)))
            toward = point.spawn_ray_to(ds.p)
            connects &= ~scene.ray_test(toward, connects)
            beam = flight(air, toward, dr.select(connects, toward.maxt, 0.0))
            connects &= ~beam.shadowed
            between = way.transmittance(beam)
            phase_value, phase_pdf = phase.eval_pdf(context, mei, ds.d, in_air & connects)
            bsdf_value, bsdf_pdf = bsdf.eval_pdf(bsdf_context, si, si.to_local(ds.d), smooth & connects)
            value = dr.select(in_air, unpolarized(phase_value), unpolarized(bsdf_value))
            pdf = dr.select(ds.delta, 0.0, dr.select(in_air, phase_pdf, bsdf_pdf))
            gain = worth * value * between * unpolarized(light) * mis_weight(ds.pdf, pdf)
            result += dr.select(connects, gain, 0.0)

            # Go on.
            seen |= active
            wo, phase_weight, phase_pdf = self._scatter(guide, phase, context, mei, sampler, in_air)
            bs, bsdf_weight = bsdf.sample(
                bsdf_context, si, sampler.next_1d(on_surface), sampler.next_2d(on_surface), on_surface
            )
            worth *= dr.select(in_air, unpolarized(phase_weight), unpolarized(bsdf_weight))
            last_pdf = dr.select(in_air, phase_pdf, bs.pdf)
            alone = on_surface & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            direction = dr.select(in_air, wo, si.to_world(bs.wo))
            ray = point.spawn_ray(direction)
            last = point
            depth += 1
            largest = dr.max(worth)
            first = dr.select(depth == 1, largest, first)
            survives = dr.minimum(largest / first, 1.0)
            ends = depth >= self.rr_depth
            active &= (largest > 0.0) & (~ends | (sampler.next_1d(active) < survives))
            worth *= dr.select(ends, 1.0 / dr.maximum(survives, 1e-12), 1.0)

        return mi.Spectrum(result), seen, []

    def _guide_of(self, scene: Any, air: Any) -> Any:
        """The guide, where one is wanted."""
        if not self.guided:
            return None
        suns = [e for e in scene.emitters() if hasattr(e, "sun_vector")]
        if len(suns) != 1:
            raise AtmosphereError("guided", f"true with {len(suns)} suns", "true with one sun of planet()")
        sun = suns[0].sun_vector
        if self._guide is None or self._guide_key != (id(air), id(air.majorants), tuple(sun)):
            self._guide, self._guide_key = Guide(air, sun), (id(air), id(air.majorants), tuple(sun))
        return self._guide

    def _scatter(
        self, guide: Any, phase: Any, context: Any, mei: Any, sampler: Any, active: Any
    ) -> tuple[Any, Any, Any]:
        """Direction, weight and density of the phase function; with a guide the best of CANDIDATES such directions.

        Resampled importance sampling (Talbot et al. 2005): one of them is taken in proportion to what arrives from
        there, and weighted by the mean over that of the one taken."""
        wo, weight, pdf = phase.sample(context, mei, sampler.next_1d(active), sampler.next_2d(active), active)
        if guide is None:
            return wo, weight, pdf
        row = guide.air.wavelengths.row(mei)
        place = guide.here(mei.p)
        arriving = guide.radiance(row, *place, wo)
        total = arriving * dr.mean(unpolarized(weight))
        for _ in range(1, CANDIDATES):
            other, other_weight, other_pdf = phase.sample(
                context, mei, sampler.next_1d(active), sampler.next_2d(active), active
            )
            found = guide.radiance(row, *place, other)
            share = found * dr.mean(unpolarized(other_weight))
            total += share
            take = sampler.next_1d(active) * total < share
            wo, weight, pdf = (
                dr.select(take, other, wo),
                dr.select(take, other_weight, weight),
                dr.select(take, other_pdf, pdf),
            )
            arriving = dr.select(take, found, arriving)
        factor = total * (1.0 / CANDIDATES) / (arriving * dr.mean(unpolarized(weight)))
        return wo, weight * dr.select(active, factor, 0.0), pdf

    def to_string(self) -> str:
        return f"AtmosphereVolpath[max_depth = {self.max_depth}, guided = {self.guided}]"


def has_lobe(bsdf: Any) -> Any:
    """Whether a BSDF does more than what its diffuse reflectance says."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)


def unpolarized(value: Any) -> Any:
    """A spectrum as an unpolarised one."""
    return mi.UnpolarizedSpectrum(value)


def mis_weight(own: Any, other: Any) -> Any:
    """Balance heuristic (Veach 1997, eq. 9.8)."""
    return dr.select(own > 0.0, own / (own + other), 0.0)


def medium_of(scene: Any, medium: Any) -> Any:
    """The ``atmosphere_medium`` of a scene: ``medium``, in which the sensor is, or that of a shape."""
    found = [medium] if medium is not None else []
    for shape in scene.shapes():
        found += [m for m in (shape.interior_medium(), shape.exterior_medium()) if m is not None]
    air = {id(m): m for m in found if hasattr(m, "air")}
    if len(air) != 1 or len(air) != len({id(m) for m in found}):
        text = f"{len(air)} media atmosphere_medium and {len({id(m) for m in found}) - len(air)} others"
        raise AtmosphereError("medium", text, "one atmosphere_medium, of the sensor or of a shape")
    return next(iter(air.values()))
