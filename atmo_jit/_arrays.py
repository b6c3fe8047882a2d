"""The few functions that work alike on NumPy and Dr.Jit arrays.

Dr.Jit is imported only after a Dr.Jit array was seen.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def is_drjit(x: Any) -> bool:
    """Whether ``x`` is a Dr.Jit array (asked without importing Dr.Jit)."""
    return type(x).__module__.partition(".")[0] == "drjit"


def module_of(*values: Any) -> Any:
    """The module whose ``exp``, ``abs``, ``maximum`` fit ``values``: drjit if any is a Dr.Jit array, else numpy.

    Other kinds of values bring theirs along as ``array_module``.
    """
    for x in values:
        if hasattr(type(x), "array_module"):
            return x.array_module
    if any(is_drjit(x) for x in values):
        import drjit as dr

        return dr
    return np


def asarray(x: Any) -> Any:
    """``x`` as a float64 NumPy array, a Dr.Jit array as it is."""
    return x if is_drjit(x) else np.asarray(x, dtype=np.float64)


def piecewise_linear(x: Any, knots: Any, values: Any) -> Any:
    """Linear interpolation of ``values`` at ascending ``knots``, held constant outside.

    A knot given twice is a step; there the value after the step holds. ``x`` is a NumPy array (any shape) or a Dr.Jit
    array; the result has its type and shape. In Dr.Jit the tables are stored in the precision of ``x``, and may be
    Dr.Jit arrays; derivatives flow through them and through ``x``.
    """
    if is_drjit(x):
        return _piecewise_linear_drjit(x, knots, values)
    x = np.asarray(x, dtype=np.float64)
    last = np.searchsorted(knots, x, side="right") - 1
    i = np.clip(last, 0, len(knots) - 1)
    offset = np.maximum(x - knots[i], 0.0)
    return values[i] + offset * _slopes(knots, values)[i]


def _slopes(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Slope of the segment that starts at each knot; 0 for a step and after the last knot."""
    width = np.diff(knots)
    rise = np.diff(values)
    return np.append(np.divide(rise, width, out=np.zeros_like(rise), where=width > 0), 0.0)


def _piecewise_linear_drjit(x: Any, knots: Any, values: Any) -> Any:
    import drjit as dr

    kind = type(x)
    # From lists, so that Dr.Jit owns the memory: it compiles the alignment of borrowed NumPy memory into the kernel.
    at, value = (table if is_drjit(table) else kind(table.tolist()) for table in (knots, values))
    start = dr.detach(x)
    # The first index whose knot lies beyond x; the segment that holds x starts at the one before it.
    beyond = dr.binary_search(0, len(knots), lambda i: dr.gather(kind, at, i, i < len(knots)) <= start)
    index = dr.uint32_array_t(dr.detached_t(kind))
    i = index(dr.maximum(index(beyond), 1) - 1)
    after = dr.minimum(i + 1, len(knots) - 1)
    low, high, low_value, high_value = (dr.gather(kind, table, j) for table in (at, value) for j in (i, after))
    width = high - low  # 0 for a step and after the last knot
    slope = dr.select(width > 0, (high_value - low_value) / dr.select(width > 0, width, 1), 0)
    return dr.fma(dr.maximum(x - low, 0), slope, low_value)
