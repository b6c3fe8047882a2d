"""``atmo-jit render``: a Mitsuba scene to a linear OpenEXR and a tone-mapped PNG beside it."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np

from atmo_jit import __version__, scenes
from atmo_jit.errors import InputError, one_line
from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.image import Picture, display, luminance, write_exr, write_png
from atmo_jit.progress import progress_bar

# Camera samples of one pass: bounds the memory (about 0.1 KiB each) and keeps the bar moving on small machines.
PASS_SAMPLES = 2**21
# The same for the path-traced medium, whose samples need more memory.
REFERENCE_PASS_SAMPLES = 2**19
# Seconds between the pictures that a --reference render leaves on the way.
KEEP_SECONDS = 20.0
# A picture takes at least this many passes where it has the samples for it, so that the bar moves.
LEAST_PASSES = 16


@click.command()
@click.argument("scene", required=False)
@click.option("--out", type=click.Path(path_type=Path), help="Picture to write, .exr; a .png goes beside it.")
@click.option("--spp", type=click.IntRange(min=1), help="Samples per pixel in place of the scene's.")
@click.option("--width", type=click.IntRange(1, 65536), help="Width in pixels; without --height the proportions stay.")
@click.option("--height", type=click.IntRange(1, 65536), help="Height in pixels; without --width the proportions stay.")
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Mitsuba variant.")
@click.option(
    "-D", "definitions", multiple=True, metavar="NAME=VALUE", help="Set a parameter of the scene; repeatable."
)
@click.option("--reference", is_flag=True, help="Path-trace the air in place of the emitter `atmosphere`.")
@click.option(
    "--standard-error", is_flag=True, help="Also write X.error.exr: the standard error of every pixel and channel."
)
@click.option("--exposure", type=float, default=0.0, metavar="EV", help="Stops around the PNG's automatic exposure.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
@click.option("--list", "list_scenes", is_flag=True, help="Name the shipped scenes and stop.")
def command(
    scene: str | None,
    out: Path | None,
    spp: int | None,
    width: int | None,
    height: int | None,
    variant: str,
    definitions: tuple[str, ...],
    reference: bool,
    standard_error: bool,
    exposure: float,
    quiet: bool,
    list_scenes: bool,
) -> None:
    """Render SCENE, a shipped scene's name or an .xml or .json file, to a linear OpenEXR and a PNG.

    \b
    atmo-jit render noon --out noon.exr
    atmo-jit render sunset --out sunset.exr --spp 256 --width 1280 -D "sun=0, 1, 0.02"

    With --reference the air is a medium that light is traced through, path by path: the same picture from other
    mathematics, with noise. It is written after the first passes and again from time to time, so that an interrupted
    render leaves the picture of the passes done.
    """
    if list_scenes:
        for name, path in scenes.shipped().items():
            click.echo(f"{name:<10} {scenes.purpose(path)}")
        return
    if scene is None:
        raise InputError("SCENE is missing; give a file or one of the shipped scenes: " + ", ".join(scenes.shipped()))
    if out is None:
        raise InputError("--out is missing; give the .exr file to write")
    if not -100.0 <= exposure <= 100.0:  # also refuses NaN
        raise InputError(f"--exposure is {exposure}; must be a number of stops from -100 to 100")
    exr, png = check_output(out, ".exr"), check_output(out.with_suffix(".png"), ".png")
    path = scenes.find(scene)
    parameters = _parameters(definitions)

    error = check_output(out.with_suffix(".error.exr"), ".exr") if standard_error else None

    started = time.perf_counter()
    metadata = {
        "software": f"atmo-jit {__version__}",
        "scene": path.name,
        "parameters": " ".join(f"{name}={value}" for name, value in parameters.items()),
        "variant": variant,
        "reference": str(reference).lower(),
    }

    def write(passes: Passes) -> Picture:
        """The picture of the passes done, to all files."""
        picture = passes.picture()
        extra = {"samplesPerPixel": passes.samples, "renderSeconds": time.perf_counter() - started}
        with atomic_outputs(exr, png, *([error] if error else [])) as parts:
            write_exr(parts[0], picture, metadata | extra)
            write_png(parts[1], display(picture.rgb, exposure))
            if error:
                write_exr(parts[2], passes.standard_error(), metadata | extra)
        return picture

    with _mitsuba(variant):
        loaded = _load(path, parameters, width, height, reference)
        most = REFERENCE_PASS_SAMPLES if reference else PASS_SAMPLES
        passes = Passes(loaded, spp, most, scatter=standard_error)
        with progress_bar(f"rendering {path.stem}", quiet=quiet) as advance:
            written = started
            try:
                for _ in passes.run(advance):
                    if reference and time.perf_counter() - written > KEEP_SECONDS:
                        write(passes)
                        written = time.perf_counter()
            except KeyboardInterrupt:
                if reference and passes.samples:
                    write(passes)
                    _warn(f"interrupted: {exr.name} holds {passes.samples} of {passes.total} samples per pixel")
                raise
        picture = write(passes)
    invalid = int(picture.invalid.sum())
    if invalid:
        _warn(
            f"{invalid} of {picture.invalid.size} pixels are NaN or infinite: kept in {exr.name}, magenta in {png.name}"
        )
    if not quiet:
        rows, columns = picture.pixels.shape[:2]
        seconds = time.perf_counter() - started
        click.echo(f"{out} and {png.name}: {columns}x{rows}, {passes.samples} samples per pixel, {seconds:.1f} s")


def _load(path: Path, parameters: dict[str, str], width: int | None, height: int | None, reference: bool) -> Any:
    """The scene of a file, for ``reference`` with the path-traced air in it."""
    from atmo_jit.scenes.reader import load_scene

    if not reference:
        return load_scene(path, parameters, width=width, height=height)
    from atmo_jit.plugins.reference import load_reference

    return load_reference(lambda edit: load_scene(path, parameters, width=width, height=height, edit=edit))


def render_picture(scene: Any, spp: int | None, advance: Callable[[float], None]) -> tuple[Picture, int]:
    """Render with the scene's integrator and first sensor, in passes of different seeds, and return it with its spp.

    spp: samples per pixel, None for the sensor's own number. Samplers that cannot take a number take the next larger
        one; the second result is the number really used.
    advance: called with the fraction done after every pass.
    """
    passes = Passes(scene, spp)
    for _ in passes.run(advance):
        continue
    return passes.picture(), passes.samples


class Passes:
    """A picture in passes of different seeds, with the scene's integrator and first sensor.

    The passes' weighted sums and filter weights are added in float64 and divided once, so the picture is the same
    estimate that one pass with all samples would give. ``samples``: per pixel, in the passes done; ``total``: in all;
    ``seed``: of the first pass. scatter: whether :meth:`standard_error` will be asked for, which takes memory.
    """

    def __init__(self, scene: Any, spp: int | None, most: int = PASS_SAMPLES, scatter: bool = True) -> None:
        self._scene, self._sensor = scene, scene.sensors()[0]
        self._film, self._sampler = self._sensor.film(), self._sensor.sampler()
        self.total = spp or self._sampler.sample_count()
        self._sizes = list(pass_sizes(self.total, int(np.prod(self._film.crop_size())), most))
        if len(self._sizes) == 1 and self.total > 1:  # one pass knows no standard error
            self._sizes = [self.total // 2, self.total - self.total // 2]
        # A film with more pixels than a pass may have samples is rendered in strips.
        self._strips = list(strips(*(int(n) for n in self._film.crop_size()), most))
        self.samples, self.seed, self._scatter = 0, 0, scatter
        self._sums: np.ndarray | float = 0.0
        # Of the passes' own pictures x with n samples each: sums of n x, n^2 x, n^2 x^2, n^2.
        self._moments: list[Any] = [0.0, 0.0, 0.0, 0.0]

    def run(self, advance: Callable[[float], None]) -> Iterator[None]:
        """Render, one pass at each step; ``advance`` is called with the fraction done."""
        done = 0
        for seed, count in enumerate(self._sizes):
            raw = self._pass(self.seed + seed, count)
            taken = self._sampler.sample_count()
            if self._scatter:
                x = _developed(self._film, raw).pixels.astype(np.float64)
                terms = (taken * x, taken**2 * x, taken**2 * x * x, float(taken**2))
                self._moments = [total + term for total, term in zip(self._moments, terms, strict=True)]
            raw += self._sums
            self._sums = raw
            self.samples += taken
            done += count
            advance(done / self.total)
            yield

    def _pass(self, seed: int, count: int) -> np.ndarray:
        """The film's weighted sums after ``count`` samples per pixel, float64."""
        integrator = self._scene.integrator()

        def taken(number: int) -> np.ndarray:
            integrator.render(self._scene, self._sensor, seed=number, spp=count, develop=False, evaluate=True)
            return np.array(self._film.develop(raw=True), dtype=np.float64)

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
                    result = np.empty((height, *part.shape[1:]))
                result[first : first + rows] = part
        finally:
            crop(0, height)
        return result

    def picture(self) -> Picture:
        """The picture of the passes done."""
        return _developed(self._film, self._sums)

    def standard_error(self) -> Picture:
        """The standard error of :meth:`picture`, from the scatter of the passes; NaN after the first."""
        first, weighted, squares, weights = self._moments
        mean = first / self.samples
        passes = min(len(self._sizes), max(1, round(self.samples / self._sizes[0])))
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = (squares - 2.0 * mean * weighted + mean * mean * weights) / self.samples**2
            error = np.sqrt(np.maximum(spread, 0.0) * passes / (passes - 1.0))
        return Picture(error.astype(np.float32), self.picture().channels)


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


