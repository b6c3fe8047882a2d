"""Statistical tests of noisy pictures: Z-tests against a stored mean and variance, with a bound for all pixels
together.

A test that compares N noisy numbers must not fail by chance because N is large. With Sidak's correction each of the N
two-sided Z-tests is made at the level 1 - (1 - alpha)^(1/N), so that all of them together fail with probability alpha
if the picture is right. (Z. Sidak 1967, J. Am. Stat. Assoc. 62, 626; Mitsuba's own rendering tests do the same.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

# Probability that a correct picture fails. Seeds are fixed, so a test that passes once passes always.
ALPHA = 0.01


@dataclass(frozen=True)
class Estimate:
    """A picture with the variance of each of its numbers (of the mean, not of a sample), arrays of one shape."""

    mean: np.ndarray
    variance: np.ndarray

    def save(self, path) -> None:
        """Store in an NPZ file (single precision)."""
        np.savez_compressed(path, mean=self.mean.astype(np.float32), variance=self.variance.astype(np.float32))

    def with_mean(self, mean: np.ndarray, share: float) -> Estimate:
        """A new estimate of the same numbers from ``share`` times as many samples, with the variance that this one
        knows better.
        """
        return Estimate(np.asarray(mean, dtype=np.float64), self.variance / share)

    @classmethod
    def load(cls, path) -> Estimate:
        """Read what :meth:`save` stored."""
        with np.load(path) as file:
            return cls(file["mean"].astype(np.float64), file["variance"].astype(np.float64))


def of_passes(passes: np.ndarray) -> Estimate:
    """The estimate from independent passes [K, ...] of equal size."""
    passes = np.asarray(passes, dtype=np.float64)
    return Estimate(passes.mean(axis=0), passes.var(axis=0, ddof=1) / len(passes))


def limit(count: int, alpha: float = ALPHA) -> float:
    """The abs(z) that the largest of ``count`` standard normal numbers exceeds with probability ``alpha``."""
    return NormalDist().inv_cdf(1.0 - 0.5 * -math.expm1(math.log1p(-alpha) / count))


def z_scores(one: Estimate, other: Estimate) -> np.ndarray:
    """Difference over its standard error; 0 where both are exact and equal, infinite where exact and different."""
    spread = np.sqrt(one.variance + other.variance)
    difference = one.mean - other.mean
    exact = np.where(difference == 0.0, 0.0, np.inf)
    return np.divide(difference, spread, out=exact, where=spread > 0.0)


def assert_agree(one: Estimate, other: Estimate, alpha: float = ALPHA) -> None:
    """Raise AssertionError where two estimates differ by more than chance allows, anywhere or on the whole.

    Two tests at half the level each: the largest of all abs(z), and the sum of z over the square root of their
    number, which finds a bias that is too small to show in any single pixel."""
    z = z_scores(one, other).ravel()
    worst = int(np.argmax(np.abs(z)))
    allowed = limit(len(z), alpha / 2.0)
    assert abs(z[worst]) <= allowed, f"number {worst} of {len(z)}: z = {z[worst]:.2f}, allowed {allowed:.2f}"
    together = float(np.sum(z) / math.sqrt(len(z)))
    allowed = limit(1, alpha / 2.0)
    assert abs(together) <= allowed, f"all {len(z)} numbers together: z = {together:.2f}, allowed {allowed:.2f}"
