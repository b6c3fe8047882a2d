"""Where texels lie on an axis, and the horizon."""

from __future__ import annotations

from typing import Any

import numpy as np

from .either import square_root


def texels(count: int, *, ends: bool = True) -> np.ndarray:
    """Unit coordinates of ``count`` texels' centres: i / (n - 1), or (i + 1/2) / n without ``ends``."""
    return np.linspace(0.0, 1.0, count) if ends else (np.arange(count) + 0.5) / count


def texture_coordinate(x: Any, count: int) -> Any:
    """Unit coordinate to texture coordinate of a table with texels on both ends: 0.5 / n + x (1 - 1 / n). B17."""
    return 0.5 / count + x * (1.0 - 1.0 / count)


def unit_coordinate(u: Any, count: int) -> Any:
    """Inverse of :func:`texture_coordinate`."""
    return (u - 0.5 / count) / (1.0 - 1.0 / count)


def horizon(radius: float, h: Any) -> Any:
    """Cosine of the horizon's zenith angle, -sqrt(1 - (R / (R + h))^2), without cancellation at small h."""
    return -square_root(h * (2.0 * radius + h)) / (radius + h)
