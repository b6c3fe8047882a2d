"""Light in planetary atmospheres, differentiable, on Dr.Jit and Mitsuba 3.

    import atmo_jit

    views = {"altitude_m": 0.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [0.0, 45.0, 89.0], "azimuth_deg": 90.0}
    print(atmo_jit.sky("earth", views).radiance)

Importing this package is light: names come from their modules on first use, and neither Dr.Jit nor Mitsuba is
imported. It chooses the LLVM library that Dr.Jit will load (:mod:`atmo_jit.llvm`), so import it before ``drjit`` and
``mitsuba``.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from . import llvm

__version__ = "0.1.0"

_MODULE_OF = {
    "Atmosphere": "atmosphere",
    "AtmosphereError": "errors",
    "Constituent": "atmosphere",
    "InputError": "errors",
    "LLVMError": "errors",
    "Linearization": "derivatives",
    "RayLight": "solved",
    "Sky": "solved",
    "SkyResult": "sky",
    "earth_at": "earth",
    "differentiable": "operation",
    "jacobian": "derivatives",
    "linearize": "derivatives",
}
_MODULES = ("atmosphere", "derivatives", "errors", "phase", "presets", "profile", "sky")

__all__ = ["__version__", *_MODULE_OF, *_MODULES]

# In a source tree the folders plugins/, fits/ and scenes/ lie beside this package; installed, they lie inside it.
_root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if all(os.path.isfile(os.path.join(_root, *name)) for name in (("pyproject.toml",), ("plugins", "__init__.py"))):
    __path__.append(_root)


class _CallableModule(ModuleType):
    """A module that can be called like the function of its name: ``atmo_jit.sky`` is both, whoever imports it first."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.sky(*args, **kwargs)

    @property
    def __signature__(self) -> Any:
        from inspect import signature

        return signature(self.sky)


class _Package(ModuleType):
    """This package's type: the import system sets submodules as attributes here, and ``sky`` then becomes callable."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "sky" and type(value) is ModuleType:
            value.__class__ = _CallableModule
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f".{name}", __name__)
    if name in _MODULE_OF:
        return getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


llvm.configure()
