"""What the package costs and how far it is from the truth: ``python -m bench.accuracy``, ``python -m bench.speed``."""

import atmo_jit  # noqa: F401 - first of all: it chooses the LLVM library before anything imports Dr.Jit
