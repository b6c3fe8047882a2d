"""Commands that are stopped at random moments: their outputs are the old ones or complete new ones.

    python -m bench.kills --count 50

Ctrl-C, SIGTERM and SIGKILL at any moment from the start to beyond the end of render, export, sky, fit and bench, and
disks that are full after some bytes (RLIMIT_FSIZE). What is kept of interrupted work is whole too, and --resume goes on
from it. Afterwards every command runs once undisturbed, after which nothing temporary may be left.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from atmo_jit.export.containers import read_exr
from atmo_jit.files import read_npz

from .counted import command
from .hostile_targets import CONFIG

OLD = b"old"
WAYS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL, "full disk")
FULL = (0, 1, 100, 4096, 20_000, 200_000)  # bytes that still fit
READERS: dict[str, Callable[[Path], Any]] = {
    ".exr": read_exr,
    ".npz": lambda path: read_npz(path, kinds="biufU"),
    ".json": lambda path: json.loads(path.read_text(encoding="utf-8")),
    ".png": lambda path: _starts(path, b"\x89PNG"),
    ".md": lambda path: _starts(path, b"#"),
}


# The command line, where files cannot grow beyond some bytes, and which a shell's background job does not make deaf.
# What can be resumed is kept at every step.
LIMITED = """
import resource, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)  # while Python imports, an interrupt just ends it
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
if (limit := int(sys.argv[1])) >= 0:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
from atmo_jit import partial
partial.KEEP_SECONDS = 0.0
from atmo_jit.cli import main
sys.exit(main(sys.argv[2:]))
"""


@dataclass
class Work:
    """A command line (after ``atmo-jit``), the folder it writes to, the files that it leaves there, and the ``kept``
    one that it goes on from."""

    name: str
    arguments: tuple[str, ...]
    folder: Path
    outputs: tuple[str, ...]
    kept: str | None
    seconds: float = 0.0

    def start(self, limit: int | None = None) -> subprocess.Popen:
        """The running command; ``limit``: bytes that a file may have."""
        more = ["--resume"] if self.kept else []
        command = [sys.executable, "-c", LIMITED, str(-1 if limit is None else limit), *self.arguments, *more]
        # An interrupt waits until Python itself has started, which has a traceback for it.
        former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, former)

    def lay_old(self) -> None:
        """Old outputs in the place of the new ones."""
        self.folder.mkdir(exist_ok=True)
        for name in self.outputs:
            (self.folder / name).write_bytes(OLD)

    def broken(self) -> list[str]:
        """Outputs that are neither old nor complete, and what was kept if it is not."""
        found = []
        for name in (*self.outputs, *([self.kept] if self.resumes() else [])):
            path = self.folder / name
            try:
                if path.read_bytes() != OLD:
                    READERS.get(path.suffix, Path.read_bytes)(path)
            except Exception as error:  # whatever a reader says of half a file
                found.append(f"{name}: {error}")
        return found

    def temporaries(self) -> list[str]:
        """Names of what is in the folder beside the outputs and what is kept."""
        return sorted(set(os.listdir(self.folder)) - {*self.outputs, self.kept})

    def resumes(self) -> bool:
        """Whether something was kept."""
        return self.kept is not None and (self.folder / self.kept).exists()


def works(folder: Path, names: tuple[str, ...]) -> list[Work]:
    """The commands, small, writing below ``folder``."""
    few = 400
    views = {"altitude_m": np.zeros(few), "sun_zenith_deg": np.full(few, 40.0), "azimuth_deg": np.full(few, 90.0)}
    views["view_zenith_deg"] = np.linspace(0.0, 80.0, few)
    np.savez(folder / "views.npz", **views)
    part = {name: values[:: few // 20] for name, values in views.items()}
    np.savez(folder / "scan.npz", **part, radiance=np.full((20, 3), 0.05), relative_sigma=0.05,
             wavelengths_nm=[680.0, 550.0, 440.0])  # fmt: skip
    (folder / "fit.toml").write_text(CONFIG, encoding="utf-8")

    def work(name: str, arguments: str, *outputs: str, kept: str | None = None) -> Work:
        place = {"here": str(folder), "out": str(folder / name)}
        return Work(name, tuple(part.format(**place) for part in arguments.split()), folder / name, outputs, kept)

    picture = "noon --width 48 --height 27 --spp 16 --out {out}/a.exr"
    fit = "fit --observations {here}/scan.npz --config {here}/fit.toml --out {out}/a.json"
    every = [
        work("sky", "sky --atmosphere earth --views {here}/views.npz --out {out}/a.npz", "a.npz"),
        work("render", f"render {picture}", "a.exr", "a.png"),
        work("reference", f"render {picture} --reference", "a.exr", "a.png", kept="a.partial.npz"),
        work("export", "export --atmosphere earth --layout power3d --size 8x16x16 --out {out}", "params.json"),
        work("fit", fit, "a.json", "a.png", kept="a.partial.json"),
        work("bench", "bench --quick --part stages --out {out}", "bench.json", "bench.md"),
    ]
    return [w for w in every if w.name in names]


def _starts(path: Path, start: bytes) -> None:
    if not path.read_bytes().startswith(start):
        raise ValueError(f"does not start with {start!r}")


def kill(
    count: int, seed: int = 0, names: tuple[str, ...] = ("sky", "render", "reference", "export", "fit", "bench"),
    advance: Callable[[float], None] | None = None,
) -> tuple[Counter, list[str]]:  # fmt: skip
    """How often a command ended with which status after what, and a line for every output that was broken."""
    found, wrong, rng = Counter(), [], Random(seed)
    with tempfile.TemporaryDirectory(prefix="atmo-jit-kills-") as name:
        every = works(Path(name), names)
        for work in every:
            work.lay_old()
            started = time.perf_counter()
            process = work.start()
            _, text = process.communicate()
            work.seconds = time.perf_counter() - started
            if process.returncode or work.broken():
                raise RuntimeError(f"{' '.join(work.arguments)}: status {process.returncode}: {text} {work.broken()}")
            work.outputs = tuple(sorted({*os.listdir(work.folder), *work.outputs}))
        for number in range(count):
            work, way = every[number % len(every)], WAYS[number // len(every) % len(WAYS)]
            work.lay_old()
            full = way == "full disk"
            process = work.start(rng.choice(FULL) if full else None)
            if not full:
                try:
                    process.wait(timeout=rng.uniform(0.0, 1.1) * work.seconds)
                except subprocess.TimeoutExpired:
                    process.send_signal(way)
            _, text = process.communicate()
            label = way if full else way.name
            found[work.name, label, f"status {process.returncode}"] += 1
            what = f"{work.name}, {label}, {seed}:{number}: "
            wrong += [what + line for line in work.broken()]
            old = any((work.folder / n).read_bytes() == OLD for n in work.outputs)
            # A path-traced picture is written on the way too.
            if full and (old if process.returncode == 0 else not old and work.name != "reference"):
                wrong.append(f"{what}status {process.returncode} says otherwise")
            if "Traceback" in text:
                wrong.append(f"{what}{text.strip().splitlines()[-1]}")
            if way != signal.SIGKILL and work.temporaries():
                wrong.append(f"{what}left {work.temporaries()}")
            if work.resumes():
                found[work.name, label, "kept"] += 1
                wrong += [what + line for line in _resumed(work)]
            if advance:
                advance((number + 1) / count)
        for work in every:
            work.start().communicate()
            if work.temporaries() or work.resumes():
                wrong.append(f"{work.name}: a next run left {sorted(os.listdir(work.folder))}")
    return found, wrong


def _resumed(work: Work) -> list[str]:
    """What is wrong after a command that went on from what was kept."""
    work.lay_old()
    process = work.start()
    _, text = process.communicate()
    old = [name for name in work.outputs if (work.folder / name).read_bytes() == OLD]
    if process.returncode or old or work.resumes():
        return [f"resumed with status {process.returncode}: {text.strip()}; old: {old}; {os.listdir(work.folder)}"]
    return work.broken()


main = command("bench.kills", __doc__, "kills", 50, lambda count, seed, advance: kill(count, seed, advance=advance))

if __name__ == "__main__":
    sys.exit(main())
