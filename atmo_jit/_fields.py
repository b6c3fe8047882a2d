"""Checked reading of the numbers in an atmosphere description: one place that knows what "a finite number > 0" means.

Every function takes the plain name of the field for the message; callers that hold the object under a longer name
wrap the call in :func:`atmo_jit.errors.within`. All raise :class:`~atmo_jit.errors.AtmosphereError` and return float
or float64 NumPy arrays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from .errors import AtmosphereError, shown


@dataclass(frozen=True)
class Range:
    """An interval of allowed finite numbers; ``low_open`` and ``high_open`` exclude its ends."""

    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, x: float) -> bool:
        above = x > self.low if self.low_open else x >= self.low
        below = x < self.high if self.high_open else x <= self.high
        return math.isfinite(x) and above and below

    def __str__(self) -> str:
        if math.isinf(self.low) and math.isinf(self.high):
            return ""
        if math.isinf(self.high):
            return f" {'>' if self.low_open else '>='} {self.low:g}"
        return f" in {'(' if self.low_open else '['}{self.low:g}, {self.high:g}{')' if self.high_open else ']'}"


MISSING = "nothing (the key is missing)"
ANY = Range()
POSITIVE = Range(0, low_open=True)
NOT_NEGATIVE = Range(0)
FRACTION = Range(0, 1)
LENGTH = Range(1e-3, 1e12)  # m: of scales of profiles; what is shorter or longer is lost in single precision


def number(value: Any, name: str, allowed: Range = ANY, *, text: str | None = None) -> float:
    """``value`` as a float inside ``allowed``. A bool or a string is no number; NaN and infinities are refused."""
    x = _as_float(value)
    if x is None or x not in allowed:
        raise AtmosphereError(name, shown(value), text or f"a finite number{allowed}")
    return x


def numbers(value: Any, name: str, allowed: Range = ANY, *, least: int = 1) -> np.ndarray:
    """A list of at least ``least`` numbers inside ``allowed``, as a float64 array."""
    if not _is_list(value) or len(value) < least:
        found = f"a list of {len(value)}" if _is_list(value) else shown(value)
        raise AtmosphereError(name, found, f"a list of at least {least} finite number{'s' * (least > 1)}{allowed}")
    return np.fromiter((_element(x, name, i, allowed) for i, x in enumerate(value)), np.float64, len(value))


def per_wavelength(value: Any, name: str, count: int, allowed: Range = ANY) -> np.ndarray:
    """One number for all wavelengths or a list of ``count``, as a float64 array of shape ``[count]``."""
    if _is_list(value):
        if len(value) != count:
            allowed = f"a list of {count} (one for each wavelength) or one number for all"
            raise AtmosphereError(name, f"a list of {len(value)}", allowed)
        return numbers(value, name, allowed)
    text = f"a finite number{allowed}, or a list of {count} (one for each wavelength)"
    return np.full(count, number(value, name, allowed, text=text))


def mapping(value: Any, name: str, required: Sequence[str], optional: Sequence[str] = ()) -> Mapping[str, Any]:
    """``value`` as a mapping that has every ``required`` key and no key beyond those and the ``optional`` ones.

    ``name`` is the field that holds it, ``""`` for the description as a whole.
    """
    known = (*required, *optional)
    prefix = f"{name}." if name else ""
    if not isinstance(value, Mapping):
        raise AtmosphereError(name or "atmosphere", shown(value), f"an object with the keys {', '.join(known)}")
    for key in value:
        if key not in known:
            label = key if isinstance(key, str) and key.isidentifier() else shown(key)
            raise AtmosphereError(f"{prefix}{label}", "an unknown key", f"the keys {', '.join(known)}")
    for key in required:
        if key not in value:
            raise AtmosphereError(f"{prefix}{key}", MISSING, f"the keys {', '.join(known)}")
    return value


def one_of(value: Mapping[str, Any], *groups: Sequence[str]) -> Sequence[str]:
    """The one group of keys that ``value`` has: exactly one group must be there, and it must be complete."""
    present = [group for group in groups if any(key in value for key in group)]
    choice = " or ".join(" with ".join(group) for group in groups)
    if not present:
        raise AtmosphereError(groups[0][0], MISSING, f"exactly one of {choice}")
    if len(present) > 1:
        both = " and ".join(next(key for key in group if key in value) for group in present)
        raise AtmosphereError(present[1][0], f"{both} together", f"exactly one of {choice}")
    for key in present[0]:
        if key not in value:
            raise AtmosphereError(key, MISSING, f"exactly one of {choice}")
    return present[0]


def _element(value: Any, name: str, index: int, allowed: Range) -> float:
    # The common case, without making a name for a message that is not needed.
    if (type(value) is float or (type(value) is int and abs(value) < 2**53)) and value in allowed:
        return value
    return number(value, f"{name}[{index}]", allowed)


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim == 1)


def _as_float(value: Any) -> float | None:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (Integral, Real)):
        return None
    try:
        return float(value)
    except (OverflowError, ValueError, TypeError):  # an integer beyond float's range, or a foreign Real
        return None
