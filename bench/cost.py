"""What a solve costs: seconds with cold and warm kernels, peak memory, bytes kept.

Each question is answered by a process of its own, ``python -m atmo_jit.bench.cost METHOD SETTING ATMOSPHERE``, which
prints one line of JSON: nothing else that ran before can help or burden it.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPEATS = 5
ENOUGH_S = 60.0  # wall seconds after which nothing is repeated
MIB = 2.0**20


def memory_mib(peak: bool = False) -> float:
    """Memory of this process now, or the most so far (MiB). Where the system does not tell, the most so far."""
    name = "VmHWM:" if peak else "VmRSS:"
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return used / MIB if sys.platform == "darwin" else used / 1024.0
    return next(float(line.split()[1]) for line in lines if line.startswith(name)) / 1024.0


def timed(work: Any, repeats: int = REPEATS) -> dict[str, float]:
    """Median wall and CPU seconds of ``work()`` and of all kernels that it starts; it is called once before. Of fewer
    runs where these take long."""
    import drjit as dr

    start = time.perf_counter()
    work()
    dr.sync_thread()
    runs: list[tuple[float, float]] = []
    for _ in range(repeats):
        if runs and time.perf_counter() - start > ENOUGH_S:
            break
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        dr.sync_thread()
        runs.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = (statistics.median(column) for column in zip(*runs, strict=True))
    return {"wall_s": wall, "cpu_s": cpu}


def measure_here(method: str, setting: str, atmosphere: str, repeats: int, backend: str = "llvm") -> dict[str, Any]:
    """The first solve of this process, then more of them, and what they took."""
    from atmo_jit.atmosphere import Atmosphere

    from .methods import method_of

    solve = method_of(method).solve
    air = Atmosphere.load(atmosphere)
    import drjit as dr

    import atmo_jit.sky  # noqa: F401 - imports are not what is measured
    from atmo_jit.backend import floats, use
    from atmo_jit.grid import Grid
    from atmo_jit.kept import bytes_kept

    use(backend)

    dr.eval(floats([1.0]) + 1.0)  # starts the back end
    dr.sync_thread()
    before = memory_mib()
    cpu, wall = time.process_time(), time.perf_counter()
    solved = solve(setting, air)
    first = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    result = {"first": first, "peak_mib": memory_mib(peak=True) - before, "bytes": bytes_kept(solved, (Grid,))}
    if repeats:
        result["warm"] = timed(lambda: solve(setting, air), repeats)
    return result


def _process(words: tuple[str, ...], repeats: int, backend: str, folder: Path) -> dict[str, Any]:
    """``measure_here`` in a process whose kernel cache is ``folder``."""
    environment = {**os.environ, "HOME": str(folder), "DRJIT_CACHE_DIR": str(folder / "kernels")}
    command = [sys.executable, "-m", "atmo_jit.bench.cost", *words, str(repeats), backend]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{', '.join(words)}: the process ended with {done.returncode}: {done.stderr[-400:]}")
    return json.loads(done.stdout.splitlines()[-1])


def cost(
    method: str, setting: str, atmosphere: str = "earth", repeats: int = REPEATS, backend: str = "llvm"
) -> dict[str, Any]:
    """What a solve of a method costs, kernels compiled, read from disk, or ready.

    ``cold``: the first solve of a process with an empty kernel cache; ``cached``: with a full one; ``warm``: the median
    of ``repeats`` later solves (0: that of ``cached`` again, where a solve takes minutes); each wall and CPU seconds
    beyond imports. ``peak_mib`` beyond imports, kernels from the cache; ``solution_bytes``.
    """
    with tempfile.TemporaryDirectory() as name:
        cold = _process((method, setting, atmosphere), 0, backend, Path(name))
        cached = _process((method, setting, atmosphere), repeats, backend, Path(name))
    return {
        "cold": cold["first"],
        "cached": cached["first"],
        "warm": cached.get("warm", cached["first"]),
        "peak_mib": cached["peak_mib"],
        "solution_bytes": cached["bytes"],
    }


if __name__ == "__main__":
    print(json.dumps(measure_here(*sys.argv[1:4], int(sys.argv[4]), sys.argv[5])))
