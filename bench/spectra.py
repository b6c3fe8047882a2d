"""The tables behind atmo_jit/spectrum.py: ``python -m bench.spectra`` takes them from colour-science."""

from __future__ import annotations

import sys
import warnings
from typing import Any

import numpy as np

from atmo_jit.files import atomic_outputs
from atmo_jit.spectrum import DATA


def main() -> None:
    """Write the file."""
    with atomic_outputs(DATA) as (part,), open(part, "wb") as file:
        np.savez_compressed(file, **tables())


def tables() -> dict[str, np.ndarray]:
    """CIE 1931 2 degree colour matching functions (nm [471], xyz [471, 3]), the matrix from XYZ to linear sRGB (IEC
    61966-2-1), and ASTM G173-03 extraterrestrial irradiance (nm and W m^-2 nm^-1 [N, 2])."""
    colour = colour_science()
    functions = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    from colour.plotting.datasets.astm_g_173 import DATA_ASTMG173_ETR

    return {
        "cie_1931_nm": np.array(functions.wavelengths, dtype=np.float64),
        "cie_1931": np.array(functions.values, dtype=np.float64),
        "xyz_to_srgb": np.array(colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB, dtype=np.float64),
        "astm_g173": np.array(sorted(DATA_ASTMG173_ETR.items()), dtype=np.float64),
    }


def colour_science() -> Any:
    """The package colour-science.

    Where matplotlib is not installed it says so in a warning and puts mocks of it into ``sys.modules``, which would
    make others believe that matplotlib is there: no plot is drawn here, so both are undone.
    """
    present = set(sys.modules)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    for name in set(sys.modules) - present:
        if type(sys.modules[name]).__name__ == "MagicMock":
            del sys.modules[name]
    return colour


if __name__ == "__main__":
    main()
