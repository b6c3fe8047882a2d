"""Where on a ray shapes can keep the sun away: the box around all shapes, drawn out away from the sun."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def shadowed_interval(box: Any, sun: Any, ray: Any, length: Any) -> tuple[Any, Any]:
    """First and last distance, in [0, ``length``], of the points of a ray from which a ray towards ``sun`` meets
    ``box``; an empty interval (last = first) where there are none.

    ``sun`` is a unit vector. A point o + t d sees the box at the distance s where box.min <= o + t d + s sun <=
    box.max, s >= 0: six bounds of s that are linear in t, and every lower one must be below every upper one.
    """
    lower, upper = [(mi.Float(0.0), mi.Float(0.0))], []  # (a, b): s >= a + b t, s <= a + b t
    begin, end = mi.Float(0.0), mi.Float(length)
    for axis in range(3):
        inverse = 1.0 / dr.select(dr.abs(sun[axis]) > FLAT, sun[axis], dr.copysign(mi.Float(FLAT), sun[axis]))
        ends = [((bound[axis] - ray.o[axis]) * inverse, -ray.d[axis] * inverse) for bound in (box.min, box.max)]
        forward = inverse > 0.0
        lower.append(tuple(dr.select(forward, a, b) for a, b in zip(*ends, strict=True)))
        upper.append(tuple(dr.select(forward, b, a) for a, b in zip(*ends, strict=True)))
    for low in lower:
        for high in upper:
            # low.a + low.b t <= high.a + high.b t
            room, slope = high[0] - low[0], low[1] - high[1]
            limit = room / slope
            end = dr.select(slope > 0.0, dr.minimum(end, limit), end)
            begin = dr.select(slope < 0.0, dr.maximum(begin, limit), begin)
            end = dr.select((slope == 0.0) & (room < 0.0), begin, end)
    begin = dr.minimum(begin, length)
    return begin, dr.maximum(end, begin)


FLAT = 1e-6  # a sun exactly along an axis is moved by this