def _developed(film: Any, sums: np.ndarray) -> Picture:
    """A film's weighted sums over its weights: red, green, blue or luminance, alpha, then the integrator's extras."""
    names = [field.name for field in film.bitmap(raw=True).struct_()]
    if "W" not in names or "R" not in names:
        raise InputError(f"the scene's film gives the channels {', '.join(names)}; must be an hdrfilm")
    weight = sums[..., names.index("W"), None]
    values = np.divide(sums, weight, out=np.zeros_like(sums), where=weight != 0.0)
    planes = {name: values[..., index] for index, name in enumerate(names) if name != "W"}
    developed = [field.name for field in film.bitmap().struct_()]
    if developed[0] == "Y":
        grey = luminance(np.stack([planes.pop(name) for name in "RGB"], axis=-1))
        planes = {"Y": grey, **planes}
    return Picture(np.stack(list(planes.values()), axis=-1).astype(np.float32), tuple(planes))


def _parameters(definitions: tuple[str, ...]) -> dict[str, str]:
    """The scene parameters of all -D options. Raises InputError for one that is not NAME=VALUE."""
    parameters = {}
    for definition in definitions:
        name, equals, value = definition.partition("=")
        if not (equals and name):
            raise InputError(f"-D {definition}: must be NAME=VALUE")
        parameters[name] = value
    return parameters


