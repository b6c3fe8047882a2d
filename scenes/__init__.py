"""The shipped scenes: Mitsuba scene files in this folder, each with one purpose, and how a scene file is found.

Import does not load Mitsuba; ``atmo_jit.scenes.reader`` does.
"""

from __future__ import annotations

import re
from pathlib import Path

from atmo_jit.errors import InputError, shown
from atmo_jit.files import is_file

FOLDER = Path(__file__).parent
SUFFIXES = (".xml", ".json")


def shipped() -> dict[str, Path]:
    """The shipped scenes: name -> file, in alphabetical order."""
    return {path.stem: path for path in sorted(FOLDER.iterdir()) if path.suffix in SUFFIXES}


def find(scene: str) -> Path:
    """The file of a scene, given as a path or as the name of a shipped scene; a file of that path wins.

    Raises InputError when there is none, or when it is neither .xml nor .json.
    """
    path = Path(scene)
    if path.suffix.lower() in SUFFIXES:
        if is_file(path):
            return path
        raise InputError(f"scene {shown(scene)}: no such file; shipped scenes: {', '.join(shipped())}")
    if scene in shipped():
        return shipped()[scene]
    names = ", ".join(shipped())
    raise InputError(
        f"scene {shown(scene)}: neither an .xml or .json file nor a shipped scene; shipped scenes: {names}"
    )


def purpose(path: Path) -> str:
    """The first sentence of the comment that a scene file starts with; empty where there is none."""
    text = path.read_text(encoding="utf-8")
    comment = re.search(r'<!--(.*?)-->|"comment"\s*:\s*"([^"]*)"', text, re.DOTALL)
    words = " ".join((comment[1] or comment[2] or "").split()) if comment else ""
    return re.split(r"(?<=[.!?])\s", words, maxsplit=1)[0]
