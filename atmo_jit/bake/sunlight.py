"""Direct sunlight anywhere in the air, as a table to be read at every node of many rays."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend import packet, padded, stored, types
from ..column import SunColumns
from ..optics import Optics

SIZE = (192, 640)  # altitudes, sun cosines


class Sunlight:
    """Transmittance from altitude toward the sun: rows even in the square root of altitude, columns even in
    sqrt((mu_s - horizon) / (1 - horizon)), so that both crowd where it changes."""

    def __init__(self, optics: Optics, columns: SunColumns, size: tuple[int, int] = SIZE) -> None:
        t = types()
        self.rows, self.cosines = size
        self.size = padded(optics.channel_count)
        lane = dr.arange(t.UInt, self.rows * self.cosines)
        y, x = t.Float(lane // self.cosines) / (self.rows - 1.0), t.Float(lane % self.cosines) / (self.cosines - 1.0)
        h = optics.thickness * y * y
        horizon = -dr.sqrt(h * (2.0 * optics.radius + h)) / (optics.radius + h)
        depths = optics.optical_depths(columns.toward(h, dr.fma(1.0 - horizon, x * x, horizon)))
        self.table = stored([dr.exp(-d) for d in depths], lane, self.size)

    def at(self, row: Any, x: Any) -> list[Any]:
        """Per channel (and padding), at ``row`` = sqrt(h / thickness) and ``x`` = sqrt((mu_s - horizon) / (1 -
        horizon))."""
        t = types()
        x, row = dr.minimum(x, 1.0) * (self.cosines - 1), row * (self.rows - 1)
        j, i = dr.minimum(t.Int(x), self.cosines - 2), dr.minimum(t.Int(row), self.rows - 2)
        fx, fy = x - t.Float(j), row - t.Float(i)
        corner = t.UInt(dr.fma(i, self.cosines, j))
        a, b, c, d = (packet(self.table, corner + o, self.size) for o in (0, 1, self.cosines, self.cosines + 1))
        return [dr.lerp(dr.lerp(p, q, fx), dr.lerp(r, s, fx), fy) for p, q, r, s in zip(a, b, c, d, strict=True)]
