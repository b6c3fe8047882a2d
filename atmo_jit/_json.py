"""Defensive reading of JSON: bounded size, no repeated keys, and one line that says what is wrong."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import AtmosphereError, shown

SIZE_LIMIT = 16 * 1024 * 1024
DEPTH_LIMIT = 32


class _Repeated(dict):
    """A JSON object in which ``key`` stood twice: Python's parser would keep the second value without a word."""

    key: str


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) == len(pairs):
        return result
    repeated = _Repeated(result)
    seen: set[str] = set()
    repeated.key = next(key for key, _ in pairs if key in seen or seen.add(key))
    return repeated


def read_json(path: Path, name: str, allowed: str = "a JSON file") -> Any:
    """The JSON value in a file of at most 16 MiB of UTF-8.

    Raises :class:`~atmo_jit.errors.AtmosphereError` for ``name`` when the file is missing or unreadable (its message
    then says what is ``allowed``), too large or not JSON. Repeated keys are reported by :func:`plain`, which knows
    where they stand.
    """
    try:
        with open(path, "rb") as stream:
            raw = stream.read(SIZE_LIMIT + 1)
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise AtmosphereError(name, f"{shown(str(path), 200)} ({reason})", allowed) from None
    if len(raw) > SIZE_LIMIT:
        raise AtmosphereError(name, "a larger file", f"at most {SIZE_LIMIT // 1024**2} MiB of JSON", str(path))
    try:
        return json.loads(raw.decode("utf-8-sig"), object_pairs_hook=_object)
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, an integer of thousands of digits, endless [[[
        reason = "brackets nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise AtmosphereError(name, f"invalid JSON ({reason})", "a JSON object in UTF-8", str(path)) from None


def plain(value: Any, name: str = "") -> Any:
    """A deep copy of dicts, lists and Python numbers: tuples and NumPy arrays become lists, NumPy numbers Python's.

    Raises :class:`~atmo_jit.errors.AtmosphereError` with the dotted name of a repeated key, or when the nesting has
    no end.
    """
    if name.count(".") > DEPTH_LIMIT:
        raise AtmosphereError(name.split(".")[0], "endless nesting", f"at most {DEPTH_LIMIT} levels")
    prefix = f"{name}." if name else ""
    if isinstance(value, _Repeated):
        raise AtmosphereError(f"{prefix}{value.key}", "the key twice in one object", "each key once")
    if isinstance(value, Mapping):
        return {key: plain(item, f"{prefix}{key}") for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return [item if type(item) in (int, float) else plain(item, f"{prefix}{i}") for i, item in enumerate(value)]
    return value
