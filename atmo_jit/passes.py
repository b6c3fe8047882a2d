"""Mitsuba pictures in passes: bounded memory, a bar that moves, a picture on the way, and its standard error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from atmo_jit.errors import InputError
from atmo_jit.image import Picture, luminance

# Camera samples of one pass: bounds the memory (about 0.1 KiB each) and keeps the bar moving on small machines.
PASS_SAMPLES = 2**21
# The same for the path-traced medium, whose samples need more memory.
REFERENCE_PASS_SAMPLES = 2**19
# A picture takes at least this many passes where it has the samples for it, so that the bar moves.
LEAST_PASSES = 16


class Passes:
    """A picture in passes of different seeds, with the scene's integrator and first sensor.

    The passes' weighted sums and filter weights are added in float64 and divided once, so the picture is the same
    estimate that one pass with all samples would give. ``samples``: per pixel, in the passes done; ``total``: in all;
    ``pixels``: of the film; ``seed``: of the first pass. scatter: whether :meth:`standard_error` will be asked for,
    which takes time and memory.
    """

    def __init__(self, scene: Any, spp: int | None, most: int = PASS_SAMPLES, scatter: bool = True) -> None:
        self._scene, self._sensor = scene, scene.sensors()[0]
        self._film, self._sampler = self._sensor.film(), self._sensor.sampler()
        self.total = spp or self._sampler.sample_count()
        self.pixels = int(np.prod(self._film.crop_size()))
        self._sizes = list(pass_sizes(self.total, self.pixels, most))
        if len(self._sizes) == 1 and self.total > 1:  # one pass knows no standard error
            self._sizes = [self.total // 2, self.total - self.total // 2]
        # A film with more pixels than a pass may have samples is rendered in strips.
        self._strips = list(strips(*(int(n) for n in self._film.crop_size()), most))
        self.samples, self.seed, self._scatter, self._done = 0, 0, scatter, 0
        self._raw: list[str] = []  # the film's channels, with the weight W among them
        self._grey = False
        # Weighted sums and weights; sum over the passes x of n (x - mean)^2, n their samples per pixel.
        self._sums: np.ndarray | float = 0.0
        self._squares: np.ndarray | float = 0.0

    def run(self, advance: Callable[[float], None]) -> Iterator[None]:
        """Render, one pass at each step, from where :meth:`restore` left it; ``advance`` is called with the fraction
        done."""
        done = sum(self._sizes[: self._done])
        for seed, count in list(enumerate(self._sizes))[self._done :]:
            raw = self._pass(self.seed + seed, count)
            taken = self._sampler.sample_count()
            if self._scatter and self._done:
                # Chan, Golub & LeVeque 1983, eq. 2.1: no difference of large sums, so float32 holds.
                away = self._developed(raw) - self._developed(self._sums)
                self._squares += (taken * self.samples / (taken + self.samples)) * away * away
            if self._done:
                self._sums += raw
            else:
                self._sums = raw.astype(np.float64)
            self.samples += taken
            self._done += 1
            done += count
            advance(done / self.total)
            yield

    def state(self) -> dict[str, np.ndarray]:
        """What has to be kept of the passes done: with it the others give the same picture, but for the order in which
        a pass adds its samples."""
        counts = np.array([self._done, self.samples, self._grey])
        return {"counts": counts, "channels": np.array(self._raw), "sums": self._sums, "squares": self._squares}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on after the passes of a :meth:`state`. Raises ValueError where it is not one of this picture."""
        counts, channels = (np.asarray(state[name]) for name in ("counts", "channels"))
        sums, squares = (np.asarray(state[name]) for name in ("sums", "squares"))
        width, height = (int(n) for n in self._film.crop_size())
        if counts.shape != (3,) or counts.dtype.kind != "i" or channels.ndim != 1 or channels.dtype.kind != "U":
            raise ValueError("no counts or no names of channels")
        done, samples, grey = (int(n) for n in counts)
        raw = channels.tolist()
        if not (0 < done <= len(self._sizes) and samples > 0 and {"R", "W"} <= set(raw) and len(set(raw)) == len(raw)):
            raise ValueError(f"{done} passes, {samples} samples, channels {raw}")
        scattered = self._scatter and done > 1
        visible = height, width, len(raw) - (3 if grey else 1)
        if sums.shape != (height, width, len(raw)) or squares.shape != (visible if scattered else ()):
            raise ValueError(f"sums of shapes {sums.shape} and {squares.shape}")
        self._done, self.samples, self._raw, self._grey = done, samples, raw, bool(grey)
        self._sums, self._squares = sums.astype(np.float64), squares if scattered else 0.0

    def _pass(self, seed: int, count: int) -> np.ndarray:
        """The film's weighted sums after ``count`` samples per pixel."""
        integrator = self._scene.integrator()

        def taken(number: int) -> np.ndarray:
            integrator.render(self._scene, self._sensor, seed=number, spp=count, develop=False, evaluate=True)
            if not self._raw:
                self._raw, self._grey = _channels(self._film)
            return np.array(self._film.develop(raw=True))

        if len(self._strips) == 1:
            return taken(seed)
        import mitsuba as mi

        width, height = (int(v) for v in self._film.crop_size())
        left, top = (int(v) for v in self._film.crop_offset())
        reach = math.ceil(self._film.rfilter().radius())

        def crop(first: int, rows: int) -> None:
            parameters = mi.traverse(self._sensor)
            parameters["film.crop_size"] = mi.ScalarVector2u(width, rows)
            parameters["film.crop_offset"] = mi.ScalarPoint2u(left, top + first)
            parameters.update()

        result: Any = None
        try:
            for number, (first, rows) in enumerate(self._strips):
                # Samples beyond a strip count in it as far as the film's filter reaches.
                begin, end = max(first - reach, 0), min(first + rows + reach, height)
                crop(begin, end - begin)
                # Seeds of a strip are those of the passes of no other one.
                part = taken(seed * len(self._strips) + number)[first - begin :][:rows]
                if result is None:
                    result = np.empty((height, *part.shape[1:]), part.dtype)
                result[first : first + rows] = part
        finally:
            crop(0, height)
        return result

    def picture(self) -> Picture:
        """The picture of the passes done."""
        return Picture(self._developed(self._sums), self._names)

    def standard_error(self) -> Picture:
        """The standard error of :meth:`picture`, from the scatter of the passes; NaN after the first.

        A pass of n samples has the variance s^2/n, so the expectation of the sum of n (x - mean)^2 over P passes is
        (P - 1) s^2, and the mean of all N samples has the variance s^2/N.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = np.divide(self._squares, (self._done - 1.0) * self.samples)
        shape = (*np.shape(self._sums)[:2], len(self._names))
        return Picture(np.broadcast_to(np.sqrt(variance), shape).astype(np.float32), self._names)

    @property
    def _names(self) -> tuple[str, ...]:
        """Channels of the picture: red, green, blue or luminance, alpha, then the integrator's extras."""
        names = [name for name in self._raw if name != "W"]
        return ("Y", *names[3:]) if self._grey else tuple(names)

    def _developed(self, sums: np.ndarray) -> np.ndarray:
        """Weighted sums [height, width, channels] over their weights, float32; black where nothing fell."""
        weight = self._raw.index("W")
        picture = np.empty((*sums.shape[:2], len(self._names)), np.float32)
        for row, line in zip(picture, sums, strict=True):  # row by row: a large film would not fit in memory twice
            values = np.delete(line, weight, axis=-1).astype(np.float64)
            fell = line[:, weight] != 0.0
            values[fell] /= line[fell, weight, None]
            values[~fell] = 0.0
            row[:] = np.column_stack((luminance(values[:, :3]), values[:, 3:])) if self._grey else values
        return picture


