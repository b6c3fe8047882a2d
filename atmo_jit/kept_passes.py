"""The passes of a picture that took long, in a file beside it: X.partial.npz."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .files import check_output, read_npz, write_npz
from .partial import check_same, not_ours, partial_path
from .passes import Passes

# Of a file with the sums of a film: bytes per pixel, generously (12 for each channel), and for all else.
PIXEL_BYTES, OTHER_BYTES = 4096, 1 << 20


class KeptPasses:
    """The file at ``path`` beside ``picture``; ``settings``: what has to be the same for passes to be added to it.

    Raises InputError where the file cannot be written.
    """

    def __init__(self, picture: Path) -> None:
        self.path = check_output(partial_path(picture, ".npz"), ".npz")
        self.settings: dict[str, Any] = {}

    def begin(self, passes: Passes, resume: bool, warn: Callable[[str], None]) -> float:
        """Have ``passes`` go on from the file, and return the seconds that it took so far; 0 where there is none, or
        where they shall not ``resume``, of which the file's owner is warned.

        Raises InputError for a file that is not of this kind, and on the way on for one of other settings.
        """
        if not self.path.exists():
            return 0.0
        arrays, about = self._read(passes.pixels)
        if not resume:
            warn(f"{self.path.name} is from an interrupted run; rendering anew, since --resume is not given")
            return 0.0
        check_same(self.path, about.get("settings"), self.settings)
        try:
            passes.restore(arrays)
            return float(about["seconds"])
        except (KeyError, TypeError, ValueError):
            raise not_ours(self.path) from None

    def write(self, part: Path, passes: Passes, seconds: float) -> None:
        """The passes done and the seconds that they took, to a temporary file."""
        about = json.dumps({"settings": self.settings, "seconds": seconds})
        write_npz(part, passes.state() | {"meta": np.array(about)})

    def _read(self, pixels: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        try:
            arrays = read_npz(self.path, kinds="iufU", limit=PIXEL_BYTES * pixels + OTHER_BYTES)
            about = json.loads(str(arrays["meta"]))
        except (InputError, KeyError, ValueError, RecursionError):
            raise not_ours(self.path) from None
        if not isinstance(about, dict):
            raise not_ours(self.path)
        return arrays, about
