"""The files that commands read, a good one of each kind, and what reads it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit import presets
from atmo_jit.cli import main as run_command
from atmo_jit.errors import InputError
from atmo_jit.export import Options, export
from atmo_jit.image import Picture, write_exr
from atmo_jit.kept_passes import KeptPasses
from atmo_jit.passes import Passes

from .damage import npz

CONFIG = """
atmosphere = "earth"
[free]
"mie.phase.g" = { start = 0.6, min = -0.5, max = 0.97 }
"""
SCENE = {
    "comment": "A ball. For tests.",
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 2},
    "sensor": {"type": "perspective", "fov": 40, "film": {"type": "hdrfilm", "width": 4, "height": 4}},
    "sky": {"type": "atmosphere"},
    "ball": {"type": "sphere"},
}


SCENE_XML = """<scene version="3.9.0">
    <default name="elevation" value="0.4"/>
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/></film></sensor>
    <emitter type="atmosphere"><vector name="sun_direction" value="1, 0, $elevation"/></emitter>
    <shape type="sphere"/>
</scene>
"""
PICTURE = """
[picture]
projection = "latlong"
sun_zenith_deg = 40
"""


@dataclass(frozen=True)
class Target:
    """One kind of file: its ``name``, what a good one holds, ``call(path, out)``, which reads it and returns an exit
    status, and the name of what may be written."""

    name: str
    content: bytes
    call: Callable[[Path, Path], int]
    output: str = "old.json"


class _Enough(Exception):
    """Raised out of a fit that has begun."""


def targets(folder: Path) -> list[Target]:
    """The kinds of files, with what else the commands need in ``folder``."""
    few = 6
    views = {"altitude_m": np.zeros(few), "sun_zenith_deg": np.full(few, 40.0), "azimuth_deg": np.full(few, 90.0)}
    views["view_zenith_deg"] = np.linspace(0.0, 80.0, few)
    scan = {**views, "radiance": np.full((few, 3), 0.05), "relative_sigma": np.array(0.05)}
    scan["wavelengths_nm"] = np.array([680.0, 550.0, 440.0])
    (folder / "fit.toml").write_text(CONFIG, encoding="utf-8")
    (folder / "picture.toml").write_text(CONFIG + PICTURE, encoding="utf-8")
    (folder / "views.npz").write_bytes(npz(views))
    (folder / "scan.npz").write_bytes(npz(scan))
    text = "altitude_m,sun_zenith_deg,view_zenith_deg,azimuth_deg,wavelengths_nm,radiance,relative_sigma\n"
    text += "".join(f"0,40,{10 * i},90,{w},0.05,0.05\n" for i in range(few) for w in (680, 550, 440))
    write_exr(folder / "picture.exr", Picture(np.full((8, 16, 3), 0.05, np.float32), ("R", "G", "B")), {})
    atmosphere = json.dumps(presets.read("earth")).encode()

    def sky(air: Path | str, file: Path, out: Path) -> int:
        arguments = ["--atmosphere", str(air), "--views", str(file), "--out", str(out.with_suffix(".npz")), "--quiet"]
        return run_command(["sky", *arguments])

    def plan(path: Path, out: Path) -> int:
        return run_command(["plan", str(path), "--json"])

    return [
        Target("air.json", atmosphere, lambda p, o: sky(p, folder / "views.npz", o), "old.npz"),
        Target("views.npz", npz(views), lambda p, o: sky("earth", p, o), "old.npz"),
        Target("scan.npz", npz(scan), lambda p, o: _fitted(p, folder / "fit.toml")),
        Target("scan.csv", text.encode(), lambda p, o: _fitted(p, folder / "fit.toml")),
        Target("fit.toml", CONFIG.encode(), lambda p, o: _fitted(folder / "scan.npz", p)),
        Target("sky.exr", (folder / "picture.exr").read_bytes(), lambda p, o: _fitted(p, folder / "picture.toml")),
        Target("scene.json", json.dumps(SCENE).encode(), plan),
        Target("scene.xml", SCENE_XML.encode(), plan),
        *_exported(folder),
        *_kept(folder),
    ]


def _fitted(observations: Path, config: Path) -> int:
    """What atmo-jit fit does up to its first steps."""
    from atmo_jit.fits import FitConfig, fit, load_observations
    from atmo_jit.fits.pictures import load_picture

    def enough(_: float) -> None:
        raise _Enough

    def work() -> None:
        settings = FitConfig.load(config)
        picture = observations.suffix == ".exr"
        data = load_picture(observations, settings) if picture else load_observations(observations)
        fit(data, settings, enough)

    return _status(work)


def _exported(folder: Path) -> list[Target]:
    """The files of an export that can be read back."""
    from atmo_jit.export import read

    exported = folder / "exported"
    export("earth", "native", exported, Options())
    good = {file.name: file.read_bytes() for file in exported.iterdir()}

    def target(name: str) -> Target:
        def call(path: Path, out: Path) -> int:
            for file, content in (good | {name: path.read_bytes()}).items():
                (exported / file).write_bytes(content)
            return _status(lambda: read(exported))

        return Target(name, good[name], call)

    return [target(name) for name in sorted(good)]


def _kept(folder: Path) -> list[Target]:
    """What interrupted work keeps."""
    import mitsuba as mi

    from atmo_jit.fits import FitConfig, load_observations
    from atmo_jit.fits.kept import KeptFit, Point
    from atmo_jit.plugins import register
    from atmo_jit.scenes.reader import load_scene

    mi.set_variant("llvm_ad_rgb")
    register()
    (folder / "kept.json").write_text(json.dumps(SCENE), encoding="utf-8")
    scene = load_scene(folder / "kept.json")
    observed = load_observations(folder / "scan.npz"), FitConfig.load(folder / "fit.toml")

    def picture(out: Path) -> tuple[KeptPasses, Passes]:
        return KeptPasses(out.with_suffix(".exr")), Passes(scene, 16)

    def fit(out: Path) -> KeptFit:
        return KeptFit(out.with_suffix(".json"), *observed)

    def call(kept: Any, path: Path, *more: Any) -> int:
        kept.path.write_bytes(path.read_bytes())
        try:
            return _status(lambda: kept.begin(*more, True, print))
        finally:
            kept.path.unlink()

    kept, passes = picture(folder / "good")
    next(passes.run(lambda fraction: None))
    kept.write(folder / "good.npz", passes, 1.0)
    begun = fit(folder / "good")
    begun.keep(Point(0, (), (0.0,), (0.0,)))
    begun.write()

    def of_picture(path: Path, out: Path) -> int:
        there, fresh = picture(out)
        return call(there, path, fresh)

    return [
        Target("passes.npz", (folder / "good.npz").read_bytes(), of_picture),
        Target("point.json", begun.path.read_bytes(), lambda p, o: call(fit(o), p)),
    ]


def _status(work: Callable[[], Any]) -> int:
    """The exit status that the command line would give."""
    try:
        work()
    except _Enough:
        return 0
    except InputError as error:
        print(f"atmo-jit: {error}", file=sys.stderr)
        return 2
    return 0
