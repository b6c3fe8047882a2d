"""From an atmosphere to a folder of tables that a client loads.

>>> from atmo_jit.export import export
>>> report = export("earth", "takram", "tables")
>>> report.error["day"]["median"], report.warnings
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from .. import __version__
from ..atmosphere import Atmosphere
from ..errors import InputError
from ..files import check_folder
from .containers import document, write_all

LAYOUTS = ("takram", "bruneton", "cosmoscout", "hillaire", "power3d", "native")
PRECISIONS = ("half", "float")
TEXELS = ("exact", "fitted")


@dataclass(frozen=True)
class Options:
    """What a layout lets one choose; None: what the layout has by default.

    ``texels``: "fitted" to err least between the suns (see :mod:`.fitting`; default of the family of ``takram``), or
    "exact" at their centres.
    ``mu_s_min``: cosine of the lowest sun of the scattering table. ``size``: texels of it. ``precision``: "half" or
    "float". ``colour``: "samples" or "spectral" (see :mod:`.colour`). ``tolerance``, ``orders``: of the solution, as
    for :class:`atmo_jit.Sky`. ``altitude_m``, ``sun_zenith_deg``: of tables for one observer and sun.
    """

    mu_s_min: float | None = None
    size: tuple[int, ...] | None = None
    precision: str | None = None
    colour: str | None = None
    tolerance: float = 0.01
    orders: int | None = None
    altitude_m: float | None = None
    sun_zenith_deg: float | None = None
    texels: str | None = None


@dataclass
class Report:
    """What was written: file names, bytes, the error estimate, warnings, and seconds by stage."""

    folder: Path
    files: list[str]
    nbytes: int
    error: dict[str, Any]
    warnings: list[str]
    seconds: dict[str, float] = field(default_factory=dict)


class Clock:
    """Seconds since the last call, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stage(self, name: str) -> None:
        """Book the time since the last stage under ``name``."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def export(
    atmosphere: Any,
    layout: str,
    out: str | Path,
    options: Options | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Report:
    """Solve ``atmosphere`` (what Atmosphere.load takes) and write its tables in ``layout`` into the folder ``out``.

    Everything is read back before it gets its name; params.json comes along. Raises InputError for options that the
    layout does not have and for atmospheres of which the client's picture would be silently wrong, AtmosphereError for
    a bad atmosphere, OSError when a file cannot be written or does not read back.
    """
    if layout not in LAYOUTS:
        raise InputError(f"layout: is {layout!r}; must be one of {', '.join(LAYOUTS)}")
    options = options or Options()
    if options.precision not in (None, *PRECISIONS):
        raise InputError(f"precision: is {options.precision!r}; must be one of {', '.join(PRECISIONS)}")
    if options.texels not in (None, *TEXELS):
        raise InputError(f"texels: is {options.texels!r}; must be one of {', '.join(TEXELS)}")
    folder = check_folder(out)
    air, clock = Atmosphere.load(atmosphere), Clock()
    if not air.constituents:
        raise InputError("atmosphere: has no constituents; an empty sky needs no tables")
    name = "family" if layout in ("takram", "bruneton", "cosmoscout") else layout
    made = import_module(f".{name}", __package__).make(layout, air, options, clock, progress)
    made.parameters["metadata"] = {
        "writtenBy": f"atmo-jit {__version__}",
        "layout": layout,
        **made.metadata,
        "errorEstimate": made.error,
        "warnings": made.warnings,
        "atmosphere": air.to_dict(),
    }
    files = [*made.files, document("params.json", made.parameters)]
    nbytes = write_all(folder, files)
    clock.stage("write and read back")
    return Report(folder, [f.name for f in files], nbytes, made.error, made.warnings, clock.seconds)


@dataclass
class Made:
    """What a layout's module returns: files, the contents of params.json and of its metadata, error and warnings."""

    files: Sequence[Any]
    parameters: dict[str, Any]
    metadata: dict[str, Any]
    error: dict[str, Any]
    warnings: list[str]


def only(layout: str, name: str, value: Any, allowed: Sequence[Any], reason: str) -> Any:
    """``value``, the first of ``allowed`` where it is None. Raises InputError with the ``reason`` for others."""
    if value is None:
        return allowed[0]
    if value not in allowed:
        found = "x".join(map(str, value)) if isinstance(value, tuple) else value
        choices = ["x".join(map(str, v)) if isinstance(v, tuple) else str(v) for v in allowed]
        raise InputError(f"{name}: is {found}; {layout} allows {', '.join(choices)} ({reason})")
    return value


def refuse(layout: str, options: Options, names: Sequence[str]) -> None:
    """Raise InputError for options that the layout does not have."""
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"{name}: is {getattr(options, name)}; the layout {layout} has no such choice")
