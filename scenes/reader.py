"""Scene files, XML or JSON, to Mitsuba scenes.

    mi.set_variant("llvm_ad_rgb")
    scene = load_scene("scenes/noon.xml", {"spp": "16"}, width=320)

XML is Mitsuba's own format; ``json_form`` describes the JSON one. Parameters (``$name`` in the file) are given as text,
as on the command line; files that a scene names are looked for beside the scene file first.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit.errors import InputError, one_line
from atmo_jit.files import is_file
from atmo_jit.partial import digest
from atmo_jit.scenes import json_form

# Mitsuba's own film size, for a film that states none.
DEFAULT_FILM = (768, 576)


def load_scene(
    path: str | Path,
    parameters: Mapping[str, str] | None = None,
    *,
    width: int | None = None,
    height: int | None = None,
    edit: Callable[[Any], None] | None = None,
) -> Any:
    """The ``mi.Scene`` in a file, for the variant that is set.

    width, height: size of the film in pixels in place of the scene's; one alone keeps the scene's proportions.
    edit: called with the parser's state of the whole scene before anything is made of it, to change it.
    Raises InputError with one line that names the file and what is wrong with it.
    """
    import mitsuba as mi

    path = Path(path)
    config = mi.parser.ParserConfig(mi.variant())
    with _files_beside(path), _mitsuba_errors(path):
        if path.suffix.lower() == ".json":
            state = _parse_json(path, config, parameters or {})
        else:
            state = _parse_xml(path, config, parameters or {})
        if width or height:
            _resize_films(path, state, width, height)
        if edit:
            edit(state)
        mi.parser.transform_all(config, state)
        scene = mi.parser.instantiate(config, state)
    if not isinstance(scene, mi.Scene):
        raise InputError(f"{path}: holds {type(scene).__name__}, must be a scene")
    if not scene.sensors():
        raise InputError(f"{path}: the scene has no sensor")
    if scene.integrator() is None:
        raise InputError(f"{path}: the scene has no integrator")
    return scene


def contents(state: Any) -> str:
    """Tells parsed scenes from each other by their objects' properties and the files that these name (meshes, textures,
    atmospheres)."""
    import mitsuba as mi

    found: list[bytes | Path] = []
    for node in state.nodes:
        found.append(f"{node.type} {node.props.plugin_name()} {node.props.id()}".encode())
        for key in node.props.keys():
            value = node.props[key]
            if isinstance(value, str):
                file = Path(str(mi.file_resolver().resolve(value)))
                if is_file(file):  # a string may be anything
                    found.append(file)
            if not isinstance(value, str | int | float):  # what Mitsuba prints of arrays is rounded
                with suppress(TypeError, ValueError):
                    # Asked of the type: an array has any attribute, as swizzling.
                    numbers = value.matrix if hasattr(type(value), "matrix") else value
                    found.append(np.asarray(numbers, float).tobytes())
            found.append(f"{key} {value!r}".encode())
    return digest(*found)


def _parse_xml(path: Path, config: Any, parameters: Mapping[str, str]) -> Any:
    """The parser state of an XML scene; a parameter that it does not have is named together with those that it has."""
    import mitsuba as mi

    try:
        return mi.parser.parse_file(config, str(path), **parameters)
    except RuntimeError as error:
        unused = re.search(r"unused parameters:\s*- \$(\w+)", str(error))
        if not unused:
            raise
        known = sorted(set(re.findall(r'<default\s+name="(\w+)"', path.read_text(encoding="utf-8"))))
        raise InputError(
            f"{path}: has no parameter {unused[1]!r}; parameters are: {', '.join(known) or 'none'}"
        ) from None


def _parse_json(path: Path, config: Any, parameters: Mapping[str, str]) -> Any:
    """The parser state of a JSON scene. Mitsuba's dictionaries take no keys with dots, so those are set afterwards."""
    import mitsuba as mi

    scene, dotted = json_form.read(path, parameters)
    state = mi.parser.parse_dict(config, scene)
    for place, key, value in dotted:
        state.nodes[list(state.node_paths).index(place or "root")].props[key] = value
    return state


def _resize_films(path: Path, state: Any, width: int | None, height: int | None) -> None:
    """Give every film in the parsed scene the new size."""
    import mitsuba as mi

    films = [node.props for node in state.nodes if node.type == mi.ObjectType.Film]
    if not films:
        raise InputError(f"{path}: has no film whose width and height could be set; add one to its sensor")
    for film in films:
        old = [film[key] if key in film else size for key, size in zip(("width", "height"), DEFAULT_FILM, strict=True)]
        film["width"] = width or max(1, round(height * old[0] / old[1]))
        film["height"] = height or max(1, round(width * old[1] / old[0]))


@contextmanager
def _files_beside(path: Path) -> Iterator[None]:
    """Let Mitsuba look for files in the folder of ``path`` first, inside the block."""
    import mitsuba as mi

    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(path.resolve().parent))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


@contextmanager
def _mitsuba_errors(path: Path) -> Iterator[None]:
    """Turn what Mitsuba raises inside the block into an InputError that names the file."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: {what_mitsuba_says(str(error))}") from None


def what_mitsuba_says(text: str) -> str:
    """Mitsuba's message as one line: no source location, and of a plugin's traceback only the exception's text."""
    text = re.sub(r"^\[\w+\.(cpp|h):\d+\]\s*", "", text.strip())
    head, trace, tail = text.partition("Traceback (most recent call last):")
    if trace:
        last = tail.strip().splitlines()[-1] if tail.strip() else ""
        text = head + re.sub(r"^[\w.]*(Error|Exception):\s*", "", last)
    return one_line(text)
