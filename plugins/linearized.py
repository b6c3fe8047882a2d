"""The derivative of a picture by the numbers of its atmosphere, for the integrator ``atmosphere_path``.

A picture depends on few numbers of the atmosphere, but on large tables made from them, and through loops of which each
turn needs the one before. So it is differentiated along one direction in the space of the numbers: the same paths are
followed through the air a little before and after. All that chooses paths and points on them is that of the air in the
middle, so that the difference has no noise but the picture's own; and both ends are solved on the same nodes with the
same shares of the orders, as derivatives of the solver are (docs/method.md, section 14).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from atmo_jit._trees import flat, like
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.derivatives import PROFILE
from atmo_jit.errors import InputError
from atmo_jit.optics import on_device
from atmo_jit.parameters import RADII, check_names, described, tangent
from atmo_jit.solved import Sky

from .near_ground import near_ground

Changes = Mapping[str, np.ndarray]
# Of the number that moves most, relative. Smaller, and float32 shows: pictures are known to 1e-6 or so.
STEP = 5e-3


class LinearizedSky:
    """The sky of ``atmosphere``, solved for as many ``orders`` (None: all) as derivatives need, at the altitudes of
    pictures."""

    def __init__(self, atmosphere: Atmosphere, orders: int | None = None) -> None:
        self.atmosphere = atmosphere
        too = [c.name for c in atmosphere.constituents]
        self.sky = Sky(atmosphere, orders, resolution=near_ground(atmosphere), scattering_too=too, sure=True)

    @cached_property
    def _numbers(self) -> list[dict[str, Any]]:
        r = self.sky.resolution
        return [b.optics.numbers(self.atmosphere, r.degrees, r.phase_degree) for b in self.sky.solutions]

    def ends(self, changes: Changes) -> tuple[float, tuple[Sky, Sky]]:
        """Skies a little before and after along ``changes`` of parameters, arrays by name, and by how many changes the
        two are apart.

        Raises InputError for a name that is no parameter, and for the planet's radii, which move everything in a
        scene.
        """
        names, r = check_names(self.atmosphere, tuple(changes), ()), self.sky.resolution
        radii = [name for name in names if name in RADII]
        if radii:
            raise InputError(f"{radii[0]}: atmosphere_path has no derivatives by it; allowed are all but the radii")
        own = {name: shaped(changes[name], described(self.atmosphere, name)) for name in names}
        fastest = max((float(np.max(np.abs(own[name]))) / self._size(name) for name in names), default=0.0)
        step = STEP / fastest if fastest > 0.0 else 1.0
        ends: list[list[Any]] = [[], []]
        for band, numbers in zip(self.sky.solutions, self._numbers, strict=True):
            steps = [np.zeros(np.shape(leaf)) for leaf in flat(numbers)]
            for name in names:
                along = tangent(band.optics, name, own[name], r.degrees, r.phase_degree)
                steps = [a + b for a, b in zip(steps, along, strict=True)]
            for end, sign in zip(ends, (-step, step), strict=True):
                there = [leaf + sign * s for leaf, s in zip(flat(numbers), steps, strict=True)]
                end.append(on_device(like(numbers, there)))
        shares = [band.field.shares for band in self.sky.solutions]
        skies = self.sky, self.sky
        of_profiles = (*PROFILE, "sun_angular_radius_deg")
        if any(name.rpartition(".")[2] in of_profiles or ".profile." in name for name in names):
            # What is kept with the grid is of its profiles: others have grids of their own, with the same nodes.
            skies = tuple(self._among(names, own, sign * step) for sign in (-1.0, 1.0))
        low, high = (sky.again(values, shares) for sky, values in zip(skies, ends, strict=True))
        return 2.0 * step, (low, high)

    def _among(self, names: Iterable[str], changes: Mapping[str, Any], step: float) -> Sky:
        """The sky, without its light, among the profiles of an atmosphere so far along ``changes``."""
        moved = {name: described(self.atmosphere, name) + step * changes[name] for name in names}
        return self.sky.unlit(self.atmosphere.replace({n: np.asarray(value).tolist() for n, value in moved.items()}))

    def _size(self, name: str) -> float:
        """What a step of a parameter is measured by: its largest number, for g also how far that is from 1."""
        size = float(np.max(np.abs(described(self.atmosphere, name))))
        if name.endswith(".g"):
            return 1.0 - size
        return size if size > 0.0 else 1e-5 if name.endswith("_per_m") else 1.0


def shaped(change: np.ndarray, value: float | np.ndarray) -> float | np.ndarray:
    """A change in the shape of the parameter's value: one number may stand for all."""
    if np.ndim(value) == 0:
        return float(np.sum(change))
    return np.broadcast_to(change, np.shape(value)) if len(change) == 1 else np.asarray(change)


def unit_changes(values: Mapping[str, Any]) -> Iterator[tuple[str, int, Changes]]:
    """Name, index and change of each number in ``values``, Dr.Jit arrays by name."""
    for name, value in values.items():
        for i, change in enumerate(np.eye(len(value))):
            yield name, i, {name: change}
