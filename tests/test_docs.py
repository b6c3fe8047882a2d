"""The documentation names what is there: functions in docs/method.md, names in docs/glossary.md, links everywhere."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
METHOD, GLOSSARY = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("method.md", "glossary.md"))
SOURCES = [*ROOT.glob("atmo_jit/**/*.py"), *ROOT.glob("plugins/*.py"), *ROOT.glob("fits/*.py")]
PAGES = [ROOT / "README.md", *ROOT.glob("docs/*.md")]


def defined(nodes, names):
    """Whether ``names``, a chain like Class.method, are defined or assigned in a module's or class's body."""
    for node in nodes:
        targets = [t.id for t in getattr(node, "targets", ()) if isinstance(t, ast.Name)]
        if names[0] in (getattr(node, "name", None), *targets):
            return len(names) == 1 or defined(node.body, names[1:])
    return False


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`([a-z_]+(?:\.[A-Za-z_]+)+)`", METHOD))))
def test_functions_of_the_method_exist(name):
    folder = "." if name.startswith(("plugins.", "fits.")) else "atmo_jit"
    parts = name.split(".")
    count = 1
    while (file := ROOT / folder / "/".join(parts[:count])).is_dir():
        count += 1
    tree = ast.parse(file.with_suffix(".py").read_text(encoding="utf-8"))
    assert defined(tree.body, parts[count:])


def test_names_of_the_glossary_are_used():
    words = set(re.findall(r"\w+", "".join(file.read_text(encoding="utf-8") for file in SOURCES)))
    rows = [row.rsplit("|", 2)[1] for row in GLOSSARY.splitlines() if row.startswith("|")]
    named = {word for cell in rows for code in re.findall(r"`([^`]+)`", cell) for word in re.findall(r"\w+", code)}
    assert len(named) > 50 and not named - words


def outside_of_code(page):
    """The page's text without what is set as code."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`]*`", "code", re.sub(r"^    .*$", "", text, flags=re.MULTILINE))


def anchors(page):
    """What headings may be linked as."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Files, pictures, and headings."""
    for link in re.findall(r"\]\(([^)]+)\)", outside_of_code(page)):
        if re.match(r"https?://", link):
            continue
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_are_well_formed(page):
    """What a reader of Markdown would take for something else: rows of tables that lack cells or have too many, code
    that does not end, headings that skip a level, links without an end."""
    text = outside_of_code(page)
    assert "`" not in text and not re.search(r"\]\([^)]*$", text, re.MULTILINE)
    assert page.read_text(encoding="utf-8").count("\n```") % 2 == 0
    levels = [len(marks) for marks in re.findall(r"^(#+) ", text, re.MULTILINE)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in zip(levels, levels[1:], strict=False))
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        rows = [row.count("|") for row in table.splitlines()]
        assert set(rows) == {rows[0]} and re.fullmatch(r"[|: -]+", table.splitlines()[1]), table


def test_the_page_of_plugins_is_that_of_their_docstrings():
    from atmo_jit.plugins import PLUGINS
    from bench.plugin_page import PAGE, PAGES, page

    assert PAGE.read_text(encoding="utf-8") == page(), "python -m bench.plugin_page writes it"
    internal = {"AtmosphereNeeds", "AtmosphereSun"}
    assert {name for name, _ in PAGES} | internal == {entry[3] for entry in PLUGINS.values()}
