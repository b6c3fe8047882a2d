"""Nested dictionaries and lists, and their leaves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def flat(tree: Any) -> list[Any]:
    """The leaves of nested dictionaries and lists."""
    if isinstance(tree, dict):
        return [leaf for part in tree.values() for leaf in flat(part)]
    if isinstance(tree, list):
        return [leaf for part in tree for leaf in flat(part)]
    return [tree]


def like(tree: Any, leaves: Iterable[Any]) -> Any:
    """The tree with other leaves."""
    # Not a function within: one that calls itself holds on to the leaves until garbage is collected.
    remaining = iter(leaves)
    if isinstance(tree, dict):
        return {key: like(part, remaining) for key, part in tree.items()}
    return [like(part, remaining) for part in tree] if isinstance(tree, list) else next(remaining)
