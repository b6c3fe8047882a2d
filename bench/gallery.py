"""The shipped scenes: pictures, times, and the same scenes with path-traced air beside them.

    python -m bench.gallery --page docs/gallery.md --pictures docs/images/gallery      # 20 minutes on 2 cores
    python -m bench.gallery --scenes shafts city --spp 256 --times                     # some, and what they take

Each scene is rendered in independent passes by its own integrator and with path-traced air
(``atmo_jit.plugins.reference``), which gives both pictures' noise. Differences are of means over squares of pixels.
The gain is the ratio of 1 / (relative variance x CPU seconds) of the two, over the pixels that neither has black.
``--times`` adds the wall seconds of ``atmo-jit render NAME`` at its own size, with an empty cache of kernels and again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .page import table

SIZE = (320, 180)
SQUARE = 20
SHADED = 1.0  # per cent that shadows in the air take away
PASSES = 4
TEXT = """# Gallery

Printed by `python -m bench.gallery {arguments}--page docs/gallery.md --pictures docs/images/gallery`.
Left the scene's own integrator with the solved atmosphere, right the same scene with path-traced air
(`atmo-jit render NAME --reference`) at {spp} samples per pixel. Differences are of the means over squares of
{square} x {square} pixels, in per cent of the green channel; "beyond 3 sigma" is the 95th percentile of what they
exceed three standard errors by. "gain" is how many times less processor time the left picture takes for the same noise.

Light of order 2 and more that shapes keep from the air is read from a table (docs/method.md), whose bias is that of the
last column. Making it, once for a scene, does not count in the gain. "shaded" are squares that shafts
and shadows change by more than {shaded:g} %, "clear" the others: the last columns have, of these, what "p95 beyond 3
sigma" is of all, and of those the mean difference.

