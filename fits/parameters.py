"""What a fit may change: scalars with bounds and priors, and the atmosphere's values that they stand for.

A :class:`Scalar` is one unknown. Its value v lives between bounds; the optimiser sees u, without bounds:

    z = v or ln v,        t = (z - z_low) / (z_high - z_low),        u = ln(t / (1 - t))

ln v where both bounds are positive and far apart (scattering coefficients), v otherwise; without bounds u = v / scale.
Standard errors and intervals are those of z, which does not stretch at the bounds as u does.

A :class:`Leaf` is one value of the atmosphere (``mie.scattering_per_m``) as a function of one or more scalars:

==================  =======================  =====================================================================
mode                scalars                  values at the wavelengths
==================  =======================  =====================================================================
``scale``           1                        the atmosphere's own spectrum, times a factor; the scalar is the value
                                             at 550 nm (for plain numbers, the number)
``per_wavelength``  W                        free
``angstrom``        2: at 550 nm, exponent   v (lambda / 550 nm)^-exponent (Angstrom 1929)
==================  =======================  =====================================================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import InputError

MODES = ("scale", "per_wavelength", "angstrom")
REFERENCE_NM = 550.0
FAR_APART = 50.0  # ratio of bounds from which on a scalar is fitted on a logarithmic scale
FARTHEST = 200.0  # of z without bounds
EDGE = 1e-3  # part of the range that starts keep from the bounds, and within which a result is at a bound
# Bounds where none are given, by the last part of the dotted name; None: a hundredth and a hundred times the start.
BOUNDS: dict[str, tuple[float, float] | None] = {
    "scattering_per_m": (1e-9, 1e-2),
    "absorption_per_m": None,
    "single_scattering_albedo": (0.3, 1.0),
    "g": (-0.9, 0.98),
    "ground_albedo": (0.0, 1.0),
    "exponent": (-2.0, 5.0),
}


@dataclass(frozen=True)
class Scalar:
    """One unknown: ``start``; bounds ``low`` and ``high`` (infinite: none); a Gaussian prior of mean ``prior`` and
    standard deviation ``prior_sigma`` (infinite: none); ``scale`` measures unbounded ones. ``positive``: a factor,
    fitted and judged by its logarithm, of which the prior holds too. ``wavelength_nm``: of one that belongs to a
    wavelength."""

    name: str
    start: float
    low: float = -np.inf
    high: float = np.inf
    prior: float = 0.0
    prior_sigma: float = np.inf
    scale: float = 1.0
    positive: bool = False
    nuisance: bool = False
    wavelength_nm: float | None = None

    @property
    def family(self) -> str:
        """The name without the wavelength."""
        return self.name.rpartition("[")[0] if self.wavelength_nm is not None else self.name

    @property
    def logarithmic(self) -> bool:
        """Whether z is ln v."""
        return self.positive or (self.low > 0.0 and np.isfinite(self.high) and self.high / self.low > FAR_APART)

    @property
    def bounded(self) -> bool:
        """Whether there are two bounds."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))

    def _z(self, value: float) -> float:
        return float(np.log(value)) if self.logarithmic else value

    def inner(self, value: float) -> float:
        """u of a value; values at or beyond a bound are first put a little inside."""
        if not self.bounded:
            return self._z(value) / self.scale
        low, high = self._z(self.low), self._z(self.high)
        clipped = min(max(value, self.low), self.high)
        t = float(np.clip((self._z(clipped) - low) / (high - low), EDGE, 1.0 - EDGE))
        return float(np.log(t / (1.0 - t)))

    def value(self, u: float) -> float:
        """v of u."""
        if self.bounded:
            low, high = self._z(self.low), self._z(self.high)
            z = low + (high - low) / (1.0 + np.exp(-np.clip(u, -40.0, 40.0)))
        else:
            z = float(np.clip(u * self.scale, -FARTHEST, FARTHEST))
        return float(np.exp(z)) if self.logarithmic else float(z)

    def slopes(self, u: float) -> tuple[float, float]:
        """dv/du and dz/du."""
        if self.bounded:
            t = 1.0 / (1.0 + np.exp(-np.clip(u, -40.0, 40.0)))
            dz = (self._z(self.high) - self._z(self.low)) * t * (1.0 - t)
        else:
            dz = self.scale
        return (self.value(u) * dz if self.logarithmic else dz), dz

    def prior_residual(self, u: float) -> tuple[float, float]:
        """(z - prior) / prior_sigma and its derivative by u; z for factors, v for others. Zeros without a prior."""
        if not np.isfinite(self.prior_sigma):
            return 0.0, 0.0
        dv, dz = self.slopes(u)
        if self.positive:
            return (np.log(self.value(u)) - np.log(self.prior)) / self.prior_sigma, dz / self.prior_sigma
        return (self.value(u) - self.prior) / self.prior_sigma, dv / self.prior_sigma

    def interval(self, value: float, error: float, deviations: float = 1.959964) -> tuple[float, float]:
        """The interval of ``deviations`` standard errors (of v) about a value, inside the bounds."""
        if self.logarithmic:
            width = np.exp(np.clip(deviations * error / value, 0.0, 700.0))
            ends = value / width, value * width
        else:
            ends = value - deviations * error, value + deviations * error
        return float(np.clip(ends[0], self.low, self.high)), float(np.clip(ends[1], self.low, self.high))

    def at_bound(self, value: float) -> str | None:
        """"low" or "high" if the value is within EDGE of a bound's end of the range."""
        if not self.bounded:
            return None
        low, high = self._z(self.low), self._z(self.high)
        t = (self._z(value) - low) / (high - low)
        return "low" if t <= EDGE else "high" if t >= 1.0 - EDGE else None


