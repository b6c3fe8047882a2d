"""Visits of paths in groups at one level: what a lane reads of the light there serves all of a group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .backend import row, uints
from .paths import Paths

TOGETHER = 2  # visits of a group
WIDE = 32  # numbers that are summed for each: of more there is no room for several


@dataclass(frozen=True)
class Visits:
    """Groups of ``together`` visits, in the order of their first: ``members`` [groups, together], ``level`` of each;
    ``place`` [visits]: where each is among the members, where some are there twice for want of another at their level.
    ``at_levels``: the groups level by level, from ``first`` [K + 1] on."""

    paths: Paths
    together: int
    members: Any
    level: Any
    at_levels: Any
    first: np.ndarray
    place: np.ndarray

    @classmethod
    def of(cls, paths: Paths, width: int) -> Visits:
        """The groups for sums of ``width`` numbers, kept with the paths."""
        together = TOGETHER if width <= WIDE else 1
        return paths.kept(("visits", together), lambda: cls._made(paths, together))

    @classmethod
    def _made(cls, paths: Paths, together: int) -> Visits:
        count = int(paths.level.max(initial=0)) + 1
        found = []
        for visits in (np.flatnonzero(paths.level == level) for level in range(count)):
            # Visits of neighbouring rays: what reads along one ray finds them side by side.
            found.append(np.pad(visits, (0, -len(visits) % together), mode="edge" if len(visits) else "constant"))
        members = np.concatenate(found).reshape(-1, together)
        members = members[np.argsort(members[:, 0], kind="stable")]
        level = paths.level[members[:, 0]]
        flat = members.ravel()
        place = np.empty(len(paths.level), int)
        place[flat[::-1]] = np.arange(len(flat))[::-1]
        first = np.searchsorted(np.sort(level), np.arange(count + 1))
        order = np.argsort(level, kind="stable")
        return cls(paths, together, uints(members), uints(level), uints(order), first, place)

    @property
    def groups(self) -> int:
        """How many there are."""
        return len(self.at_levels)

    def rows_of_suns(self, suns: int) -> Any:
        """Row of every visit under the first of as many suns in a table whose rows are those of a group under one sun,
        under the next, and so on: under the next sun it is ``together`` further."""
        return self.paths.kept(("rows", self.together, suns), lambda: uints(self.rows(suns)))

    def rows(self, suns: int) -> np.ndarray:
        """The same as a NumPy array."""
        group, member = np.divmod(self.place, self.together)
        return group * suns * self.together + member


def weighed(basis: Any, weights: Any, place: Any, orders: int, channels: int) -> list[Any]:
    """What moments of one degree count at a visit, [m x channels]: harmonic times weight."""
    harmonics, counts = row(basis, place, orders), row(weights, place, channels)
    return [harmonic * count for harmonic in harmonics for count in counts]
