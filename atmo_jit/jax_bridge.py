"""The sky as a function that JAX differentiates: one custom_vjp around host callbacks.

>>> from atmo_jit.jax_bridge import radiance_function
>>> radiance = radiance_function("earth", {"altitude_m": 0, "sun_zenith_deg": 60, "view_zenith_deg": [0, 45],
...     "azimuth_deg": 90}, tolerance=0.03)
>>> radiance({"mie.phase.g": 0.7}).shape  # views, wavelengths
(2, 3)

``jax.grad`` of any loss of it works, ``jax.jit`` too; derivatives in forward mode are Linearization.jvp's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .derivatives import Linearization
from .operation import moved_to, shaped
from .views import check_views


def radiance_function(atmosphere: Any, views: Mapping[str, Any], **options: Any) -> Callable[[Mapping[str, Any]], Any]:
    """A function of parameters, JAX arrays by name, that gives the radiance [N, W] as float32.

    A parameter is one number, or has as many as the description has. ``options``: see Linearization. JAX is imported
    here and nowhere else (``pip install 'atmo-jit[fit]'``). Raises what Linearization raises.
    """
    import jax

    at = Linearization(atmosphere, views, **options)
    given, result = check_views(views), jax.ShapeDtypeStruct(at.value["radiance"].shape, np.float32)

    def linearized(parameters: Mapping[str, Any]) -> Linearization:
        nonlocal at
        values = {name: np.asarray(value, np.float64) for name, value in parameters.items()}
        key = {name: value.tolist() for name, value in values.items()}
        if kept.get("key") != key:
            at = moved_to(atmosphere, given, values, **options)
            kept["key"] = key
        return at

    kept: dict[str, Any] = {}

    def value(parameters: Mapping[str, Any]) -> np.ndarray:
        return linearized(parameters).value["radiance"].astype(np.float32)

    def pulled_back(parameters: Mapping[str, Any], weights: Any) -> dict[str, np.ndarray]:
        found = linearized(parameters).vjp({"radiance": np.asarray(weights)}, tuple(parameters))
        return {n: shaped(found[n], np.shape(p)).astype(np.asarray(p).dtype) for n, p in parameters.items()}

    @jax.custom_vjp
    def radiance(parameters: Mapping[str, Any]) -> Any:
        return jax.pure_callback(value, result, parameters)

    def forward(parameters: Mapping[str, Any]) -> tuple[Any, Any]:
        return radiance(parameters), parameters

    def backward(parameters: Mapping[str, Any], weights: Any) -> tuple[Any]:
        kinds = jax.tree.map(lambda p: jax.ShapeDtypeStruct(np.shape(p), p.dtype), parameters)
        return (jax.pure_callback(pulled_back, kinds, parameters, weights),)

    radiance.defvjp(forward, backward)
    return lambda parameters: radiance({name: jax.numpy.asarray(p) for name, p in parameters.items()})
