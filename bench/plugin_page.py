"""docs/plugins.md from the docstrings of the plugins: ``python -m bench.plugin_page`` writes it."""

from __future__ import annotations

import ast
import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "plugins.md"
HEAD = """# Plugins

What scenes may name after `atmo_jit.plugins.register()`. `python -m bench.plugin_page` writes this page from the
docstrings; a test compares them.
"""
# In the order of the page: class and module in plugins/.
PAGES = (
    ("AtmosphereEmitter", "emitter"),
    ("AtmospherePath", "path"),
    ("AtmosphereVolpath", "volpath"),
    ("AtmosphereMedium", "medium"),
    ("CornetteShanksPhase", "cornette_shanks"),
    ("Fisheye", "sensors"),
    ("LatLong", "sensors"),
)
_PARAMETERS = re.compile(r"\.\. pluginparameters::\n\n((?: \* - .*\n(?:(?: {3}.*)?\n)*)+)")
_TAB = re.compile(r" *\.\. code-tab:: (\w+)\n(?: *:name:.*\n)?\n((?: {8}.*\n?|\n)+)")


def page() -> str:
    """The page."""
    return HEAD + "".join(f"\n{_section(_docstring(*entry))}\n" for entry in PAGES)


def _docstring(name: str, module: str) -> str:
    tree = ast.parse((ROOT / "plugins" / f"{module}.py").read_text(encoding="utf-8"))
    (node,) = (n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name)
    return ast.get_docstring(node) + "\n"


def _section(text: str) -> str:
    """One docstring as Markdown."""
    text = re.sub(r"^\.\. _.*:\n\n", "", text)
    text = re.sub(r"^(.+)\n-{5,}\n", r"## \1\n", text)
    text = _inline(_PARAMETERS.sub(lambda m: _table(m[1]), text))
    text = text.replace(".. tabs::\n", "")
    text = _TAB.sub(lambda m: f"\n```{m[1]}\n{textwrap.dedent(m[2]).strip()}\n```\n", text)
    text = re.sub(r"\.\. math::\n\n((?: {4}.*\n)+)", lambda m: f"```math\n{textwrap.dedent(m[1])}```\n", text)
    return re.sub(r"\n{3,}", "\n\n", text).strip()


def _table(items: str) -> str:
    rows = ["| parameter | type | meaning | |", "|---|---|---|---|"]
    for item in re.split(r"^ \* - ", items, flags=re.MULTILINE)[1:]:
        cells = [" ".join(cell.split()) for cell in re.split(r"^   - ", item, flags=re.MULTILINE)]
        name, kind, meaning, flags = [*cells, ""][:4]
        rows.append("| " + " | ".join([name, kind, meaning, flags]) + " |")
    return "\n".join(rows) + "\n\n"


def _inline(text: str) -> str:
    """RST's marks within a line as Markdown's."""
    text = re.sub(r":math:`([^`]*)`", r"$\1$", text)
    text = re.sub(r":ref:`([^`<]*?) ?<[^`]*>`", r"`\1`", text)
    text = re.sub(r":[a-z:]+:`([^`]*)`", r"`\1`", text)
    text = re.sub(r"\|(\w+)\|", r"\1", text)
    return re.sub(r"``([^`]*)``", r"`\1`", text)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
