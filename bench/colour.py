"""Colour from few wavelengths: which ones, by which matrix, and how far from the colour of 40.

    python -m bench.colour            # the errors of what the package has
    python -m bench.colour --fit      # choose wavelengths, fit matrices, and print both for atmo_jit/spectrum.py
    python -m bench.colour --presets  # those of presets that were made for three wavelengths
    python -m bench.colour --twilight # chromaticities with and without ozone

Skies are those of random Earths (:func:`atmo_jit.earth.earth_at`: six types of aerosol, optical depths by a factor of
three either way, ozone 200 to 450 DU, ground albedo 0 to 0.6), solved with all orders at 40 wavelengths from 380 to
770 nm, seen from 0 to 12 km under suns from the zenith to 6 degrees below the horizon. Fits are made from some of
them and tested on others. The difference of two colours is CIE Delta E 2000 under the white D65, both brightened by the
factor that gives the truth half the luminance of white.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from atmo_jit import Atmosphere, Sky
from atmo_jit.backend import doubles
from atmo_jit.earth import AEROSOLS, earth_at
from atmo_jit.spectrum import FITTED, SpectralBasis, solar_irradiance
from atmo_jit.wavelengths import at_wavelengths

from .page import table
from .spectra import colour_science

GRID_NM = np.arange(380.0, 771.0, 10.0)
PRESET_NM = (680.0, 550.0, 440.0)
WHITE_XY = (0.3127, 0.3290)  # D65
SHOWN_LUMINANCE = 0.5
STEP = 1e-4  # of XYZ, for the metric of Delta E
TRAINING, HELD_OUT = 1, 2  # seeds
SHORTLIST = 200
NOISE = 0.003  # relative error of each radiance that a matrix has to bear
VIEWS = 150  # of each atmosphere


def skies(seed: int, atmospheres: int, views: int) -> dict[str, np.ndarray]:
    """Spectra [N, 40] of ``light``, their ``sun_zenith_deg`` [N] and ``kind`` [N]: skylight, or sunlight falling on
    horizontal ground."""
    rng = np.random.default_rng(seed)
    light, suns, kinds = [], [], []
    for i in range(atmospheres):
        name = list(AEROSOLS)[i % len(AEROSOLS)]
        depth = AEROSOLS[name].optical_depth * 3.0 ** rng.uniform(-1.0, 1.0)
        air = earth_at(
            GRID_NM, name, optical_depth=depth, ozone_du=rng.uniform(200, 450), ground_albedo=rng.uniform(0, 0.6)
        )
        aloft = rng.random(views) < 0.25
        altitude = np.where(aloft, rng.uniform(0.0, 12e3, views), 0.0)
        sun = np.concatenate([rng.uniform(0.0, 85.0, views // 2), rng.uniform(80.0, 96.0, views - views // 2)])
        view = np.degrees(np.arccos(rng.uniform(0.0, 1.0, views))) + np.where(aloft, 15.0, -0.5)
        azimuth = rng.uniform(0.0, 180.0, views)
        solved = Sky(air)
        angles = [np.radians(v) for v in (sun, np.maximum(view, 0.0), azimuth)]
        radiance = solved.rays(altitude, *angles).radiance
        high = np.linspace(0.0, 88.0, 12)
        direct, _ = solved.irradiance(doubles(0.0 * high), doubles(np.radians(high)))
        for values, at, kind in ((radiance, sun, "skylight"), (direct, high, "sunlight")):
            light.append(np.stack([v.numpy() for v in values], axis=-1).astype(float))
            suns.append(at)
            kinds.append(np.full(len(at), kind))
    return {"light": np.concatenate(light), "sun_zenith_deg": np.concatenate(suns), "kind": np.concatenate(kinds)}


def true_xyz(light: np.ndarray) -> np.ndarray:
    """XYZ [N, 3] of spectra [N, 40]."""
    return light @ SpectralBasis(GRID_NM, solar_irradiance(GRID_NM)).xyz_matrix.T


def shown(xyz: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """``xyz`` under the exposure that gives ``truth`` half the luminance of white."""
    return xyz * (SHOWN_LUMINANCE / truth[:, 1:2])


def difference(xyz: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """CIE Delta E 2000 [N] between colours under that exposure."""
    colour = colour_science()
    lab = [colour.XYZ_to_Lab(shown(v, truth), WHITE_XY) for v in (xyz, truth)]
    return np.asarray(colour.delta_E(*lab, method="CIE 2000"))


def metric(truth: np.ndarray) -> np.ndarray:
    """G [N, 3, 3]: Delta E^2 = d G d for a small difference d of the shown XYZ."""
    at = shown(truth, truth)
    axes = STEP * np.eye(3)

    def squared(d: np.ndarray) -> np.ndarray:
        return (difference((at + d) * truth[:, 1:2] / SHOWN_LUMINANCE, truth) / STEP) ** 2

    single = [squared(axis) for axis in axes]
    result = np.zeros((len(truth), 3, 3))
    for i in range(3):
        result[:, i, i] = single[i]
        for j in range(i):
            result[:, i, j] = result[:, j, i] = (squared(axes[i] + axes[j]) - single[i] - single[j]) / 2.0
    return result


class Fit:
    """Least squares in Delta E over the training spectra, for any choice of wavelengths."""

    def __init__(self, light: np.ndarray) -> None:
        self.truth = true_xyz(light)
        self.scaled = light / solar_irradiance(GRID_NM) * (SHOWN_LUMINANCE / self.truth[:, 1:2])
        self.metric = metric(self.truth)
        self.target = shown(self.truth, self.truth)
        # Normal equations of M [3, W] for all 40 wavelengths at once.
        self.left = np.einsum("nij,na,nb->iajb", self.metric, self.scaled, self.scaled, optimize=True)
        self.right = np.einsum("nij,nj,na->ia", self.metric, self.target, self.scaled, optimize=True)
        # An error of its own in each wavelength, so that no small difference of large terms is chosen.
        noise = NOISE**2 * np.einsum("nij,na->ija", self.metric, self.scaled**2)
        every = np.arange(len(GRID_NM))
        self.left[:, every, :, every] += noise.transpose(2, 0, 1)

    def solve(self, chosen: np.ndarray) -> np.ndarray:
        """Matrices [K, 3, W] for K choices [K, W] of the grid's wavelengths."""
        k, w = chosen.shape
        a, b = np.arange(3)[None, :, None], chosen[:, None, :]
        columns = np.arange(3)[None, None, None, :, None], b[:, None, None]
        rows = self.left[a[..., None, None], b[..., None, None], *columns]
        return np.linalg.solve(rows.reshape(k, 3 * w, 3 * w), self.right[a, b].reshape(k, 3 * w, 1)).reshape(k, 3, w)

    def best(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The ``count`` wavelengths (as indices) and their matrix [3, count]: of the :data:`SHORTLIST` choices with the
        least mean square Delta E that with the least maximum."""
        chosen = np.array(list(combinations(range(2, len(GRID_NM) - 5), count)))
        # What a choice takes off the sum of squares is the product of its solution with the right-hand side.
        gain = np.concatenate(
            [
                np.einsum("kiw,kiw->k", self.solve(part), self.right[np.arange(3)[None, :, None], part[:, None]])
                for part in np.array_split(chosen, len(chosen) // 4000 + 1)
            ]
        )
        shortlist = chosen[np.argsort(-gain)[:SHORTLIST]]
        worst = []
        for indices, matrix in zip(shortlist, self.solve(shortlist), strict=True):
            off = self.scaled[:, indices] @ matrix.T - self.target
            parts = self.metric, matrix, matrix, self.scaled[:, indices] ** 2
            noise = NOISE**2 * np.einsum("nij,ia,ja,na->n", *parts, optimize=True)
            worst.append((np.einsum("ni,nij,nj->n", off, self.metric, off) + noise).max())
        indices = shortlist[int(np.argmin(worst))]
        return indices, self.solve(indices[None])[0]


def rows(data: dict[str, np.ndarray], ways: dict[str, tuple[Sequence[float], np.ndarray]]) -> list[dict[str, Any]]:
    """Delta E of ways to make XYZ: wavelengths and matrix [3, W] of radiance at them."""
    truth, result = true_xyz(data["light"]), []
    sun = data["sun_zenith_deg"]
    sky = data["kind"] == "skylight"
    groups = {
        "skylight, all": sky,
        "sun 0-80 deg": sky & (sun <= 80),
        "sun 80-90 deg": sky & (sun > 80) & (sun <= 90),
        "sun 90-96 deg": sky & (sun > 90),
        "sunlight on the ground": ~sky,
    }
    for name, (nm, matrix) in ways.items():
        at = np.searchsorted(GRID_NM, nm)
        error = difference(data["light"][:, at] @ matrix.T, truth)
        for group, inside in groups.items():
            e = error[inside]
            figures = {"median": np.median(e), "p95": np.percentile(e, 95), "max": e.max()}
            result.append({"way": name, "light": group, "colours": len(e)} | {k: float(v) for k, v in figures.items()})
    return result


def package_ways() -> dict[str, tuple[Sequence[float], np.ndarray]]:
    """What the package does with the presets' three wavelengths and with the fast ones."""
    ways = {}
    for nm in (PRESET_NM, *FITTED):
        kind = "fitted" if nm in FITTED else "interpolated"
        name = f"{' / '.join(f'{v:g}' for v in nm)} nm, {kind}"
        ways[name] = nm, SpectralBasis(np.array(nm), solar_irradiance(nm)).xyz_matrix
    return ways


def preset_rows(names: Sequence[str]) -> list[dict[str, Any]]:
    """Delta E of presets seen from the ground, at their own wavelengths and described at the fitted ones, against
    the same at 40 wavelengths."""
    rng = np.random.default_rng(HELD_OUT)
    sun = np.radians(np.concatenate([rng.uniform(0.0, 85.0, VIEWS), rng.uniform(80.0, 96.0, VIEWS)]))
    view, azimuth = np.arccos(rng.uniform(0.0, 1.0, 2 * VIEWS)), rng.uniform(0.0, np.pi, 2 * VIEWS)

    def xyz(air: Atmosphere) -> np.ndarray:
        light = Sky(air).rays(0.0 * sun, sun, view, azimuth).radiance
        return np.stack([v.numpy() for v in light], axis=-1).astype(float) @ SpectralBasis.of(air).xyz_matrix.T

    found = []
    for name in names:
        air = Atmosphere.load(name)
        truth = xyz(at_wavelengths(air, GRID_NM))
        for nm in (air.wavelengths_nm, *FITTED):
            e = difference(xyz(at_wavelengths(air, nm)), truth)
            figures = {"median": np.median(e), "p95": np.percentile(e, 95), "max": e.max()}
            way = " / ".join(f"{v:g}" for v in nm) + " nm"
            found.append({"way": way, "light": name, "colours": len(e)} | {k: float(v) for k, v in figures.items()})
    return found


def report(found: list[dict[str, Any]]) -> str:
    """The table of :func:`rows`."""
    heads = {"way": "wavelengths", "light": "light", "colours": "colours"}
    return table(found, heads | {k: f"Delta E {k}" for k in ("median", "p95", "max")})


def chromaticities() -> list[dict[str, Any]]:
    """CIE 1931 xy of the zenith and of the horizon at right angles to the sun (2 degrees up), at noon and in the blue
    hour, with and without ozone: continental clean aerosol, 40 wavelengths."""
    names, found = ("zenith x", "zenith y", "horizon x", "horizon y"), []
    for label, sun in (("noon, sun at 30 deg", 30.0), ("sunset, 90 deg", 90.0), ("blue hour, 96 deg", 96.0)):
        for ozone in (300.0, 0.0):
            air = earth_at(GRID_NM, "continental_clean", ozone_du=ozone)
            view = np.radians([0.0, 88.0])
            light = Sky(air).rays(np.zeros(2), np.full(2, np.radians(sun)), view, np.full(2, np.pi / 2)).radiance
            xyz = true_xyz(np.stack([v.numpy() for v in light], axis=-1).astype(float))
            xy = (xyz[:, :2] / xyz.sum(axis=1, keepdims=True)).ravel().tolist()
            found.append({"sky": label, "ozone DU": ozone, **dict(zip(names, xy, strict=True))})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--fit", action="store_true", help="choose wavelengths, fit matrices and print them")
    parser.add_argument("--twilight", action="store_true", help="print chromaticities with and without ozone")
    parser.add_argument("--presets", action="store_true", help="print the errors of presets with three wavelengths")
    parser.add_argument("--atmospheres", type=int, default=24, help="of each set (24)")
    options = parser.parse_args()
    if options.twilight:
        found = chromaticities()
        print(table(found, {name: name for name in found[0]}))
        return
    if options.presets:
        print(report(preset_rows(("earth", "bruneton2008", "hillaire2020", "mars"))))
        return
    held_out = skies(HELD_OUT, options.atmospheres, VIEWS)
    if not options.fit:
        print(report(rows(held_out, package_ways())))
        return
    training = skies(TRAINING, options.atmospheres, VIEWS)
    fit, ways = Fit(training["light"][training["kind"] == "skylight"]), {}
    for count in (3, 4):
        indices, matrix = fit.best(count)
        nm = tuple(GRID_NM[indices].tolist())
        print(f"{nm}:", np.round(matrix, 5).tolist())
        ways[f"{nm}, fitted"] = nm, matrix / solar_irradiance(nm)
    preset = fit.solve(np.searchsorted(GRID_NM, PRESET_NM)[None])[0]
    ways[f"{PRESET_NM}, fitted"] = PRESET_NM, preset / solar_irradiance(PRESET_NM)
    print(report(rows(held_out, ways)))


if __name__ == "__main__":
    main()
