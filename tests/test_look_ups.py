"""Look-ups by cells against the plain loop over one look-up, and their derivatives both ways."""

import copy

import drjit as dr
import numpy as np
import pytest
from tolerances import ADJOINT

import atmo_jit
from atmo_jit import look_ups
from atmo_jit.backend import floats, traversing, types
from atmo_jit.harmonics import Harmonics

COUNT = 1000


@pytest.fixture(scope="module")
def field():
    return atmo_jit.Sky("earth").bands[0].field


def places(field, seed):
    """Altitudes, sun, view and azimuth cosines, of look-ups in few and in many cells."""
    rng = np.random.default_rng(seed)
    crowded = rng.random(COUNT) < 0.5
    altitude = np.where(crowded, 1000.0, rng.uniform(0.0, 6e4, COUNT))
    sun = np.where(crowded, 0.5, rng.uniform(-0.1, 1.0, COUNT))
    return [floats(v) for v in (altitude, sun, rng.uniform(-1.0, 1.0, COUNT), rng.uniform(-1.0, 1.0, COUNT))]


@pytest.fixture
def small(monkeypatch):
    """Borders of chunks and batches within cells."""
    monkeypatch.setattr(look_ups, "BATCH", 300)
    monkeypatch.setattr(look_ups, "CHUNK", 16)


def test_sums_are_those_of_single_look_ups(field):
    where, active = places(field, 0), types().Bool(np.arange(COUNT) % 7 > 0)
    plain = [v.numpy() for kind in field.unclipped(*where, active) for v in kind]
    given = [types().Float(v) for v in where]
    dr.enable_grad(given)
    with traversing():
        by_cells = [dr.detach(v).numpy() for kind in field.unclipped(*given, active) for v in kind]
    for one, other in zip(by_cells, plain, strict=True):
        assert one == pytest.approx(other, rel=1e-5, abs=float(1e-6 * np.abs(plain).max()))


def test_both_ways(field, small):
    """<J v, w> = <v, J' w> by moments, phase moments and weights of corners, and J v is the change along v."""
    t, rng = types(), np.random.default_rng(1)
    altitude, sun, mu, cos_phi = places(field, 1)
    moments, phases, recurrences = (dr.detach(v) for v in field._tables[0])
    nodes, weights, _ = field.corners(altitude, sun, True)
    cells, (channels, kinds) = t.UInt(nodes[0]), (field.optics.channel_count, len(field._groups[0][1]))
    weights = [[t.Float(w) for _ in range(channels)] for w in weights]
    active = t.Bool(np.arange(COUNT) % 5 > 0)

    def sums(moments, phases, weights):
        basis = Harmonics(mu, cos_phi, slopes=True)
        places = field.grid, field.degree, channels, kinds, cells, basis, recurrences, active
        return look_ups.LookUps(*places)(moments, phases, weights)[0]

    leaves = [moments, phases, *(w for of_corner in weights for w in of_corner)]

    def of(leaves):
        flat = leaves[2:]
        return sums(leaves[0], leaves[1], [flat[i : i + channels] for i in range(0, len(flat), channels)])

    steps = [floats(rng.normal(size=len(v)) * v.numpy()) for v in leaves]
    with traversing():
        given = [t.Float(v) for v in leaves]
        dr.enable_grad(given)
        found = of(given)
        for leaf, step in zip(given, steps, strict=True):
            dr.set_grad(leaf, step)
        dr.enqueue(dr.ADMode.Forward, *given)
        dr.traverse(dr.ADMode.Forward)
        forward = [v.numpy().astype(float) for v in dr.grad(found)]
        given = [t.Float(v) for v in leaves]
        dr.enable_grad(given)
        found, cotangents = of(given), [floats(rng.normal(size=COUNT)) for _ in found]
        for value, cotangent in zip(found, cotangents, strict=True):
            dr.set_grad(value, cotangent)
        dr.enqueue(dr.ADMode.Backward, *found)
        dr.traverse(dr.ADMode.Backward)
        backward = [v.numpy().astype(float) for v in dr.grad(given)]
    # Trilinear: a central difference is off by the product of all three steps alone.
    size = 1e-2
    ends = [
        [v.numpy().astype(float) for v in of([a + sign * size * b for a, b in zip(leaves, steps, strict=True)])]
        for sign in (1.0, -1.0)
    ]
    for moved, high, low in zip(forward, *ends, strict=True):
        assert moved == pytest.approx((high - low) / (2.0 * size), rel=2e-3, abs=2e-3 * np.abs(moved).max())
    ahead = sum(np.vdot(a, c.numpy()) for a, c in zip(forward, cotangents, strict=True))
    products = [a * b.numpy() for a, b in zip(backward, steps, strict=True)]
    scale = np.sqrt(sum(float(np.sum(p**2)) for p in products))
    assert ahead == pytest.approx(sum(float(np.sum(p)) for p in products), abs=ADJOINT * scale)


def test_what_is_not_active_sends_nothing_back(field, small):
    where = places(field, 2)
    one = copy.copy(field)
    for made in ("_tables", "_refined_moments"):
        one.__dict__.pop(made, None)
    one.moments = types().Float(field.moments)
    dr.enable_grad(one.moments)
    with traversing():
        one.prepare()
        values = [v for kind in one.unclipped(*where, types().Bool(np.zeros(COUNT, bool))) for v in kind]
        dr.backward(sum(values))
    assert not np.any(dr.grad(one.moments).numpy())
