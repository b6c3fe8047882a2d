"""What shapes keep from the air of a scene, for the integrator ``atmosphere_path``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.solved import Sky

from .airlight import Airlight, Stretch
from .exposed import parameters_of, same
from .hidden_light import PASSES, HiddenLight
from .lattice import Lattice
from .open_sky import OpenSky
from .shadow_volume import shadowed_interval
from .skylight import Skylight

# Shapes lie in valleys at most this deep (m): below it the planet's ground hides them.
DEEPEST_M = 500.0
LEAST_DEPTH = 1e-3  # optical depth of the box around all shapes: shadows in thinner air are not looked for
# Of a segment's light, that shapes may hide in one sample: those that weigh most would leave black specks. A bound of
# 1 would make shadows too bright.
MOST_HIDDEN = 2.0


class ShadedAir:
    """Of light that has at most so many ``orders`` (None: no limit)."""

    def __init__(self, orders: int | None) -> None:
        self._orders = orders
        self._held: tuple[Any, ...] = None, None, None  # air, shapes, and what they hide
        self._lattice: tuple[Any, ...] = None, None, None  # globe, shapes, and the nodes

    def matters(self, scene: Any, air: Airlight) -> bool:
        """Whether the shadows of shapes matter to the air."""
        box = scene.bbox()
        across = float(np.linalg.norm(np.array(box.max) - np.array(box.min))) / air.globe.scale if box.valid() else 0.0
        return across * air.densest > LEAST_DEPTH

    def later_orders(self, scene: Any, air: Airlight, *, skies: bool = True) -> HiddenLight | None:
        """What shapes keep of order 2 and more, made again where the air or the shapes changed; ``skies``: with skies
        solved for few orders where orders are limited."""
        if None in air.sources:
            return None
        shapes = parameters_of(scene.shapes())
        if self._held[0] is not air or not same(self._held[1], shapes):
            with dr.suspend_grad():
                self._held = air, shapes, self._anew(scene, air, shapes, skies)
        return self._held[2]

    def _anew(self, scene: Any, air: Airlight, shapes: list[Any], skies: bool) -> HiddenLight | None:
        sun = np.array(air.sun, dtype=np.float64).ravel()
        # Both ends of a derivative have the same nodes.
        if self._lattice[0] is not air.globe or not same(self._lattice[1], shapes):
            lattice = Lattice(scene, air.globe, DEEPEST_M, sun, 1.0 / air.densest, air.count)
            self._lattice = air.globe, shapes, lattice
        lattice = self._lattice[2]
        if not lattice.found:
            return None
        most, solved = None, [air.sky]
        if self._orders is not None:
            most = self._orders - 1
            if skies:
                # Light that a shape hides has been scattered less often than all that the field may hold.
                solved = [Sky(air.sky.atmosphere, n) for n in range(most, max(most - PASSES, 0), -1)]
        return HiddenLight(scene, air, lattice, OpenSky(solved, air.globe, scene.bbox(), sun), most)


def inscatter(
    scene: Any,
    sampler: Any,
    ray: Any,
    part: Stretch,
    light: Skylight,
    air: Airlight,
    hidden: HiddenLight | None,
    samples: int,
    active: Any,
) -> list[Any]:
    """What the air of a segment scatters, less what shapes keep from it (W); ``samples``: points at which it is asked
    whether they see the sun, at most."""
    toward = light.toward_sun(sampler.next_2d(active))
    start, end = shadowed_interval(scene.bbox(), toward, ray, dr.select(active, part.distance, 0.0))
    sample = sampler.next_1d(active)
    missing = air.shade(part, start, end, sample, samples, lambda d: lit(scene, ray(d), toward, active))
    if hidden is not None:
        later = hidden.missing(ray, part, sampler, active)
        missing = [a + b for a, b in zip(missing, later, strict=True)]
    return [a - dr.minimum(b, MOST_HIDDEN * a) for a, b in zip(part.light, missing, strict=True)]


def lit(scene: Any, p: Any, toward: Any, active: Any) -> Any:
    """1 where no shape is between a point of the air and the sun, else 0."""
    return dr.select(scene.ray_test(mi.Ray3f(p, toward), active), 0.0, 1.0)
