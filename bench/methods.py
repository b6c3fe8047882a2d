"""The methods that are compared, each at several settings, behind one interface.

    solved = METHODS["atmo-jit"].solve("tolerance 0.01", atmosphere)
    radiance = solved.radiance(views)      # [N, W], views as for atmo_jit.sky

``solve`` does all that depends on the atmosphere alone; ``radiance`` is then asked for any views. Peers that have no
such split do their work in ``radiance``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Protocol

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import InputError
from atmo_jit.resolution import Resolution

TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
SCALES = (0.5, 0.7, 1.0, 1.4)
DEFAULT_TOLERANCE = 0.01  # of atmo_jit.sky
FEWEST = 4  # no count is scaled below this: directions are split in parts, each with its own
# What a scale leaves as it is: the bound on the number of orders is no size.
UNSCALED = ("orders", "first_suns", "refine", "sun_refine")


class Solved(Protocol):
    """A sky that was solved."""

    def radiance(self, views: Mapping[str, np.ndarray]) -> np.ndarray:
        """Radiance [N, W] of views, ground included, no sun disc; for the atmosphere's solar irradiance."""


@dataclass(frozen=True)
class Method:
    """``settings``: from fast to accurate; ``solve(setting, atmosphere)``; ``slow``: at its published size a solve
    takes minutes, so that only ``cases`` of the reference are asked; ``what``: one line for tables."""

    name: str
    what: str
    settings: tuple[str, ...]
    solve: Callable[[str, Any], Solved]
    slow: bool = False


class OwnSky:
    """This package's solution."""

    def __init__(self, atmosphere: Any, tolerance: float, resolution: Resolution | None = None) -> None:
        import drjit as dr

        from atmo_jit.solved import Sky

        self.sky = Sky(atmosphere, tolerance=tolerance, resolution=resolution)
        dr.sync_thread()

    def radiance(self, views: Mapping[str, np.ndarray]) -> np.ndarray:
        """Radiance [N, W]."""
        import drjit as dr

        columns = columns_of(views)
        light = self.sky.rays(*columns)
        dr.eval(light.radiance)
        shape = np.shape(views["altitude_m"])
        return np.stack([np.broadcast_to(v.numpy(), shape) for v in light.radiance], axis=-1)


def columns_of(views: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Views (degrees) as the arguments of ``Sky.rays``: altitude and three angles in radians."""
    angles = (np.deg2rad(views[name]) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg"))
    return [np.asarray(views["altitude_m"], float), *angles]


def scaled(resolution: Any, factor: float) -> Any:
    """``resolution`` with every count of nodes, directions and moments multiplied, also in what it holds (those of
    ``UNSCALED`` excepted)."""

    def times(value: Any) -> Any:
        if is_dataclass(value):
            return scaled(value, factor)
        if isinstance(value, tuple):
            return tuple(times(v) for v in value)
        if isinstance(value, int) and not isinstance(value, bool):
            return max(min(value, FEWEST), round(factor * value))
        return value

    names = (f.name for f in fields(resolution) if f.name not in UNSCALED)
    return replace(resolution, **{name: times(getattr(resolution, name)) for name in names})


def number_in(setting: str, kind: str) -> float:
    """The number of a setting like ``"tolerance 0.01"`` of ``kind`` "tolerance"."""
    word, _, text = setting.partition(" ")
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if word != kind or not value > 0.0:
        raise InputError(f"setting: is {setting!r}; must be {kind!r} and a number > 0")
    return value


def _by_tolerance(setting: str, atmosphere: Any) -> OwnSky:
    return OwnSky(atmosphere, number_in(setting, "tolerance"))


def _by_resolution(setting: str, atmosphere: Any) -> OwnSky:
    air = Atmosphere.load(atmosphere)
    base = Resolution.suited(air, DEFAULT_TOLERANCE)
    # A tolerance far below what any of these reaches: the orders then add no error of their own.
    return OwnSky(air, 1e-4, scaled(base, number_in(setting, "times")))


def _bruneton(setting: str, atmosphere: Any) -> Solved:
    from .bruneton import solve

    return solve(setting, atmosphere)


def _hillaire(setting: str, atmosphere: Any) -> Solved:
    from .hillaire import solve

    return solve(setting, atmosphere)


METHODS = {
    method.name: method
    for method in (
        Method(
            "atmo-jit",
            "this package, by tolerance",
            tuple(f"tolerance {t:g}" for t in TOLERANCES),
            _by_tolerance,
        ),
        Method(
            "atmo-jit resolution",
            f"this package, the resolution of tolerance {DEFAULT_TOLERANCE:g} times a factor",
            tuple(f"times {s:g}" for s in SCALES),
            _by_resolution,
        ),
        Method(
            "bruneton2017",
            "gather over directions on 4-D tables, 4 orders, sizes as published times a factor",
            ("size 0.25", "size 0.5", "size 1"),
            _bruneton,
            slow=True,
        ),
        Method(
            "hillaire2020",
            "isotropic multiple scattering, table 32x32, 8x8 directions",
            ("size 1",),
            _hillaire,
        ),
    )
}


def method_of(name: str) -> Method:
    """The method called ``name``; raises InputError."""
    if name not in METHODS:
        raise InputError(f"--method: is {name!r}; must be one of {', '.join(METHODS)}")
    return METHODS[name]
