"""The sky: everything that users, plugins, exporters and fits call.

>>> import atmo_jit
>>> views = {"altitude_m": 2.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [0.0, 45.0], "azimuth_deg": 90.0}
>>> result = atmo_jit.sky("earth", views)
>>> result.radiance.shape  # views, wavelengths
(2, 3)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import drjit as dr
import numpy as np

from . import __version__
from .atmosphere import Atmosphere
from .backend import doubles, one_at_a_time
from .errors import InputError
from .parameters import check_names
from .solved import Sky
from .views import check_views

METHODS = ("auto", "tables", "march")
VIEWS_AT_ONCE = 1 << 18  # bounds memory: a view costs some hundred bytes while it is marched


@dataclass
class SkyResult:
    """What ``sky`` returns: float32 arrays [N, W] and ``meta``.

    ``radiance`` (W m^-2 sr^-1 nm^-1 for the atmosphere's solar irradiance; 1/sr where that is 1), ``transmittance``
    along the ray, ``sun_irradiance`` and ``sky_irradiance`` on a horizontal surface at the observer (W m^-2 nm^-1);
    ``meta``: version, seconds, tolerance, orders, method and the plan (resolution) of the solve. ``gradient``: the
    derivatives that were asked for, by name (derivatives.Linearization.gradients).
    """

    radiance: np.ndarray
    transmittance: np.ndarray
    sun_irradiance: np.ndarray
    sky_irradiance: np.ndarray
    meta: dict[str, Any]
    gradient: dict[str, np.ndarray] = field(default_factory=dict)


@one_at_a_time
def sky(
    atmosphere: Any,
    views: Mapping[str, Any],
    *,
    tolerance: float = 0.01,
    orders: int | None = None,
    ground: bool = True,
    sun_disc: bool = False,
    method: str = "auto",
    gradient: Sequence[str] = (),
    progress: Callable[[float], None] | None = None,
) -> SkyResult:
    """Radiance, transmittance and irradiances for a list of views.

    ``atmosphere``: preset name, JSON file, dict or Atmosphere. ``views``: mapping with ``altitude_m``,
    ``sun_zenith_deg``, ``view_zenith_deg``, ``azimuth_deg`` and optionally ``distance_m``: numbers or 1-D arrays of
    one length N (see atmo_jit.views). ``orders``: scattering and reflection events counted (None: all, to
    ``tolerance``). ``ground=False`` leaves out the ground's own radiance, ``sun_disc=True`` adds the sun's.
    ``method``: "march" integrates every ray, "tables" interpolates them where a table serves, "auto" takes tables where
    they pay and keep the tolerance. ``gradient``: names of parameters by which the radiance is differentiated
    (parameters.parameter_names has them all), on finer nodes (``fine`` of derivatives.Linearization). ``progress`` is
    called with the fraction done.

    Raises InputError for views, orders, tolerance, method or names that are not allowed, AtmosphereError for a bad
    atmosphere, LLVMError without a usable LLVM.
    """
    if method not in METHODS:
        raise InputError(f"method: is {method!r}; must be one of {', '.join(METHODS)}")
    air = Atmosphere.load(atmosphere)
    checked = check_views(views)
    names = check_names(air, gradient, checked)
    start = time.perf_counter()
    solved = Sky(air, orders, tolerance)
    solve_seconds = time.perf_counter() - start

    def by_march(some: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        return _march(solved, some, ground, sun_disc, progress)

    if method == "march":
        arrays, done = by_march(checked), {"method": "march"}
    else:
        from .bake.method import evaluate  # builds on this module

        arrays, done = evaluate(
            solved, checked, method=method, tolerance=tolerance, ground=ground, sun_disc=sun_disc, march=by_march
        )
    derivatives = {}
    if names:
        from .derivatives import Linearization  # builds on this module

        options = {"tolerance": tolerance, "orders": orders, "ground": ground, "sun_disc": sun_disc}
        derivatives = Linearization(air, checked, fine=True, **options).gradients(names)
    meta = {
        "atmo_jit": __version__,
        "seconds": time.perf_counter() - start,
        "solve_seconds": solve_seconds,
        "tolerance": tolerance,
        "orders": orders,
        **done,
        "wavelengths_nm": air.wavelengths_nm.tolist(),
        "plan": asdict(solved.resolution),
    }
    return SkyResult(*arrays, meta, derivatives)


def _march(
    solved: Sky,
    views: Mapping[str, np.ndarray],
    ground: bool,
    sun_disc: bool,
    progress: Callable[[float], None] | None,
) -> list[np.ndarray]:
    """The four arrays of a SkyResult by marching, some views at a time."""
    count = len(views["altitude_m"])
    parts = []
    for first in range(0, count, VIEWS_AT_ONCE):
        part = {name: v[first : first + VIEWS_AT_ONCE] for name, v in views.items()}
        parts.append(_evaluate(solved, part, ground, sun_disc))
        if progress is not None:
            progress(min(first + VIEWS_AT_ONCE, count) / count)
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _evaluate(solved: Sky, views: Mapping[str, np.ndarray], ground: bool, sun_disc: bool) -> list[np.ndarray]:
    """The four arrays of a SkyResult for some of its views."""
    altitude = views["altitude_m"]
    angles = [np.deg2rad(views[name]) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")]
    light = solved.rays(altitude, *angles, views.get("distance_m"), ground=ground, sun_disc=sun_disc)
    sun, scattered = solved.irradiance(doubles(altitude), doubles(angles[0]))
    groups = (light.radiance, light.transmittance, sun, scattered)
    dr.eval(groups)
    shape = views["altitude_m"].shape
    return [
        np.stack([np.broadcast_to(v.numpy(), shape) for v in group], axis=-1).astype(np.float32) for group in groups
    ]
