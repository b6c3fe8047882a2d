"""Run time against error of every method and setting on this machine, with the peers that are installed.

``atmo-jit bench --out DIR`` writes ``bench.json``, ``bench.png`` and ``bench.md``; :func:`measure` returns what the
JSON holds::

    schema       2
    atmo_jit     version
    machine      processor, cores, threads, march_steps_per_s, gathers_per_s, instructions_per_s, ns_per_step_core
    truth        what errors are measured against
    atmosphere   the one whose solve is timed
    frontier     a row per method and setting:
        method, setting, what
        cases    "all", or the names of the atmospheres of the reference that were asked
        groups   a row per group of rays (bench.truth): group, rays; median, p95, max and the same beyond three sigma
                 (beyond_median ...) in per cent; cpu_s: mean CPU seconds of the solves behind these rays, warm kernels
        cost     for ``atmosphere``: cold, cached, warm (each wall_s and cpu_s), peak_mib, solution_bytes (bench.cost)
    own_on_few   error rows of this package on the few cases that slow methods are asked for
    stages       solve, rays: rows as from bench.limits.stages
    tables       what it costs to make tables and to read pictures from them: rows as from bench.tables.times
    peers        rows as from bench.peers
    curves       resolution, wavelengths, views, threads (bench.curves)
    skipped      what was not measured, and why
    seconds      of the whole run
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import atmo_jit
from atmo_jit.errors import InputError

from . import cost, limits
from .methods import DEFAULT_TOLERANCE, METHODS, Method, method_of
from .truth import FEW_CASES, Truth

SCHEMA = 2
PARTS = ("frontier", "stages", "tables", "peers", "curves")
# What --quick keeps: the settings that say most, and what takes seconds.
QUICK = {"atmo-jit": ("tolerance 0.01",), "hillaire2020": ("size 1",)}
Advance = Callable[[float], None]


def measure(
    *,
    reference: Path | None = None,
    atmosphere: str = "earth",
    methods: Iterable[str] | None = None,
    parts: Iterable[str] = PARTS,
    quick: bool = False,
    most_views: int = 10**6,
    advance: Advance = lambda fraction: None,
) -> dict[str, Any]:
    """Everything that the JSON holds; ``advance`` is called with the fraction done.

    ``reference``: folder of ``sky_radiance.npz`` (None: beside the repository where it is there, else errors are
    measured against this package). ``quick``: a minute, for a look and for tests.
    """
    start = time.perf_counter()
    skipped: list[dict[str, str]] = []
    parts = tuple(parts)
    wanted = _wanted(methods, quick, skipped)
    needs_truth = "frontier" in parts or "peers" in parts
    truth = _truth(reference, quick, skipped) if needs_truth else None
    machine = {"processor": _processor(), "cores": os.cpu_count(), **limits.machine()}
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "atmo_jit": atmo_jit.__version__,
        "machine": machine,
        "truth": truth.name if truth else None,
        "atmosphere": atmosphere,
    }
    advance(0.02)
    if "frontier" in parts:
        rows, total = [], sum(len(settings) for _, settings in wanted)
        for method, settings in wanted:
            for setting in settings:
                rows.append(_row(method, setting, truth, atmosphere, quick))
                advance(0.02 + 0.6 * len(rows) / total)
        result["frontier"] = rows
        few = tuple(case.name for case in truth.cases if case.name in FEW_CASES)
        if few and any(row["cases"] != "all" for row in rows):
            own = METHODS["atmo-jit"]
            value, seconds = truth.radiance(lambda a: own.solve(f"tolerance {DEFAULT_TOLERANCE:g}", a), few)
            result["own_on_few"] = truth.rows(value, seconds)
    if "stages" in parts:
        result["stages"] = _stages(atmosphere, machine, quick)
        advance(0.65)
    if "tables" in parts:
        from . import tables

        if quick:
            skipped.append({"what": "tables", "reason": "--quick"})
        else:
            result["tables"] = list(tables.times(atmosphere))
    if "peers" in parts:
        from . import peers

        result["peers"] = peers.rows(truth, quick, skipped)
        advance(0.85)
    if "curves" in parts:
        from . import curves

        result["curves"] = curves.measure(atmosphere, quick, most_views, skipped)
    advance(1.0)
    return {**result, "skipped": skipped, "seconds": time.perf_counter() - start}


def _wanted(
    methods: Iterable[str] | None, quick: bool, skipped: list[dict[str, str]]
) -> list[tuple[Method, tuple[str, ...]]]:
    names = tuple(methods) if methods else tuple(METHODS)
    chosen = []
    for method in (method_of(name) for name in names):
        settings = method.settings
        if quick and not methods:
            settings = QUICK.get(method.name, ())
            left = [s for s in method.settings if s not in settings]
            if left:
                skipped.append({"what": f"{method.name}: {', '.join(left)}", "reason": "--quick"})
        elif quick:
            settings = settings[:1]
        if settings:
            chosen.append((method, settings))
    return chosen


def _truth(folder: Path | None, quick: bool, skipped: list[dict[str, str]]) -> Truth:
    try:
        return Truth.of_reference(folder)
    except FileNotFoundError as error:
        if folder:
            raise InputError(f"--reference: {error}") from None
        skipped.append({"what": "errors against independent references", "reason": str(error)})
        return Truth.of_package(10, 0.03, 1.4) if quick else Truth.of_package()


def _row(method: Method, setting: str, truth: Truth, atmosphere: str, quick: bool) -> dict[str, Any]:
    """One method at one setting: its errors and what it costs."""
    full = method.slow and setting == method.settings[-1]
    few = tuple(case.name for case in truth.cases if case.name in FEW_CASES) if method.slow or quick else ()
    value, seconds = truth.radiance(lambda air: method.solve(setting, air), few or None)
    return {
        "method": method.name,
        "setting": setting,
        "what": method.what,
        "cases": list(few) if few else "all",
        "groups": truth.rows(value, seconds),
        "cost": cost.cost(method.name, setting, atmosphere, 0 if full else 1 if quick else cost.REPEATS),
    }


def _stages(atmosphere: str, machine: dict[str, Any], quick: bool) -> dict[str, Any]:
    from .methods import OwnSky
    from .speed import random_views

    solved = OwnSky(atmosphere, DEFAULT_TOLERANCE)
    views = random_views(2000 if quick else 50_000)
    return {
        "solve": limits.stages(lambda: OwnSky(atmosphere, DEFAULT_TOLERANCE), machine),
        "rays": limits.stages(lambda: solved.radiance(views), machine),
    }


def _processor() -> str:
    """The processor's name, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