def pass_sizes(spp: int, pixels: int, limit: int = PASS_SAMPLES) -> Iterator[int]:
    """Samples per pixel of each pass: powers of two, so that all passes of one picture share a compiled kernel.

    limit: camera samples of one pass.
    """
    most = max(1, min(spp // LEAST_PASSES, limit // pixels))
    size = 1 << (most.bit_length() - 1)
    if spp >= 4:
        size = max(size, 4) if 4 * pixels <= limit else size
    while spp:
        while size > spp:
            size //= 2
        yield size
        spp -= size


def strips(width: int, height: int, limit: int) -> Iterator[tuple[int, int]]:
    """First row and number of rows of the parts of a film that have at most ``limit`` pixels each (or one row)."""
    rows = max(1, limit // width)
    for first in range(0, height, rows):
        yield first, min(rows, height - first)


def _channels(film: Any) -> tuple[list[str], bool]:
    """Names of a film's weighted sums, and whether it develops them to luminance. Raises InputError without RGB."""
    raw = [field.name for field in film.bitmap(raw=True).struct_()]
    if "R" not in raw or "W" not in raw:
        raise InputError(f"the scene's film gives the channels {', '.join(raw)}; must be an hdrfilm")
    return raw, film.bitmap().struct_()[0].name == "Y"
