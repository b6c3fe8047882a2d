"""Tables back from the folders that ``atmo-jit export`` writes."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from .._json import read_json
from ..errors import InputError

READABLE = ("takram", "bruneton", "native")


def read(folder: str | Path) -> Any:
    """What a folder with a params.json holds: :class:`.lookup.ClientTables` for the layouts takram and bruneton, a
    solved :class:`atmo_jit.Sky` for native.

    Raises InputError for folders that are incomplete or of another layout, and files of a wrong size.
    """
    folder = Path(folder)
    parameters = parameters_of(folder)
    metadata = parameters.get("metadata", {})
    layout = metadata.get("layout") if isinstance(metadata, dict) else None
    if layout not in READABLE:
        raise InputError(f"{str(folder)!r}: is of the layout {layout!r}; can be read: {', '.join(READABLE)}")
    try:
        return import_module(f".{layout}", __package__).read(folder, parameters)
    except InputError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(f"{str(folder / 'params.json')!r}: lacks or misstates {error}") from None


def parameters_of(folder: Path) -> dict[str, Any]:
    """The contents of params.json."""
    found = read_json(folder / "params.json", "folder", "the folder of an export, with its params.json")
    if not isinstance(found, dict):
        raise InputError(f"{str(folder / 'params.json')!r}: is no JSON object")
    return found
