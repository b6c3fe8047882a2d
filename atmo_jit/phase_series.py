"""Legendre series of phase functions, as the light of order 1 scattered into all directions reads them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from .resolution import moments_of

PHASE_NODES = 513


def phase_node(nu: Any) -> Any:
    """Where a cosine ``nu`` lies among the PHASE_NODES of Optics.phase_table, from 0 at -1 to PHASE_NODES - 1 at 1.

    Nodes are uniform in sqrt(1 - abs(nu)) on both sides, nearly in the angle: uniform in the cosine a peak of g = 0.85
    has so few that linear interpolation makes it up to a third too bright.
    """
    middle = 0.5 * (PHASE_NODES - 1)
    step = middle * dr.safe_sqrt(1.0 - dr.abs(nu))
    return dr.select(nu > 0.0, 2.0 * middle - step, step)


@lru_cache(maxsize=16)
def _legendre_values(degree: int) -> np.ndarray:
    """P_l at the cosines of ``phase_node``, [node, l]."""
    side = np.linspace(0.0, 1.0, PHASE_NODES // 2 + 1)[1:] ** 2
    return np.polynomial.legendre.legvander(np.concatenate([[-1.0], side - 1.0, (1.0 - side)[-2::-1], [1.0]]), degree)


@lru_cache(maxsize=64)
def of_asymmetry(kind: type, g: float) -> Any:
    """One phase function for all that are equal."""
    return kind(g)


# Kept: of the parameters by which derivatives are asked for few move a phase function.
@lru_cache(maxsize=64)
def phase_moments(phases: tuple[Any, ...], degree: int) -> np.ndarray:
    """Legendre moments of several phase functions, [l, phase function]."""
    columns = [moments_of(phase, degree) for phase in phases]
    return np.column_stack(columns) if columns else np.zeros((degree + 1, 1))


@lru_cache(maxsize=64)
def phase_series(phases: tuple[Any, ...], degree: int) -> np.ndarray:
    """Their Legendre series at the cosines of phase_node."""
    weights = (2.0 * np.arange(degree + 1) + 1.0) / (4.0 * np.pi)
    return _legendre_values(degree) @ (weights[:, None] * phase_moments(phases, degree))


def distinct(phases: list[Any]) -> tuple[list[Any], list[int]]:
    """The phase functions that differ, and which of them is that of each channel."""
    found: list[Any] = []
    for phase in phases:
        if not any(phase is other for other in found):
            found.append(phase)
    return found, [next(i for i, other in enumerate(found) if other is phase) for phase in phases]