"""


def passes(scene: Any, count: int, spp: int) -> tuple[np.ndarray, float]:
    """Pictures [count, height, width, 3] with seeds of their own, and CPU seconds, kernels compiled."""
    import mitsuba as mi

    np.array(mi.render(scene, spp=1, seed=1000))
    started = time.process_time()
    pictures = [np.array(mi.render(scene, spp=spp, seed=i), dtype=np.float64)[..., :3] for i in range(count)]
    return np.stack(pictures), time.process_time() - started


def squares(pictures: np.ndarray, size: int) -> np.ndarray:
    """Means over squares of pixels of the green channel: [passes, squares]."""
    n, height, width, _ = pictures.shape
    inside = pictures[:, : height // size * size, : width // size * size, 1]
    return inside.reshape(n, height // size, size, width // size, size).mean(axis=(2, 4)).reshape(n, -1)


def shaded_squares(scene: Any, own: np.ndarray, spp: int) -> np.ndarray:
    """Which squares shadows in the air change by more than SHADED per cent: the same paths without them."""
    integrator = scene.integrator()
    if not hasattr(integrator, "shaft_samples"):  # another integrator, for scenes without shapes
        return np.zeros(squares(own, SQUARE).shape[1], dtype=bool)
    count, integrator.shaft_samples = integrator.shaft_samples, 0
    try:
        without, _ = passes(scene, PASSES, spp)
    finally:
        integrator.shaft_samples = count
    with_, without = (squares(v, SQUARE).mean(axis=0) for v in (own, without))
    return np.abs(without - with_) > 0.01 * SHADED * with_


def compare(
    own: np.ndarray, truth: np.ndarray, own_seconds: float, truth_seconds: float, shaded: np.ndarray
) -> dict[str, Any]:
    """Figures of two stacks of passes; differences in per cent. ``shaded``: squares in shadowed air."""
    a, b = (squares(v, SQUARE) for v in (own, truth))
    mean, reference = a.mean(axis=0), b.mean(axis=0)
    sigma = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / len(a))
    known = (reference > 1e-3 * reference.max()) & (sigma < 0.2 * reference)
    mean, reference, sigma, shaded = mean[known], reference[known], sigma[known], shaded[known]
    signed = 100.0 * (mean / reference - 1.0)
    difference = np.abs(signed)
    beyond = np.maximum(difference - 300.0 * sigma / reference, 0.0)

    def efficiency(pictures: np.ndarray, seconds: float) -> float:
        green = pictures[..., 1]
        lit = np.all(green > 0.0, axis=0)
        relative = green.var(axis=0, ddof=1)[lit] / green.mean(axis=0)[lit] ** 2
        # The median: a pixel with the edge of the sun in it would make all of a mean.
        return 1.0 / (float(np.median(relative)) * seconds)

    return {
        "median": float(np.median(difference)),
        "p95": float(np.percentile(difference, 95)),
        "beyond": float(np.percentile(beyond, 95)),
        "clear": float(np.percentile(beyond[~shaded], 95)) if np.any(~shaded) else "-",
        "bias": float(np.mean(signed[shaded])) if np.any(shaded) else "-",
        "gain": efficiency(own, own_seconds) / efficiency(truth, truth_seconds),
    }


def seconds_of_command(name: str, folder: Path) -> tuple[float, float]:
    """Wall seconds of ``atmo-jit render NAME``, with an empty cache of kernels and with the one that it left."""
    import os

    environment = os.environ | {"DRJIT_CACHE_DIR": str(folder / "cache"), "HOME": str(folder)}
    found = []
    for _ in range(2):
        started = time.perf_counter()
        command = [sys.executable, "-m", "atmo_jit", "render", name, "--out", str(folder / f"{name}.exr"), "--quiet"]
        subprocess.run(command, check=True, env=environment)
        found.append(time.perf_counter() - started)
    return found[0], found[1]


def measure(name: str, spp: int, time_command: bool, show: Callable[[str, np.ndarray], None]) -> dict[str, Any]:
    """One scene's row."""
    from atmo_jit import scenes
    from atmo_jit.plugins.reference import load_reference
    from atmo_jit.scenes.reader import load_scene

    path, (width, height) = scenes.find(name), SIZE
    own_scene = load_scene(path, width=width, height=height)
    twin = load_reference(lambda edit: load_scene(path, width=width, height=height, edit=edit))
    own_spp = max(own_scene.sensors()[0].sampler().sample_count() // PASSES, 1)
    own, own_seconds = passes(own_scene, PASSES, own_spp)
    truth, truth_seconds = passes(twin, PASSES, max(spp // PASSES, 1))
    show(name, np.concatenate([own.mean(axis=0), truth.mean(axis=0)], axis=1))
    shaded = shaded_squares(own_scene, own, own_spp)
    row: dict[str, Any] = {"scene": name, **compare(own, truth, own_seconds, truth_seconds, shaded)}
    if time_command:
        with tempfile.TemporaryDirectory() as folder:
            cold, warm = seconds_of_command(name, Path(folder))
        row["seconds"] = f"{cold:.1f}, {warm:.1f}"
    return row


def page(rows: Sequence[Mapping[str, Any]], spp: int, folder: str, arguments: str) -> str:
    from atmo_jit import scenes

    columns = {
        "scene": "scene",
        **({"seconds": "seconds, first and again"} if "seconds" in rows[0] else {}),
        "median": "median %",
        "p95": "p95 %",
        "beyond": "p95 beyond 3 sigma %",
        "gain": "gain",
        "clear": "clear: p95 beyond 3 sigma %",
        "bias": "shaded: bias %",
    }
    text = TEXT.format(spp=spp, square=SQUARE, shaded=SHADED, arguments=arguments) + table(rows, columns)
    for row in rows:
        name = row["scene"]
        purpose, command = scenes.purpose(scenes.find(name)), f"`atmo-jit render {name} --out {name}.exr`"
        text += f"\n## {name}\n\n{purpose}\n\n{command}\n\n![{name}]({folder}/{name}.png)\n"
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    from atmo_jit import scenes

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", metavar="NAME")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel of the path-traced twin")
    parser.add_argument("--times", action="store_true")
    parser.add_argument("--page", type=Path)
    parser.add_argument("--pictures", type=Path, metavar="FOLDER")
    given = parser.parse_args(arguments)
    import atmo_jit  # noqa: F401, I001  (first: it chooses the LLVM library)
    import mitsuba as mi

    from atmo_jit.image import display

    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register

    register()

    def show(name: str, picture: np.ndarray) -> None:
        if given.pictures:
            given.pictures.mkdir(parents=True, exist_ok=True)
            mi.util.write_bitmap(str(given.pictures / f"{name}.png"), display(picture).astype(np.float32))

    rows = []
    for name in given.scenes or scenes.shipped():
        rows.append(measure(name, given.spp, given.times, show))
        print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else str(v) for k, v in rows[-1].items()), flush=True)
    if given.page:
        relative = Path(given.pictures or "images/gallery")
        folder = relative.relative_to(given.page.parent) if relative.is_relative_to(given.page.parent) else relative
        named = (f"--scenes {' '.join(given.scenes)} " if given.scenes else "") + ("--times " if given.times else "")
        given.page.write_text(page(rows, given.spp, str(folder), named), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
