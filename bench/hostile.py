"""Damaged and malicious files, fed to every command that reads one.

    python -m bench.hostile --count 500

Good files are made, then one at a time truncated, bit-flipped, filled with other numbers, shapes and kinds, blown up
and pointed elsewhere. The commands run in this process, through the entry point of the command line: each must end
within TIMEOUT seconds with status 0 (the damage was harmless) or 2 and one line, and may have touched nothing but its
output. A Python object in a file that is unpickled would leave a mark, which is looked for.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from random import Random
from typing import Any

from .counted import command
from .damage import damaged
from .hostile_targets import Target, targets

TIMEOUT = 60  # seconds, on a loaded machine


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
                path.write_bytes(damaged(rng, target.name, target.content, str(mark)))
                before = _files(home)
                kept = out / target.output
                kept.write_bytes(b"old")
                status, text = _run(target, path, out / "old")
                found[target.name, f"status {status}"] += 1
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
    """Exit status, and all that was written to the terminal, by libraries too."""
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as said:
        former = os.dup(2)
        sys.stderr.flush()
        os.dup2(said.fileno(), 2)
        signal.alarm(TIMEOUT)
        try:
            with redirect_stderr(said), redirect_stdout(said):
                status = target.call(path, out)
        except BaseException:  # what the command line lets out is what is looked for
            said.write(traceback.format_exc())
            status = -1
        finally:
            signal.alarm(0)
            os.dup2(former, 2)
            os.close(former)
        said.seek(0)
        return status, said.read()


def _files(folder: Path) -> set[str]:
    return {os.path.join(root, name) for root, _, names in os.walk(folder) for name in names}


main = command("bench.hostile", __doc__, "files", 500, feed)

if __name__ == "__main__":
    sys.exit(main())
