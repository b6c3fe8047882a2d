"""Derivatives of pictures by the numbers of their atmosphere, for the integrator ``atmosphere_path``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.errors import InputError

from .airlight import Airlight
from .colours import Colours
from .exposed import array, host
from .linearized import Changes, LinearizedSky, unit_changes
from .skylight import Skylight

SCALES = ("sun_scale", "sky_scale")
TABLES = ("sky_radiance", "sun_radiance")  # of the emitter; they say here only where to look for light


class FollowedPictures:
    """What an integrator needs to be differentiated: it takes its light from ``_moving`` where that is not None."""

    _solved: LinearizedSky | None = None
    _moving: tuple[Skylight, Airlight, Colours] | None = None  # while a derivative is rendered

    def _followed(self, scene: Any, params: Any) -> dict[str, Any]:
        """The numbers by which derivatives are wanted. Raises InputError if some are wanted by anything else."""
        emitter = self._emitter(scene)
        found = (self.exposed or emitter.exposed).followed() | emitter.followed_scales
        allowed = {value.index_ad for value in found.values()}
        for key, value in params or ():
            if key.rpartition(".")[2] in TABLES or not (dr.is_diff_v(value) and dr.grad_enabled(value)):
                continue
            if getattr(value, "index_ad", None) not in allowed:
                raise InputError(f"{key}: atmosphere_path has no derivatives by it, only by the atmosphere's values")
        return found

    def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
        changes = {name: host(dr.grad(value)) for name, value in self._followed(scene, params).items()}
        return self._derivative(scene, sensor, seed, spp, changes)

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> None:
        followed = self._followed(scene, params)
        found = {name: np.zeros(len(value)) for name, value in followed.items()}
        for name, i, change in unit_changes(followed):
            moved = self._derivative(scene, sensor, seed, spp, change)
            found[name][i] = float(dr.sum(moved.array * grad_in.array)[0])
        for name, value in followed.items():
            dr.accum_grad(value, array(found[name]))

    def _derivative(self, scene: Any, sensor: Any, seed: Any, spp: int, changes: Changes) -> Any:
        """How the picture changes along changes of numbers by name: see :mod:`.linearized`."""
        emitter = self._emitter(scene)
        air = (self.exposed or emitter.exposed).atmosphere
        if self._solved is None or self._solved.atmosphere != air:
            self._solved = LinearizedSky(air, self.orders)
        apart, skies = self._solved.ends({name: v for name, v in changes.items() if name not in SCALES})
        light, middle, colours = self._made(emitter, self._solved.sky)
        pictures = []
        with dr.suspend_grad():
            for sky, sign in zip(skies, (-0.5, 0.5), strict=True):
                there = middle.moved(sky)
                moved = light.moved(there.solar, *(sign * apart * float(changes.get(n, [0.0])[0]) for n in SCALES))
                self._moving = moved, there, colours
                try:
                    picture = self.render(scene, sensor, seed, spp, develop=True, evaluate=False)
                    dr.eval(picture)
                    pictures.append(picture)
                finally:
                    self._moving = None
        return (pictures[1] - pictures[0]) * (1.0 / apart)
