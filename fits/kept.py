"""How far a fit has come, and that in a file beside its result (scan.json: scan.partial.json), to go on from there."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit import __version__
from atmo_jit.errors import InputError
from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.partial import KEEP_SECONDS, check_same, digest, not_ours, partial_path

from .config import FitConfig
from .observations import Observations

SIZE_LIMIT = 2**26


@dataclass(frozen=True)
class Point:
    """How far a fit has come; every u is that of the scalars in use.

    ``step``: 0 while it looks at some of the samples, then the number of the minimisation for all. ``ends``: u of the
    searches in step 0 that are over. ``nodes``: u that the nodes in use (and the weights, from step 1 on) were chosen
    at. ``u``: where to go on. ``iterations`` and ``seconds`` so far.
    """

    step: int
    ends: tuple[tuple[float, ...], ...]
    nodes: tuple[float, ...]
    u: tuple[float, ...]
    iterations: int = 0
    seconds: float = 0.0

    @classmethod
    def of(cls, document: Any) -> Point:
        """From what JSON has of one. Raises TypeError or ValueError for anything else."""
        if set(document) != {field.name for field in fields(cls)}:
            raise ValueError("not a point")
        numbers = {name: tuple(map(float, document[name])) for name in ("nodes", "u")}
        ends = tuple(tuple(map(float, end)) for end in document["ends"])
        counts = {name: int(document[name]) for name in ("step", "iterations")}
        point = cls(**numbers, **counts, ends=ends, seconds=float(document["seconds"]))
        flat = [point.seconds, *point.nodes, *point.u, *(v for end in ends for v in end)]
        if not (np.isfinite(flat).all() and 0 <= point.step <= 2 and point.iterations >= 0 and point.seconds >= 0.0):
            raise ValueError("not a point")
        return point


class Report:
    """Progress over all minimisations: every iteration takes a share of what is left; and the ``point`` reached."""

    def __init__(
        self,
        progress: Callable[[float], None] | None,
        keep: Callable[[Point], None] | None,
        point: Point,
        started: float,
    ) -> None:
        self._progress, self._keep, self._started = progress, keep, started
        self.point, self.iterations = point, point.iterations
        self._left = 0.9**self.iterations

    def __call__(self, iteration: int, cost: float, u: np.ndarray) -> None:
        self.iterations += 1
        self._left *= 0.9
        if self._progress is not None:
            self._progress(1.0 - self._left)
        # Of the samples that are looked at first, every round has nodes, loss and weights of its own start.
        self.reached(**({"u": u} if self.point.step else {}))

    def reached(self, **changes: Any) -> None:
        """Have the point changed, and kept."""
        if "ends" in changes:
            changes["ends"] = tuple(tuple(u.tolist()) for u in changes["ends"])
        changes |= {name: tuple(changes[name].tolist()) for name in ("nodes", "u") if name in changes}
        seconds = time.perf_counter() - self._started
        self.point = replace(self.point, **changes, iterations=self.iterations, seconds=seconds)
        if self._keep is not None:
            self._keep(self.point)


class KeptFit:
    """The file beside ``result``, for these observations and this configuration.

    Raises InputError where the file cannot be written.
    """

    def __init__(self, result: Path, data: Observations, config: FitConfig) -> None:
        self.path = check_output(partial_path(result, ".json"), ".json")
        arrays = (getattr(data, field.name) for field in fields(data))
        air = {"atmosphere": config.atmosphere.to_dict()}
        self._settings = {
            "the version": f"atmo-jit {__version__}",
            "--observations": digest(*(a.tobytes() for a in arrays if isinstance(a, np.ndarray))),
            "--config": digest(repr({**vars(config), **air}).encode()),
        }
        self._point: Point | None = None
        self._written = time.perf_counter()

    def begin(self, resume: bool, warn: Callable[[str], None]) -> Point | None:
        """Where to go on; None where there is no file, or where the fit shall not ``resume``, of which the file's owner
        is warned.

        Raises InputError for a file that is not of this kind, and on the way on for one of other inputs.
        """
        if not self.path.exists():
            return None
        try:
            if self.path.stat().st_size > SIZE_LIMIT:
                raise ValueError("too large")
            document = json.loads(self.path.read_text(encoding="utf-8"))
            point = Point.of(document["point"])
            settings = document["settings"]
        except (OSError, KeyError, TypeError, ValueError, OverflowError, RecursionError):
            raise not_ours(self.path) from None
        if not resume:
            warn(f"{self.path.name} is from an interrupted run; fitting anew, since --resume is not given")
            return None
        check_same(self.path, settings, self._settings)
        return point

    def keep(self, point: Point) -> None:
        """Have ``point`` in the file in a while, or when the work ends early."""
        self._point = point
        if time.perf_counter() - self._written > KEEP_SECONDS:
            self.write()

    @contextmanager
    def until_done(self, warn: Callable[[str], None]) -> Iterator[None]:
        """Write the last point when the block ends early; remove the file when it is done."""
        try:
            yield
        except BaseException as error:  # an interrupt may come out of a library as something else
            if self._point and not isinstance(error, InputError):
                with suppress(OSError):  # a full disk, perhaps what ended the block
                    self.write()
                    warn(f"{self.path.name} holds the fit after {self._point.iterations} iterations; --resume goes on")
            raise
        self.path.unlink(missing_ok=True)

    def write(self) -> None:
        """Have the last point in the file now."""
        document = {"settings": self._settings, "point": asdict(self._point)}
        with atomic_outputs(self.path) as (part,):
            part.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        self._written = time.perf_counter()
