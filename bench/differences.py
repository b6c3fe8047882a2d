"""Derivatives of the sky, ``fine`` ones, against differences of solves on more nodes, on random atmospheres:
``python -m bench.differences [--count N] [--seed S]``.

By every parameter but the radii (whose derivatives are differences themselves), of the radiance at three wavelengths,
under suns above and below the horizon: fourth-order differences of four solves each, all on the same nodes, with twice
the altitudes, three times the suns and sharper moments than the linearization has. Printed per parameter: how many
derivatives are compared (those that, as the change of the logarithm of the radiance by that of the parameter, are
above WORTH), the relative difference of the median, of 95 and of 100 per cent of them, and the share within 1e-3; then
the same for views within a degree of the horizon, where 1e-2 is asked.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

VIEWS, NEAR = 20, 4  # directions, and those within a degree of the horizon
WORTH = 0.02
STEPS = {"altitude_m": 20.0, "sun_zenith_deg": 0.1, "view_zenith_deg": 0.1, "azimuth_deg": 1.0, "mie.phase.g": 0.004}
STEP = 0.01  # relative, of all others
STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -8.0 / 12.0), (1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))
LIMITS = ("beyond a degree of the horizon", 1e-3), ("within a degree of it", 1e-2)


def drawn(rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """An atmosphere and views of it."""
    gas, haze = rng.uniform(0.3, 2.0), 10.0 ** rng.uniform(-6.0, -4.0)
    radius = float(rng.choice([1.7e6, 6.36e6]))
    air = {
        "wavelengths_nm": [680.0, 550.0, 440.0],
        "bottom_radius_m": radius,
        "top_radius_m": radius + 1e5,
        "rayleigh": {
            "scattering_per_m": [gas * b for b in (5.8e-6, 13.5e-6, 33.1e-6)],
            "scale_height_m": rng.uniform(6e3, 1.1e4),
        },
        "mie": {
            "scattering_per_m": [haze * f for f in (0.8, 1.0, 1.3)],
            "single_scattering_albedo": rng.uniform(0.8, 0.99),
            "scale_height_m": rng.uniform(800.0, 3000.0),
            "phase": {"type": str(rng.choice(["henyey_greenstein", "cornette_shanks"])), "g": rng.uniform(0.0, 0.85)},
        },
        "ozone": {
            "absorption_per_m": [6e-7, 1.9e-6, 8e-8],
            "center_m": rng.uniform(2e4, 3e4),
            "half_width_m": rng.uniform(8e3, 1.5e4),
        },
        "ground_albedo": rng.uniform(0.02, 0.95),
    }
    zenith = np.concatenate([rng.uniform(2.0, 88.5, VIEWS - NEAR), rng.uniform(89.0, 89.9, NEAR)])
    views = {
        "altitude_m": np.full(VIEWS, 200.0),
        "sun_zenith_deg": np.full(VIEWS, rng.choice([rng.uniform(10.0, 80.0), rng.uniform(80.0, 94.0)])),
        "view_zenith_deg": zenith,
        "azimuth_deg": rng.uniform(10.0, 170.0, VIEWS),
    }
    return air, views


def compared(seed: int) -> dict[str, np.ndarray]:
    """By parameter: ours, differences, both per relative change of the radiance, and whether a view is near the
    horizon, [3, N]."""
    import drjit as dr

    from atmo_jit import Atmosphere, Linearization, Sky
    from atmo_jit.derivatives import PROFILE
    from atmo_jit.parameters import RADII, described, parameter_names
    from atmo_jit.resolution import Resolution

    description, views = drawn(np.random.default_rng(seed))
    air = Atmosphere.load(description)
    at = Linearization(air, views, fine=True)
    r = Resolution.suited(air, 0.002, fine=True)
    r = replace(r, altitudes=2 * at.sky.resolution.altitudes, suns=3 * at.sky.resolution.suns)

    def light(there: Atmosphere, where: dict[str, np.ndarray], layout: Atmosphere | None = air) -> np.ndarray:
        sky = Sky(there, tolerance=0.002, resolution=r, layout=layout, sure=True)
        angles = [np.radians(where[n]) for n in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")]
        found = sky.rays(where["altitude_m"], *angles).radiance
        dr.eval(found)
        return np.stack([v.numpy() for v in found], axis=-1).astype(float)

    names = [name for name in parameter_names(air, views) if name not in RADII and name != "sun_angular_radius_deg"]
    ours, here = at.jacobian(names), light(air, views)
    found = {}
    for name in names:
        if name in views:
            step, unit = STEPS[name], np.full((VIEWS, 1), np.degrees(1.0) if name.endswith("deg") else 8000.0)
            ends = [(w, light(air, views | {name: views[name] + s * step})) for s, w in STENCIL]
        else:
            value = described(air, name)
            step = STEPS.get(name, STEP) if name in STEPS else STEP * value
            unit = np.ones((1, 1)) if name == "mie.phase.g" else np.broadcast_to(value, (1, 3))
            # Nodes are those of the profiles.
            layout = None if name.rpartition(".")[2] in PROFILE else air
            moved = [(w, air.replace({name: np.asarray(value + s * step).tolist()})) for s, w in STENCIL]
            ends = [(w, light(there, views, layout)) for w, there in moved]
        slope = sum(w * end for w, end in ends) / step
        near = np.broadcast_to(views["view_zenith_deg"][:, None] >= 89.0, here.shape)
        found[name] = np.stack([v.ravel() for v in (ours[name] * unit / here, slope * unit / here, near)])
    return found


def table(found: dict[str, np.ndarray]) -> str:
    """Both parts as Markdown."""
    lines = []
    for near, (where, limit) in enumerate(LIMITS):
        lines += [f"| {where} | compared | median | 95 % | all | within {limit:g} |", "|---|---|---|---|---|---|"]
        for name, (ours, truth, at) in found.items():
            counts = (np.abs(truth) > WORTH) & (at == near)
            if np.any(counts):
                errors = np.abs(ours - truth)[counts] / np.abs(truth[counts])
                cells = [f"{q:.1e}" for q in np.quantile(errors, [0.5, 0.95, 1.0])]
                share = f"{np.mean(errors <= limit):.1%}"
                lines.append(f"| {name} | {np.sum(counts)} | " + " | ".join([*cells, share]) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    parts = [compared(seed) for seed in range(given.seed, given.seed + given.count)]
    print(table({name: np.concatenate([part[name] for part in parts], axis=1) for name in parts[0]}))


if __name__ == "__main__":
    main()
