"""What is remembered, and how much memory that may take."""

from __future__ import annotations

import gc
import weakref

import numpy as np

from atmo_jit.backend import floats
from atmo_jit.kept import Remembered, bytes_kept


class Thing:
    """Refers to itself, as what is built on a grid refers to the grid."""

    def __init__(self, count: int) -> None:
        self.a = np.zeros(count)
        self.b = [floats(np.zeros(100)), {"c": self.a}]
        self.again = self.b
        self.me = self


def test_bytes_kept():
    class Grid:
        def __init__(self):
            self.big = np.zeros(1000)

    thing = Thing(10)
    assert bytes_kept(thing) == 80 + 400
    thing.grid = Grid()
    assert bytes_kept(thing, (Grid,)) == 480
    assert bytes_kept(thing) == 8480


def test_the_last_few_are_remembered():
    remembered, made = Remembered(2), []
    for key in "abacab":
        remembered.of(key, lambda key=key: made.append(key))
    assert made == ["a", "b", "c", "b"]
    remembered.clear()
    remembered.of("b", lambda: made.append("b"))
    assert made[-1] == "b" and len(made) == 5


def test_large_things_leave_the_memory():
    gc.disable()
    try:
        remembered, seen = Remembered(8, most_bytes=20_000), []
        for key in range(8):
            thing = remembered.of(key, lambda: Thing(1000))
            seen.append(weakref.ref(thing))
            del thing
        alive = [key for key, thing in enumerate(seen) if thing() is not None]
    finally:
        gc.enable()
    # Two and the newest; and as much that is forgotten and not collected yet.
    assert alive == sorted(alive) and alive[-3:] == [5, 6, 7] and 3 <= len(alive) <= 6
