"""The exceptions that users of atmo-jit see.

Input that cannot be used raises :class:`InputError` (the command line prints its text and exits with 2); an LLVM
library that would abort the process raises :class:`LLVMError`, and a disk that takes no more :class:`OutputError` (exit
status 1). Every message is one line.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class InputError(ValueError):
    """Input (a file, a value, an option) that cannot be used: one line with its name, what it is, what is allowed."""


class AtmosphereError(InputError):
    """A wrong value in an atmosphere description.

    ``field`` is the dotted name (``mie.phase.g``, ``mie.1.scale_height_m``), ``found`` describes what was there and
    ``allowed`` what may be; ``source`` is the file the description came from, if it came from one.
    """

    def __init__(self, field: str, found: str, allowed: str, source: str | None = None) -> None:
        self.field, self.found, self.allowed, self.source = field, found, allowed, source
        super().__init__(field, found, allowed, source)  # so that the exception can be pickled and copied

    def __str__(self) -> str:
        place = f"{self.source}: " if self.source else ""
        return one_line(f"{place}{self.field}: found {self.found}; allowed: {self.allowed}")

    def below(self, parent: str) -> AtmosphereError:
        """The same error as seen from the object that holds the field under the name ``parent``."""
        return AtmosphereError(f"{parent}.{self.field}", self.found, self.allowed, self.source)


class LLVMError(RuntimeError):
    """The LLVM library that Dr.Jit would load is missing or would abort the process. The message says what to do."""


class OutputError(OSError):
    """Files could not be written (a full disk, a folder that became write-protected). What was there before stays."""


@contextmanager
def within(parent: str) -> Iterator[None]:
    """Name the fields of every :class:`AtmosphereError` raised inside as members of ``parent``."""
    try:
        yield
    except AtmosphereError as error:
        raise error.below(parent) from None


def one_line(text: str) -> str:
    """``text`` without line breaks or control characters, whatever an input file put into it."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def shown(value: Any, limit: int = 60) -> str:
    """``repr(value)`` shortened to ``limit`` characters, for use in a message."""
    try:
        text = repr(value)
    except Exception:  # a foreign __repr__ may raise anything, and a message must still come out
        text = f"<{type(value).__name__}>"
    text = one_line(text)
    return text if len(text) <= limit else f"{text[: limit - 3]}..."
