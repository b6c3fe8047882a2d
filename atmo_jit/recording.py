"""Functions of Dr.Jit arrays that are recorded when called again (dr.freeze), and played back from then on.

A solve is a hundred small kernels, and tracing them costs more than running them.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable
from typing import Any

import drjit as dr

from .grid import arrays_in


class Recordings:
    """Recordings of functions whose arguments hold all that changes; what they read beside is kept with a grid, or with
    the other objects that are given here.

    The first call of each is plain, since it makes what is kept. Derivatives do not pass through a recording: a
    function that is recorded may propagate them inside.
    """

    def __init__(self, *keepers: Any) -> None:
        self._keepers = keepers
        self._recorded: dict[Any, Callable[..., Any]] = {}
        self._used: set[Any] = set()

    def run(self, key: Any, function: Callable[..., Any], *arguments: Any, prepare: Any = None) -> Any:
        """What ``function`` returns; ``key`` tells functions apart. ``prepare``: the part of the function that makes
        what is kept, called in place of the first, plain call: kernels differ where they are recorded, and those of the
        rest are then compiled once."""
        if key not in self._used:
            self._used.add(key)
            if prepare is None:
                made = function(*arguments)
                give_back()
                return made
            prepare(*arguments)
        known = key in self._recorded
        if not known:
            arrays = arrays_in(self._keepers)
            self._recorded[key] = dr.freeze(function, state_fn=lambda *_: arrays)
        # Dr.Jit aborts the process if an array that borrows NumPy's memory dies while it records, so the garbage
        # collector has to wait.
        collects = gc.isenabled()
        gc.disable()
        try:
            made = self._recorded[key](*arguments)
        finally:
            if collects:
                gc.enable()
        if not known:
            give_back()
        return made


def give_back() -> None:
    """Give free memory back to the system: what Dr.Jit keeps for arrays to come, and what tracing and compiling left in
    glibc's heap, half as much as all arrays of a solve and its derivatives."""
    dr.sync_thread()
    dr.flush_malloc_cache()
    if sys.platform == "linux":  # Windows has no library of the process itself
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:  # musl has none
            trim(0)


def copied(tree: Any) -> Any:
    """Dictionaries and lists of arrays of their own: derivatives that these carry do not show on the originals."""
    if isinstance(tree, dict):
        return {key: copied(part) for key, part in tree.items()}
    if isinstance(tree, list):
        return [copied(part) for part in tree]
    return type(tree)(tree)
