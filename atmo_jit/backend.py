"""The Dr.Jit types that every kernel of this package uses, chosen in one place.

The solver has array types of its own, whatever Mitsuba variant is active: ``drjit.llvm.ad`` by default,
``drjit.cuda.ad`` after ``use("cuda")``. Kernels ask for ``types()`` when they are traced, never at import.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, wraps
from types import ModuleType
from typing import Any

import numpy as np

from . import noted
from ._trees import flat, like
from .errors import InputError

_NAMES = ("llvm", "cuda")
_selected = "llvm"
_wide = False


def use(name: str) -> None:
    """Select the Dr.Jit backend: ``"llvm"`` (processor) or ``"cuda"``. Raises InputError for any other name."""
    global _selected
    if name not in _NAMES:
        raise InputError(f"backend: {name!r} is not one of {', '.join(_NAMES)}")
    _selected = name


def types() -> ModuleType:
    """The module with ``Float``, ``UInt``, ``Bool``, ``ArrayXf``, ``Float64`` of the selected backend.

    Raises LLVMError when the LLVM backend is selected and no usable libLLVM is there.
    """
    return _widened(_selected) if _wide else _module(_selected)


@contextmanager
def double_precision() -> Iterator[None]:
    """All that is computed in such a block is in double precision, at twice the cost: differences of solves then have
    no noise, and derivatives can be compared with them. What was made outside is not to be used inside."""
    global _wide
    before, _wide = _wide, True
    try:
        yield
    finally:
        _wide = before


@lru_cache(maxsize=2)
def _widened(name: str) -> ModuleType:
    module = _module(name)
    wide = ModuleType(f"{module.__name__}.wide")
    vars(wide).update({n: getattr(module, n) for n in dir(module) if not n.startswith("_")})
    wide.Float, wide.ArrayXf = module.Float64, module.ArrayXf64
    return wide


def _real() -> Any:
    """What NumPy calls a ``Float``."""
    return np.float64 if _wide else np.float32


@lru_cache(maxsize=2)
def _module(name: str) -> ModuleType:
    if name == "cuda":
        import drjit.cuda.ad as module
    else:
        from .llvm import require_llvm

        require_llvm()
        import drjit.llvm.ad as module
    return module


def floats(values: Any) -> Any:
    """A Dr.Jit ``Float`` buffer with the values of an array, flattened in C order."""
    return types().Float(_copied(values, _real()))


def doubles(values: Any) -> Any:
    """A Dr.Jit ``Float64`` buffer with the values of an array, flattened in C order."""
    return types().Float64(_copied(values, np.float64))


def uints(values: Any) -> Any:
    """A Dr.Jit ``UInt`` buffer with the values of an array, flattened in C order."""
    return types().UInt(_copied(values, np.uint32))


def _copied(values: Any, dtype: Any) -> np.ndarray:
    """A flat copy that starts on a 64-byte boundary.

    Dr.Jit uses NumPy's memory as it is and compiles its alignment into the kernel: arrays that happen to lie
    elsewhere would compile the same kernel again.
    """
    flat = np.asarray(values, dtype=dtype).ravel()
    copy = aligned(flat.shape, dtype)
    copy[:] = flat
    return copy


def aligned(shape: Sequence[int], dtype: Any = np.float32) -> np.ndarray:
    """An array with any values, that starts on a 64-byte boundary."""
    count = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.empty(count + 64, dtype=np.uint8)
    skip = -room.ctypes.data % 64
    return room[skip : skip + count].view(dtype).reshape(shape)


def parameter(value: Any) -> Any:
    """A width-1 ``Float`` that kernels read from memory.

    A literal would be compiled into the kernel, and every new atmosphere would compile it again. Dr.Jit values pass
    through with their gradient.
    """
    import drjit as dr

    t = types()
    if isinstance(value, t.Float):
        return value
    if dr.is_array_v(value):
        return t.Float(value)
    return dr.opaque(t.Float, float(value), 1)


def packet(
    buffer: Any, index: Any, count: int, active: Any = True, *, alone: bool = False, once: bool = False
) -> list[Any]:
    """``count`` consecutive values of a Float or UInt ``buffer`` from ``index * count`` on, as a list: packet loads
    where the count is a power of two. Other counts are slow to run, and slower to compile. ``alone``: nothing else
    reads the buffer; each thread then sums its derivatives for itself. ``once``: nor does a lane read what another
    does; there is nothing to sum."""
    import drjit as dr

    t, mode = types(), dr.ReduceMode.Expand if alone else dr.ReduceMode.Auto
    mode = dr.ReduceMode.NoConflicts if once else mode
    one, several = (t.UInt, t.ArrayXu) if isinstance(buffer, t.UInt) else (t.Float, t.ArrayXf)
    if count == 1:
        return [dr.gather(one, buffer, index, active, mode=mode)]
    values = dr.gather(several, buffer, index, active, mode=mode, shape=(count, dr.width(index)))
    return [values[i] for i in range(count)]


_alone = threading.RLock()


def one_at_a_time(work: Callable[..., Any]) -> Callable[..., Any]:
    """``work`` for one thread at a time: what is kept with a grid, recordings above all, is everyone's, and Dr.Jit
    does not record or play back one in two threads at once."""

    @wraps(work)
    def alone(*arguments: Any, **options: Any) -> Any:
        with _alone:
            return work(*arguments, **options)

    return alone


def not_negative(value: Any) -> Any:
    """max(value, 0) with the derivative from above at 0, where dr.maximum has none: ground that is black, or aerosol
    that is not there yet, sends the first light when it changes."""
    import drjit as dr

    return dr.select(value < 0.0, 0.0, value)


def padded(channel_count: int) -> int:
    """Floats stored per entry of a table: a packet load wants a power of two."""
    return 4 if channel_count == 3 else channel_count


def row_size(count: int) -> int:
    """Floats stored for a row of ``count``: 1, 2 or 4, then multiples of 8, which load in packets."""
    return 1 << (count - 1).bit_length() if count <= 4 else -(-count // 8) * 8


def row(
    buffer: Any, index: Any, count: int, length: int | None = None, active: Any = True, **readers: bool
) -> list[Any]:
    """The first ``count`` values of row ``index`` of a table of rows of ``length`` (default: ``count``); ``readers``:
    see packet."""
    size = row_size(length or count)
    step = min(size, 8)
    parts = [packet(buffer, index * (size // step) + i, step, active, **readers) for i in range(count // step)]
    done = count - count % step
    if done < count:
        last = row_size(count - done)
        parts.append(packet(buffer, index * (size // last) + done // last, last, active, **readers))
    return [value for part in parts for value in part][:count]


def table_of(values: Sequence[Any], lane: Any) -> Any:
    """Floats of one width as a table of rows, one per lane, evaluated."""
    return tables_of([values], lane)[0]


def table(values: Any) -> Any:
    """A NumPy array [..., count] as a table of rows, of UInts if it is one of integers."""
    values = np.asarray(values)
    whole = values.dtype.kind in "iu"
    rows = np.zeros((*values.shape[:-1], row_size(values.shape[-1])), dtype=np.uint32 if whole else _real())
    rows[..., : values.shape[-1]] = values
    return (uints if whole else floats)(rows)


def stored(values: Sequence[Any], lane: Any, size: int) -> Any:
    """A few Floats as one buffer [lane, size], evaluated; zeros where there are fewer than ``size``."""
    return _stored([values], lane, [size])[0]


def tables_of(groups: Sequence[Sequence[Any]], lane: Any) -> list[Any]:
    """Each group of Floats as a table of rows, one per lane, evaluated together: in one kernel."""
    return _stored(groups, lane, [row_size(len(values)) for values in groups])


def _stored(groups: Sequence[Sequence[Any]], lane: Any, sizes: list[int]) -> list[Any]:
    import drjit as dr

    known = noted.take(len(sizes))
    if known is None:
        return evaluated([scattered(values, lane, size) for values, size in zip(groups, sizes, strict=True)])
    if not dr.grad_enabled(groups):
        return known
    zero = dr.zeros(types().Float, dr.width(lane))
    return dr.custom(_operations()[1], [[value + zero for value in values] for values in groups], lane, sizes, known)


def scattered(values: Sequence[Any], lane: Any, size: int) -> Any:
    """The same of one buffer, not evaluated."""
    import drjit as dr

    t = types()
    out = dr.empty(t.Float, dr.width(lane) * size)  # every lane writes its row
    padded_values = [*values, *[t.Float(0.0)] * (size - len(values))]
    dr.scatter(out, t.ArrayXf(padded_values) if size > 1 else padded_values[0], lane)
    return out


def evaluated(buffer: Any) -> Any:
    """A Float that later kernels gather from: evaluated now, and so are its derivatives when they come by.

    Several Floats in a list are evaluated together, in one kernel if they are of one width; so are their derivatives.
    Where they are known (noted.knowing) they are not computed, and only derivatives are.

    Dr.Jit leaves the derivatives of a gather or scatter pending, and a loop that reads them while it is traced aborts
    the process ("dirty variable").
    """
    import drjit as dr

    if not isinstance(buffer, list):
        return evaluated([buffer])[0]
    known = noted.take(len(buffer))
    if known is None:
        dr.eval(buffer)
        noted.note(buffer)
    return together(buffer, known)


def together(values: list[Any], known: list[Any] | None = None) -> list[Any]:
    """The same Floats, whose derivatives are evaluated together when they come by: in one kernel if they are of one
    width. One by one, each would run everything that they have in common once more. ``known``: their values."""
    import drjit as dr

    places = [i for i, value in enumerate(values) if dr.grad_enabled(value)]
    given = [values[i] for i in places]
    values = list(known or values)
    if places:
        new = dr.custom(_operations()[0], given, [values[i] for i in places] if known else None)
        for i, value in zip(places, new, strict=True):
            values[i] = value
    return values


def spread(numbers: list[Any], width: int) -> list[Any]:
    """Floats of width 1 as Floats of ``width``, for a kernel that uses them in every lane: their derivatives, sums over
    the lanes, are evaluated together (see together)."""
    import drjit as dr

    zero = dr.zeros(types().Float, width)
    return together([number + zero for number in numbers])


def sum_loop(
    state: tuple[Any, ...], condition: Callable[..., Any], body: Callable[..., Any], shared: Any, label: str
) -> tuple[Any, ...]:
    """A loop that only adds to its state, so that derivatives pass through it forwards and backwards with nothing kept.

    ``body`` and ``condition`` take the state; ``body`` after it ``shared``, lists and dictionaries of arrays of the
    loop's width, which it may use. Those that carry derivatives go through the loop as part of its state: the
    derivatives of what a body takes from outside are summed in memory instead, atomically, at every turn.
    """
    import drjit as dr

    leaves = flat(shared)
    places = [i for i, leaf in enumerate(leaves) if dr.grad_enabled(leaf)]

    def turn(*arguments: Any) -> tuple[Any, ...]:
        *own, carried = arguments
        inside = list(leaves)
        for i, leaf in zip(places, carried, strict=True):
            inside[i] = leaf
        return (*body(*own, like(shared, inside)), carried)

    start = (*state, [leaves[i] for i in places])
    return dr.while_loop(start, lambda *a: condition(*a[:-1]), turn, max_iterations=-1, label=label)[:-1]


def set_rows(table: Any, rows: Sequence[Sequence[Any]], index: Any, active: Any = True) -> None:
    """Write as many ``rows`` of a table as are given, side by side: the ``index``-th of such blocks, one a lane."""
    import drjit as dr

    t, fill = types(), row_size(len(rows[0])) - len(rows[0])
    values = [value for values in rows for value in [*values, *[t.Float(0.0)] * fill]]
    dr.scatter(table, t.ArrayXf(values) if len(values) > 1 else values[0], index, active)


@contextmanager
def traversing() -> Iterator[None]:
    """Derivatives are to be propagated through this package's kernels in such a block.

    Dr.Jit 1.5 aborts the process ("dirty variable") where it sums derivatives into copies of a buffer, one per thread,
    in a kernel with a loop; here it sums into the buffer itself.
    """
    import drjit as dr

    threshold = dr.expand_threshold()
    dr.set_expand_threshold(0)
    try:
        yield
    finally:
        dr.set_expand_threshold(threshold)


@lru_cache(maxsize=1)
def _operations() -> tuple[type, type]:
    import drjit as dr

    class Together(dr.CustomOp):
        def eval(self, values: list[Any], known: list[Any] | None) -> list[Any]:
            return list(known or values)

        def forward(self) -> None:
            grads = self.grad_in("values")
            dr.eval(grads)
            self.set_grad_out(grads)

        def backward(self) -> None:
            grads = self.grad_out()
            dr.eval(grads)
            self.set_grad_in("values", grads)

        def name(self) -> str:
            return "together"

    class Stored(dr.CustomOp):
        def eval(self, groups: list[list[Any]], lane: Any, sizes: list[int], known: list[Any]) -> list[Any]:
            self.lane, self.sizes, self.counts = lane, sizes, [len(values) for values in groups]
            return known

        def forward(self) -> None:
            steps = zip(self.grad_in("groups"), self.sizes, strict=True)
            grads = [scattered(values, self.lane, size) for values, size in steps]
            dr.eval(grads)
            self.set_grad_out(grads)

        def backward(self) -> None:
            grads = self.grad_out()
            dr.eval(grads)
            rows = [packet(grad, self.lane, size) for grad, size in zip(grads, self.sizes, strict=True)]
            self.set_grad_in("groups", [values[:n] for values, n in zip(rows, self.counts, strict=True)])

        def name(self) -> str:
            return "stored"

    return Together, Stored
