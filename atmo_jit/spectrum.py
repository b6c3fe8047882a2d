"""From radiance at an atmosphere's few wavelengths to spectra, XYZ and linear sRGB, in Mitsuba's units.

An atmosphere is solved at W wavelengths; a picture needs the spectrum in between. :class:`SpectralBasis` holds the
one rule that the whole package uses for that, and everything in it is linear in the W values, so that conversion and
summation commute (the colour of an irradiance is the irradiance of the colours) and derivatives pass through a
constant matrix:

    L(lambda) = E(lambda) * sum_i h_i(lambda) * L_i / E_i

- ``h_i``: piecewise linear in lambda^-4 between the wavelengths, held constant outside of them. That is exact for light
  scattered once by Rayleigh particles and grey aerosol; with many wavelengths the choice matters little.
- ``E``: the solar spectrum, ASTM G173-03 extraterrestrial smoothed over 10 nm, scaled to the atmosphere's own
  ``solar_irradiance`` at its wavelengths (the factor is interpolated with the same ``h_i``).
- An atmosphere whose ``solar_irradiance`` is the same number at all wavelengths (1, for instance) is taken at its word:
  its sun is a white one, E is that constant, and a constant spectrum stays constant.

XYZ are the integrals with the CIE 1931 2 degree colour matching functions divided by the integral of y-bar, as Mitsuba
divides by ``MI_CIE_Y_NORMALIZATION``: Y is a mean radiance in W m^-2 sr^-1 nm^-1, not candela. The constant spectrum 1
has Y = 1 and the linear sRGB value (1.2048, 0.9483, 0.9091) that Mitsuba's spectral film gives it; no white balance is
applied.

For the wavelengths of :data:`FITTED` XYZ are not integrals of that spectrum, but a matrix fitted to many skies: the
fast path, whose colour is next to that of 40 wavelengths (docs/colour.md). Spectra in between stay as above.

How good three wavelengths are otherwise (680, 550, 440 nm; tests/plugins/test_spectrum.py): skylight of up to 2 air
masses is right within 5 % of its brightest channel, the sun's red is 2 % too bright at 1 air mass and 27 % at 10,
because transmittance is convex in between and the ozone band at 600 nm is missed. Ten wavelengths are right within 2 %.

Colour matching functions, the solar spectrum and the sRGB matrix are colour-science's, held in a file of their own:
importing that package takes longer than a picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError

__all__ = [
    "FAST_NM",
    "FITTED",
    "SpectralBasis",
    "cie_1931",
    "interpolation_weights",
    "solar_irradiance",
    "xyz_to_rgb",
    "xyz_to_srgb",
]

VISIBLE_NM = (360.0, 830.0)  # Mitsuba's range of wavelengths, and that of the colour matching functions
SMOOTHING_NM = 10  # below this the Fraunhofer lines would make single wavelengths bad anchors of the spectrum
SOLAR_RANGE_NM = (280.0, 4000.0)
DATA = Path(__file__).with_name("spectrum.npz")


@cache
def _data() -> dict[str, np.ndarray]:
    """Tables of colour-science: see bench/spectra.py."""
    with np.load(DATA, allow_pickle=False) as held:
        return {name: held[name] for name in held.files}


# XYZ (normalised as below) of light under the Earth's sun, from its radiance over the sun's irradiance at a few
# wavelengths (ascending), for skies of the Earth: least squares in CIE Delta E 2000, by `python -m bench.colour --fit`.
FITTED = {
    (460.0, 530.0, 620.0): (
        (0.23898, 0.58073, 0.91417),
        (-0.03558, 1.32858, 0.49378),
        (2.06824, -0.32307, 0.10476),
    ),
    (440.0, 530.0, 560.0, 640.0): (
        (0.28685, -0.23039, 1.1971, 0.50569),
        (0.07094, 0.59711, 0.88151, 0.26015),
        (1.42744, 1.10803, -0.73594, 0.06868),
    ),
}
FAST_NM = {len(nm): nm for nm in FITTED}  # by their number


@cache
def cie_1931() -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths (nm, [471]) and the CIE 1931 2 degree colour matching functions x, y, z there ([471, 3])."""
    return _frozen(_data()["cie_1931_nm"]), _frozen(_data()["cie_1931"])


@cache
def xyz_to_srgb() -> np.ndarray:
    """The [3, 3] matrix from CIE XYZ to linear sRGB (IEC 61966-2-1)."""
    return _frozen(_data()["xyz_to_srgb"])


