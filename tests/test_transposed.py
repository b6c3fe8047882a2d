"""The gather's derivatives backwards: the transposed of its sums, <A v, w> = <v, A' w>."""

import drjit as dr
import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import floats, traversing
from atmo_jit.gather import Samples, contracted, interpolated
from atmo_jit.grid import Grid
from atmo_jit.paths import directions_at
from atmo_jit.resolution import Resolution
from atmo_jit.visits import Visits

from .tolerances import ADJOINT

RESOLUTION = Resolution()
ORDERS, CHANNELS, DEGREE, AZIMUTHS = 3, 3, 4, 6
ROW = {ORDERS * CHANNELS: 16, CHANNELS: 4}  # floats for which a row of a table has room


@pytest.fixture(scope="module")
def samples():
    grid = Grid.of(atmo_jit.Atmosphere.load("earth"), RESOLUTION)
    return Samples(grid, directions_at(grid, 6, 4), AZIMUTHS)


def both_ways(function, values, seed):
    """<A v, w> and <v, A' w> of a linear function of one Float, in double precision, and the product of their norms."""
    rng = np.random.default_rng(seed)
    with traversing():
        leaf = floats(values)
        dr.enable_grad(leaf)
        result = function(leaf)
        weights = rng.normal(size=dr.width(result)).astype(np.float32)
        dr.set_grad(result, floats(weights))
        dr.enqueue(dr.ADMode.Backward, result)
        dr.traverse(dr.ADMode.Backward)
        adjoint = dr.grad(leaf).numpy().astype(float)
    light = dr.detach(result).numpy().astype(float)
    size = float(np.linalg.norm(weights) * np.linalg.norm(light))
    return np.vdot(light, weights), np.vdot(values.astype(float), adjoint), size


def filled(rng, *shape, width=ORDERS * CHANNELS):
    values = rng.normal(size=(*shape, ROW[width])).astype(np.float32)
    values[..., width:] = 0.0  # what fills a row up
    return values


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("suns", [27, 4])
@pytest.mark.parametrize("degree", [DEGREE, DEGREE + 1])
def test_moments_seen_along_paths(samples, number, suns, degree):
    """By the moments and by the weights of their sum; numbers of suns and rows that lanes share out evenly or not."""
    paths = samples.paths
    rng = np.random.default_rng(1)
    levels = int(paths.level.max()) + 1
    inputs = [filled(rng, levels, suns, degree + 2), filled(rng, len(paths.station), degree + 2, width=CHANNELS)]

    def seen(leaf):
        given = [floats(v) for v in inputs]
        given[number] = leaf
        return contracted(paths, *given, suns, degree, ORDERS, CHANNELS)

    forwards, backwards, size = both_ways(seen, inputs[number], 2)
    assert forwards == pytest.approx(backwards, abs=ADJOINT * size)


def test_radiance_of_a_table(samples):
    """By the table [visits, suns + 1, m x channels] that radiance is interpolated in."""
    rng, visits = np.random.default_rng(3), Visits.of(samples.paths, ORDERS * CHANNELS)
    scale = rng.random((len(visits.place), samples.per_visit, 4)).astype(np.float32)
    table = filled(rng, visits.groups * visits.together, samples.suns + 1)
    forwards, backwards, size = both_ways(
        lambda leaf: interpolated(samples, floats(scale), leaf, ORDERS, CHANNELS), table, 4
    )
    assert forwards == pytest.approx(backwards, abs=ADJOINT * size)
