"""Descriptions (what JSON files hold) with one entry changed, for tests of what is refused."""

from __future__ import annotations

import copy
from typing import Any


def changed(description: Any, place: str | tuple, value: Any = ...) -> Any:
    """A deep copy with the entry at ``place`` replaced, or removed for ``...``.

    ``place``: a dotted name, whose parts count as indices where a list is, or a tuple of keys and indices.
    """
    result = copy.deepcopy(description)
    node = result
    *parents, key = place.split(".") if isinstance(place, str) else place
    for step in parents:
        node = node[int(step) if isinstance(node, list) else step]
    key = int(key) if isinstance(node, list) else key
    if value is ...:
        del node[key]
    else:
        node[key] = value
    return result
