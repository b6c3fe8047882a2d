"""Scenes as JSON: the nested dictionaries of ``mi.load_dict``, in a form that a text file can hold.

    {
      "comment": "A ball under the sky. Purpose and command, for people.",
      "parameters": {"spp": 64, "sun": [0, 1, 0.5]},
      "type": "scene",
      "integrator": {"type": "path"},
      "sensor": {
        "type": "perspective", "fov": 50,
        "to_world": {"look_at": {"origin": [0, -5, 1.7], "target": [0, 0, 1], "up": [0, 0, 1]}},
        "sampler": {"type": "independent", "sample_count": "$spp"},
        "film": {"type": "hdrfilm", "width": 640, "height": 360}
      },
      "light": {"type": "atmosphere", "sun_direction": "$sun", "mie.phase.g": 0.8},
      "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.2, 0.1]}}}
    }

Values are numbers, true/false, text, vectors (3 numbers) and objects, which have a "type". ``"$name"`` stands for an
entry of "parameters" with its type; inside a longer text it stands for the entry's text. A transform is what stands
under a key that starts with ``to_``: a 4x4 matrix, one operation, or a list of operations, the first applied first:

    {"translate": [x, y, z]}   {"scale": s}   {"scale": [x, y, z]}   {"rotate": {"axis": [x, y, z], "angle": degrees}}
    {"look_at": {"origin": [...], "target": [...], "up": [...]}}   {"matrix": [[...], [...], [...], [...]]}

Nothing in a file is run or imported; whatever is not in this description is refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from atmo_jit.errors import InputError, shown

# (path of the object, key, value) of keys that Mitsuba's dictionaries cannot hold
Dotted = list[tuple[str, str, Any]]
_INT64 = 2**63
SIZE_LIMIT = 2**24  # bytes of a file


def read(path: Path, parameters: Mapping[str, str]) -> tuple[dict[str, Any], Dotted]:
    """The dictionary for ``mi.parser.parse_dict`` in a JSON file, and the values under dotted keys that it cannot hold.

    parameters: text in place of entries of the file's "parameters", read as the kind of value that stands there.
    A Mitsuba variant must be set. Raises InputError.
    """
    try:
        with open(path, "rb") as stream:
            raw = stream.read(SIZE_LIMIT + 1)
        if len(raw) > SIZE_LIMIT:
            raise InputError(f"{path}: is larger than {SIZE_LIMIT} bytes")
        content = json.loads(raw.decode("utf-8"), parse_constant=_no_constant, object_pairs_hook=_no_duplicates)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{path}: nested too deeply") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: is not a JSON object")
    content.pop("comment", None)
    return _Expander(path, content.pop("parameters", {}), parameters).scene(content)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number that a scene can hold")


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise ValueError(f"the key {key!r} appears twice in one object")
        seen[key] = value
    return seen


class _Expander:
    """Checks a scene and puts parameters and transforms in place; ``place`` is always the dotted path in the file."""

    def __init__(self, path: Path, defaults: Any, given: Mapping[str, str]) -> None:
        self.path = path
        if not isinstance(defaults, dict):
            self.fail("parameters", defaults, "an object")
        self.values = dict(defaults)
        for name, text in given.items():
            if name not in self.values:
                known = ", ".join(self.values) or "none"
                raise InputError(f"{path}: has no parameter {name!r}; parameters are: {known}")
            self.values[name] = self.typed(name, text, self.values[name])
        self.dotted: Dotted = []

    def fail(self, place: str, found: Any, allowed: str) -> NoReturn:
        raise InputError(f"{self.path}: {place} is {shown(found)}; must be {allowed}")

    def typed(self, name: str, text: str, default: Any) -> Any:
        """The text of a parameter from the command line as the kind of value that its default is."""
        if isinstance(default, str):
            return text
        kind = "true or false" if isinstance(default, bool) else "numbers" if isinstance(default, list) else "a number"
        try:
            words = re.split(r"[,\s]+", text.strip())
            parts = [float(word) if re.search(r"[.eE]", word) else int(word) for word in words]
        except ValueError:
            parts = []
        if isinstance(default, bool) and text.strip().lower() in ("true", "false"):
            return text.strip().lower() == "true"
        if isinstance(default, list) and parts:
            return parts
        if isinstance(default, (int, float)) and not isinstance(default, bool) and len(parts) == 1:
            return parts[0] if isinstance(default, int) else float(parts[0])
        self.fail(f"parameter {name}", text, kind)

    def scene(self, content: dict[str, Any]) -> tuple[dict[str, Any], Dotted]:
        return self.object({"type": "scene", **content}, ""), self.dotted

    def object(self, content: dict[str, Any], place: str) -> dict[str, Any]:
        """An object (plugin, colour, reference) with everything in it."""
        if not isinstance(self.substitute(content.get("type"), place), str):
            self.fail(f"{place}.type", content.get("type"), "the name of a plugin")
        if content["type"] in ("rgb", "spectrum"):
            return {key: self.substitute(value, f"{place}.{key}") for key, value in content.items()}
        result = {}
        for key, raw in content.items():
            here = f"{place}.{key}" if place else key
            value = self.substitute(raw, here)
            if key.startswith("to_"):
                value = self.transform(value, here)
            elif isinstance(value, dict):
                value = self.object(value, here)
            elif isinstance(value, list):
                value = self.vector(value, here)
            elif value is None:
                self.fail(here, None, "a number, true or false, text, 3 numbers, or an object")
            if "." in key:
                if isinstance(value, dict):
                    self.fail(here, raw, "a number, true or false, text or 3 numbers, since its name has a dot")
                self.dotted.append((place, key, value))
            else:
                result[key] = value
        return result

    def substitute(self, value: Any, place: str) -> Any:
        """``value`` with ``$name`` replaced, and its numbers checked."""
        if isinstance(value, str) and "$" in value:
            whole = re.fullmatch(r"\$(\w+)", value)
            inside = re.compile(r"\$(\w+)")
            value = self.lookup(whole, place) if whole else inside.sub(lambda m: str(self.lookup(m, place)), value)
        if isinstance(value, float) and not math.isfinite(value):
            self.fail(place, value, "finite")
        if isinstance(value, int) and abs(value) >= _INT64:
            self.fail(place, value, "an integer of at most 64 bits")
        if isinstance(value, list):
            return [self.substitute(entry, f"{place}[{index}]") for index, entry in enumerate(value)]
        return value

    def lookup(self, match: re.Match[str], place: str) -> Any:
        if match[1] not in self.values:
            known = ", ".join(self.values) or "none"
            raise InputError(f"{self.path}: {place}: unknown parameter ${match[1]}; parameters are: {known}")
        return self.values[match[1]]

    def vector(self, value: Any, place: str) -> list[float]:
        if not (isinstance(value, list) and len(value) == 3 and all(_is_number(x) for x in value)):
            self.fail(place, value, "3 numbers")
        return [float(x) for x in value]

    def transform(self, value: Any, place: str) -> Any:
        """The ``mi.ScalarTransform4f`` of a matrix, an operation or a list of operations."""
        import mitsuba as mi

        if _is_matrix(value):
            return mi.ScalarTransform4f([[float(x) for x in row] for row in value])
        operations = value if isinstance(value, list) else [value]
        result = mi.ScalarTransform4f()
        for operation in operations:
            if not (isinstance(operation, dict) and len(operation) == 1):
                allowed = "a 4x4 matrix, {translate|scale|rotate|look_at|matrix: ...} or a list of these"
                self.fail(place, operation, allowed)
            [(name, raw)] = operation.items()
            result = self.operation(name, self.substitute(raw, f"{place}.{name}"), f"{place}.{name}") @ result
        return result

    def operation(self, name: str, value: Any, place: str) -> Any:
        import mitsuba as mi

        transform = mi.ScalarTransform4f
        if name == "translate":
            return transform().translate(self.vector(value, place))
        if name == "scale":
            return transform().scale(float(value) if _is_number(value) else self.vector(value, place))
        if name == "rotate":
            parts = self.members(value, ("axis", "angle"), place)
            if not _is_number(parts["angle"]):
                self.fail(f"{place}.angle", parts["angle"], "a number (degrees)")
            return transform().rotate(self.vector(parts["axis"], f"{place}.axis"), float(parts["angle"]))
        if name == "look_at":
            parts = self.members(value, ("origin", "target", "up"), place)
            return transform().look_at(**{key: self.vector(part, f"{place}.{key}") for key, part in parts.items()})
        if name == "matrix" and _is_matrix(value):
            return transform([[float(x) for x in row] for row in value])
        self.fail(place, value, "one of translate, scale, rotate, look_at, matrix (4x4)")

    def members(self, value: Any, names: tuple[str, ...], place: str) -> dict[str, Any]:
        if not isinstance(value, dict) or set(value) != set(names):
            self.fail(place, value, f"an object with {', '.join(names)}")
        return {name: self.substitute(value[name], f"{place}.{name}") for name in names}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_matrix(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 4
        and all(isinstance(row, list) and len(row) == 4 and all(_is_number(x) for x in row) for row in value)
    )
