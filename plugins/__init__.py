"""Mitsuba 3 plugins: the emitter ``atmosphere``.

>>> import mitsuba as mi
>>> mi.set_variant("llvm_ad_rgb")
>>> import atmo_jit.plugins
>>> atmo_jit.plugins.register()
>>> scene = mi.load_dict({"type": "scene", "sky": {"type": "atmosphere", "sun_direction": [1, 0, 1]}})

Importing this package registers nothing and does not import Mitsuba.
"""

from __future__ import annotations

from functools import cache
from typing import Any

__all__ = ["register"]


def register() -> None:
    """Make the plugins known to Mitsuba, in the current variant and in every one that ``mi.set_variant`` selects later.

    May be called any number of times, before or after a variant is set.
    """
    import atmo_jit  # noqa: F401  (points Dr.Jit at a usable LLVM library before Mitsuba imports it)
    import mitsuba as mi

    mi.detail.add_variant_callback(_on_variant)
    if mi.variant() is not None:
        _on_variant(None, mi.variant())


def _on_variant(old: str | None, new: str) -> None:
    """Called by Mitsuba after each change of variant."""
    import mitsuba as mi

    # Mitsuba asks scalar_rgb what kind of object a plugin is, whatever the variant.
    for module in (mi, mi.scalar_rgb):
        module.register_emitter("atmosphere", _emitter)


def _emitter(props: Any) -> Any:
    """The constructor that Mitsuba calls, in the variant that is current then."""
    import mitsuba as mi

    return _emitter_class(mi.variant())(props)


@cache
def _emitter_class(variant: str) -> type:
    """Plugin classes inherit from the variant's own Emitter, so there is one per variant, made when it is first needed."""
    from .emitter import AtmosphereEmitter
    from .variants import bound

    return bound(AtmosphereEmitter, "Emitter")