WHITES = {"D65": (0.3127, 0.3290), "ACES": (0.32168, 0.33767)}
# xy of red, green, blue, and the white: ITU-R BT.2020-2, table 3; ACES, S-2014-004.
RGB_SPACES = {
    "rec2020": (((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)), "D65"),
    "acescg": (((0.713, 0.293), (0.165, 0.830), (0.128, 0.044)), "ACES"),
}
# Cone responses of Lam 1985, known as Bradford's.
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def white_xyz(xy: tuple[float, float]) -> np.ndarray:
    """XYZ [3] of luminance 1 with the chromaticity xy."""
    x, y = xy
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


def adaptation(source: Any, target: Any) -> np.ndarray:
    """[3, 3]: XYZ of a colour under the white ``source`` to those of the corresponding colour under ``target`` (both
    XYZ [3]), by von Kries' rule with Bradford's cones; a white of any luminance keeps it."""
    source, target = (np.asarray(w, float) / w[1] for w in (source, target))
    gain = (_BRADFORD @ target) / (_BRADFORD @ source)
    return np.linalg.solve(_BRADFORD, gain[:, None] * _BRADFORD)


@cache
def xyz_to_rgb(space: str) -> np.ndarray:
    """The [3, 3] matrix from CIE XYZ to linear ``srgb``, ``rec2020`` or ``acescg``.

    XYZ are under D65, the white of the first two; ACEScg has a white of its own, to which they are adapted, so that
    what is grey in one space is grey in all. Raises InputError for another name.
    """
    if space == "srgb":
        return xyz_to_srgb()
    if space not in RGB_SPACES:
        raise InputError(f"space: is {space!r}; must be one of srgb, {', '.join(RGB_SPACES)}")
    primaries, white = RGB_SPACES[space]
    columns = np.stack([white_xyz(xy) for xy in primaries], axis=-1)
    to_xyz = columns * np.linalg.solve(columns, white_xyz(WHITES[white]))
    return _frozen(np.linalg.inv(to_xyz) @ adaptation(white_xyz(WHITES["D65"]), white_xyz(WHITES[white])))


@cache
def _smooth_solar() -> tuple[np.ndarray, np.ndarray]:
    """ASTM G173-03 extraterrestrial irradiance at whole nanometres, as a running mean over SMOOTHING_NM."""
    data = _data()["astm_g173"]
    step = 0.5  # the finest sampling in the data
    fine = np.arange(SOLAR_RANGE_NM[0], SOLAR_RANGE_NM[1] + step, step)
    integral = np.concatenate([[0.0], np.cumsum(np.convolve(np.interp(fine, *data.T), [0.5, 0.5], "valid") * step)])
    nm = np.arange(SOLAR_RANGE_NM[0], SOLAR_RANGE_NM[1] + 1.0)
    low = np.clip(nm - SMOOTHING_NM / 2, *SOLAR_RANGE_NM)
    high = np.clip(nm + SMOOTHING_NM / 2, *SOLAR_RANGE_NM)
    return _frozen(nm), _frozen((np.interp(high, fine, integral) - np.interp(low, fine, integral)) / (high - low))


def solar_irradiance(wavelengths_nm: Any) -> np.ndarray:
    """Sunlight at the top of the Earth's atmosphere (W m^-2 nm^-1) at any wavelengths (nm), mean distance.

    ASTM G173-03 extraterrestrial, running mean over 10 nm, linear in between; 0 outside of 280-4000 nm. Shape as given.
    """
    nm, values = _smooth_solar()
    return np.interp(np.asarray(wavelengths_nm, dtype=np.float64), nm, values, left=0.0, right=0.0)


def interpolation_weights(wavelengths_nm: Any, at_nm: Any) -> np.ndarray:
    """Weights h [N, W] that interpolate W values, given in any order, to the N wavelengths ``at_nm``.

    Linear in lambda^-4 between neighbours, held constant outside; each row sums to 1 and none is negative. Of
    wavelengths given twice the first counts.
    """
    knots = np.asarray(wavelengths_nm, dtype=np.float64)
    points = np.asarray(at_nm, dtype=np.float64)
    order = np.unique(knots, return_index=True)[1][::-1]  # ascending in lambda^-4
    x, xk = points**-4.0, knots[order] ** -4.0
    weights = np.zeros((len(points), len(knots)))
    for i, k in enumerate(order):
        weights[:, k] = np.interp(x, xk, np.eye(len(order))[i])
    return weights


