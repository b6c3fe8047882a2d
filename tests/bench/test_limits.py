"""Loops counted in the code and by counters, and the machine's limits."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from atmo_jit.backend import floats, packet, types
from bench import limits
from bench.cost import memory_mib, timed


def triangle(rows):
    """Sum over i < n of i times a gathered packet, n = lane % rows, by a loop inside a loop."""
    t = types()
    lane = dr.arange(t.UInt, 1000)
    table = floats(np.ones(4 * rows))
    count = lane % dr.opaque(t.UInt, rows, 1)

    def inner(j, total):
        return j + 1, total + packet(table, j, 4)[1]

    def outer(i, total):
        _, part = dr.while_loop((t.UInt(0), dr.zeros(t.Float, 1000)), lambda j, _: j < i, inner, label="inner")
        return i + 1, total + part

    _, total = dr.while_loop((t.UInt(0), dr.zeros(t.Float, 1000)), lambda i, _: i < count, outer, label="outer")
    dr.eval(total)
    return total.numpy()


def test_loops_are_counted_exactly():
    expected = np.arange(1000) % 7
    with limits.counted_loops() as trips:
        total = triangle(7)
    assert trips == {"outer": expected.sum(), "inner": (expected * (expected - 1) // 2).sum()}
    assert np.array_equal(total, expected * (expected - 1) / 2)
    assert dr.while_loop.__module__.startswith("drjit")


def test_counters_leave_even_after_an_error():
    before = dr.while_loop
    with pytest.raises(ValueError), limits.counted_loops():
        raise ValueError
    assert dr.while_loop is before


def test_loops_in_the_code():
    with limits.kernel_history() as kernels:
        triangle(9)
    (found,) = [f for k in kernels if (f := limits.loops_of(k["ir"].getvalue()))]
    assert list(found) == ["outer", "inner"]
    (once, arithmetic, gathers), (_, inner_arithmetic, inner_gathers) = found["outer"], found["inner"]
    assert once == 1 and gathers == 0 and inner_gathers == 1
    assert 2 <= arithmetic < 60 and 2 <= inner_arithmetic < 60


def test_kernel_history_is_switched_back():
    before = dr.flag(dr.JitFlag.KernelHistory)
    with limits.kernel_history():
        assert dr.flag(dr.JitFlag.KernelHistory)
    assert dr.flag(dr.JitFlag.KernelHistory) == before


def test_stages():
    machine = limits.machine(1 << 12, 16)
    assert all(np.isfinite(value) and value > 0 for value in machine.values())
    (row,) = [r for r in limits.stages(lambda: triangle(50), machine) if r["stage"] == "outer > inner"]
    assert row["launches"] == 1 and row["wall_s"] > 0 and row["ratio"] > 0
    n = np.arange(1000) % 50
    assert row["passes"] == {"outer": n.sum(), "inner": (n * (n - 1) // 2).sum()}
    least = row["instructions_per_s"] / machine["instructions_per_s"] + row["gathers_per_s"] / machine["gathers_per_s"]
    assert row["ratio"] == pytest.approx(1.0 / least)


def test_memory_and_time():
    before = memory_mib()
    held = np.ones(2**23)
    assert memory_mib(peak=True) >= memory_mib() > before + 50
    del held
    calls = []
    cost = timed(lambda: calls.append(1), 3)
    assert len(calls) == 4 and cost["wall_s"] >= 0 and cost["cpu_s"] >= 0
