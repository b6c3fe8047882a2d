"""Functions that take NumPy and Dr.Jit arrays alike."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._arrays import module_of


def where(condition: Any, a: Any, b: Any) -> Any:
    xp = module_of(condition, a, b)
    return np.where(condition, a, b) if xp is np else xp.select(condition, a, b)


def square_root(x: Any) -> Any:
    """Square root, 0 of what rounding made negative."""
    return module_of(x).sqrt(maximum(x, 0.0))


def maximum(a: Any, b: Any) -> Any:
    return module_of(a, b).maximum(a, b)


def minimum(a: Any, b: Any) -> Any:
    return module_of(a, b).minimum(a, b)


def clip(x: Any, low: float, high: float) -> Any:
    return module_of(x).clip(x, low, high)


def acos(x: Any) -> Any:
    xp = module_of(x)
    return np.arccos(x) if xp is np else xp.acos(x)


def atan(x: Any) -> Any:
    xp = module_of(x)
    return np.arctan(x) if xp is np else xp.atan(x)
