r"""Phase functions: how scattered light is distributed over directions.

``value(nu)`` is the density per steradian at the cosine ``nu`` of the scattering angle (1 = straight on); its
integral over the sphere is 1. ``moments(L)`` are the Legendre moments chi_0 .. chi_L of

    p(nu) = sum_l (2 l + 1) / (4 pi) chi_l P_l(nu),        chi_l = 2 pi int p(nu) P_l(nu) dnu,     chi_0 = 1.

Shapes. ``nu`` may be a float, a NumPy array of any shape S or a Dr.Jit array.

==================  ======================  ======================  =================================
g                   value, NumPy nu         value, Dr.Jit nu        moments(L)
==================  ======================  ======================  =================================
none, or a number   S                       Dr.Jit array            float64 [L + 1]
``[W]`` numbers     S + (W,)                list of W Dr.Jit arrays float64 [L + 1, W]
Dr.Jit array        Dr.Jit array            Dr.Jit array            list of L + 1 Dr.Jit arrays
==================  ======================  ======================  =================================

``at(w)`` is the phase function of the wavelength with index w, whose g is one number. The constructors validate and
raise :class:`~atmo_jit.errors.AtmosphereError`; a Dr.Jit ``g`` is taken as it is, since it may carry a gradient.

>>> from atmo_jit.phase import HenyeyGreenstein
>>> HenyeyGreenstein(0.5).moments(2).tolist()
[1.0, 0.5, 0.25]
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._arrays import asarray, is_drjit, module_of, piecewise_linear
from ._fields import ANY, MISSING, NOT_NEGATIVE, Range, mapping, number, numbers, per_wavelength
from .errors import AtmosphereError, shown, within

ASYMMETRY = Range(-1, 1, low_open=True, high_open=True)
COSINE = Range(-1, 1)


class _OneParameter:
    """What the two analytic peaks share: ``g``, a number, a float64 array [W] or a Dr.Jit array."""

    type: str
    g: Any

    def __post_init__(self) -> None:
        if is_drjit(self.g):
            return
        several = isinstance(self.g, (list, tuple)) or (isinstance(self.g, np.ndarray) and self.g.ndim == 1)
        g = numbers(self.g, "g", ASYMMETRY) if several else number(self.g, "g", ASYMMETRY)
        if np.any(np.abs(np.float32(g)) == 1.0):
            raise AtmosphereError("g", shown(self.g), "a finite number in (-1, 1), in single precision too")
        if several:
            g.flags.writeable = False
        object.__setattr__(self, "g", g)

    def at(self, wavelength: int) -> Any:
        """The phase function at the wavelength with this index."""
        return type(self)(float(self.g[wavelength])) if isinstance(self.g, np.ndarray) else self

    def value(self, nu: Any) -> Any:
        """Density (1/sr) at the cosine ``nu`` of the scattering angle."""
        if isinstance(self.g, np.ndarray) and is_drjit(nu):
            return [self._density(nu, float(g)) for g in self.g]
        if is_drjit(self.g):
            return self._density(nu, self.g)
        nu = asarray(nu)
        return self._density(nu[..., None] if isinstance(self.g, np.ndarray) else nu, self.g)

    def prepared(self) -> Callable[[Any], Any]:
        """``value`` of a Dr.Jit ``g``, with what depends on that alone computed once, and not at every look-up."""
        constants = self._constants(self.g)
        if not module_of(self.g).grad_enabled(constants):
            module_of(self.g).eval(constants)
        return lambda nu: self._with(constants, nu, self.g)

    def _density(self, nu: Any, g: Any) -> Any:
        return self._with(self._constants(g), nu, g)

    def _constants(self, g: Any) -> tuple[Any, ...]:
        """Scale, |g| and (1 - |g|)^2."""
        size = abs(g)
        return self._scale(g), size, (1.0 - size) * (1.0 - size)

    def _with(self, constants: tuple[Any, ...], nu: Any, g: Any) -> Any:
        """The density: its divisor is (1 + g^2 - 2 g nu)^(3/2), without the cancellation that costs float32 its digits
        in a sharp forward (or backward) peak."""
        xp, (scale, size, gap) = module_of(nu, g), constants
        from_peak = xp.fma(-g, nu, size) if xp is not np else size - g * nu
        squared = 2.0 * from_peak + gap
        return scale * self._weight(nu) / (squared * xp.sqrt(squared))

    def moments(self, order: int) -> Any:
        """Legendre moments chi_0 .. chi_order (see the module's table of shapes)."""
        chi = self._moments(order)
        return chi if is_drjit(self.g) else np.stack(chi)

    def to_dict(self) -> dict[str, Any]:
        """The ``phase`` object of the JSON."""
        return {"type": self.type, "g": self.g.tolist() if isinstance(self.g, np.ndarray) else self.g}


@dataclass(frozen=True, eq=False)
class HenyeyGreenstein(_OneParameter):
    """(1 - g^2) / (4 pi (1 + g^2 - 2 g nu)^(3/2)), chi_l = g^l. Henyey and Greenstein 1941, eq. 2."""

    g: Any
    type = "henyey_greenstein"

    def _scale(self, g: Any) -> Any:
        return 0.25 / math.pi * (1.0 - g * g)

    def _weight(self, nu: Any) -> Any:
        return 1.0

    def _moments(self, order: int) -> list[Any]:
        return _powers(self.g, order)


@dataclass(frozen=True, eq=False)
class CornetteShanks(_OneParameter):
    """3 (1 - g^2) (1 + nu^2) / (8 pi (2 + g^2) (1 + g^2 - 2 g nu)^(3/2)); g = 0 is Rayleigh's.

    Cornette and Shanks 1992, Physically reasonable analytic expression for the single-scattering phase function.

    It is 3 (1 + nu^2) / (2 (2 + g^2)) times Henyey-Greenstein's, so its moments follow from g^l by applying "times
    nu" twice: 2 pi int nu f P_l = ((l + 1) f_(l+1) + l f_(l-1)) / (2 l + 1). The mean cosine is 3 g (4 + g^2) / (5 (2
    + g^2)), not g.
    """

    g: Any
    type = "cornette_shanks"

    def _scale(self, g: Any) -> Any:
        return 0.375 / math.pi * (1.0 - g * g) / (2.0 + g * g)

    def _weight(self, nu: Any) -> Any:
        return 1.0 + nu * nu

    def _moments(self, order: int) -> list[Any]:
        peak = _powers(self.g, order + 2)
        squared = _times_cosine(_times_cosine(peak))
        scale = 1.5 / (2.0 + self.g * self.g)
        # chi_0 is 1 whatever g is; computing it would only add rounding (and a derivative that is not exactly 0).
        return [peak[0], *(scale * (peak[n] + squared[n]) for n in range(1, order + 1))]


@dataclass(frozen=True)
class RayleighPhase:
    """3 (1 + nu^2) / (16 pi): chi_0 = 1, chi_2 = 1/10, all others 0.

    Molecules without anisotropy: Chandrasekhar 1950, Radiative Transfer, chapter I.
    """

    def at(self, wavelength: int) -> RayleighPhase:
        """The same at every wavelength."""
        return self

    def value(self, nu: Any) -> Any:
        """Density (1/sr) at the cosine ``nu`` of the scattering angle."""
        nu = asarray(nu)
        return 3.0 / (16.0 * math.pi) * (1.0 + nu * nu)

    def moments(self, order: int) -> np.ndarray:
        """Legendre moments chi_0 .. chi_order, float64 [order + 1]."""
        return _padded([1.0, 0.0, 0.1], order)

    def to_dict(self) -> dict[str, Any]:
        """The ``phase`` object of the JSON."""
        return {"type": "rayleigh"}


@dataclass(frozen=True)
class Isotropic:
    """1 / (4 pi) in every direction: chi_0 = 1, all others 0."""

    def at(self, wavelength: int) -> Isotropic:
        """The same at every wavelength."""
        return self

    def value(self, nu: Any) -> Any:
        """Density (1/sr) at the cosine ``nu`` of the scattering angle."""
        return type(nu)(0.25 / math.pi) if is_drjit(nu) else np.full(np.shape(nu), 0.25 / math.pi)

    def moments(self, order: int) -> np.ndarray:
        """Legendre moments chi_0 .. chi_order, float64 [order + 1]."""
        return _padded([1.0], order)

    def to_dict(self) -> dict[str, Any]:
        """The ``phase`` object of the JSON."""
        return {"type": "isotropic"}


@dataclass(frozen=True, eq=False)
class TabulatedPhase:
    """Linear in the cosine between samples, held beyond them, scaled so that its integral over the sphere is 1.

    ``cos_theta`` ascends strictly within [-1, 1]; ``values`` are >= 0 in any unit and not all 0. After construction
    ``values`` hold the normalised densities (1/sr).
    """

    cos_theta: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        cosine = numbers(self.cos_theta, "cos_theta", COSINE, least=2)
        values = numbers(self.values, "values", NOT_NEGATIVE, least=2)
        if len(cosine) != len(values):
            allowed = f"as many numbers as cos_theta has ({len(cosine)})"
            raise AtmosphereError("values", f"a list of {len(values)}", allowed)
        for i in np.flatnonzero(np.diff(cosine) <= 0) + 1:
            found = f"{cosine[i]:g} after {cosine[i - 1]:g}"
            raise AtmosphereError(f"cos_theta[{i}]", found, "strictly ascending cosines")
        if not values.any():
            raise AtmosphereError("values", "only zeros", "at least one number > 0")
        values = values / values.max()  # so that no sum of huge or tiny values overflows
        knots, ends = _with_ends(cosine, values)
        values = values / (2.0 * math.pi * float(np.sum(np.diff(knots) * (ends[1:] + ends[:-1]) / 2.0)))
        cosine.flags.writeable = values.flags.writeable = False
        object.__setattr__(self, "cos_theta", cosine)
        object.__setattr__(self, "values", values)

    def at(self, wavelength: int) -> TabulatedPhase:
        """The same at every wavelength."""
        return self

    def value(self, nu: Any) -> Any:
        """Density (1/sr) at the cosine ``nu`` of the scattering angle."""
        return piecewise_linear(nu, self.cos_theta, self.values)

    def moments(self, order: int) -> np.ndarray:
        """Legendre moments chi_0 .. chi_order, float64 [order + 1].

        Exact up to rounding: on each linear segment the integrand is a polynomial of degree order + 1.
        """
        knots, values = _with_ends(self.cos_theta, self.values)
        x, weight = np.polynomial.legendre.leggauss(order // 2 + 2)
        half = np.diff(knots)[:, None] / 2.0
        nu = knots[:-1, None] + half * (1.0 + x)
        density = values[:-1, None] + np.diff(values)[:, None] * (1.0 + x) / 2.0
        legendre = np.polynomial.legendre.legvander(nu.ravel(), order)
        chi = 2.0 * math.pi * (half * weight * density).ravel() @ legendre
        chi[0] = 1.0
        return chi

    def to_dict(self) -> dict[str, Any]:
        """The ``phase`` object of the JSON, with normalised values."""
        return {"type": "tabulated", "cos_theta": self.cos_theta.tolist(), "values": self.values.tolist()}


@dataclass(frozen=True, eq=False)
class LegendrePhase:
    """sum_l (2 l + 1) / (4 pi) chi_l P_l(nu) with the given ``coefficients`` chi_l: chi_0 = 1 and abs(chi_l) <= 1.

    (The JSON calls them ``moments``, which here is the method that serves any order.) Where a truncated series
    dips below 0, it is 0: no light is negative. Light that scatters more than once has its moments as given.
    """

    coefficients: np.ndarray

    def __post_init__(self) -> None:
        chi = numbers(self.coefficients, "moments", ANY)
        if chi[0] != 1.0:
            raise AtmosphereError("moments[0]", f"{chi[0]:.17g}", "chi_0 = 1 (the phase function integrates to 1)")
        for i in np.flatnonzero(np.abs(chi) > 1.0):
            raise AtmosphereError(f"moments[{i}]", f"{chi[i]:.17g}", "a finite number in [-1, 1]")
        chi.flags.writeable = False
        object.__setattr__(self, "coefficients", chi)

    def at(self, wavelength: int) -> LegendrePhase:
        """The same at every wavelength."""
        return self

    def value(self, nu: Any) -> Any:
        """Density (1/sr) at the cosine ``nu`` of the scattering angle, by Clenshaw's recurrence."""
        nu = asarray(nu)
        after = after_next = 0.0 * nu
        for n in range(len(self.coefficients) - 1, 0, -1):
            series = (2 * n + 1) * float(self.coefficients[n])
            after, after_next = series + (2 * n + 1) / (n + 1) * nu * after - (n + 1) / (n + 2) * after_next, after
        return module_of(nu).maximum((1.0 + nu * after - after_next / 2.0) * (0.25 / math.pi), 0.0)

    def moments(self, order: int) -> np.ndarray:
        """The moments chi_0 .. chi_order, float64 [order + 1], 0 beyond those given."""
        return _padded(self.coefficients, order)

    def to_dict(self) -> dict[str, Any]:
        """The ``phase`` object of the JSON."""
        return {"type": "legendre", "moments": self.coefficients.tolist()}


Phase = CornetteShanks | HenyeyGreenstein | RayleighPhase | Isotropic | TabulatedPhase | LegendrePhase

# JSON type -> the keys beside `type` and how they make the phase function.
TYPES: dict[str, tuple[tuple[str, ...], Callable[..., Any]]] = {
    "cornette_shanks": (("g",), CornetteShanks),
    "henyey_greenstein": (("g",), HenyeyGreenstein),
    "rayleigh": ((), RayleighPhase),
    "isotropic": ((), Isotropic),
    "tabulated": (("cos_theta", "values"), TabulatedPhase),
    "legendre": (("moments",), LegendrePhase),
}


def phase_from_dict(phase: Any, wavelengths: int) -> Phase:
    """The phase function of a JSON ``phase`` object; ``g`` may be a list of as many numbers as ``wavelengths``.

    Raises :class:`~atmo_jit.errors.AtmosphereError` naming the field below the constituent (``phase.g``).
    """
    kinds = f"one of {', '.join(TYPES)}"
    if not isinstance(phase, Mapping):
        raise AtmosphereError("phase", shown(phase), f"an object whose type is {kinds}")
    kind = phase.get("type")
    if not isinstance(kind, str) or kind not in TYPES:
        raise AtmosphereError("phase.type", shown(kind) if "type" in phase else MISSING, kinds)
    keys, make = TYPES[kind]
    mapping(phase, "phase", ("type", *keys))
    with within("phase"):
        if "g" in keys and not np.isscalar(phase["g"]):
            per_wavelength(phase["g"], "g", wavelengths, ASYMMETRY)
        return make(*(phase[key] for key in keys))


def _powers(g: Any, order: int) -> list[Any]:
    """g^0 .. g^order by products: exact at g = 0, and differentiable there."""
    powers = [type(g)(1.0) if is_drjit(g) else np.ones(np.shape(g))]
    for _ in range(order):
        powers.append(powers[-1] * g)
    return powers


def _times_cosine(moments: Sequence[Any]) -> list[Any]:
    """Moments of nu f(nu) from those of f; one fewer, since order l needs l + 1."""
    result = [moments[1]]
    for n in range(1, len(moments) - 1):
        result.append(((n + 1) * moments[n + 1] + n * moments[n - 1]) / (2 * n + 1))
    return result


def _padded(moments: Sequence[float] | np.ndarray, order: int) -> np.ndarray:
    chi = np.zeros(order + 1)
    kept = min(order + 1, len(moments))
    chi[:kept] = moments[:kept]
    return chi


def _with_ends(cosine: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The table with its ends held out to -1 and 1 (segments of length 0 where it already reaches them)."""
    return np.concatenate(([-1.0], cosine, [1.0])), np.concatenate((values[:1], values, values[-1:]))
