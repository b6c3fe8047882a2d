"""What fits reach: recovery, intervals, speed, and the measured skies of Kider et al. 2014.

    python -m bench.fits recovery            # without noise, and from starts ten times off
    python -m bench.fits coverage            # 100 skies drawn at random, 64 x 64 fisheye, 1 % noise
    python -m bench.fits speed               # one such fit, again and again
    python -m bench.fits kider --out scans   # the reference data's scans, as observations and fitted

``kider`` writes the scans as files that `atmo-jit fit --config fits/clear_sky.toml` takes.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import atmo_jit
from atmo_jit.fits import FitConfig, fit, observations, result
from atmo_jit.fits.pictures import directions

from . import reference

FREE = {
    "mie.scattering_per_m": {"mode": "scale", "start": 1e-5, "min": 1e-8, "max": 1e-2},
    "mie.phase.g": {"start": 0.6, "min": -0.5, "max": 0.97},
}
CONFIG = Path(__file__).parents[1] / "fits" / "clear_sky.toml"
CENTRES_NM, WIDTH_NM = np.arange(365.0, 720.0, 25.0), 10.0


def fisheye(scattering: float, g: float, sun_deg: float, size: int = 64, noise: float = 0.0, seed: int = 0) -> Any:
    """A picture of the sky of ``earth`` with this aerosol as arrays of observations."""
    zenith, azimuth, seen = directions({"projection": "fisheye", "fov_deg": 180.0, "up_deg": 0.0}, size, size)
    views = {"altitude_m": 0.0, "sun_zenith_deg": sun_deg}
    views |= {"view_zenith_deg": zenith[seen], "azimuth_deg": azimuth[seen]}
    air = atmo_jit.Atmosphere.load("earth").replace({"mie.scattering_per_m": scattering, "mie.phase.g": g})
    radiance = atmo_jit.sky(air, views).radiance.astype(float)
    radiance *= 1.0 + noise * np.random.default_rng(seed).standard_normal(radiance.shape)
    return views | {"radiance": radiance, "relative_sigma": max(noise, 0.01), "wavelengths_nm": air.wavelengths_nm}


def config(factor: float = 1.0, robust: bool = True) -> FitConfig:
    """Scattering and g free, the start of scattering ``factor`` times 1e-5."""
    first = FREE["mie.scattering_per_m"] | {"start": 1e-5 * factor}
    free = FREE | {"mie.scattering_per_m": first}
    return FitConfig.of({"atmosphere": "earth", "free": free, "robust": robust})


def _draw(rng: np.random.Generator) -> tuple[float, float, float]:
    return float(np.exp(rng.uniform(np.log(2e-6), np.log(1e-4)))), rng.uniform(0.3, 0.9), rng.uniform(20.0, 85.0)


def coverage(count: int, size: int = 64, noise: float = 0.01, seed: int = 1) -> Iterator[dict[str, Any]]:
    """Fits of ``count`` skies: of each the truth, relative errors and whether the 95 % intervals hold the truth."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        scattering, g, sun = _draw(rng)
        report = result(fit(observations(fisheye(scattering, g, sun, size, noise, seed + i)), config(robust=False)))
        row: dict[str, Any] = {"sun_zenith_deg": sun, "error": {}, "inside": {}, "converged": report["converged"]}
        for name, truth in (("mie.scattering_per_m", scattering), ("mie.phase.g", g)):
            entry = report["parameters"][name]
            low, high = entry["interval_95"]
            row["error"][name], row["inside"][name] = entry["value"] / truth - 1.0, low <= truth <= high
        yield row | {"scattering_per_m": scattering, "g": g, "seconds": report["seconds"]}


def recovery() -> None:
    """Errors without noise, from three starts."""
    rng = np.random.default_rng(2)
    print("scattering 1/m      g   sun | start x   error of scattering, of g (%)   starts, iterations, converged")
    for _ in range(4):
        scattering, g, sun = _draw(rng)
        data = observations(fisheye(scattering, g, sun, size=24))
        for factor in (0.1, 1.0, 10.0):
            start = factor * scattering / 1e-5
            report = result(fit(data, config(start)))
            values = [report["parameters"][name]["value"] for name in FREE]
            errors = "   ".join(f"{100 * (v / t - 1):+8.4f}" for v, t in zip(values, (scattering, g), strict=True))
            how = f"{report['starts']}, {report['iterations']}, {report['converged']}"
            print(f"{scattering:14.3g} {g:6.3f} {sun:5.1f} | {factor:7g}   {errors}   {how}", flush=True)


def speed(repeats: int = 9) -> None:
    """Wall and CPU seconds of a fit of scattering and g to a 64 x 64 fisheye with 1 % noise."""
    data = observations(fisheye(1.3e-5, 0.72, 50.0, noise=0.01))
    times = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        fit(data, config())
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    first, later = times[0], np.median(times[1:], axis=0)
    print(f"first fit: {first[0]:.2f} s, {first[1]:.2f} CPU s; later, median: {later[0]:.2f} s, {later[1]:.2f} CPU s")