@dataclass(frozen=True)
class Leaf:
    """A value of the atmosphere under its dotted ``name`` as a function of ``scalars``. ``shape`` [W]: spectrum of a
    value in mode ``scale``; None for a plain number."""

    name: str
    mode: str
    scalars: tuple[Scalar, ...]
    wavelengths_nm: np.ndarray
    shape: np.ndarray | None

    def at(self, channels: np.ndarray) -> Leaf:
        """The leaf at some of the wavelengths."""
        scalars = tuple(self.scalars[c] for c in channels) if self.mode == "per_wavelength" else self.scalars
        shape = None if self.shape is None else self.shape[channels]
        return Leaf(self.name, self.mode, scalars, self.wavelengths_nm[channels], shape)

    def values(self, v: np.ndarray) -> Any:
        """The value [W], or a number, for the scalars' values ``v``."""
        if self.mode == "per_wavelength":
            return v.copy()
        if self.mode == "angstrom":
            return v[0] * (self.wavelengths_nm / REFERENCE_NM) ** -v[1]
        return float(v[0]) if self.shape is None else v[0] * self.shape

    def slopes(self, v: np.ndarray) -> np.ndarray:
        """Derivatives of :meth:`values` by the scalars: [scalars, W], or [1] for a number."""
        if self.mode == "per_wavelength":
            return np.eye(len(v))
        if self.mode == "angstrom":
            power = (self.wavelengths_nm / REFERENCE_NM) ** -v[1]
            return np.stack([power, -v[0] * power * np.log(self.wavelengths_nm / REFERENCE_NM)])
        return np.ones(1) if self.shape is None else self.shape[None, :]


