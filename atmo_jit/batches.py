"""Views in batches, so that derivatives of many of them take no more memory than those of some."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ._trees import flat, like
from .backend import types
from .pieces import Pieces, room_for

MOST = 1024  # views in a batch: with fewer, what is done once for each takes longer than what they do


@dataclass
class Batches:
    """Batches of ``size`` of ``rays`` views, one after the other, the last filled up with the last view; ``rooms``:
    pieces for which there is room in one, per band (None: there are none)."""

    rays: int
    size: int
    rooms: list[int | None]

    @classmethod
    def of(cls, rays: int, pieces: list[Pieces | None]) -> Batches | None:
        """Batches of as many views each as suits; None: all views are one."""
        count = -(-rays // MOST)
        if count < 2:
            return None
        size = -(-rays // count)
        ends = np.minimum(np.arange(count + 1) * size, rays)
        firsts = [part and part.first.numpy()[ends].astype(int) for part in pieces]
        return cls(rays, size, [None if first is None else room_for(int(np.diff(first).max())) for first in firsts])

    def begins(self) -> Iterator[Any]:
        """The first view of each."""
        for begin in range(0, self.rays, self.size):
            yield dr.opaque(types().UInt, begin, 1)

    def taken(self, begin: Any, views: Any, pieces: list[Pieces | None], weights: Any) -> tuple[Any, ...]:
        """The views, the pieces of their rays, and the weights of one batch; 0 for what fills it up."""
        t = types()
        view, last = begin + dr.arange(t.UInt, self.size), dr.opaque(t.UInt, self.rays - 1, 1)
        there, index = view <= last, dr.minimum(view, last)
        views = like(views, [dr.gather(type(v), v, index) for v in flat(views)])
        weights = like(weights, [dr.gather(type(v), v, index, there) for v in flat(weights)])
        parts = [part and part.taken(begin, self.size, room) for part, room in zip(pieces, self.rooms, strict=True)]
        made = views, parts, weights
        dr.eval(made)
        return made
