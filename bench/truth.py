"""What errors are measured against: the reference data where they are, else this package at its highest resolution.

    truth = Truth.of_reference(folder)      # or Truth.of_package()
    value = truth.radiance(solve)           # solve(atmosphere) gives something with radiance(views)
    rows = truth.rows(value)                # error rows by group

Groups. ``day``: rays of no flag; ``horizon``: view 88 to 95 degrees; ``twilight``: sun at or below the horizontal;
``limb``: from space past the planet's edge; ``haze``: day rays through aerosol of beta_M >= 5e-5 1/m, and ``haze
horizon``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import reference
from .methods import OwnSky, scaled

HORIZON, TWILIGHT, LIMB = 4, 1, 2
HAZE = 5e-5  # 1/m
LONG_S = 10.0
GROUPS = ("day", "horizon", "twilight", "limb", "haze", "haze horizon")
# Atmospheres that the slowest peers are asked for at their published sizes: clear and hazy, low and high sun, space.
FEW_CASES = ("clear_noon_cs", "hazy_sza60_cs85_a9", "bn08_sza90_cs", "toa_sza30_bn08")


@dataclass(frozen=True)
class Truth:
    """Rays with their radiance ``L`` and its noise ``sigma`` (one standard deviation), [N]; ``cases``: the
    atmospheres and which rays are theirs; ``flag`` [N] bits as above, ``beta_m`` [N] aerosol scattering (1/m)."""

    name: str
    cases: tuple[reference.Case, ...]
    L: np.ndarray
    sigma: np.ndarray
    flag: np.ndarray
    beta_m: np.ndarray

    @classmethod
    def of_reference(cls, folder: Path | None = None) -> Truth:
        """``sky_radiance.npz``; raises FileNotFoundError where it is absent."""
        data = reference.load("sky_radiance", folder)
        return cls(
            "reference data (sky_radiance.npz)",
            tuple(reference.sky_cases(data)),
            data["L"],
            data["L_sigma"],
            data["flag"],
            data["beta_M_sca"],
        )

    @classmethod
    def of_package(cls, count: int = 40, tolerance: float = 0.001, factor: float = 2.0) -> Truth:
        """This package at ``factor`` times the resolution of ``tolerance``, for 4 ``count`` rays in each of three
        atmospheres: shows how errors fall, not that they fall to the truth."""
        from atmo_jit.atmosphere import Atmosphere
        from atmo_jit.resolution import Resolution

        cases, parts, first = [], [], 0
        for name, changes in _ATMOSPHERES.items():
            air = Atmosphere.load("earth").replace({"solar_irradiance": 1.0, "sun_angular_radius_deg": 0.0, **changes})
            views = _views(count, seed=len(cases))
            channel = np.arange(len(views["altitude_m"])) % len(air.wavelengths_nm)
            solved = OwnSky(air, 1e-4, scaled(Resolution.suited(air, tolerance), factor))
            radiance = solved.radiance(views)[np.arange(len(channel)), channel]
            rows = first + np.arange(len(channel))
            cases.append(reference.Case(name, air.to_dict(), rows, channel, views))
            beta = np.asarray(air.mie[0].scattering_per_m)[channel] if air.mie else 0.0 * radiance
            parts.append((radiance, flags(views, air.thickness_m), beta))
            first += len(rows)
        radiance, flag, beta = (np.concatenate(column) for column in zip(*parts, strict=True))
        return cls("this package at its highest resolution", tuple(cases), radiance, 0.0 * radiance, flag, beta)

    def radiance(
        self, solve: Callable[[Any], Any], cases: tuple[str, ...] | None = None, *, once: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """(radiance, CPU seconds of the solve) [N] of every ray, NaN for rays of cases left out.

        Every atmosphere is solved twice, so that no compilation is counted; but not where the first took longer than
        LONG_S, of which compilation is little, nor if ``once``.
        """
        value, seconds = np.full(self.L.shape, np.nan), np.full(self.L.shape, np.nan)
        for case in self.cases:
            if cases is not None and case.name not in cases:
                continue
            for _ in range(1 if once else 2):
                start = time.process_time()
                solved = solve(case.atmosphere)
                seconds[case.rows] = spent = time.process_time() - start
                if spent > LONG_S:
                    break
            found = np.asarray(solved.radiance(case.views), dtype=np.float64)
            value[case.rows] = found[np.arange(len(case.rows)), case.channel]
        return value, seconds

    def masks(self) -> dict[str, np.ndarray]:
        """The groups of rays."""
        day, horizon, hazy = self.flag == 0, (self.flag & HORIZON) > 0, self.beta_m >= HAZE
        return {
            "day": day,
            "horizon": horizon,
            "twilight": (self.flag & TWILIGHT) > 0,
            "limb": (self.flag & LIMB) > 0,
            "haze": day & hazy,
            "haze horizon": horizon & hazy,
        }

    def rows(self, value: np.ndarray, seconds: np.ndarray | None = None) -> list[dict[str, Any]]:
        """A row per group: rays; error in per cent (median, p95, max), raw and beyond three sigma; mean CPU seconds."""
        rows = []
        for name, mask in self.masks().items():
            here = mask & np.isfinite(value)
            gap, truth, sigma = np.abs(value - self.L)[here], self.L[here], self.sigma[here]
            row: dict[str, Any] = {"group": name, "rays": int(here.sum())}
            row |= _percentiles("", gap / truth)
            row |= _percentiles("beyond_", np.maximum(gap - 3.0 * sigma, 0.0) / truth)
            if seconds is not None:
                row["cpu_s"] = float(seconds[here].mean()) if here.any() else None
            rows.append(row)
        return rows


def _percentiles(prefix: str, error: np.ndarray) -> dict[str, float | None]:
    names = {"median": 50, "p95": 95, "max": 100}
    return {
        f"{prefix}{name}": float(np.percentile(error, p) * 100) if error.size else None for name, p in names.items()
    }


def flags(views: Mapping[str, np.ndarray], thickness_m: float) -> np.ndarray:
    """The bits of ``flag`` that geometry decides: twilight 1, limb from space 2, view near the horizon 4."""
    view, h = views["view_zenith_deg"], views["altitude_m"]
    horizon = (view >= 88.0) & (view <= 95.0)
    return (
        TWILIGHT * (views["sun_zenith_deg"] >= 90.0)
        + LIMB * (h > thickness_m)
        + HORIZON * (horizon & (h <= thickness_m))
    ).astype(int)


_ATMOSPHERES: dict[str, dict[str, Any]] = {
    "clear": {},
    "hazy": {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.8, "ground_albedo": 0.4},
    "no aerosol": {"mie.scattering_per_m": 0.0, "ground_albedo": 0.0},
}


def _views(count: int, seed: int) -> dict[str, np.ndarray]:
    """``count`` rays each: by day from the ground, towards the horizon, at twilight, and past the limb from space."""
    rng = np.random.default_rng(seed)
    n = 4 * count
    kind = np.arange(n) // count
    r, h = 6.36e6, 4e5
    low, high = (np.degrees(np.pi - np.arcsin((r + edge) / (r + h))) for edge in (5e4, 1e3))
    day = np.degrees(np.arccos(rng.uniform(0.05, 1.0, n)))
    return {
        "altitude_m": np.select([kind < 3], [1e4 * rng.random(n) ** 4], h),
        "sun_zenith_deg": np.where(kind == 2, rng.uniform(90, 96, n), rng.uniform(0, 85, n)),
        "view_zenith_deg": np.select([kind == 1, kind == 3], [rng.uniform(88, 91, n), rng.uniform(low, high, n)], day),
        "azimuth_deg": rng.uniform(10, 350, n),
    }
