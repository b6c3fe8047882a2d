"""What Dr.Jit's LLVM back end is told about this processor: that it has gather instructions worth using.

With AVX2 and without AVX-512, LLVM takes gathers apart, lane by lane, on all processors but some of Intel's: eight
branches in the machine code for each, several times the time to compile, and nothing gained when it runs. The feature
``fast-gather`` makes it emit the instruction. Dr.Jit has no setting for that in Python; its library has a function,
which is called here. It changes all that Dr.Jit compiles in this process from then on, and results by nothing.

With AVX-512 gathers are always instructions. Where the processor's own gathers leak data and the microcode makes them
slow ("gather data sampling"), everything is left as it is.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

FEATURE = "+fast-gather"
# Names in Dr.Jit's library of: cpu(), features(), vector_width(), set_target(cpu, features, vector width).
_CPU, _FEATURES, _WIDTH = "_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv", "_Z21jit_llvm_vector_widthv"
_SET = "_Z19jit_llvm_set_targetPKcS0_j"
_LEAK = Path("/sys/devices/system/cpu/vulnerabilities/gather_data_sampling")


def use_gathers() -> bool:
    """Have gathers compiled to the processor's instruction where it has it and LLVM would not; whether that was done.

    Dr.Jit's LLVM back end must have been started. Where its library has no such function nothing is done.
    """
    import drjit as dr

    try:
        library = ctypes.CDLL(os.path.join(os.path.dirname(dr.__file__), "libdrjit-core.so"))
        cpu, features, width, set_target = (getattr(library, name) for name in (_CPU, _FEATURES, _WIDTH, _SET))
    except (OSError, AttributeError):
        return False
    for function in (cpu, features):
        function.restype = ctypes.c_char_p
    width.restype = ctypes.c_uint32
    set_target.argtypes, set_target.restype = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32), None
    wanted = with_gathers((features() or b"").decode("ascii", "replace"), _leak())
    if wanted is None:
        return False
    # Copies: the library frees its own before it takes the new.
    set_target(bytes(cpu()), wanted.encode("ascii"), width())
    return True


def with_gathers(features: str, leak: str | None) -> str | None:
    """LLVM's feature string with ``fast-gather``; None where it is to stay as it is. ``leak``: what Linux says of the
    processor's gathers, None where it says nothing."""
    known = features.split(",")
    gathers = "+avx2" in known and "+avx512f" not in known and not any("fast-gather" in f for f in known)
    fast = leak is None or leak.startswith(("Not affected", "Vulnerable"))
    return f"{features},{FEATURE}" if gathers and fast else None


def _leak() -> str | None:
    try:
        return _LEAK.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
