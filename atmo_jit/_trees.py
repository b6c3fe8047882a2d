"""Nested dictionaries and lists, and their leaves."""

from __future__ import annotations

from typing import Any


def flat(tree: Any) -> list[Any]:
    """The leaves of nested dictionaries and lists."""
    if isinstance(tree, dict):
        return [leaf for part in tree.values() for leaf in flat(part)]
    if isinstance(tree, list):
        return [leaf for part in tree for leaf in flat(part)]
    return [tree]


def like(tree: Any, leaves: list[Any]) -> Any:
    """The tree with other leaves."""
    remaining = iter(leaves)

    def build(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: build(p) for key, p in part.items()}
        return [build(p) for p in part] if isinstance(part, list) else next(remaining)

    return build(tree)
