"""What the package costs: whole processes with empty and full kernel caches, the solve, and rays per second.

Run from the repository root::

    python -m bench.speed            # a table
    python -m bench.speed --json     # the same numbers as JSON

"Cold" starts ``atmo-jit sky`` with an empty Dr.Jit kernel cache, as after an installation; "warm" with the cache that
the cold run left. The cache is moved by ``DRJIT_CACHE_DIR`` (Dr.Jit 1.5) and, for releases that only know
``~/.drjit``, by ``HOME``, so the user's stays as it is. In-process figures are medians after one warm-up; CPU time
is that of all threads.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from .cost import timed

Row = dict[str, object]

ROOT = Path(__file__).resolve().parents[1]
VIEWS = 1000


def random_views(count: int = VIEWS, seed: int = 2, **fixed: float) -> dict[str, np.ndarray]:
    """Views from the ground to 400 km, sun from overhead to 100 deg; ``fixed`` values replace the random ones."""
    rng = np.random.default_rng(seed)
    views = {
        "altitude_m": 4e5 * rng.random(count) ** 6,
        "sun_zenith_deg": 100 * rng.random(count),
        "view_zenith_deg": 180 * rng.random(count),
        "azimuth_deg": 360 * rng.random(count),
    }
    return {name: np.full(count, float(fixed[name])) if name in fixed else values for name, values in views.items()}


SCENES = {
    "any observer, any sun": {},
    "ground, sun at 40 deg": {"altitude_m": 2.0, "sun_zenith_deg": 40.0},
    "ground, sun at 94 deg": {"altitude_m": 2.0, "sun_zenith_deg": 94.0},
}


def command() -> list[str]:
    """How ``atmo-jit`` is started: the script beside this interpreter, else through the interpreter."""
    script = shutil.which("atmo-jit", path=str(Path(sys.executable).parent))
    return [script] if script else [sys.executable, "-c", "import sys; from atmo_jit.cli import main; sys.exit(main())"]


def timed_process(arguments: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """(wall, CPU) seconds of a process; raises RuntimeError with its last words where it fails."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(arguments, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}: {done.stderr.strip()[-400:]}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def whole_processes(atmosphere: str = "earth", repeats: int = 3) -> list[Row]:
    """Cold and warm ``atmo-jit sky`` for 1,000 views of each scene; warm is the median of ``repeats``."""
    rows = []
    for scene, fixed in SCENES.items():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            np.savez(folder / "views.npz", **random_views(**fixed))
            environment = {**os.environ, "HOME": name, "DRJIT_CACHE_DIR": str(folder / "kernels")}
            arguments = [*command(), "sky", "--atmosphere", atmosphere, "--views", str(folder / "views.npz")]
            arguments += ["--out", str(folder / "sky.npz"), "--quiet"]
            runs = [timed_process(arguments, environment) for _ in range(repeats + 1)]
            kernels = [file for file in (folder / "kernels").rglob("*") if file.is_file()]
        rows.append(
            {"scene": scene, "what": "atmo-jit sky, 1,000 views, cold", "wall_s": runs[0][0], "cpu_s": runs[0][1]}
        )
        wall, cpu = (statistics.median(run[i] for run in runs[1:]) for i in (0, 1))
        rows.append({"scene": scene, "what": "atmo-jit sky, 1,000 views, warm", "wall_s": wall, "cpu_s": cpu})
        rows[-2]["kernels"] = rows[-1]["kernels"] = len(kernels)
    return rows


def in_process(name: str = "earth", rays: int = 200_000) -> list[Row]:
    """Warm solve, solve of an atmosphere that changes each time, and evaluation of many rays."""
    import drjit as dr
    from drjit.llvm.ad import Float

    import atmo_jit
    from atmo_jit.solved import Sky

    atmosphere = atmo_jit.Atmosphere.load(name)
    scattering = atmosphere.mie[0].scattering_per_m
    count = iter(range(1, 10_000))

    def solve(changed: object) -> Sky:
        solved = Sky(changed)
        dr.eval([*solved.rays(*(Float([v]) for v in (2.0, 0.7, 0.5, 1.0))).radiance])
        dr.sync_thread()
        return solved

    def another() -> object:
        return atmosphere.replace({"mie.scattering_per_m": scattering * (1 + 1e-3 * next(count))})

    rows = []
    for what, work in (
        ("solve", lambda: solve(atmosphere)),
        ("solve, new atmosphere each time", lambda: solve(another())),
    ):
        rows.append({"scene": "all suns and altitudes, 3 wavelengths", "what": what, **timed(work, 7)})
    solved = solve(atmosphere)
    for scene, fixed in SCENES.items():
        views = random_views(rays, **fixed)
        angles = [
            views["altitude_m"],
            *(np.radians(views[f"{k}_deg"]) for k in ("sun_zenith", "view_zenith", "azimuth")),
        ]

        def evaluate(inputs: list[np.ndarray] = angles) -> None:
            dr.eval(solved.rays(*inputs).radiance)
            dr.sync_thread()

        cost = timed(evaluate, 3)
        rows.append({"scene": scene, "what": f"{rays:,} rays", **cost, "rays_per_s": rays / cost["wall_s"]})
    return rows


def table(rows: list[Row]) -> str:
    """Rows as aligned text."""
    lines = [f"{'':38}{'':32}{'wall s':>9}{'CPU s':>9}{'M rays/s':>10}"]
    for row in rows:
        rate = f"{row['rays_per_s'] / 1e6:10.3f}" if "rays_per_s" in row else ""
        lines.append(f"{row['scene']:38}{row['what']:32}{row['wall_s']:9.3f}{row['cpu_s']:9.3f}{rate}")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.speed", description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--atmosphere", default="earth", help="preset or JSON file")
    parser.add_argument("--rays", type=int, default=200_000, help="rays of the throughput rows")
    parser.add_argument("--part", choices=("all", "processes", "solve"), default="all")
    options = parser.parse_args(arguments)
    rows = whole_processes(options.atmosphere) if options.part != "solve" else []
    rows += in_process(options.atmosphere, options.rays) if options.part != "processes" else []
    result = {"cores": os.cpu_count(), "rows": rows}
    print(json.dumps(result, indent=1) if options.json else f"{os.cpu_count()} cores\n{table(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
