"""Plugin classes for every variant from one description."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def bound(description: type, base: str) -> type:
    """A subclass of ``mi.<base>`` of the current variant with the attributes of ``description`` and of its own base
    classes.

    Mitsuba's classes allow no second base class, so the attributes are copied. ``description`` calls inherited
    methods as ``mi.<base>.method(self, ...)``.
    """
    skipped = ("__dict__", "__weakref__")
    attributes: dict[str, Any] = {}
    for source in reversed(description.__mro__[:-1]):
        attributes |= {k: v for k, v in vars(source).items() if k not in skipped}
    return type(getattr(mi, base))(description.__name__, (getattr(mi, base),), attributes)
