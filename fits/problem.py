"""The least-squares problem of a fit: residuals of samples and priors, and their derivatives, for a vector of unknowns.

    predicted = calibration x mixing . L(atmosphere, sun zenith + turn, azimuth - turn)
    residual  = (ln predicted - ln measured) / relative sigma,     or (predicted - measured) / sigma

The sum of r^2 / 2 is minimised; with a robust loss that of d^2 (sqrt(1 + (r / d)^2) - 1) (pseudo-Huber): quadratic up
to about d, then linear, so that clouds, masts and what the model cannot follow do not decide. Priors stay quadratic.

Where residuals are larger than sigma it is the model that errs, and its errors are alike at neighbouring directions and
wavelengths: hundreds of samples then count as few. ``excess`` says by how much their weight is lowered against that of
the priors; it is the variance of the residuals over sigma, times the design effect of Kish 1965, Survey Sampling,
section 5.4: how much more the means of parts of the sky, or of wavelengths, scatter than means of independent samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from atmo_jit.wavelengths import at_wavelengths

from .config import FitConfig
from .forward import SkyModel, air_mass
from .observations import Observations
from .parameters import Leaf, Scalar, leaf_of

TURN = np.radians(0.02)  # step of differences by the sun's angles
HUBER = 1.345  # robust scale at which a Gaussian sample loses 5 % of its worth (Huber 1964)
SKY_PARTS = (3, 6)  # in zenith angle and azimuth: directions at which the model's errors are taken to be alike
LEAST = 1e-30  # of a predicted radiance whose logarithm is taken


@dataclass(frozen=True)
class Evaluation:
    """At one point: ``predicted`` [N, C]; ``raw`` residuals [N, C] over sigma, NaN where no sample is in use;
    ``jacobian`` [M, P] by u of those in use and then of the priors, without the loss, None if it is not known."""

    predicted: np.ndarray
    raw: np.ndarray
    jacobian: np.ndarray | None = None


class Problem:
    """Unknowns ``scalars``: those of the atmosphere's leaves, then the nuisances of every scan.

    ``huber``: d of the loss, infinite for plain least squares. ``excess``: variance of a sample in units of sigma^2.
    """

    def __init__(
        self,
        config: FitConfig,
        data: Observations,
        model: SkyModel,
        leaves: tuple[Leaf, ...],
        huber: float = np.inf,
        excess: float = 1.0,
    ) -> None:
        self.config, self.data, self.model, self.leaves = config, data, model, leaves
        self.huber, self.excess = huber, excess
        self._last: dict[Any, Any] = {}
        self._nuisances = _nuisances(config, data)
        self.scalars = (*(s for leaf in leaves for s in leaf.scalars), *(n.scalar for n in self._nuisances))
        self.logarithmic = config.residual == "log"
        self._used = data.used
        self._measured = np.log(np.maximum(data.radiance, LEAST)) if self.logarithmic else data.radiance
        self._sigma = np.where(self._used, data.sigma / data.radiance if self.logarithmic else data.sigma, np.nan)

    @classmethod
    def of(cls, config: FitConfig, data: Observations) -> Problem:
        """The problem of a configuration whose atmosphere is at the observations' wavelengths."""
        leaves = tuple(leaf_of(config.atmosphere, name, spec) for name, spec in config.free.items())
        spectral = tuple(x.name for x in leaves if np.ndim(x.values(_starts(x))) or x.name.endswith(".g"))
        others = tuple(leaf.name for leaf in leaves if leaf.name not in spectral)
        views = data.altitude_m, data.view_zenith
        model = SkyModel(config.atmosphere, *views, config.tolerance, spectral, others, air_mass(data))
        return cls(config, data, model, leaves)

    def with_loss(self, huber: float, excess: float) -> Problem:
        """The same with another loss and weight of the samples."""
        other = Problem(self.config, self.data, self.model, self.leaves, huber, excess)
        other._last = self._last
        return other

    def part(
        self, rows: np.ndarray, channels: np.ndarray | None = None, tolerance: float | None = None
    ) -> Problem:
        """The same for some of the samples, and some of the wavelengths, with another tolerance of the sky."""
        data, air, leaves = self.data.part(rows), self.model.atmosphere, self.leaves
        if channels is not None:
            air = at_wavelengths(air, data.wavelengths_nm[channels])
            data, leaves = data.channels(channels), tuple(leaf.at(channels) for leaf in leaves)
        return Problem(self.config, data, self.model.at(data, air, tolerance), leaves, self.huber, self.excess)

    def spread(self, part: Problem, u: np.ndarray) -> np.ndarray:
        """u of all scalars from that of a part's; those of other wavelengths are interpolated."""
        known = dict(zip((s.name for s in part.scalars), u, strict=True))
        families: dict[str, list[tuple[float, float]]] = {}
        for scalar in part.scalars:
            if scalar.wavelength_nm is not None:
                families.setdefault(scalar.family, []).append((scalar.wavelength_nm, known[scalar.name]))
        found = []
        for scalar in self.scalars:
            if scalar.name not in known:
                nm, values = zip(*sorted(families[scalar.family]), strict=True)
                known[scalar.name] = float(np.interp(scalar.wavelength_nm, nm, values))
            found.append(known[scalar.name])
        return np.array(found)

    def gathered(self, part: Problem, u: np.ndarray) -> np.ndarray:
        """u of a part's scalars from that of all."""
        known = dict(zip((s.name for s in self.scalars), u, strict=True))
        return np.array([known[s.name] for s in part.scalars])

    @property
    def start(self) -> np.ndarray:
        """u of the starting values."""
        return np.array([s.inner(s.start) for s in self.scalars])

    def values(self, u: np.ndarray) -> np.ndarray:
        """The scalars' values."""
        return np.array([s.value(x) for s, x in zip(self.scalars, u, strict=True)])

    def atmosphere_values(self, u: np.ndarray) -> dict[str, Any]:
        """Values of the atmosphere under their dotted names."""
        v, found, first = self.values(u), {}, 0
        for leaf in self.leaves:
            found[leaf.name] = leaf.values(v[first : first + len(leaf.scalars)])
            first += len(leaf.scalars)
        return found

    def evaluate(self, u: np.ndarray) -> Evaluation:
        """What is predicted at u, and how far it is from the data."""
        return Evaluation(*self._kept("raw", u, self._raw))

    def residuals(self, u: np.ndarray) -> np.ndarray:
        """Residuals [M] over sigma of the samples in use, then those of the priors."""
        priors = [s.prior_residual(u[i])[0] for i, s in self._with_prior]
        return np.concatenate([self.evaluate(u).raw[self._used], priors])

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Derivatives [M, P] of :meth:`residuals` by u."""
        below = np.zeros((len(self._with_prior), len(self.scalars)))
        for row, (i, scalar) in zip(below, self._with_prior, strict=True):
            row[i] = scalar.prior_residual(u[i])[1]
        return np.concatenate([self._kept("jacobian", u, self._raw_jacobian), below])

    def loss(self, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The loss of each of M residuals, its slope and its curvature."""
        count = len(residuals) - len(self._with_prior)
        samples, priors = residuals[:count], residuals[count:]
        parts = [v / self.excess for v in _pseudo_huber(samples, self.huber)]
        return tuple(
            np.concatenate(v) for v in zip(parts, (0.5 * priors**2, priors, np.ones_like(priors)), strict=True)
        )

    @property
    def _with_prior(self) -> list[tuple[int, Scalar]]:
        return [(i, s) for i, s in enumerate(self.scalars) if np.isfinite(s.prior_sigma)]

    def _kept(self, what: str, u: np.ndarray, make: Callable[[np.ndarray], Any]) -> Any:
        """What ``make`` returns at u on the nodes in use; the last few are kept for problems that share samples."""
        key = what, u.tobytes(), self.model.layout_number
        if key not in self._last:
            while len(self._last) >= 6:
                self._last.pop(next(iter(self._last)))
            self._last[key] = make(u)
        return self._last[key]

    def _raw(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        v, values = self.values(u), self.atmosphere_values(u)
        factor, sun_zenith, azimuth = self._geometry_of(v)
        predicted = factor * self._mixed(self.model.radiance(values, sun_zenith, azimuth))
        return predicted, (self._compared(predicted) - self._measured) / self._sigma

    def _raw_jacobian(self, u: np.ndarray) -> np.ndarray:
        v, values = self.values(u), self.atmosphere_values(u)
        factor, sun_zenith, azimuth = self._geometry_of(v)
        predicted, _ = self._kept("raw", u, self._raw)
        columns = np.zeros((np.count_nonzero(self._used), len(self.scalars)))
        scale = 1.0 / (np.maximum(predicted, LEAST) * self._sigma) if self.logarithmic else 1.0 / self._sigma
        slopes = np.array([s.slopes(x)[0] for s, x in zip(self.scalars, u, strict=True)])
        by_leaf = self.model.derivatives(values, sun_zenith, azimuth)
        first = 0
        for leaf in self.leaves:
            v_leaf = v[first : first + len(leaf.scalars)]
            for k, spread in enumerate(leaf.slopes(v_leaf)):
                change = factor * self._mixed(by_leaf[leaf.name] * spread)
                columns[:, first + k] = (scale * change)[self._used]
            first += len(leaf.scalars)
        turned = self._turned(values, sun_zenith, azimuth)
        for i, nuisance in enumerate(self._nuisances, first):
            if nuisance.kind.endswith("calibration"):
                change = predicted / v[i]
            else:
                change = factor * self._mixed(turned[nuisance.kind])
            columns[:, i] = np.where(nuisance.applies, scale * change, 0.0)[self._used]
        return columns * slopes

    def clusters(self) -> list[np.ndarray]:
        """For every sample in use, numbers of its part of the sky (SKY_PARTS) and scan, and of its channel and scan."""
        data = self.data
        row, channel = np.nonzero(self._used)
        zeniths, azimuths = SKY_PARTS
        up = np.clip((1.0 - np.cos(data.view_zenith)) * zeniths, 0, zeniths - 1).astype(int)
        around = ((data.azimuth % (2.0 * np.pi)) / (2.0 * np.pi) * azimuths).astype(int) % azimuths
        part = (data.scan * zeniths + up) * azimuths + around
        return [part[row], data.scan[row] * data.radiance.shape[1] + channel]

    def geometry(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Calibration [N, C], zenith angle of the sun and azimuth from it [N] (radians) at u."""
        return self._geometry_of(self.values(u))

    def _geometry_of(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Calibration [N, C], sun zenith and azimuth [N] with the nuisances in them."""
        data = self.data
        factor, zenith, azimuth = np.ones(data.radiance.shape), data.sun_zenith.copy(), data.azimuth.copy()
        first = len(self.scalars) - len(self._nuisances)
        for nuisance, value in zip(self._nuisances, v[first:], strict=True):
            if nuisance.kind.endswith("calibration"):
                factor = np.where(nuisance.applies, factor * value, factor)
            elif nuisance.kind == "sun_zenith":
                zenith = zenith + np.where(nuisance.applies[:, 0], np.radians(value), 0.0)
            else:
                azimuth = azimuth - np.where(nuisance.applies[:, 0], np.radians(value), 0.0)
        over = zenith < 0.0  # past the zenith: the same direction from the other side
        return factor, np.clip(np.abs(zenith), 0.0, np.pi), np.where(over, azimuth + np.pi, azimuth)

    def _turned(self, values: dict[str, Any], zenith: np.ndarray, azimuth: np.ndarray) -> dict[str, np.ndarray]:
        """Derivatives [N, W] of radiance by turns of the sun, per degree, by kind."""
        kinds = sorted({n.kind for n in self._nuisances if not n.kind.endswith("calibration")})
        turns = []
        for kind, sign in product(kinds, (1.0, -1.0)):
            by = (sign * TURN, 0.0) if kind == "sun_zenith" else (0.0, sign * TURN)
            turns.append((np.abs(zenith + by[0]), azimuth - by[1]))
        ends = self.model.turned(values, turns) if turns else []
        return {
            kind: (ends[2 * i] - ends[2 * i + 1]) / (2.0 * np.degrees(TURN)) for i, kind in enumerate(kinds)
        }

    def _mixed(self, light: np.ndarray) -> np.ndarray:
        return light if self.data.mixing is None else light @ self.data.mixing.T

    def _compared(self, predicted: np.ndarray) -> np.ndarray:
        return np.log(np.maximum(predicted, LEAST)) if self.logarithmic else predicted


@dataclass(frozen=True)
class _Nuisance:
    """A nuisance of one scan: ``applies`` bool [N, C] to which samples."""

    kind: str
    scalar: Scalar
    applies: np.ndarray


def _nuisances(config: FitConfig, data: Observations) -> list[_Nuisance]:
    found = []
    for kind, spec in config.nuisance.items():
        for scan in range(data.scans):
            here = np.broadcast_to((data.scan == scan)[:, None], data.radiance.shape)
            label = kind if data.scans == 1 else f"{kind}[scan {scan}]"
            if kind == "spectral_calibration":
                names = data.wavelengths_nm if data.mixing is None else np.arange(float(len(data.mixing)))
                for c, nm in enumerate(names):
                    alone = here & (np.arange(data.radiance.shape[1]) == c)
                    name = f"{label}[{nm:g} nm]" if data.mixing is None else f"{label}[channel {nm:g}]"
                    found.append(_Nuisance(kind, replace(_factor(name, spec), wavelength_nm=float(nm)), alone))
            elif kind == "calibration":
                found.append(_Nuisance(kind, _factor(label, spec), here))
            else:
                sigma = spec.get("sigma", np.inf)
                start, widest = spec.get("start", 0.0), 180.0 if kind == "sun_azimuth" else 30.0
                low, high = spec.get("min", start - widest), spec.get("max", start + widest)
                scalar = Scalar(label, start, low, high, start, sigma, 1.0, nuisance=True)
                found.append(_Nuisance(kind, scalar, here))
    return found


def _factor(label: str, spec: dict[str, Any]) -> Scalar:
    start = spec.get("start", 1.0)
    sigma = spec.get("sigma", np.inf)
    scale = min(sigma, 1.0)
    return Scalar(label, start, prior=start, prior_sigma=sigma, scale=scale, positive=True, nuisance=True)


def _starts(leaf: Leaf) -> np.ndarray:
    return np.array([s.start for s in leaf.scalars])


def _pseudo_huber(r: np.ndarray, d: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """d^2 (sqrt(1 + (r / d)^2) - 1), its slope, and its curvature or half of that of the parabola that touches it from
    above, whichever is more: steps then do not go astray among outliers."""
    if not np.isfinite(d):
        return 0.5 * r**2, r, np.ones_like(r)
    root = np.sqrt(1.0 + (r / d) ** 2)
    return r**2 / (root + 1.0), r / root, np.maximum(root**-3.0, 0.5 / root)


def without_darkness(data: Observations) -> Observations:
    """The samples whose logarithm can be taken."""
    with np.errstate(invalid="ignore"):
        return replace(data, radiance=np.where(data.radiance > 0.0, data.radiance, np.nan))