def scan(folder: Path, slot: str) -> dict[str, Any]:
    """A scan of the reference data as arrays of observations, its flagged samples masked.

    Its first sample is wrong in every scan: published comparisons over all 81 directions (Bruneton 2017, IEEE TVCG 23,
    "A Qualitative and Quantitative Evaluation of 8 Clear Sky Models") have the mean of its two neighbours instead, and
    so do those here; ``as_measured`` has its own.
    """
    with np.load(folder / "sky_radiance.npz") as data:
        i = list(data["slot"]).index(slot)
        nm, spectra = data["wavelength_nm"], data["radiance"][i].astype(float)
        bands = [spectra[:, np.abs(nm - centre) <= WIDTH_NM / 2.0].mean(axis=1) for centre in CENTRES_NM]
        arrays = {
            "radiance": np.stack(bands, axis=1),
            "relative_sigma": 0.01,
            "wavelengths_nm": CENTRES_NM,
            "altitude_m": float(data["altitude_m"]),
            "sun_zenith_deg": float(data["sun_zenith_apparent_deg"][i]),
            "view_zenith_deg": data["zenith_deg"],
            "sun_azimuth_deg": np.full(len(spectra), data["sun_azimuth_deg"][i]),
            "view_azimuth_deg": data["azimuth_deg_cw_from_north"],
        }
    arrays["as_measured"] = arrays["radiance"].copy()
    away = np.abs((arrays["view_azimuth_deg"] - arrays["view_azimuth_deg"][0] + 180.0) % 360.0 - 180.0)
    ring = np.flatnonzero(np.isclose(arrays["view_zenith_deg"], arrays["view_zenith_deg"][0]))
    neighbours = ring[np.argsort(away[ring])[1:3]]
    arrays["radiance"][0] = arrays["radiance"][neighbours].mean(axis=0)
    mask = np.ones(len(spectra), bool)
    with open(folder / "flags.csv", encoding="utf-8") as stream:
        flagged = [int(row["sample"]) for row in csv.DictReader(stream) if row["slot"] == slot]
    if len(flagged) < len(mask):  # a sky that is nowhere smooth is fitted nevertheless, and shows it
        mask[flagged] = False
    return arrays | {"mask": mask}


def _errors(found: Any, measured: np.ndarray) -> tuple[float, float]:
    """Relative and absolute rms of a fit over all samples of a scan."""
    predicted = np.empty_like(measured)
    predicted[found.problem.data.rows] = found.found.predicted
    if found.unseen:
        predicted[found.unseen[0].rows] = found.unseen[1]
    return tuple(float(np.sqrt(np.mean(v**2))) for v in (predicted / measured - 1.0, predicted - measured))


def kider(folder: Path, out: Path) -> None:
    """Fit every scan, and write it and what was found."""
    out.mkdir(parents=True, exist_ok=True)
    settings = FitConfig.load(CONFIG)
    with np.load(folder / "sky_radiance.npz") as data:
        slots = [str(slot) for slot in data["slot"]]
    for slot in slots:
        arrays = scan(folder, slot)
        np.savez(out / f"{slot}.npz", **arrays)
        times = []
        for _ in range(3):  # at first kernels are traced, then recorded
            wall, cpu = time.perf_counter(), time.process_time()
            found = fit(observations(arrays), settings)
            times.append((time.perf_counter() - wall, time.process_time() - cpu))
        report = result(found)
        (out / f"{slot}.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        derived, nuisance = report["derived"], report["nuisance"]
        errors = [f"residual {100 * report['residual_robust']:.1f} % robust"]
        rows = [("", report["relative_rms"], report["rmse"])]
        rows.append(("all 81: ", report["relative_rms_with_masked"], report["rmse_with_masked"]))
        rows.append(("all as measured: ", *_errors(found, arrays["as_measured"])))
        for where, relative, absolute in rows:
            errors.append(f"{where}{100 * relative:.1f} % rms, {1e3 * absolute:.2f} mW m^-2 sr^-1 nm^-1")
        print(f"{slot}: {'; '.join(errors)}")
        print(
            f"    tau_440 {derived['tau_440']:.3f}, asymmetry_440 {derived['asymmetry_440']:.3f}, sun azimuth "
            f"{nuisance['sun_azimuth']['value']:+.1f} deg, calibration {nuisance['calibration']['value']:.3f}; "
            f"{times[-1][0]:.1f} s, {times[-1][1]:.1f} CPU s, first {times[0][1]:.1f} CPU s; {report['reason']}"
        )
        for sentence in report["not_identifiable"]:
            print(f"    {sentence}")
        sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["recovery", "coverage", "speed", "kider"])
    parser.add_argument("--count", type=int, default=100, help="skies of coverage")
    parser.add_argument("--out", type=Path, default=Path("scans"), help="folder of kider")
    given = parser.parse_args(arguments)
    if given.what == "coverage":
        rows = []
        for row in coverage(given.count):
            rows.append(row)
            place = f"{row['scattering_per_m']:.3g} {row['g']:.3f} {row['sun_zenith_deg']:.1f}"
            off = [f"{100 * row['error'][name]:+.3f} % {'in' if row['inside'][name] else 'out'}" for name in FREE]
            print(f"{place}: {'  '.join(off)}", flush=True)
        for name in FREE:
            errors = np.abs([row["error"][name] for row in rows])
            inside = np.mean([row["inside"][name] for row in rows])
            print(
                f"{name}: in {100 * inside:.0f} % of the 95 % intervals; error median {100 * np.median(errors):.3f} %, "
                f"largest {100 * errors.max():.2f} %"
            )
    elif given.what == "kider":
        kider(reference.folder() / "kider2014", given.out)
    else:
        {"recovery": recovery, "speed": speed}[given.what]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