def leaf_of(atmosphere: Atmosphere, name: str, spec: dict[str, Any]) -> Leaf:
    """The leaf of an entry of ``[free]`` for an atmosphere.

    spec: ``mode``, ``start``, ``min``, ``max``, ``prior`` (default: the start), ``prior_sigma``, and the same in
    ``exponent`` (an object) for mode "angstrom"; all optional. A number or a list of W, where the mode is
    "per_wavelength". Raises InputError for values that are not allowed.
    """
    count = len(atmosphere.wavelengths_nm)
    current = atmosphere.get(name)
    last = name.rpartition(".")[2]
    spectral = isinstance(current, np.ndarray) and current.shape == (count,)
    if not spectral and np.ndim(current):
        raise InputError(f"free.{name}: is a list of {len(current)} values; numbers and spectra can be free")
    # A number that may be one per wavelength (phase.g) stays a number unless a spectrum is asked for.
    mode = spec.get("mode", "scale")
    if mode not in MODES:
        raise InputError(f"free.{name}: mode is {mode!r}; must be one of {', '.join(MODES)}")
    if mode != "scale" and not spectral and last != "g":
        raise InputError(f"free.{name}: mode is {mode!r}; for a plain number it must be 'scale'")
    own = np.full(count, float(np.mean(current))) if not spectral else np.asarray(current)
    if mode == "per_wavelength":
        scalars = tuple(
            _scalar(f"{name}[{nm:g} nm]", last, {**spec, **_at(spec, w, count, name)}, float(own[w]), name, float(nm))
            for w, nm in enumerate(atmosphere.wavelengths_nm)
        )
        return Leaf(name, mode, scalars, atmosphere.wavelengths_nm, None)
    order = np.argsort(atmosphere.wavelengths_nm)
    reference = float(np.interp(REFERENCE_NM, atmosphere.wavelengths_nm[order], own[order]))
    first = _scalar(name, last, spec, reference, name)
    if mode == "angstrom":
        exponent = spec.get("exponent", {})
        exponent = {"start": exponent} if isinstance(exponent, (int, float)) else exponent
        second = _scalar(f"{name}.exponent", "exponent", exponent, 1.0, f"{name}.exponent")
        return Leaf(name, mode, (first, second), atmosphere.wavelengths_nm, None)
    shape = None
    if spectral:
        shape = own / reference if reference > 0.0 else np.ones(count)
        if np.ptp(shape) > 0.0 and last in ("single_scattering_albedo", "ground_albedo"):  # no value above 1
            top = 1.0 / float(shape.max())
            if first.start > top:
                raise InputError(f"free.{name}: start is {first.start:g}; must be at most {top:g}, all of it within 1")
            first = Scalar(**{**vars(first), "high": min(first.high, top)})
    return Leaf(name, mode, (first,), atmosphere.wavelengths_nm, shape)


def _at(spec: dict[str, Any], w: int, count: int, name: str) -> dict[str, Any]:
    """The entries of ``spec`` that are lists, at wavelength ``w``."""
    found = {}
    for key in ("start", "min", "max", "prior", "prior_sigma"):
        if isinstance(spec.get(key), list):
            if len(spec[key]) != count:
                raise InputError(f"free.{name}: {key} has {len(spec[key])} values; must have {count}, or be one number")
            found[key] = spec[key][w]
    return found


def _scalar(
    label: str, kind: str, spec: dict[str, Any], own: float, name: str, wavelength_nm: float | None = None
) -> Scalar:
    """A scalar with the bounds of its kind where none are given."""

    def read(key: str, default: float) -> float:
        value = spec.get(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
            raise InputError(f"free.{name}: {key} is {value!r}; must be a finite number")
        return float(value)

    start = read("start", own)
    bounds = BOUNDS.get(kind)
    if bounds is None:
        if not start > 0.0 and not ("min" in spec and "max" in spec):
            raise InputError(f"free.{name}: starts at {start:g}; needs min and max, or a start > 0")
        bounds = (0.01 * start, 100.0 * start)
    low, high = read("min", min(bounds[0], start)), read("max", max(bounds[1], start))
    if not low < high:
        raise InputError(f"free.{name}: min is {low:g} and max is {high:g}; min must be less than max")
    if "start" not in spec:
        start = min(max(start, low), high)
    if not low <= start <= high:
        raise InputError(f"free.{name}: start is {start:g}; must be from {low:g} to {high:g} (min to max)")
    sigma = read("prior_sigma", 0.0) if "prior_sigma" in spec else np.inf
    if not sigma > 0.0:
        raise InputError(f"free.{name}: prior_sigma is {sigma:g}; must be > 0")
    return Scalar(label, start, low, high, read("prior", start), sigma, wavelength_nm=wavelength_nm)
