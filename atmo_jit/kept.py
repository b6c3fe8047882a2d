"""What is made once and kept with what it was made from, and the memory that this takes."""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from . import noted


class Keeper:
    """Something that keeps what was made from it: ``_kept``, a dictionary."""

    _kept: dict[Any, Any]

    def kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """What ``make`` returns, made once."""
        if key not in self._kept:
            with noted.apart():
                self._kept[key] = make()
        return self._kept[key]


class Remembered:
    """What was made for the last few keys: for ``count`` at most, and beside the newest of no more than ``most_bytes``
    together."""

    def __init__(self, count: int, most_bytes: int | None = None) -> None:
        self._count, self._most_bytes = count, most_bytes
        self._found: OrderedDict[Any, Any] = OrderedDict()
        self._forgotten = 0

    def of(self, key: Any, make: Callable[[], Any]) -> Any:
        """What ``make`` returned for this key."""
        if key not in self._found:
            self._make_room()
            self._found[key] = make()
        self._found.move_to_end(key)
        return self._found[key]

    def _make_room(self) -> None:
        while len(self._found) >= self._count:
            self._found.popitem(last=False)
        if self._most_bytes is None:
            return
        sizes = [bytes_kept(thing) for thing in self._found.values()]
        while sum(sizes) > self._most_bytes:
            self._found.popitem(last=False)
            self._forgotten += sizes.pop(0)
        # What is built on a thing may refer to it: Python sees late that nobody needs them, and Dr.Jit keeps memory.
        if self._forgotten > self._most_bytes:
            self._forgotten = 0
            gc.collect()
            dr.flush_malloc_cache()

    def clear(self) -> None:
        """Forget all."""
        self._found.clear()


def bytes_kept(thing: Any, without: tuple[type, ...] = ()) -> int:
    """Bytes of all Dr.Jit and NumPy arrays that can be reached from an object: what keeping it costs. What can be
    reached only through objects ``without`` is not counted: geometry that is shared between solves, for one."""
    seen: set[int] = set()
    buffers: dict[Any, int] = {}

    def visit(value: Any) -> None:
        if id(value) in seen or isinstance(value, (type, *without)):
            return
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            buffers[id(value)] = value.nbytes
        elif type(value).__module__.startswith("drjit") and hasattr(value, "index_ad"):
            buffers["drjit", value.index] = len(value) * dr.itemsize_v(value)
        elif isinstance(value, dict):
            for child in value.values():
                visit(child)
        elif isinstance(value, (list, tuple, set)):
            for child in value:
                visit(child)
        elif hasattr(value, "__dict__"):
            visit(vars(value))

    visit(thing)
    return sum(buffers.values())
