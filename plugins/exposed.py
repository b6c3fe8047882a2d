"""Plugin parameters as ``mi.traverse`` exposes them: arrays that it can write to, in every variant."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.backend import floats


def array(value: Any) -> Any:
    """Numbers as a ``mi.Float`` array; in scalar variants, whose Float is a Python number, as a Dr.Jit scalar array."""
    kind = mi.Float if dr.is_jit_v(mi.Float) else dr.scalar.ArrayXf
    return kind([float(v) for v in np.atleast_1d(np.asarray(value, dtype=np.float64))])


def tensor(values: Any) -> Any:
    """A NumPy array as a TensorXf, whose place in memory kernels do not depend on."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    return mi.TensorXf(mi.Float(floats(values)), values.shape) if dr.is_jit_v(mi.Float) else mi.TensorXf(values)


def host(value: Any) -> np.ndarray:
    """The values of a parameter as a flat float64 array."""
    return np.array(dr.detach(value), dtype=np.float64).ravel()


def first(value: Any) -> float:
    """The value of a parameter that is one number."""
    return float(host(value)[0])


def single(value: Any) -> Any:
    """A parameter that is one number in the variant's Float, with its gradient."""
    return value if dr.is_jit_v(mi.Float) else value[0]


def number(x: float) -> Any:
    """``x`` in the variant's Float, read from memory so that kernels do not depend on its value."""
    return dr.opaque(mi.Float, float(x)) if dr.is_jit_v(mi.Float) else float(x)


def variables(*objects: Any) -> list[Any]:
    """All Dr.Jit arrays and textures inside ``objects``, however deep.

    A plugin that keeps this list among its own attributes can be used in ``dr.freeze``, which does not look into
    objects of plain Python classes.
    """
    found: list[Any] = []
    for value in objects:
        if dr.is_array_v(value) or hasattr(value, "IsTexture"):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += variables(*value)
        elif isinstance(value, dict):
            found += variables(*value.values())
        elif type(value).__module__.startswith("atmo_jit.plugins"):
            found += variables(*vars(value).values())
    return found


def parameters_of(shapes: list[Any]) -> list[Any]:
    """The arrays that describe shapes and their surfaces."""
    found = []
    for shape in shapes:
        found += [getattr(value, "array", value) for _, value in mi.traverse(shape)]
    return found


def same(one: list[Any], other: list[Any]) -> bool:
    """Whether two lists hold the same arrays: what holds an array keeps others from its place in memory."""
    return len(one) == len(other) and all(
        a.index == b.index if hasattr(a, "index") else a is b or bool(a == b) for a, b in zip(one, other, strict=True)
    )
