"""Multiple scattering by orders, on angular moments instead of a four-dimensional table.

Light that scatters again is needed only through the low harmonics of its angular distribution (Rayleigh needs l <= 2, aerosol of asymmetry
g as many as g^l takes to fade). So one order is a handful of moments per altitude and sun angle, and the next follows by gathering
along straight paths from every node.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .column import SunColumns
from .field import Field
from .gather import Gather
from .grid import Grid
from .optics import Optics
from .paths import Directions
from .plan import Resolution
from .projection import Projection
from .refinement import Order, Refinement
from .single_scattering import first_order

STEADIEST_RATIO = 0.97  # of successive orders: a white world under a conservative sky loses at least this little


def solve(
    optics: Optics, columns: SunColumns, grid: Grid, resolution: Resolution, orders: int | None, tolerance: float
) -> Field:
    """The field of the light of all orders below ``orders``: what may scatter or reflect once more on the way to an observer.

    ``orders``: scattering and reflection events in the final picture; None: all of them, the rest by a geometric tail once the orders shrink
    by a steady ratio. The field's sky irradiance counts one event more than its moments.
    """
    r, channels = resolution, optics.channel_count
    fine = Directions.at_nodes(grid, r.first_up, r.first_down)
    project = Projection(grid, fine, r.first_azimuths, r.first_degree, channels)
    moments, sky = project(first_order(optics, columns, grid, fine, r))
    zeroth = Order(moments, sky, r.first_degree, project.size).zeroth()
    refine = Refinement(grid, zeroth.numpy().reshape(*grid.shape, project.size))
    light = _relative(refine, moments, sky, r.first_degree)
    if orders == 1:
        return Field(optics, columns, grid, refine, None, light.sky)
    gather = Gather(optics, grid, Directions.at_nodes(grid, r.up, r.down), r.azimuths)
    project = Projection(grid, gather.directions, r.azimuths, r.degree, channels)
    total, ratio = light, None
    for order in range(2, (orders or r.orders) + 1):
        before, light = light, _relative(refine, *project(gather(refine, light)), r.degree)
        if order == orders:
            return Field(optics, columns, grid, refine, total, total.sky + light.sky)
        total = total.plus(light)
        if orders is None:
            earlier, ratio = ratio, _ratio(grid, light, before)
            if order == r.orders or (
                earlier is not None and _tail_error(grid, total, light, ratio, earlier) < 0.1 * tolerance
            ):
                return Field(optics, columns, grid, refine, *_with_tail(total, light, ratio))
    raise AssertionError("unreachable")


def _relative(refine: Refinement, moments: Any, sky: Any, degree: int) -> Order:
    """An order over the reference."""
    inverse = refine.inverse
    size = refine.size
    lane = dr.arange(dr.uint32_array_t(type(moments)), dr.width(moments))
    per_node = dr.width(moments) // dr.width(sky)
    moments = moments * dr.gather(type(inverse), inverse, lane // (per_node * size) * size + lane % size)
    sky = sky * inverse
    dr.eval(moments, sky)
    return Order(moments, sky, degree, size)


def _ratio(grid: Grid, light: Order, before: Order) -> np.ndarray:
    """Light of an order over that of the order before, [S, size], summed over altitudes."""
    new, old = (o.zeroth().numpy().reshape(*grid.shape, o.size).sum(axis=0) for o in (light, before))
    return np.clip(np.divide(new, old, out=np.zeros_like(new), where=old > 0.0), 0.0, STEADIEST_RATIO)


def _tail_error(grid: Grid, total: Order, light: Order, ratio: np.ndarray, earlier: np.ndarray) -> float:
    """What the geometric tail may be wrong by, relative to all the light: the change of q / (1 - q) since the order before."""
    last, whole = (o.zeroth().numpy().reshape(*grid.shape, o.size).sum(axis=0) for o in (light, total))
    share = np.divide(last, whole, out=np.zeros_like(last), where=whole > 0.0)
    return float(np.max(share * np.abs(ratio / (1.0 - ratio) - earlier / (1.0 - earlier))))


def _with_tail(total: Order, light: Order, ratio: np.ndarray) -> tuple[Order, Any]:
    """The total with q / (1 - q) times the last order added, and its sky irradiance."""
    from .backend import floats

    total = total.plus(light, floats(ratio / (1.0 - ratio)))
    return total, total.sky
