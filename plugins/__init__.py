"""Mitsuba 3 plugins: see ``PLUGINS``.

>>> import mitsuba as mi
>>> mi.set_variant("llvm_ad_rgb")
>>> import atmo_jit.plugins
>>> atmo_jit.plugins.register()
>>> scene = mi.load_dict({"type": "scene", "sky": {"type": "atmosphere", "sun_direction": [1, 0, 1]}})

Importing this package registers nothing and does not import Mitsuba.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module

__all__ = ["PLUGINS", "register"]

# Plugin: its kind and base class in Mitsuba, the module here and the class in it.
PLUGINS = {
    "atmosphere": ("emitter", "Emitter", "emitter", "AtmosphereEmitter"),
    "atmosphere_needs": ("emitter", "Emitter", "needs", "AtmosphereNeeds"),
    "atmosphere_sun": ("emitter", "Emitter", "reference", "AtmosphereSun"),
    "atmosphere_path": ("integrator", "SamplingIntegrator", "path", "AtmospherePath"),
    "atmosphere_volpath": ("integrator", "SamplingIntegrator", "volpath", "AtmosphereVolpath"),
    "atmosphere_medium": ("medium", "Medium", "medium", "AtmosphereMedium"),
    "cornette_shanks": ("phase", "PhaseFunction", "cornette_shanks", "CornetteShanksPhase"),
    "fisheye": ("sensor", "Sensor", "sensors", "Fisheye"),
    "latlong": ("sensor", "Sensor", "sensors", "LatLong"),
}


def register() -> None:
    """Make the plugins known to Mitsuba, in the current variant and in every one that ``mi.set_variant`` selects later.

    May be called any number of times, before or after a variant is set.
    """
    import atmo_jit  # noqa: F401, I001  (first: it points Dr.Jit at a usable LLVM library before Mitsuba imports it)
    import drjit as dr
    import mitsuba as mi

    if dr.thread_count() == 1:  # one processor: Mitsuba's writer of OpenEXR waits for another thread, without end
        dr.set_thread_count(2)
    mi.detail.add_variant_callback(_on_variant)
    if mi.variant() is not None:
        _on_variant(None, mi.variant())


def _on_variant(old: str | None, new: str) -> None:
    """Called by Mitsuba after each change of variant."""
    import mitsuba as mi

    # Mitsuba asks scalar_rgb what kind of object a plugin is, whatever the variant.
    for module in (mi, mi.scalar_rgb):
        for name, (kind, *_) in PLUGINS.items():
            getattr(module, f"register_{kind}")(name, lambda props, name=name: plugin_class(name)(props))


def plugin_class(name: str) -> type:
    """The class of a plugin in the current variant."""
    import mitsuba as mi

    return _plugin_class(name, mi.variant())


@cache
def _plugin_class(name: str, variant: str) -> type:
    """Plugin classes inherit from the variant's own base class: there is one per variant, made when first needed."""
    from .variants import bound

    _, base, module, description = PLUGINS[name]
    return bound(getattr(import_module(f"{__name__}.{module}"), description), base)
