"""Shader text from the package's own arithmetic: code that works on arrays, run on names, prints what it does.

:class:`Value` stands for a number or truth value of a shader. Every operation on it writes one line of source; what
:mod:`atmo_jit.mapping` does to a texel is so printed and not written a second time. GLSL ES 3.0 and HLSL share the
subset that is used.

>>> from atmo_jit.mapping import half_elevation
>>> block = Block()
>>> result = half_elevation(block.name("mu"))
>>> print("\\n".join(block.lines), result.text)
"""

from __future__ import annotations

import math
from typing import Any


class Block:
    """Lines of one function's body, each a constant; the same operation on the same values is written once."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._known: dict[str, Value] = {}

    def name(self, text: str, kind: str = "float") -> Value:
        """A value that the shader already has under this name."""
        return Value(self, text, kind)

    def store(self, expression: str, kind: str = "float") -> Value:
        """A new constant."""
        if expression not in self._known:
            value = Value(self, f"t{len(self.lines)}", kind)
            self.lines.append(f"{kind} {value.text} = {expression};")
            self._known[expression] = value
        return self._known[expression]


class _Functions:
    """What mapping code calls on a module, by NumPy's and Dr.Jit's names."""

    @staticmethod
    def _call(name: str, *values: Any) -> Value:
        block = next(v.block for v in values if isinstance(v, Value))
        return block.store(f"{name}({', '.join(text(v) for v in values)})")

    def sqrt(self, x: Any) -> Value:
        return self._call("sqrt", x)

    def acos(self, x: Any) -> Value:
        return self._call("acos", x)

    def atan(self, x: Any) -> Value:
        return self._call("atan", x)

    def tan(self, x: Any) -> Value:
        return self._call("tan", x)

    def cos(self, x: Any) -> Value:
        return self._call("cos", x)

    def maximum(self, a: Any, b: Any) -> Value:
        return self._call("max", a, b)

    def minimum(self, a: Any, b: Any) -> Value:
        return self._call("min", a, b)

    def clip(self, x: Any, low: Any, high: Any) -> Value:
        return self._call("clamp", x, low, high)

    def select(self, condition: Any, a: Any, b: Any) -> Any:
        if not isinstance(condition, Value):
            return a if condition else b
        return condition.block.store(f"{condition.text} ? {text(a)} : {text(b)}")


def text(value: Any) -> str:
    """A value or number as source; raises ValueError for numbers that a shader cannot hold."""
    if isinstance(value, Value):
        return value.text
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} cannot be written in a shader")
    digits = f"{number:.9g}"
    return digits if any(c in digits for c in ".e") else f"{digits}.0"


class Value:
    """A named number (``kind`` "float") or truth value ("bool") of a block."""

    array_module = _Functions()  # found by _arrays.module_of
    __array_ufunc__ = None  # NumPy numbers on the left leave the operation to this class

    def __init__(self, block: Block, text: str, kind: str) -> None:
        self.block, self.text, self.kind = block, text, kind

    def _binary(self, sign: str, other: Any, kind: str = "float", swapped: bool = False) -> Value:
        a, b = (text(other), self.text) if swapped else (self.text, text(other))
        return self.block.store(f"{a} {sign} {b}", kind)

    def __add__(self, other: Any) -> Value:
        return self._binary("+", other)

    def __radd__(self, other: Any) -> Value:
        return self._binary("+", other, swapped=True)

    def __sub__(self, other: Any) -> Value:
        return self._binary("-", other)

    def __rsub__(self, other: Any) -> Value:
        return self._binary("-", other, swapped=True)

    def __mul__(self, other: Any) -> Value:
        return self._binary("*", other)

    def __rmul__(self, other: Any) -> Value:
        return self._binary("*", other, swapped=True)

    def __truediv__(self, other: Any) -> Value:
        return self._binary("/", other)

    def __rtruediv__(self, other: Any) -> Value:
        return self._binary("/", other, swapped=True)

    def __pow__(self, exponent: Any) -> Value:
        return self.array_module._call("pow", self, exponent)

    def __neg__(self) -> Value:
        return self.block.store(f"-{self.text}")

    def __abs__(self) -> Value:
        return self.array_module._call("abs", self)

    def __lt__(self, other: Any) -> Value:
        return self._binary("<", other, "bool")

    def __le__(self, other: Any) -> Value:
        return self._binary("<=", other, "bool")

    def __gt__(self, other: Any) -> Value:
        return self._binary(">", other, "bool")

    def __ge__(self, other: Any) -> Value:
        return self._binary(">=", other, "bool")

    def __and__(self, other: Any) -> Value:
        return self._binary("&&", other, "bool")

    def __invert__(self) -> Value:
        return self.block.store(f"!{self.text}", "bool")
