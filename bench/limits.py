"""What this machine can do at most, and how far each stage of a solve is from it.

Two bare loops give the limits: a march step (one square root, two exponentials, nothing read) and gathers of four
neighbouring floats at random places of a table of 256 KiB. A stage is a compiled kernel, named by the loops in it. Its
own work is counted, not estimated: how often each loop runs (by a counter in the loop), and how many arithmetic
instructions and gathers one pass through it has (in the compiler's intermediate code); what is outside loops counts
once for every lane. The ratio

    seconds / (instructions / rate of the march step + gathers / rate of gathers)

is how many times longer the stage takes than its own work would at the limits. Prefetching of neighbouring addresses
can bring it below 1.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from .cost import timed

LANES, STEPS = 1 << 17, 256
RUNS = 5
TABLE = 1 << 14  # packets of four floats: 256 KiB
_LOOP = re.compile(r"; Symbolic loop: (\S+)")
OUTSIDE = ""
_LABEL = re.compile(r"^l_(\d+)_(\w+):")
_GATHER = re.compile(r"call .*(@llvm\.masked\.gather|@gather_\d+x)")


@contextmanager
def kernel_history() -> Iterator[list[dict[str, Any]]]:
    """The kernels launched in the block: a list that is filled when it ends."""
    import drjit as dr

    found: list[dict[str, Any]] = []
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    try:
        yield found
        dr.sync_thread()
        found += [k for k in dr.kernel_history() if "ir" in k]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, before)


def _bare(read: bool, lanes: int, steps: int) -> Callable[[], Any]:
    """A bare loop: march steps, or gathers where ``read``."""
    import drjit as dr

    from atmo_jit.backend import floats, packet, types

    t = types()
    rng = np.random.default_rng(0)
    table = floats(rng.random(4 * TABLE))
    start = floats(rng.random(lanes))
    count = dr.opaque(t.UInt, steps, 1)
    scale = dr.opaque(t.Float, -0.7, 1)

    def step(i: Any, x: Any, total: Any) -> tuple[Any, ...]:
        # x grows as the root of the step's number: no exponential underflows, which would be slow.
        return i + 1, dr.sqrt(dr.fma(x, x, 0.1)), total + dr.exp(x * scale) + dr.exp(x * x * scale * 0.25)

    def gather(i: Any, x: Any, total: Any) -> tuple[Any, ...]:
        # The next address does not depend on what was read: this asks for rate, not for latency.
        values = packet(table, t.UInt(x) & (TABLE - 1), 4)
        return (
            i + 1,
            x * 1.37 - dr.floor(x * (1.37 / 2**16)) * 2**16,
            total + values[0] + values[1] + values[2] + values[3],
        )

    def run() -> None:
        x = start * 2**16 if read else start
        state = (t.UInt(0), x, dr.zeros(t.Float, lanes))
        body = gather if read else step
        _, _, total = dr.while_loop(state, lambda i, *_: i < count, body, max_iterations=-1, label="bare")
        dr.eval(total)
        dr.sync_thread()

    return run


def machine(lanes: int = LANES, steps: int = STEPS) -> dict[str, float]:
    """``march_steps_per_s``, ``gathers_per_s`` of four floats, ``instructions_per_s`` of the march step, by wall clock
    with all threads; ``ns_per_step_core``: CPU nanoseconds of a step. Each is the best of RUNS."""
    import drjit as dr

    run = _bare(False, lanes, steps)
    seconds = _best(run)
    with kernel_history() as kernels:
        run()
    ((_, instructions, _),) = loops_of(kernels[-1]["ir"].getvalue()).values()
    gathers = _best(_bare(True, lanes, steps))
    total = float(lanes * steps)
    return {
        "threads": dr.thread_count(),
        "march_steps_per_s": total / seconds["wall_s"],
        "instructions_per_s": total * instructions / seconds["wall_s"],
        "gathers_per_s": total / gathers["wall_s"],
        "ns_per_step_core": 1e9 * seconds["cpu_s"] / total,
    }


def _best(work: Callable[[], Any]) -> dict[str, float]:
    """The least wall and CPU seconds of RUNS calls: other programs only ever add to them."""
    runs = [timed(work, 1) for _ in range(RUNS)]
    return {key: min(run[key] for run in runs) for key in ("wall_s", "cpu_s")}


def loops_of(code: str) -> dict[str, tuple[int, int, int]]:
    """Of every loop in a kernel's intermediate code, by its label: (1, arithmetic instructions, gathers) of one pass,
    what is in loops inside it not counted."""
    found = _counted(code)
    del found[OUTSIDE]
    return found


def outside_loops(code: str) -> tuple[int, int]:
    """Arithmetic instructions and gathers of a kernel that every lane runs once."""
    return _counted(code)[OUTSIDE][1:]


def _counted(code: str) -> dict[str, tuple[int, int, int]]:
    found: dict[str, list[int]] = {OUTSIDE: [1, 0, 0]}
    open_loops: list[tuple[str, str]] = []  # number of the block, label of the loop
    number = ""
    for line in code.splitlines():
        text = line.strip()
        if label := _LABEL.match(text):
            number, place = label.groups()
            if place == "done" and open_loops and open_loops[-1][0] == number:
                open_loops.pop()
        elif loop := _LOOP.match(text):
            open_loops.append((number, loop[1]))
            found.setdefault(loop[1], [0, 0, 0])[0] += 1
        elif text.startswith(("define internal", "attributes", "}")):
            break  # the kernel ends; what it calls follows
        elif " = " in text:
            counts = found[open_loops[-1][1] if open_loops else OUTSIDE]
            if _GATHER.search(text):
                counts[2] += 1
            elif " phi " not in text and "getelementptr" not in text and "extractvalue" not in text:
                counts[1] += 1
    return {name: tuple(counts) for name, counts in found.items()}


@contextmanager
def counted_loops() -> Iterator[dict[str, int]]:
    """How often each labelled loop runs in the block, summed over lanes: filled when the block ends."""
    import drjit as dr

    from atmo_jit.backend import types

    result: dict[str, int] = {}
    counters: dict[str, Any] = {}
    original = dr.while_loop

    def counting(state: Any, cond: Any, body: Any, labels: Any = (), label: str | None = None, **options: Any) -> Any:
        t = types()
        if label not in counters:
            counters[label] = dr.zeros(t.UInt, 1)
        counter = counters[label]

        def counted(*values: Any) -> Any:
            dr.scatter_add(counter, t.UInt(1), t.UInt(0))
            return body(*values)

        return original(state, cond, counted, labels=labels, label=label, **options)

    dr.while_loop = counting
    try:
        yield result
    finally:
        dr.while_loop = original
    for label, counter in counters.items():
        dr.eval(counter)
        result[str(label)] = int(counter.numpy()[0])


def stages(work: Callable[[], Any], limits: dict[str, float]) -> list[dict[str, Any]]:
    """A row per kernel of ``work``, longest first, kernels of the same loops (or of none) together.

    ``work`` is called once to compile, RUNS times to be timed (the least counts) and once with counters.
    """
    from atmo_jit.multiple_scattering import traced

    with traced():
        return _stages(work, limits)


def _stages(work: Callable[[], Any], limits: dict[str, float]) -> list[dict[str, Any]]:
    work()
    seconds: dict[tuple[str, ...], float] = {}
    for _ in range(RUNS):
        with kernel_history() as kernels:
            work()
        spent_now: dict[tuple[str, ...], float] = defaultdict(float)
        launches: dict[tuple[str, ...], int] = defaultdict(int)
        once: dict[tuple[str, ...], np.ndarray] = defaultdict(lambda: np.zeros(2))
        per_pass: dict[str, tuple[float, float]] = {}
        for kernel in kernels:
            code = kernel["ir"].getvalue()
            loops = loops_of(code)
            spent_now[tuple(loops)] += 1e-3 * kernel["execution_time"]
            launches[tuple(loops)] += 1
            once[tuple(loops)] += kernel["size"] * np.array(outside_loops(code), dtype=float)
            for label, (times, instructions, gathers) in loops.items():
                per_pass[label] = (instructions / times, gathers / times)
        seconds = {labels: min(spent, seconds.get(labels, spent)) for labels, spent in spent_now.items()}
    with counted_loops() as trips:
        work()
    rows = []
    for labels, spent in seconds.items():
        row: dict[str, Any] = {
            "stage": " > ".join(labels) or "(no loop)",
            "launches": launches[labels],
            "wall_s": spent,
        }
        # A loop of one name that is in several kernels cannot be told apart by its counter.
        alone = [sum(label in other for other in seconds) == 1 for label in labels]
        if all(alone) and all(label in trips for label in labels):
            instructions, gathers = once[labels]
            instructions += sum(trips[label] * per_pass[label][0] for label in labels)
            gathers += sum(trips[label] * per_pass[label][1] for label in labels)
            least = instructions / limits["instructions_per_s"] + gathers / limits["gathers_per_s"]
            row |= {
                "passes": {label: trips[label] for label in labels},
                "instructions_per_s": instructions / spent,
                "gathers_per_s": gathers / spent,
                "ratio": spent / least,
            }
        rows.append(row)
    return sorted(rows, key=lambda row: -row["wall_s"])
