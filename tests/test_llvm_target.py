"""The processor features that kernels are compiled for."""

from __future__ import annotations

import subprocess
import sys

import pytest

from atmo_jit.llvm_target import with_gathers

AVX2 = "+sse4.2,+avx,+avx2,-avx512f,+fma"


@pytest.mark.parametrize("leak", [None, "Not affected", "Vulnerable: No microcode"])
def test_gathers_are_asked_for_where_llvm_would_not_use_them(leak):
    assert with_gathers(AVX2, leak) == f"{AVX2},+fast-gather"


@pytest.mark.parametrize(
    ("features", "leak"),
    [
        ("+sse4.2,+avx,-avx2", None),
        (AVX2.replace("-avx512f", "+avx512f"), None),
        (f"{AVX2},+fast-gather", None),
        (f"{AVX2},-fast-gather", None),  # someone has decided that
        ("+neon", None),
        ("", None),
        (AVX2, "Mitigation: Microcode"),
        (AVX2, "Unknown: Dependent on hypervisor status"),
    ],
)
def test_others_are_left_alone(features, leak):
    assert with_gathers(features, leak) is None


PROGRAM = """
import ctypes, os, sys
import atmo_jit
import drjit as dr
import numpy as np
from atmo_jit import llvm_target
from atmo_jit.backend import floats, types
t = types()
library = ctypes.CDLL(os.path.join(os.path.dirname(dr.__file__), "libdrjit-core.so"))
features = getattr(library, llvm_target._FEATURES)
features.restype = ctypes.c_char_p
known = features().decode()
# As a processor without AVX-512 has it.
plain = [f for f in known.split(",") if f != llvm_target.FEATURE]
plain = ["-" + f[1:] if "avx512" in f or "avx10" in f else f for f in plain]
setter = getattr(library, llvm_target._SET)
setter.argtypes, setter.restype = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32), None
setter(b"znver3", ",".join(plain).encode(), 8)
found = []
for again in (False, True):
    if again:
        llvm_target._leak = lambda: "Not affected"
        assert llvm_target.use_gathers() and not llvm_target.use_gathers()
        assert features().decode().endswith(",+fast-gather"), features()
    values = floats(np.random.default_rng(0).random(1000))
    index = dr.arange(t.UInt, 300)
    light = [dr.gather(t.Float, values, index * 3), dr.gather(t.Float, values, 999 - index, index < 200)]
    dr.eval(light)
    found.append([np.array(v) for v in light])
np.testing.assert_array_equal(found[0], found[1])
print("same")
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Dr.Jit's library has this name on Linux alone")
def test_values_are_the_same():
    """On a processor that is told to have AVX2 alone, in a process of its own: the target is everyone's in one."""
    with open("/proc/cpuinfo", encoding="utf-8") as told:
        if " avx2 " not in told.read():
            pytest.skip("this processor has no AVX2")
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.strip() == "same", done.stderr[-1000:]
