"""What a fit begins with: some of the samples, starting values, and a look at whether the data can be fitted at all."""

from __future__ import annotations

import numpy as np

from atmo_jit.errors import InputError
from atmo_jit.optics import MAX_CHANNELS

from .forward import ROUGH
from .kept import Point
from .observations import Observations
from .problem import Problem

FEW = 128  # samples (directions) that the first steps look at, or
FEW_EACH = 32  # of each scan, or
FEW_FOLD = 8  # as many times the unknowns, whichever is most
UNIT_FACTOR = 30.0  # between data and sky at the start, from which on the units are suspected


def starting_points(whole: Problem) -> list[np.ndarray]:
    """The start, then logarithmic scalars ten times larger and smaller and the others in the middle of their ranges."""
    points = [whole.start]
    for factor in (10.0, 0.1, 1.0):
        middle = [
            s.inner(s.start * factor) if s.logarithmic and not s.nuisance else 0.0 if s.bounded else s.inner(s.start)
            for s in whole.scalars
        ]
        points.append(np.array(middle))
    return points


def few_of(whole: Problem) -> Problem:
    """The problem for some directions, and as many wavelengths as are solved at once."""
    rows = _some(whole.data, max(FEW, FEW_EACH * whole.data.scans, FEW_FOLD * len(whole.scalars)))
    count = len(whole.data.wavelengths_nm)
    if whole.data.mixing is not None or count <= MAX_CHANNELS:
        return whole.part(rows, tolerance=max(whole.config.tolerance, ROUGH))
    order = np.argsort(whole.data.wavelengths_nm)
    channels = np.sort(order[np.linspace(0, count - 1, MAX_CHANNELS).round().astype(int)])
    return whole.part(rows, channels, max(whole.config.tolerance, ROUGH))


def _some(data: Observations, count: int) -> np.ndarray:
    """At most ``count`` rows, spread evenly over the order of the data, as many of each scan as it has part."""
    total = len(data.radiance)
    if total <= 2 * count:
        return np.arange(total)
    rows = np.sort(np.random.default_rng(0).permutation(total)[:count])
    missing = [int(np.flatnonzero(data.scan == s)[0]) for s in range(data.scans) if not np.any(data.scan[rows] == s)]
    return np.union1d(rows, np.array(missing, int))


def check_count(problem: Problem, samples: int) -> None:
    unknowns = sum(not np.isfinite(s.prior_sigma) for s in problem.scalars)
    if samples < max(unknowns, 1):
        raise InputError(
            f"observations: {samples} samples for {unknowns} unknowns without a prior; needed are at least {unknowns}"
        )


def check_units(problem: Problem) -> None:
    """Raise InputError where data and sky are so far apart, with and without aerosol, that the unit must be wrong."""
    if any(s.positive and s.prior_sigma > 1.0 for s in problem.scalars):
        return  # the calibration is free: any unit will do
    ratio = np.inf
    for factor in (1.0, 0.1, 10.0):
        u = [s.inner(s.start * (factor if s.logarithmic and not s.nuisance else 1.0)) for s in problem.scalars]
        predicted = problem.evaluate(np.array(u)).predicted[problem.data.used]
        found = float(np.median(problem.data.radiance[problem.data.used] / np.maximum(predicted, 1e-30)))
        ratio = min(ratio, found, key=lambda r: abs(np.log(max(r, 1e-30))))
        if 1.0 / UNIT_FACTOR < ratio < UNIT_FACTOR:
            return
    raise InputError(
        f"radiance: is {ratio:.3g} times that of the sky with the starting values; must be in W m^-2 sr^-1 nm^-1, "
        "as solar_irradiance in W m^-2 nm^-1 (or 1/sr where that is 1)"
    )


def fits(point: Point, few: Problem, whole: Problem) -> bool:
    """Whether the numbers of unknowns are those of the problem."""
    here = len(whole.scalars) if point.step else len(few.scalars)
    counts = {len(point.nodes) - here, len(point.u) - here, *(len(end) - len(few.scalars) for end in point.ends)}
    return counts == {0} and (len(point.ends) > 0 if point.step else len(point.ends) < len(starting_points(few)))