@dataclass(frozen=True, eq=False)
class SpectralBasis:
    """The linear map from W values of radiance to a spectrum, to XYZ and to linear sRGB (see the module's text).

    ``wavelengths_nm`` [W]; ``solar_irradiance`` [W], W m^-2 nm^-1.

    >>> basis = SpectralBasis.of("earth")
    >>> basis.srgb_matrix.shape
    (3, 3)
    """

    wavelengths_nm: np.ndarray
    solar_irradiance: np.ndarray

    @classmethod
    def of(cls, atmosphere: Any) -> SpectralBasis:
        """The basis of an atmosphere (or of anything ``Atmosphere.load`` takes)."""
        from .atmosphere import Atmosphere

        atmosphere = Atmosphere.load(atmosphere)
        return cls(atmosphere.wavelengths_nm, atmosphere.solar_irradiance)

    @property
    def grid_nm(self) -> np.ndarray:
        """Whole nanometres that cover the visible range and the atmosphere's wavelengths."""
        low = min(VISIBLE_NM[0], np.floor(self.wavelengths_nm.min()))
        high = max(VISIBLE_NM[1], np.ceil(self.wavelengths_nm.max()))
        return np.arange(low, high + 1.0)

    def sun(self, at_nm: Any) -> np.ndarray:
        """E(lambda): the solar spectrum (W m^-2 nm^-1) that passes through the atmosphere's own values."""
        at_nm = np.asarray(at_nm, dtype=np.float64)
        own = self.solar_irradiance
        if np.ptp(own) == 0.0:
            return np.full(at_nm.shape, own[0])
        reference = solar_irradiance(self.wavelengths_nm)
        if not np.all(reference > 0.0):  # beyond the reference spectrum there is no shape to follow
            return interpolation_weights(self.wavelengths_nm, at_nm) @ own
        return solar_irradiance(at_nm) * (interpolation_weights(self.wavelengths_nm, at_nm) @ (own / reference))

    def matrix(self, at_nm: Any) -> np.ndarray:
        """B [N, W]: radiance at the N wavelengths ``at_nm`` = B @ radiance at the atmosphere's wavelengths."""
        own = self.solar_irradiance
        inverse = np.divide(1.0, own, out=np.zeros_like(own), where=own > 0.0)
        return self.sun(at_nm)[:, None] * interpolation_weights(self.wavelengths_nm, at_nm) * inverse

    @property
    def fitted(self) -> np.ndarray | None:
        """The matrix [3, W] of :data:`FITTED` in the order of these wavelengths; None where there is none, or no
        sunlight of known shape."""
        given = tuple(np.sort(self.wavelengths_nm).tolist())
        if given not in FITTED or np.ptp(self.solar_irradiance) == 0.0:
            return None
        return np.array(FITTED[given])[:, np.searchsorted(given, self.wavelengths_nm)]

    @property
    def xyz_matrix(self) -> np.ndarray:
        """[3, W]: CIE XYZ of a radiance, normalised as in Mitsuba (row 1, Y, is what a mono variant shows)."""
        if self.fitted is not None:
            own = self.solar_irradiance
            brightness = np.mean(own / solar_irradiance(self.wavelengths_nm))
            return brightness * self.fitted * np.divide(1.0, own, out=np.zeros_like(own), where=own > 0.0)
        nm, functions = cie_1931()
        return functions.T @ self.matrix(nm) / functions[:, 1].sum()

    def rgb_matrix(self, space: str = "srgb", white: Any = None) -> np.ndarray:
        """[3, W]: linear colours (``srgb``, ``rec2020``, ``acescg``) of a radiance, normalised as in Mitsuba.

        Saturated light can be negative in a channel. ``white``: light [W] that shall look white, the sunlight at noon
        for instance; None: no white balance, D65 is white. Raises InputError for another space.
        """
        xyz = self.xyz_matrix
        if white is not None:
            xyz = adaptation(xyz @ np.asarray(white, dtype=np.float64), white_xyz(WHITES["D65"])) @ xyz
        return xyz_to_rgb(space) @ xyz

    @property
    def srgb_matrix(self) -> np.ndarray:
        """[3, W]: linear sRGB of a radiance (:meth:`rgb_matrix`)."""
        return self.rgb_matrix()

    def to_srgb(self, radiance: Any) -> np.ndarray:
        """Linear sRGB [..., 3] of radiance [..., W]."""
        return self.to_rgb(radiance)

    def to_rgb(self, radiance: Any, space: str = "srgb", white: Any = None) -> np.ndarray:
        """Linear colours [..., 3] of radiance [..., W] (:meth:`rgb_matrix`)."""
        return np.asarray(radiance, dtype=np.float64) @ self.rgb_matrix(space, white).T


def _frozen(values: Any) -> np.ndarray:
    """A float64 copy that cannot be changed, for values that are cached."""
    result = np.array(values, dtype=np.float64)
    result.flags.writeable = False
    return result
