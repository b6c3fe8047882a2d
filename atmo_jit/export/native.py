"""What this package itself solves for: moments, irradiances and sun columns at the nodes of its grid.

>>> from atmo_jit.export import export, read
>>> export("earth", "native", "solved")
>>> sky = read("solved")  # an atmo_jit.Sky, to the last bit the one that was solved
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..atmosphere import Atmosphere
from ..backend import floats
from ..errors import InputError
from ..files import read_npz
from ..resolution import Resolution, Stage
from ..solved import Sky
from .containers import npz
from .exporter import Clock, Made, Options, refuse

FILE = "solution.npz"


def make(layout: str, air: Atmosphere, options: Options, clock: Clock, progress: Callable[[float], None]) -> Made:
    """The files of a solved sky."""
    refuse(layout, options, ("mu_s_min", "size", "precision", "colour", "altitude_m", "sun_zenith_deg", "texels"))
    sky = Sky(air, options.orders, options.tolerance)
    clock.stage("solve")
    return files(sky)


def files(sky: Sky) -> Made:
    """The files of any solved sky."""
    arrays = {
        f"{i}.{name}": np.asarray(value) if value is not None else np.zeros(0, dtype=np.float32)
        for i, held in enumerate(sky.held)
        for name, value in held.items()
    }
    parameters = {
        "resolution": asdict(sky.resolution),
        "orders": sky.orders,
        "tolerance": sky.tolerance,
        "suns": list(sky.suns) if sky.suns else None,
    }
    metadata = {
        "mapping": "the package's own: altitudes and suns of atmo_jit.grid.Grid, harmonics of atmo_jit.harmonics; "
        "bands of up to four wavelengths are numbered",
        "units": "moments and irradiances over the reference (the zeroth moment of order 1), per solar irradiance",
        "wavelengthsNm": sky.atmosphere.wavelengths_nm.tolist(),
        "holds": {
            "moments": "[altitude][sun][l, m][channel], over the reference",
            "sky": "[altitude][sun][channel]: irradiance over reference and scattering depth above",
            "reflected": "the same, of light whose reflection still counts",
            "reference": "log [altitude][sun][channel]; inverse; fine [altitude][finer sun][4]",
            "columns": "mean densities toward the sun, atmo_jit.column.SunColumns",
        },
    }
    return Made([npz(FILE, arrays)], parameters, metadata, {}, [])


def read(folder: Path, parameters: dict[str, Any]) -> Sky:
    """The solved sky of a folder. Raises InputError when its arrays do not fit together."""
    d = parameters["resolution"]
    stages = tuple(Stage(**stage) for stage in d["stages"])
    resolution = Resolution(**(d | {"stages": stages, "columns": tuple(d["columns"])}))
    arrays = read_npz(folder / FILE, kinds="f")
    held: dict[int, dict[str, Any]] = {}
    for name, values in arrays.items():
        if values.dtype != np.float32:
            raise InputError(f"{str(folder / FILE)!r}: {name} holds {values.dtype}; must be float32")
        band, _, key = name.partition(".")
        held.setdefault(int(band), {})[key] = floats(values) if values.size else None
    suns = tuple(parameters["suns"]) if parameters["suns"] else None
    try:
        return Sky(
            parameters["metadata"]["atmosphere"],
            orders=parameters["orders"],
            tolerance=parameters["tolerance"],
            resolution=resolution,
            suns=suns,
            held=[held[i] for i in sorted(held)],
        )
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(f"{str(folder / FILE)!r}: does not fit its params.json ({error})") from None
