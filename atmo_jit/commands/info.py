"""``atmo-jit info``: versions, the LLVM library and whether it can be used, the presets."""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import click

from atmo_jit import __version__, llvm, presets
from atmo_jit.errors import InputError, shown

PACKAGES = ("numpy", "scipy", "drjit", "mitsuba", "OpenEXR", "colour-science", "jaxopt", llvm.WHEEL)


@click.command()
@click.option("--preset", metavar="NAME", help=f"Print the JSON of an atmosphere: {', '.join(presets.NAMES)}.")
@click.option("--wavelengths", metavar="NM,...|fast", help="With --preset: described at these instead; fast: the four "
              "whose colour is nearest to that of the whole spectrum.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print everything as one JSON object.")
def command(preset: str | None, wavelengths: str | None, as_json: bool) -> None:
    """Versions, which LLVM library was found and whether it is usable, and the atmospheres that come along."""
    if preset is not None:
        if preset not in presets.NAMES:
            raise InputError(f"--preset: found {shown(preset)}; allowed: {', '.join(presets.NAMES)}")
        click.echo(presets.text(preset) if wavelengths is None else _at_wavelengths(preset, wavelengths), nl=False)
        return
    if wavelengths is not None:
        raise InputError("--wavelengths: needs --preset NAME, the atmosphere to describe at them")
    found = collect()
    click.echo(json.dumps(found, indent=2) if as_json else _as_text(found))


def _at_wavelengths(preset: str, text: str) -> str:
    """The JSON of a preset described at other wavelengths."""
    from atmo_jit.atmosphere import Atmosphere
    from atmo_jit.wavelengths import at_wavelengths, chosen

    nm = chosen(text, "--wavelengths")
    return json.dumps(at_wavelengths(Atmosphere.load(preset), nm).to_dict(), indent=2) + "\n"


def collect() -> dict[str, Any]:
    """Everything that ``info`` prints; missing packages are None. LLVM is tried in a process of its own."""
    packages = {name: _version(name) for name in PACKAGES}
    state = llvm.examine_apart() if packages["drjit"] else None
    return {
        "atmo_jit": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
        "llvm": asdict(state) | {"usable": state.remedy is None} if state else None,
        "variants": _variants() if packages["mitsuba"] and state and state.version else [],
        "presets": dict(presets.SOURCES),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _variants() -> list[str]:
    """The variants of the installed Mitsuba, none where it cannot be imported."""
    try:
        import mitsuba
    except ImportError as error:
        print(f"atmo-jit: warning: mitsuba cannot be imported: {error}", file=sys.stderr)
        return []
    return list(mitsuba.variants())


def _as_text(found: dict[str, Any]) -> str:
    rows = [
        ("atmo-jit", found["atmo_jit"]),
        ("python", f"{found['python']} on {found['platform']}"),
        *((name, number or "not installed") for name, number in found["packages"].items()),
        ("LLVM", _llvm_line(found["llvm"])),
        ("variants", ", ".join(found["variants"]) or "none"),
        *((f"preset {name}", source) for name, source in found["presets"].items()),
    ]
    return "\n".join(f"{name:<20} {text}" for name, text in rows)


def _llvm_line(state: dict[str, Any] | None) -> str:
    if state is None:
        return "unknown, drjit is not installed"
    chosen = {
        "user": f"named by {llvm.VARIABLE}",
        "environment": "found in this Python environment",
        "system": "chosen by Dr.Jit from the system",
    }[state["origin"]]
    order = "; drjit was imported before atmo_jit" if state["drjit_imported_first"] else ""
    if state["usable"]:
        return f"{state['version']}, usable: {state['path']} ({chosen}{order})"
    return f"not usable ({chosen}{order}): {state['remedy']}"
