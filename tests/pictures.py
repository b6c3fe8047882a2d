"""Small path-traced pictures whose mean and variance are stored in ``tests/data``, for Z-tests of later versions.

Make the stored files again, after a change that is meant to change pictures::

    python tests/pictures.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from ztests import Estimate, assert_agree, of_passes

FOLDER = Path(__file__).parent / "data"
SIZE = 12
STORED_PASSES, PASSES, SPP = 256, 16, 64

HAZE = {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.85}
LAYER = {
    "mie": [
        {
            "scattering_per_m": 2e-5,
            "single_scattering_albedo": [0.8, 0.9, 0.95],
            "profile": {"altitude_m": [0, 1500, 1500, 4000], "density": [0.2, 0.2, 1, 0]},
            "phase": {"type": "tabulated", "cos_theta": [-1, 0.5, 0.9, 1], "values": [1, 2, 9, 30]},
        },
        {
            "scattering_per_m": 1e-5,
            "single_scattering_albedo": 1,
            "scale_height_m": 900,
            "phase": {"type": "legendre", "moments": [1, 0.6, 0.3, 0.1]},
        },
    ]
}
# Name: changes to the preset "earth", altitude of the camera (m), direction of its axis, zenith angle of the sun.
PICTURES: dict[str, tuple[dict[str, Any], float, tuple[float, float, float], float]] = {
    "earth_ground_sun30": ({}, 2.0, (0.0, 0.0, 1.0), 30.0),
    "earth_ground_sun85": ({}, 2.0, (0.0, 0.0, 1.0), 85.0),
    "haze_space_sun60": (HAZE, 400e3, (0.0, 0.3, -1.0), 60.0),
    "layer_10km_sun75": (LAYER, 10e3, (0.0, 1.0, -0.1), 75.0),
}


def scene(name: str, integrator: str = "volpath", sun: bool = True, **options: Any) -> Any:
    """The Mitsuba scene of a picture, in the variant that is set; ``options`` of the integrator."""
    import mitsuba as mi

    from atmo_jit import Atmosphere
    from atmo_jit.plugins.planet import planet

    changes, altitude, axis, zenith = PICTURES[name]
    angle = np.radians(zenith)
    parts = planet(Atmosphere.load("earth").replace(changes), sun_direction=[np.sin(angle), 0.0, np.cos(angle)])
    origin = np.array([0.0, 0.0, altitude])
    sensor = {
        "type": "fisheye",
        "fov": 170,
        "medium": parts.pop("air"),
        "to_world": mi.ScalarTransform4f().look_at(origin, origin + np.array(axis), [1.0, 0.1, 0.0]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
        "shutter_open": 0.0,
        "shutter_close": 1.0,
    }
    if integrator != "atmosphere_volpath":
        options = {"rr_depth": 64, **options}
    if not sun:
        del parts["sun"]
    tracer = {"type": integrator, "max_depth": -1, **options}
    return mi.load_dict({"type": "scene", "integrator": tracer, "sensor": sensor, **parts})


def render(scene: Any, passes: int, seed: int) -> np.ndarray:
    """The picture in passes of SPP samples: [passes, rows, columns, 3]."""
    import mitsuba as mi

    return np.stack([np.array(mi.render(scene, spp=SPP, seed=seed + i), dtype=np.float64) for i in range(passes)])


def assert_as_stored(name: str, integrator: str = "volpath", passes: int = PASSES) -> None:
    """Render a picture and compare it with the stored one, which knows the variance of a pass better than a few
    passes do.
    """
    known = stored(name)
    mean = render(scene(name, integrator), passes, seed=0).mean(axis=0)
    assert_agree(known.with_mean(mean, passes / STORED_PASSES), known)


def stored(name: str) -> Estimate:
    """The mean and variance that are stored."""
    return Estimate.load(FOLDER / f"{name}.npz")


def main() -> None:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register

    register()
    FOLDER.mkdir(exist_ok=True)
    for name in PICTURES:
        of_passes(render(scene(name), STORED_PASSES, seed=10_000)).save(FOLDER / f"{name}.npz")
        print(FOLDER / f"{name}.npz")


if __name__ == "__main__":
    import atmo_jit  # noqa: F401 - first of all: it chooses the LLVM library before anything imports Dr.Jit

    main()
