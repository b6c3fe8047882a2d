"""The Dr.Jit types that every kernel of this package uses, chosen in one place.

The solver has array types of its own, whatever Mitsuba variant is active: ``drjit.llvm.ad`` by default,
``drjit.cuda.ad`` after ``use("cuda")``. Kernels ask for ``types()`` when they are traced, never at import.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from .errors import InputError

_NAMES = ("llvm", "cuda")
_selected = "llvm"


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
    if _selected == "cuda":
        import drjit.cuda.ad as module
    else:
        from .llvm import require_llvm

        require_llvm()
        import drjit.llvm.ad as module
    return module


def floats(values: Any) -> Any:
    """A Dr.Jit ``Float`` buffer with the values of an array, flattened in C order."""
    return types().Float(_aligned(values, np.float32))


def doubles(values: Any) -> Any:
    """A Dr.Jit ``Float64`` buffer with the values of an array, flattened in C order."""
    return types().Float64(_aligned(values, np.float64))


def uints(values: Any) -> Any:
    """A Dr.Jit ``UInt`` buffer with the values of an array, flattened in C order."""
    return types().UInt(_aligned(values, np.uint32))


def _aligned(values: Any, dtype: Any) -> np.ndarray:
    """A flat copy that starts on a 64-byte boundary.

    Dr.Jit uses NumPy's memory as it is and compiles its alignment into the kernel: arrays that happen to lie
    elsewhere would compile the same kernel again.
    """
    flat = np.asarray(values, dtype=dtype).ravel()
    room = np.empty(flat.nbytes + 64, dtype=np.uint8)
    skip = -room.ctypes.data % 64
    copy = room[skip : skip + flat.nbytes].view(dtype)
    copy[:] = flat
    return copy


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


def packet(buffer: Any, index: Any, count: int, active: Any = True) -> list[Any]:
    """``count`` consecutive floats starting at ``index * count``, as a list of Floats: packet loads where the count
    allows."""
    import drjit as dr

    t = types()
    if count == 1:
        return [dr.gather(t.Float, buffer, index, active)]
    values = dr.gather(t.ArrayXf, buffer, index, active, shape=(count, dr.width(index)))
    return [values[i] for i in range(count)]


def channels(values: Sequence[Any]) -> list[Any]:
    """A list of opaque parameters, one per entry."""
    return [parameter(v) for v in values]


def padded(channel_count: int) -> int:
    """Floats stored per entry of a table: a packet load wants a power of two."""
    return 4 if channel_count == 3 else channel_count


def scatter_packet(buffer: Any, values: Sequence[Any], index: Any, size: int) -> None:
    """Write ``values`` to ``size`` consecutive floats from ``index * size``, zeros where there are fewer."""
    import drjit as dr

    t = types()
    if size == 1:
        dr.scatter(buffer, values[0], index)
    else:
        dr.scatter(buffer, t.ArrayXf([*values, *[t.Float(0.0)] * (size - len(values))]), index)


def stored(values: Sequence[Any], lane: Any, size: int) -> Any:
    """A few Floats as one buffer [lane, size], evaluated; zeros where there are fewer than ``size``."""
    import drjit as dr

    out = dr.zeros(types().Float, dr.width(lane) * size)
    scatter_packet(out, values, lane, size)
    dr.eval(out)
    return out
