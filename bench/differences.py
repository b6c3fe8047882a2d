"""Derivatives of the sky, ``fine`` ones, against differences of solves on more nodes, on random atmospheres:
``python -m bench.differences [--count N] [--seed S] [--names NAME,...]``.

By every parameter but the radii (whose derivatives are differences themselves), of the radiance at three wavelengths,
200 m above two planets, under suns above and below the horizon. The reference: fourth-order differences of four solves
each in double precision, all on the same nodes and cut at the same altitudes (those of the atmosphere in the middle,
and corners of their own), with more altitudes, suns, degrees and azimuthal orders than the linearization has, and the
field asked for in pieces of rays a quarter as long. In single precision, or where the places at which columns and rays
are cut move with a scale height, differences are off by up to a fifth of a small derivative. It is made twice, at two
such resolutions, and what the two differ by is printed beside what the derivatives are off.

An error is relative to the derivative, or to SMALL of the largest derivative by that parameter among the views of that
atmosphere and wavelength where it is less than that: a derivative that passes through 0 between two views has no digits
there. Printed per parameter: the error of the median, of 95 and of 100 per cent, the share within 1e-3 (1e-2 for views
within a degree of the horizon), the same of derivatives that count, and what 95 per cent of the reference change by
between its resolutions. A derivative counts where one per cent of the parameter (0.01 degrees, a metre) changes the
light by COUNTS of it, about the rounding of single precision.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

VIEWS, NEAR = 20, 4  # directions, and those within a degree of the horizon
SMALL = 0.05
STEPS = {"altitude_m": 20.0, "sun_zenith_deg": 0.2, "view_zenith_deg": 0.02, "azimuth_deg": 0.2, "mie.phase.g": 0.004}
NARROW = {"single_scattering_albedo": 0.004}  # which ends at 1
# Look-ups are linear between levels and suns: steps that are wider than these lie apart.
REFINE, SUN_REFINE = {"altitude_m": 16, "sun_zenith_deg": 4}, {"altitude_m": 4, "sun_zenith_deg": 16}
STEP = 0.01  # relative, of all others
TOLERANCE = 3e-4  # of the reference's orders: where the four solves stop after different ones, differences are off
STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -8.0 / 12.0), (1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))
UNITS = {"altitude_m": 100.0}  # of views, others 1: what a hundredth is of
COUNTS = 1e-5
LIMITS = ("beyond a degree of the horizon", 1e-3), ("within a degree of it", 1e-2)
NEAR_GROUND = 4.0
COARSER, FINER = (1.3, 1.2, 1, 1), (1.7, 1.5, 1, 2)  # altitudes, suns, steps of the degree, azimuthal orders


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


def finer(resolution: Any, altitudes: float, suns: float, degrees: int, orders: int, name: str = "") -> Any:
    """A resolution with so many times as many altitudes and suns, and so many more degrees and azimuthal orders,
    for differences by a ``name``."""
    from atmo_jit.resolution import FIRST_DEGREES

    place = min(FIRST_DEGREES.index(resolution.first_degree) + degrees, len(FIRST_DEGREES) - 1)
    degree = FIRST_DEGREES[place]
    stages = tuple(
        replace(
            stage,
            degree=degree,
            most=stage.most + orders,
            azimuths=stage.azimuths + orders,
            up=degree,
            down=degree - 2,
        )
        for stage in resolution.stages
    )
    return replace(
        resolution,
        altitudes=int(altitudes * resolution.altitudes),
        suns=int(suns * resolution.suns),
        refine=REFINE.get(name, 6),
        sun_refine=SUN_REFINE.get(name, 8),
        near_ground=NEAR_GROUND,
        stages=stages,
        nodes=4,
        first_up=degree + 4,
        first_down=degree + 2,
        first_azimuths=degree + 8,
        first_degree=degree,
        phase_degree=max(16, degree + 8),
        beam_nodes=4,
        columns=(768, 384),
    )


@contextmanager
def shorter_pieces() -> Iterator[None]:
    """Rays are cut at twice as many levels."""
    from atmo_jit import levels

    before = levels.LEVELS
    ends = np.concatenate([[0.0], before])
    levels.LEVELS = tuple(np.sort(np.concatenate([before, 0.5 * (ends[1:] + ends[:-1])])).tolist())
    try:
        yield
    finally:
        levels.LEVELS = before


@contextmanager
def cut_alike(air: Any) -> Iterator[None]:
    """Rays, and tables of columns, of any atmosphere are cut at the altitudes at which those of ``air`` are, and at
    corners of its own."""
    from atmo_jit import column, levels

    before = levels.breaks, column.thinnest
    thin, here = levels.thinnest(air), levels.breaks(air)
    smooth = set(here.tolist()) - {k for c in air.constituents for k in c.profile.kinks_m}

    def breaks(atmosphere: Any) -> np.ndarray:
        corners = {k for c in atmosphere.constituents for k in c.profile.kinks_m}
        return np.array(sorted({0.0, *smooth, *np.clip(list(corners), 0.0, atmosphere.thickness_m).tolist()}))

    levels.breaks, column.thinnest = breaks, lambda _: thin
    try:
        yield
    finally:
        levels.breaks, column.thinnest = before


def differences(
    air: Any, views: dict[str, np.ndarray], names: Sequence[str], resolution: Any, by: tuple[float, float, int, int]
) -> dict[str, np.ndarray]:
    """Derivatives of the radiance [N, W] by name, at a resolution ``by`` so much finer."""
    import drjit as dr

    from atmo_jit import Atmosphere, Sky
    from atmo_jit.backend import double_precision, doubles
    from atmo_jit.parameters import described
    from atmo_jit.pieces import Pieces

    sun = np.radians(views["sun_zenith_deg"])
    suns = float(sun.min() - 0.01), float(sun.max() + 0.01)

    def light(there: Atmosphere, where: dict[str, np.ndarray]) -> np.ndarray:
        how = {"tolerance": TOLERANCE, "resolution": finer(resolution, *by, name), "suns": suns}
        sky = Sky(there, layout=air, sure=True, fine=True, **how)
        angles = [doubles(np.radians(where[n])) for n in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")]
        place = doubles(where["altitude_m"]), *angles
        rays, _, _ = sky.enter(*place)
        pieces = [Pieces.of(band.optics, rays, fine=True) for band in sky.solutions]
        found = sky.rays(*place, pieces=pieces).radiance
        dr.eval(found)
        return np.stack([v.numpy() for v in found], axis=-1).astype(float)

    found = {}
    with double_precision(), shorter_pieces(), shorter_pieces(), cut_alike(air):
        for name in names:
            if name in views:
                step = STEPS[name]
                ends = [(w, light(air, views | {name: views[name] + s * step})) for s, w in STENCIL]
            else:
                value = np.asarray(described(air, name))
                step = STEPS.get(name, NARROW.get(name.rpartition(".")[2], STEP) * value)
                ends = [(w, light(air.replace({name: (value + s * step).tolist()}), views)) for s, w in STENCIL]
            found[name] = sum(w * end for w, end in ends) / step
    return found


def compared(seed: int, names: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """By parameter: errors, by how much the reference changes between its resolutions, whether a view is near the
    horizon, and whether the derivative counts, [4, N]."""
    from atmo_jit import Atmosphere, Linearization
    from atmo_jit.parameters import RADII, described, parameter_names

    description, views = drawn(np.random.default_rng(seed))
    air = Atmosphere.load(description)
    at = Linearization(air, views, fine=True)
    names = names or [n for n in parameter_names(air, views) if n not in (*RADII, "sun_angular_radius_deg")]
    ours = at.jacobian(names)
    coarser, truth = (differences(air, views, names, at.sky.resolution, by) for by in (COARSER, FINER))
    near = np.broadcast_to(views["view_zenith_deg"][:, None] >= 89.0, (VIEWS, 3))
    found = {}
    for name in names:
        scale = np.maximum(np.abs(truth[name]), SMALL * np.abs(truth[name]).max(axis=0))
        parts = [np.abs(other[name] - truth[name]) / scale for other in (ours, coarser)]
        unit = UNITS.get(name, 1.0) if name in views else np.asarray(described(air, name))
        counts = np.abs(0.01 * unit * truth[name]) > COUNTS * at.value["radiance"]
        found[name] = np.stack([part.ravel() for part in (*parts, near, counts)])
    return found


def table(found: dict[str, np.ndarray]) -> str:
    """Both parts as Markdown."""
    lines = []
    for near, (where, limit) in enumerate(LIMITS):
        lines += [
            f"| {where} | median | 95 % | largest | within {limit:g} | of those that count | reference, 95 % |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, (errors, moved, at, counts) in found.items():
            there, weighty = errors[at == near], errors[(at == near) & (counts > 0.0)]
            cells = [f"{q:.1e}" for q in np.quantile(there, [0.5, 0.95, 1.0])]
            cells += [f"{np.mean(part <= limit):.0%}" if len(part) else "-" for part in (there, weighty)]
            cells += [f"{np.quantile(moved[at == near], 0.95):.1e}"]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--names", default="")
    given = parser.parse_args()
    names = [name for name in given.names.split(",") if name]
    parts = [compared(seed, names) for seed in range(given.seed, given.seed + given.count)]
    print(table({name: np.concatenate([part[name] for part in parts], axis=1) for name in parts[0]}))


if __name__ == "__main__":
    main()
