"""An aerosol species from its particles: Mie theory for spheres with a lognormal distribution of radii.

>>> from atmo_jit import mie
>>> dust = mie.species([680, 550, 440], median_radius_um=0.4, geometric_deviation=1.8, refractive_index=1.53 - 0.005j,
...                    extinction_per_m=5e-5, scale_height_m=2000)          # doctest: +SKIP
>>> air = atmo_jit.Atmosphere.load("earth").replace({"mie": dust})          # doctest: +SKIP

Efficiencies and intensities of a sphere are those of the package miepython (`pip install 'atmo-jit[mie]'`), averaged
over the radii r, of which

    n(ln r) ~ exp(-(ln r - ln r_m)^2 / (2 ln^2 s)),        <C> = integral of n(ln r) pi r^2 Q(2 pi r / lambda) d ln r,

with the median r_m and the geometric standard deviation s, as the components of aerosol are given in the literature
(OPAC: Hess et al. 1998, table 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ._fields import POSITIVE, Range, number, numbers
from .errors import AtmosphereError, InputError, shown

__all__ = ["PHASES", "species"]

PHASES = ("tabulated", "legendre", "henyey_greenstein")
RADII = 80  # nodes over the distribution
REACH = 4.0  # standard deviations of ln r, weighted by area, on either side
ANGLES = 400
MOMENTS = 128


def species(
    wavelengths_nm: Any,
    *,
    median_radius_um: float,
    geometric_deviation: float,
    refractive_index: Any,
    extinction_per_m: float,
    scale_height_m: float,
    phase: str = "tabulated",
    reference_nm: float = 550.0,
) -> dict[str, Any]:
    """The object ``mie`` of an atmosphere file at ``wavelengths_nm`` [W].

    ``median_radius_um`` of the number of particles, in micrometres; ``geometric_deviation`` >= 1 (1: all of one size);
    ``refractive_index`` complex, one or [W] (absorption is the size of the imaginary part, whatever its sign).
    ``extinction_per_m`` where the density is 1, at ``reference_nm``. ``phase``: "tabulated" or "legendre", the phase
    function at ``reference_nm`` for all wavelengths; "henyey_greenstein", with the asymmetry of each wavelength.
    Raises AtmosphereError, naming the argument, and InputError where miepython is not installed.
    """
    nm = numbers(wavelengths_nm, "wavelengths_nm", POSITIVE)
    median = number(median_radius_um, "median_radius_um", POSITIVE)
    width = np.log(number(geometric_deviation, "geometric_deviation", Range(1, 10)))
    total = number(extinction_per_m, "extinction_per_m", POSITIVE)
    height = number(scale_height_m, "scale_height_m", POSITIVE)
    reference = number(reference_nm, "reference_nm", POSITIVE)
    if phase not in PHASES:
        raise AtmosphereError("phase", shown(phase), f"one of {', '.join(PHASES)}")
    index = np.atleast_1d(np.asarray(refractive_index, complex))
    if index.shape not in ((1,), nm.shape) or not np.all(np.isfinite(index)) or np.any(index.real <= 0.0):
        raise AtmosphereError("refractive_index", shown(refractive_index), f"one complex number, or {len(nm)}")
    index = np.broadcast_to(index.real - 1j * np.abs(index.imag), nm.shape)
    order = np.argsort(nm)
    at_reference = complex(*(np.interp(reference, nm[order], part[order]) for part in (index.real, index.imag)))
    spheres = _Spheres(median, width)
    extinction, scattering, asymmetry = (np.array(v) for v in zip(*map(spheres.mean, nm, index), strict=True))
    scale = total / spheres.mean(reference, at_reference)[0]
    result = {
        "scattering_per_m": (scale * scattering).tolist(),
        "single_scattering_albedo": (scattering / extinction).tolist(),
        "scale_height_m": height,
    }
    if phase == "henyey_greenstein":
        return result | {"phase": {"type": phase, "g": asymmetry.tolist()}}
    # The forward peak is narrow: angles are crowded there.
    cosine = np.cos(np.pi * np.linspace(1.0, 0.0, ANGLES) ** 2)
    if phase == "tabulated":
        values = spheres.intensity(reference, at_reference, cosine)
        return result | {"phase": {"type": phase, "cos_theta": cosine.tolist(), "values": values.tolist()}}
    nodes, weights = np.polynomial.legendre.leggauss(4 * MOMENTS)
    values = weights * spheres.intensity(reference, at_reference, nodes)
    chi = values @ np.polynomial.legendre.legvander(nodes, MOMENTS) / values.sum()
    return result | {"phase": {"type": phase, "moments": [1.0, *np.clip(chi[1:], -1.0, 1.0).tolist()]}}


class _Spheres:
    """Radii (um) with their weights by area, and means over them."""

    def __init__(self, median_um: float, width: float) -> None:
        self.theory = _miepython()
        offsets = np.linspace(-REACH, REACH, RADII) if width > 0.0 else np.zeros(1)
        # Weighted by r^2 a lognormal is one with the same width and this median.
        self.radii = median_um * np.exp(2.0 * width**2 + width * offsets)
        self.weights = np.exp(-0.5 * offsets**2)

    def sizes(self, nm: float) -> np.ndarray:
        return 2.0e3 * np.pi * self.radii / nm

    def mean(self, nm: float, index: complex) -> tuple[float, float, float]:
        """Extinction and scattering efficiency, weighted by area, and the mean scattering cosine."""
        extinction, scattering, _, cosine = np.array([self.theory.efficiencies_mx(index, x) for x in self.sizes(nm)]).T
        scattered = self.weights * scattering
        total = self.weights.sum()
        return self.weights @ extinction / total, scattered.sum() / total, scattered @ cosine / scattered.sum()

    def intensity(self, nm: float, index: complex, cosine: np.ndarray) -> np.ndarray:
        """Scattered intensity at the cosines, up to a factor."""
        parts = (
            weight * self.theory.i_unpolarized(index, x, cosine, norm="qsca")
            for weight, x in zip(self.weights, self.sizes(nm), strict=True)
        )
        return np.sum(list(parts), axis=0)


def _miepython() -> Any:
    try:
        import miepython
    except ImportError:
        raise InputError("Mie theory needs miepython, which is not installed: pip install 'atmo-jit[mie]'") from None
    return miepython