@contextmanager
def _mitsuba(variant: str) -> Iterator[None]:
    """Mitsuba with a variant set, this package's plugins registered and its log turned into warnings on stderr.

    Raises InputError when the variant is not in this build of Mitsuba or its backend does not start.
    """
    if variant.startswith("llvm"):
        from atmo_jit.llvm import require_llvm

        require_llvm()
    import mitsuba as mi

    if variant not in mi.variants():
        raise InputError(f"--variant is {variant!r}; this Mitsuba has {', '.join(mi.variants())}")
    try:
        mi.set_variant(variant)
    except ImportError as error:
        raise InputError(f"--variant {variant} does not start here: {one_line(str(error))}") from None

    class Warnings(mi.Appender):
        """Mitsuba's warnings, each as one line, once."""

        def __init__(self) -> None:
            super().__init__()
            self.seen: set[str] = set()

        def append(self, level: Any, text: str) -> None:
            text = one_line(re.sub(r"^\S+ \S+ WARN\s+", "", text))
            # Ctrl-C is announced as a warning too; the command line has its own word for that.
            if text not in self.seen and "interrupt signal" not in text:
                self.seen.add(text)
                _warn(text)

        def log_progress(self, *args: Any) -> None:
            """Mitsuba's own progress: this command has its bar."""

    logger = mi.logger()
    level = logger.log_level()
    former = [logger.appender(index) for index in range(logger.appender_count())]
    logger.clear_appenders()
    logger.add_appender(Warnings())
    logger.set_log_level(mi.LogLevel.Warn)
    try:
        from atmo_jit.plugins import register

        register()
        yield
    finally:
        logger.clear_appenders()
        for appender in former:
            logger.add_appender(appender)
        logger.set_log_level(level)


def _warn(text: str) -> None:
    print(f"atmo-jit: warning: {text}", file=sys.stderr)
