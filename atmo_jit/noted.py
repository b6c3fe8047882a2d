"""Tables that a solve evaluates, noted and given to the same solve with derivatives: what is known is not computed
again on the way to them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_notes: list[Any] | None = None
_known: list[Any] | None = None


@contextmanager
def noting() -> Iterator[list[Any]]:
    """A list to which all that is evaluated in this block is added, in order."""
    with _instead([], None):
        yield _notes


@contextmanager
def knowing(tables: list[Any] | None) -> Iterator[None]:
    """In this block ``tables``, noted in another of the same steps, take the place of what they would evaluate; None:
    nothing is known here."""
    if tables is None:
        yield
        return
    with _instead(None, list(tables)):
        yield
        if _known:
            raise AssertionError(f"{len(_known)} tables were noted that these steps do not make")


def apart() -> Any:
    """A block that makes what is kept longer, and only at times: nothing of it is noted or known."""
    return _instead(None, None)


@contextmanager
def _instead(notes: list[Any] | None, known: list[Any] | None) -> Iterator[None]:
    global _notes, _known
    before = _notes, _known
    _notes, _known = notes, known
    try:
        yield
    finally:
        _notes, _known = before


def note(tables: list[Any]) -> None:
    """Add evaluated tables to the notes, where they are taken."""
    if _notes is not None:
        _notes.extend(tables)


@contextmanager
def passing() -> Iterator[None]:
    """What is evaluated in this block is read by nothing but what is noted after it, and linearly: its numbers are not
    needed again, nor kept."""
    import drjit as dr

    before = len(_notes or ())
    yield
    if _notes is not None:
        _notes[before:] = [dr.full(type(table), math.nan, dr.width(table)) for table in _notes[before:]]


def take(count: int) -> list[Any] | None:
    """The next tables that are known; None: none are."""
    if _known is None:
        return None
    taken, _known[:count] = _known[:count], []
    return taken
