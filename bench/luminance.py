"""Luminance of the sky relative to the zenith, beside the CIE standard clear sky: figures 6 and 7 of Bruneton and
Neyret 2008.

    python -m bench.luminance
    python -m bench.luminance --out docs/images/sky_luminance.png

The atmosphere is the preset ``bruneton2008`` with all orders of scattering, at 40 wavelengths of which luminance is the
CIE Y. The sky to compare with is CIE type 12, "clear sky, low luminance turbidity", a fit to measurements of no
particular air.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit import Atmosphere, Sky
from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.spectrum import SpectralBasis
from atmo_jit.wavelengths import at_wavelengths

from .page import table

SUNS = np.arange(0.0, 81.0, 10.0)
AZIMUTHS = (0.0, 45.0, 90.0, 135.0, 180.0)
VIEWS = np.arange(0.0, 90.0, 2.5)
LIMITS = (75.0, 85.0)  # of the views compared: toward the horizon the haze of this air is brighter than the CIE's
WAVELENGTHS_NM = np.arange(380.0, 771.0, 10.0)


def cie_type12(sun_zenith_deg: Any, view_zenith_deg: Any, azimuth_deg: Any) -> np.ndarray:
    """Luminance relative to the zenith of the CIE standard general sky, type 12 (CIE S 011 / ISO 15469:2004):

        phi(Z) f(chi) / (phi(0) f(Z_s)),    phi(Z) = 1 + a exp(b / cos Z),
        f(chi) = 1 + c (exp(d chi) - exp(d pi / 2)) + e cos^2 chi

    with Z the view's and Z_s the sun's zenith angle, chi the angle between them; a = -1, b = -0.32, c = 10, d = -3,
    e = 0.45.
    """
    sun, view, azimuth = (np.radians(v) for v in (sun_zenith_deg, view_zenith_deg, azimuth_deg))
    cosine = np.cos(sun) * np.cos(view) + np.sin(sun) * np.sin(view) * np.cos(azimuth)

    def gradation(z: Any) -> Any:
        return 1.0 - np.exp(-0.32 / np.maximum(np.cos(z), 1e-9))

    def indicatrix(cos_chi: Any) -> Any:
        chi = np.arccos(np.clip(cos_chi, -1.0, 1.0))
        return 1.0 + 10.0 * (np.exp(-3.0 * chi) - np.exp(-1.5 * np.pi)) + 0.45 * cos_chi**2

    return gradation(view) * indicatrix(cosine) / (gradation(0.0) * indicatrix(np.cos(sun)))


def relative_luminance(atmosphere: Any, suns: Any, views: Any, azimuths: Any) -> np.ndarray:
    """Luminance of the sky seen from the ground over that of the zenith, [suns, azimuths, views] (degrees)."""
    air = at_wavelengths(Atmosphere.load(atmosphere), WAVELENGTHS_NM)
    s, a, v = (g.ravel() for g in np.meshgrid(suns, azimuths, [0.0, *views], indexing="ij"))
    light = Sky(air).rays(0.0 * v, *(np.radians(x) for x in (s, v, a)), ground=False).radiance
    weights = SpectralBasis.of(air).xyz_matrix[1]
    y = sum(weight * value.numpy().astype(float) for weight, value in zip(weights, light, strict=True))
    y = y.reshape(len(suns), len(azimuths), -1)
    return y[..., 1:] / y[..., :1]


def compare(atmosphere: Any = "bruneton2008") -> tuple[list[dict[str, Any]], np.ndarray, np.ndarray]:
    """A row per sun, and the luminances of this package and of the CIE [suns, azimuths, views]."""
    own = relative_luminance(atmosphere, SUNS, VIEWS, AZIMUTHS)
    sun, azimuth, view = np.meshgrid(SUNS, AZIMUTHS, VIEWS, indexing="ij")
    cie = cie_type12(sun, view, azimuth)
    rows = []
    for i, angle in enumerate(SUNS):
        off = 100.0 * np.log(own[i] / cie[i])
        rms = {f"to_{limit:g}": float(np.sqrt(np.mean(off[view[i] <= limit] ** 2))) for limit in LIMITS}
        high = off[view[i] <= LIMITS[0]]
        rows.append({"sun_deg": angle, **rms, "mean": float(np.mean(high)), "shape": float(np.std(high))})
    return rows, own, cie


def draw(own: np.ndarray, cie: np.ndarray, path: Path) -> None:
    """Write the PNG: a panel per sun, the plane through sun and zenith and the plane across it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    through = np.concatenate([-VIEWS[::-1], VIEWS])
    for i, (panel, sun) in enumerate(zip(figure.subplots(3, 3, sharex=True).ravel(), SUNS, strict=True)):
        for values, style, name in ((own, "-", "atmo-jit"), (cie, "--", "CIE type 12")):
            plane = np.concatenate([values[i, -1, ::-1], values[i, 0]])
            panel.plot(through, plane, "C3" + style, label=f"{name}, through the sun")
            panel.plot(VIEWS, values[i, 2], "C0" + style, label=f"{name}, across")
        panel.set_yscale("log")
        panel.set_title(f"sun at {sun:g} deg from the zenith", fontsize=9)
        panel.grid(True, which="both", linewidth=0.3, alpha=0.5)
        panel.tick_params(labelsize=8)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8)
    figure.supxlabel("view zenith angle, degrees (positive: the sun's side)", fontsize=9)
    figure.supylabel("luminance / luminance of the zenith", fontsize=9)
    figure.savefig(path, format="png", dpi=90, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--out", type=Path, help="also draw the curves into this PNG")
    options = parser.parse_args()
    rows, own, cie = compare()
    heads = {"sun_deg": "sun deg", **{f"to_{v:g}": f"rms log difference %, views to {v:g} deg" for v in LIMITS}}
    limit = f"to {LIMITS[0]:g} deg"
    print(table(rows, heads | {"mean": f"mean %, {limit}", "shape": f"rms about the mean %, {limit}"}))
    if options.out:
        with atomic_outputs(check_output(options.out, ".png")) as (part,):
            draw(own, cie, part)


if __name__ == "__main__":
    main()
