"""Multiple scattering by orders, on angular moments instead of a four-dimensional table.

Light that scatters again is needed only through the low harmonics of its angular distribution (Rayleigh needs l <= 2,
aerosol of asymmetry g as many as g^l takes to fade). So one order is a handful of moments per altitude and sun angle,
and the next follows by gathering along straight paths from every node.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from .backend import types
from .column import SunColumns
from .field import Field
from .gather import Gather
from .grid import Grid
from .optics import Optics
from .paths import directions_at
from .projection import Moments, Projection
from .refinement import Reference
from .resolution import Resolution
from .single_scattering import first_order


def solve(
    optics: Optics, columns: SunColumns, grid: Grid, resolution: Resolution, orders: int | None, tolerance: float
) -> Field:
    """The field of the light of all orders below ``orders``: what may scatter or reflect once more on the way to an
    observer.

    ``orders``: scattering and reflection events in the final picture; None: all of them, summed by extrapolation as
    soon as that is steady to ``tolerance``. The field's sky irradiance counts one event more than its moments.
    """
    r, channels = resolution, optics.channel_count
    suns = len(grid.first_theta)
    fine = directions_at(grid, r.first_up, r.first_down)
    project = Projection.at(grid, fine, r.first_degree)
    first = project(first_order(optics, columns, grid, fine, r), suns, channels)
    reference = Reference(grid, first)
    nothing = np.zeros((0, grid.shape[1], channels))
    if orders == 1:
        return Field(optics, columns, grid, reference, first, [], nothing, nothing, scatters=False)
    gathers: dict[int, tuple[Gather, Projection]] = {}
    light, later, probes = first, [], []
    for n in range(2, (orders or r.orders) + 1):
        stage = min(n - 2, len(r.stages) - 1)
        if stage not in gathers:
            s = r.stages[stage]
            directions = directions_at(grid, s.up, s.down)
            gathers[stage] = (
                Gather(optics, grid, reference, directions, s.azimuths, s.degree, r.nodes),
                Projection.at(grid, directions, s.degree),
            )
        gather, project = gathers[stage]
        light = project(gather(light), grid.shape[1], channels)
        later.append(light)
        if orders is None and len(later) >= min(3, r.orders - 1):
            probes += [_probe(order, grid, reference) for order in later[len(probes) :]]
            weights, error = _extrapolated(np.array(probes))
            if error < 0.1 * tolerance:
                break
    if orders is None:
        return Field(optics, columns, grid, reference, first, later, weights, weights)
    ones = np.ones((len(later), grid.shape[1], channels))
    counted = ones.copy()
    counted[-1] = 0.0
    return Field(optics, columns, grid, reference, first, later, counted, ones)


def _probe(order: Moments, grid: Grid, reference: Reference) -> np.ndarray:
    """The moments of degrees 0 and 1 with m = 0, over the reference: [K, S, 2, channels]."""
    t, (altitudes, suns), channels = types(), grid.shape, order.channels
    lane = dr.arange(t.UInt, altitudes * suns * 2 * channels)
    channel, place = lane % channels, lane // channels
    entry, node = place % 2, place // 2
    sun, k = node % suns, node // suns
    values = dr.gather(t.Float, dr.detach(order.values), order.index(k, entry, sun, channel))
    values = values * dr.gather(t.Float, reference.inverse, reference.index(k, sun, channel))
    return values.numpy().reshape(altitudes, suns, 2, channels)


def _extrapolated(orders: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights [N, S, size] of the N orders [N, K, S, pairs, size] whose sum is closest to that of all orders, and its
    error.

    Reduced-rank extrapolation (Eddy 1979; Sidi 1991), per sun and channel: among the combinations sum_j gamma_j x_j,
    sum gamma_j = 1, of the partial sums x_j, the one whose residual sum_j gamma_j u_{j+1} (u: the orders) is
    smallest. With two orders it is the geometric tail; it is GMRES for the fixed point, and in a thick conservative
    cloud some ten orders do the work of hundreds. The error is the norm of that residual over that of the sum, the
    largest over suns and channels that have light.
    """
    count, _, suns, _, size = orders.shape
    u = np.moveaxis(orders, (2, 4), (0, 1)).reshape(suns, size, count, -1).astype(np.float64)
    gram = u @ np.swapaxes(u, -1, -2)
    scale = np.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    dark = scale <= 0.0
    # A gram matrix of float32 data knows nothing below 1e-10 of its trace.
    gram = np.where(dark, np.eye(count), gram / np.where(dark, 1.0, scale) + 1e-10 * np.eye(count))
    gamma = np.linalg.solve(gram, np.ones((suns, size, count, 1)))[..., 0]
    gamma = gamma / gamma.sum(axis=-1, keepdims=True)
    # x_j holds the orders before the j-th, so an order counts in every later partial sum.
    weights = 1.0 - np.cumsum(gamma, axis=-1)
    residual = np.linalg.norm(np.einsum("scn,scnv->scv", gamma, u), axis=-1)
    whole = np.linalg.norm(np.einsum("scn,scnv->scv", weights, u), axis=-1) + np.linalg.norm(u[:, :, 0], axis=-1)
    weights = weights + gamma  # the residual is the next term of the sum: take it too
    error = np.divide(residual, whole, out=np.zeros_like(residual), where=whole > 0.0)
    return np.moveaxis(weights, -1, 0), float(error.max())
