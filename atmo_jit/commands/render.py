"""``atmo-jit render``: a Mitsuba scene to a linear OpenEXR and a tone-mapped PNG beside it."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import click

from atmo_jit import __version__, scenes
from atmo_jit.errors import InputError, one_line
from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.image import Picture, display, write_exr, write_png
from atmo_jit.interrupts import deferred_interrupts
from atmo_jit.kept_passes import KeptPasses
from atmo_jit.partial import KEEP_SECONDS
from atmo_jit.passes import PASS_SAMPLES, REFERENCE_PASS_SAMPLES, Passes
from atmo_jit.progress import progress_bar

# Warnings of Mitsuba that this command has its own word for: interrupts, and NaN (colours outside of sRGB, which have
# negative values, are none of its business).
OTHERWISE_SAID = ("interrupt signal", "[ImageBlock] Invalid sample value")


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
@click.option("--resume", is_flag=True, help="With --reference: go on from what an interrupted run kept.")
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
    resume: bool,
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
    mathematics, with noise. It is written after the first passes and again from time to time, and X.partial.npz with
    it, so that an interrupted render leaves the picture of the passes done, and --resume adds the others.
    """
    if list_scenes:
        for name, path in scenes.shipped().items():
            click.echo(f"{name:<{max(map(len, scenes.shipped()))}} {scenes.purpose(path)}")
        return
    if scene is None:
        raise InputError("SCENE is missing; give a file or one of the shipped scenes: " + ", ".join(scenes.shipped()))
    if out is None:
        raise InputError("--out is missing; give the .exr file to write")
    if not -100.0 <= exposure <= 100.0:  # also refuses NaN
        raise InputError(f"--exposure is {exposure}; must be a number of stops from -100 to 100")
    if resume and not reference:
        raise InputError("--resume: goes with --reference; other pictures take seconds and are rendered anew")
    exr, png = check_output(out, ".exr"), check_output(out.with_suffix(".png"), ".png")
    error = check_output(out.with_suffix(".error.exr"), ".exr") if standard_error else None
    kept = KeptPasses(exr) if reference else None
    path = scenes.find(scene)
    parameters = _parameters(definitions)

    started = time.perf_counter()
    metadata = {
        "software": f"atmo-jit {__version__}",
        "scene": path.name,
        "parameters": " ".join(f"{name}={value}" for name, value in parameters.items()),
        "variant": variant,
        "reference": str(reference).lower(),
    }

    def write(passes: Passes, keep: bool = False) -> Picture:
        """The picture of the passes done to all files; ``keep``: what the others will need too."""
        picture = passes.picture()
        extra = {"samplesPerPixel": passes.samples, "renderSeconds": time.perf_counter() - started}
        files = [exr, png, *([error] if error else []), *([kept.path] if keep else [])]
        with atomic_outputs(*files) as parts:
            write_exr(parts[0], picture, metadata | extra)
            write_png(parts[1], display(picture.rgb, exposure))
            if error:
                write_exr(parts[2], passes.standard_error(), metadata | extra)
            if keep:
                kept.write(parts[-1], passes, extra["renderSeconds"])
        return picture

    with _mitsuba(variant) as warnings:
        loaded, contents = _load(path, parameters, width, height, reference)
        warnings.say()
        most = REFERENCE_PASS_SAMPLES if reference else PASS_SAMPLES
        passes = Passes(loaded, spp, most, scatter=standard_error)
        if kept:
            kept.settings = {
                "the version": metadata["software"],
                "--variant": variant,
                "--spp": passes.total,
                "--standard-error": standard_error,
                "the scene (with its files and -D, --width and --height)": contents,
            }
            started -= kept.begin(passes, resume, _warn)
        with progress_bar(f"rendering {path.stem}", quiet=quiet) as advance:
            written = time.perf_counter()
            with deferred_interrupts() if reference else nullcontext() as interrupt:
                for _ in passes.run(advance):
                    if interrupt and interrupt.asked and passes.samples < passes.total:
                        write(passes, keep=True)
                        held = f"{exr.name} holds {passes.samples} of {passes.total} samples per pixel"
                        _warn(f"interrupted: {held}; --resume adds the others")
                        raise KeyboardInterrupt
                    if reference and time.perf_counter() - written > KEEP_SECONDS:
                        write(passes, keep=True)
                        written = time.perf_counter()
        picture = write(passes)
        if kept:
            kept.path.unlink(missing_ok=True)
    invalid = int(picture.invalid.sum())
    if invalid:
        _warn(
            f"{invalid} of {picture.invalid.size} pixels are NaN or infinite: kept in {exr.name}, magenta in {png.name}"
        )
    if not quiet:
        rows, columns = picture.pixels.shape[:2]
        seconds = time.perf_counter() - started
        click.echo(f"{out} and {png.name}: {columns}x{rows}, {passes.samples} samples per pixel, {seconds:.1f} s")


def _load(
    path: Path, parameters: dict[str, str], width: int | None, height: int | None, reference: bool
) -> tuple[Any, str]:
    """The scene of a file, for ``reference`` with the path-traced air in it, and what tells the file's contents from
    others."""
    from atmo_jit.scenes.reader import contents, load_scene

    load = partial(load_scene, path, parameters, width=width, height=height)
    if not reference:
        return load(), ""
    from atmo_jit.plugins.reference import load_reference

    found: list[str] = []

    def noting(edit: Callable[[Any], None]) -> Any:
        def noted(state: Any) -> None:
            found.append(contents(state))
            edit(state)

        return load(edit=noted)

    return load_reference(noting), found[0]


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
def _mitsuba(variant: str) -> Iterator[Any]:
    """Mitsuba with a variant set, this package's plugins registered and its log turned into warnings on stderr: those
    that come while the scene is loaded once ``say`` of what it gives is called, or at the end. Where input is refused,
    that is all that is said.

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
            self.seen: dict[str, bool] = {}  # and said
            self.saying = False

        def append(self, level: Any, text: str) -> None:
            text = one_line(re.sub(r"^\S+ \S+ WARN\s+", "", text))
            if text not in self.seen and not any(other in text for other in OTHERWISE_SAID):
                self.seen[text] = False
                if self.saying:
                    self.say()

        def say(self) -> None:
            """Say what was held back, and from now on all at once."""
            self.saying = True
            for text, said in list(self.seen.items()):  # Mitsuba's threads may add to it
                if not said:
                    self.seen[text] = True
                    _warn(text)

        def log_progress(self, *args: Any) -> None:
            """Mitsuba's own progress: this command has its bar."""

    logger = mi.logger()
    level = logger.log_level()
    former = [logger.appender(index) for index in range(logger.appender_count())]
    logger.clear_appenders()
    warnings = Warnings()
    logger.add_appender(warnings)
    logger.set_log_level(mi.LogLevel.Warn)
    try:
        from atmo_jit.plugins import register

        register()
        yield warnings
        warnings.say()
    finally:
        logger.clear_appenders()
        for appender in former:
            logger.add_appender(appender)
        logger.set_log_level(level)


def _warn(text: str) -> None:
    print(f"atmo-jit: warning: {text}", file=sys.stderr)
