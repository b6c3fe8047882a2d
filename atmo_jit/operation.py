"""The sky as one operation of Dr.Jit (and of JAX: :mod:`.jax_bridge`), with the linearization behind it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere
from .backend import floats
from .derivatives import Linearization
from .evaluation import OUTPUTS
from .parameters import replaced


def differentiable(
    atmosphere: Any, views: Mapping[str, Any], parameters: Mapping[str, Any], **options: Any
) -> dict[str, list[Any]]:
    """What sky returns as Dr.Jit arrays that derivatives pass through: by output, W Floats [N].

    ``parameters``: by name, Dr.Jit arrays (of one number, or as many as the parameter has) that take the place of the
    atmosphere's values, and of the ``views``. Derivatives go from the outputs back to them (dr.backward) and the other
    way (dr.forward); on the way the solver is asked for Linearization.vjp and jvp. ``options``: see Linearization.

    Raises what Linearization raises, and InputError for a name that is no parameter.
    """
    air = Atmosphere.load(atmosphere)
    outputs = dr.custom(_operation(), dict(parameters), lambda values: moved_to(air, views, values, **options))
    count = len(outputs) // len(OUTPUTS)
    return {name: outputs[i * count : (i + 1) * count] for i, name in enumerate(OUTPUTS)}


def moved_to(
    atmosphere: Any, views: Mapping[str, Any], parameters: Mapping[str, Any], **options: Any
) -> Linearization:
    """The linearization where ``parameters``, arrays by name, take the place of the atmosphere's and the views'."""
    return Linearization(*replaced(Atmosphere.load(atmosphere), views, parameters), **options)


def shaped(gradient: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A derivative by a parameter in the shape in which the parameter was given: one number may stand for all."""
    return np.sum(gradient).reshape(shape) if np.prod(shape) == 1 else gradient.reshape(shape)


@lru_cache(maxsize=1)
def _operation() -> type:
    class SkyOperation(dr.CustomOp):
        def eval(self, parameters: Any, linearized: Any) -> list[Any]:
            self.kinds = {name: type(value) for name, value in parameters.items()}
            self.sizes = {name: len(value) for name, value in parameters.items()}
            with dr.suspend_grad():
                self.at = linearized(parameters)
                return [floats(column) for name in OUTPUTS for column in self.at.value[name].T]

        def forward(self) -> None:
            changes = {name: np.array(v, np.float64) for name, v in self.grad_in("parameters").items()}
            moved = self.at.jvp({name: v if len(v) > 1 else v[0] for name, v in changes.items()})
            self.set_grad_out([floats(column) for name in OUTPUTS for column in moved[name].T])

        def backward(self) -> None:
            columns = np.stack([np.broadcast_to(v.numpy(), self.at.rays) for v in self.grad_out()], axis=-1)
            weights = dict(zip(OUTPUTS, np.split(columns, len(OUTPUTS), axis=-1), strict=True))
            found = self.at.vjp(weights, tuple(self.kinds))
            self.set_grad_in(
                "parameters",
                {n: kind(shaped(found[n], (self.sizes[n],)).tolist()) for n, kind in self.kinds.items()},
            )

        def name(self) -> str:
            return "sky"

    return SkyOperation
