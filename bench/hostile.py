"""Damaged and malicious files, fed to every command that reads one.

    python -m bench.hostile --files 500

Good files are made, then one at a time truncated, bit-flipped, filled with other numbers, shapes and kinds, blown up
and pointed elsewhere. The commands run in this process, through the entry point of the command line: each must end
within TIMEOUT seconds with status 0 (the damage was harmless) or 2 and one line, and may have touched nothing but its
output. A Python object in a file that is unpickled would leave a mark, which is looked for.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import signal
import sys
import tempfile
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from atmo_jit import presets
from atmo_jit.cli import main as run_command
from atmo_jit.errors import InputError
from atmo_jit.export import Options, export
from atmo_jit.progress import progress_bar

TIMEOUT = 60  # seconds, on a loaded machine
HUGE = (10**400, 1e308, -1, 0, float("nan"), float("inf"), True, None, "x", [], {}, [[1]], "../../../../etc/passwd")
NAMES = ("../escape", "/etc/passwd", "a\0b", "$(touch pwned)", "x" * 5000)

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


@dataclass(frozen=True)
class Target:
    """One kind of file: its ``name``, what a good one holds, and ``call(path, out)``, which reads it and returns an
    exit status."""

    name: str
    content: bytes
    call: Callable[[Path, Path], int]


class Pickled:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark: str) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (self.mark, "w")


class _Enough(Exception):
    """Raised out of a fit that has begun."""


def targets(folder: Path) -> list[Target]:
    """The kinds of files, with what else the commands need in ``folder``."""
    few = 6
    views = {"altitude_m": np.zeros(few), "sun_zenith_deg": np.full(few, 40.0), "azimuth_deg": np.full(few, 90.0)}
    views["view_zenith_deg"] = np.linspace(0.0, 80.0, few)
    scan = {**views, "radiance": np.full((few, 3), 0.05), "relative_sigma": np.array(0.05)}
    scan["wavelengths_nm"] = np.array([680.0, 550.0, 440.0])
    export("earth", "native", folder / "exported", Options())
    (folder / "fit.toml").write_text(CONFIG, encoding="utf-8")
    (folder / "views.npz").write_bytes(_npz(views))
    (folder / "scan.npz").write_bytes(_npz(scan))
    text = "altitude_m,sun_zenith_deg,view_zenith_deg,azimuth_deg,wavelengths_nm,radiance,relative_sigma\n"
    text += "".join(f"0,40,{10 * i},90,{w},0.05,0.05\n" for i in range(few) for w in (680, 550, 440))

    def command(*arguments: Any) -> int:
        return run_command([*map(str, arguments), "--quiet"])

    def loaded(observations: Path, config: Path) -> int:
        """What atmo-jit fit does up to its first steps."""
        from atmo_jit.fits import FitConfig, fit, load_observations

        def enough(_: float) -> None:
            raise _Enough

        return _status(lambda: fit(load_observations(observations), FitConfig.load(config), enough))

    def plan(path: Path, out: Path) -> int:
        return run_command(["plan", str(path), "--json"])

    def read(path: Path, out: Path) -> int:
        from atmo_jit.export import read as read_tables

        exported = folder / "exported"
        (exported / "params.json").write_bytes(path.read_bytes())
        return _status(lambda: read_tables(exported))

    parameters = (folder / "exported" / "params.json").read_bytes()
    atmosphere = json.dumps(presets.read("earth")).encode()
    return [
        Target("air.json", atmosphere, lambda p, o: command(
            "sky", "--atmosphere", p, "--views", folder / "views.npz", "--out", o.with_suffix(".npz"))),
        Target("views.npz", _npz(views), lambda p, o: command(
            "sky", "--atmosphere", "earth", "--views", p, "--out", o.with_suffix(".npz"))),
        Target("scan.npz", _npz(scan), lambda p, o: loaded(p, folder / "fit.toml")),
        Target("scan.csv", text.encode(), lambda p, o: loaded(p, folder / "fit.toml")),
        Target("fit.toml", CONFIG.encode(), lambda p, o: loaded(folder / "scan.npz", p)),
        Target("scene.json", json.dumps(SCENE).encode(), plan),
        Target("params.json", parameters, read),
    ]  # fmt: skip


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


def damaged(rng: Random, target: Target, mark: Path) -> bytes:
    """A bad file in place of a good one."""
    good = target.content
    kind = rng.randrange(5)
    if kind == 0:
        return good[: rng.randrange(len(good))]
    if kind == 1:
        raw = bytearray(good)
        for _ in range(rng.choice((1, 3, 20))):
            raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)
        return bytes(raw)
    if kind == 2:
        return rng.choice((b"", b"\0" * 1000, b"\xff" * 100, good * 2, b"[" * 100_000, b"\xef\xbb\xbf" + good))
    if target.name.endswith(".npz"):
        return _hostile_npz(rng, good, mark)
    if target.name.endswith(".json"):
        return _hostile_json(rng, json.loads(good)).encode()
    number = rng.choice(("1e999", "-1", "nan", "0x10", "[[", '"' * 7, "9" * 5000, "'''", "\0", "=1+1"))
    return good.replace(rng.choice((b"0.6", b"40", b"0.05", b"earth", b"90")), number.encode(), 1)


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _hostile_npz(rng: Random, good: bytes, mark: Path) -> bytes:
    with np.load(io.BytesIO(good)) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice(sorted(arrays))
    kind = rng.randrange(6)
    if kind == 0:
        arrays[name] = np.array([Pickled(str(mark))], dtype=object)
    elif kind == 1:
        arrays[name] = rng.choice([arrays[name][..., None], np.zeros((0,)), np.zeros(7), np.zeros((2, 3, 4))])
    elif kind == 2:
        arrays[name] = rng.choice([np.array(["a"]), np.array([1j]), np.full(6, np.nan), np.full(6, 1e300), np.ones(6)])
    elif kind == 3:
        arrays["extra"] = np.zeros(3)
    elif kind == 4:
        del arrays[name]
    else:  # a bomb: 16 GiB of zeros that pack into little, announced by a header
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                header, {"descr": "<f8", "fortran_order": False, "shape": (rng.choice((1 << 31, 10**14)),)}
            )
            archive.writestr(f"{name}.npy", header.getvalue() + b"\0" * (1 << 22))
        return stream.getvalue()
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _hostile_json(rng: Random, tree: Any) -> str:
    """JSON with one value, key or shape changed, somewhere."""
    node, parents = tree, []
    while isinstance(node, (dict, list)) and node and (not parents or rng.random() < 0.8):
        key = rng.choice(sorted(node)) if isinstance(node, dict) else rng.randrange(len(node))
        parents.append((node, key))
        node = node[key]
    holder, key = rng.choice(parents)
    change = rng.randrange(4)
    if change == 0 and isinstance(holder, dict):
        del holder[key]
    elif change == 1 and isinstance(holder, dict):
        holder[rng.choice(("__class__", "", "type", "metadata", "path"))] = rng.choice((*HUGE, *NAMES))
    elif change == 2:
        holder[key] = [holder[key]] * rng.choice((2, 10_000))
    else:
        holder[key] = rng.choice((*HUGE, *NAMES))
    return json.dumps(tree)


def feed(files: int, seed: int = 0, advance: Callable[[float], None] | None = None) -> tuple[Counter, list[str]]:
    """Exit statuses by kind of file, and a line for everything that was not as it must be."""
    found, wrong = Counter(), []

    def late(*_: Any) -> None:
        raise TimeoutError(f"still at it after {TIMEOUT} s")

    former = signal.signal(signal.SIGALRM, late)
    try:
        with tempfile.TemporaryDirectory(prefix="atmo-jit-hostile-") as name:
            folder = Path(name)
            home, out = folder / "in", folder / "out"
            home.mkdir(), out.mkdir()
            known = targets(home)
            for target in known:
                (home / f"good-{target.name}").write_bytes(target.content)
                status, text = _run(target, home / f"good-{target.name}", out / "old")
                if status:
                    wrong.append(f"{target.name}, undamaged: status {status}: {text}")
            for number in range(files):
                rng, target = Random(seed * 1_000_003 + number), known[number % len(known)]
                path, mark = home / f"bad-{target.name}", folder / "mark"
                path.write_bytes(damaged(rng, target, mark))
                before = _files(home)
                kept = out / ("old.json" if "json" in target.name or "fit" in target.name else "old.npz")
                kept.write_bytes(b"old")
                status, text = _run(target, path, out / "old")
                found[target.name, status] += 1
                what = f"{target.name} {seed}:{number}: "
                if status not in (0, 2):
                    wrong.append(f"{what}status {status}: {text.strip().splitlines()[-1] if text else ''}")
                elif status == 2 and (text.count("\n") != 1 or "Traceback" in text):
                    wrong.append(f"{what}{text.count(chr(10))} lines: {text[:200]!r}")
                if status == 2 and kept.read_bytes() != b"old":
                    wrong.append(f"{what}the old output is gone")
                left = {p.name.partition(".")[0] for p in out.iterdir()}
                if mark.exists() or _files(home) != before or left != {"old"}:
                    wrong.append(f"{what}something else was touched: {sorted(p.name for p in out.iterdir())}")
                if advance:
                    advance((number + 1) / files)
    finally:
        signal.signal(signal.SIGALRM, former)
    return found, wrong


def _run(target: Target, path: Path, out: Path) -> tuple[int, str]:
    errors = io.StringIO()
    signal.alarm(TIMEOUT)
    try:
        with redirect_stderr(errors), redirect_stdout(io.StringIO()):
            status = target.call(path, out)
    except BaseException:  # what the command line lets out is what is looked for
        errors.write(traceback.format_exc())
        status = -1
    finally:
        signal.alarm(0)
    return status, errors.getvalue()


def _files(folder: Path) -> set[str]:
    return {os.path.join(root, name) for root, _, names in os.walk(folder) for name in names}


def main() -> int:
    """Feed them and print what came of it."""
    parser = argparse.ArgumentParser(prog="python -m bench.hostile", description=__doc__.partition("\n")[0])
    parser.add_argument("--files", type=int, default=500, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    options = parser.parse_args()
    with progress_bar("hostile files") as advance:
        found, wrong = feed(options.files, options.seed, advance)
    for (name, status), count in sorted(found.items()):
        print(f"{name}: status {status}: {count}")
    print("\n".join(wrong))
    print(f"{options.files} files, {len(wrong)} wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
