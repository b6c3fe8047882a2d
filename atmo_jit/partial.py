"""What interrupted work keeps beside its output (x.exr: x.partial.npz), and what must be the same for it to go on."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import InputError, shown

KEEP_SECONDS = 20.0  # between the states that long work writes on the way
_DIGITS = 16  # of a SHA-256 in hexadecimal: nobody makes two inputs alike here, and messages stay short


def partial_path(output: Path, suffix: str) -> Path:
    """The name of the file beside ``output`` that holds what was done so far."""
    return output.with_suffix(f".partial{suffix}")


def check_same(partial: Path, begun: Any, now: Mapping[str, Any]) -> None:
    """Raise InputError naming the first of the settings ``now`` that has another value in ``begun``, those of the run
    that left ``partial``."""
    if not isinstance(begun, Mapping):
        raise not_ours(partial)
    for name, value in now.items():
        if begun.get(name) != value:
            raise InputError(
                f"--resume: {name} is {shown(value)}, and was {shown(begun.get(name))} when {partial.name} was begun; "
                "must be the same (without --resume all begins anew)"
            )


def not_ours(partial: Path) -> InputError:
    """The error of a file that is in the way of what would be kept."""
    return InputError(f"{shown(str(partial), 200)}: is not what an interrupted run keeps; move it, or change --out")


def digest(*contents: bytes | Path) -> str:
    """Tells inputs from each other: some digits of the SHA-256 of bytes and of the files' contents, one after the other
    and each with its length."""
    whole = hashlib.sha256()
    for content in contents:
        data = content.read_bytes() if isinstance(content, Path) else content
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()[:_DIGITS]
