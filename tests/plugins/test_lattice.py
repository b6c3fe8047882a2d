"""Where the light that shapes keep from the air is known: nodes, interpolation between them by chance, and what stands
for nodes inside shapes."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import atmo_jit

SAMPLES = 1 << 17


@pytest.fixture
def lattice(plugins):
    """Over one block, half a kilometre high."""
    from atmo_jit.plugins.globe import Globe
    from atmo_jit.plugins.lattice import Lattice

    mi.set_variant("llvm_ad_mono")
    block = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([300, 200, 250]).scale([200, 100, 250])}
    scene = mi.load_dict({"type": "scene", "block": block})
    air = atmo_jit.Atmosphere.load("earth")
    globe = Globe(air, np.array([0.0, 0.0, -air.bottom_radius_m]), 1.0)
    return Lattice(scene, globe, 500.0, np.array([0.6, 0.0, 0.8]), 1e4, 3)


def drawn(count: int) -> mi.Sampler:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, count)
    return sampler


@pytest.mark.parametrize("place", [(310.0, 180.0, 90.0), (100.0, -200.0, 700.0), (480.0, 390.0, 20.0)])
def test_the_mean_of_nodes_interpolates(lattice, place):
    """In the coordinate that nodes are even in, between the nearest nodes on both sides."""
    from atmo_jit.plugins.lattice import BINS

    p = mi.Point3f(*(mi.Float(v) for v in place)) + dr.zeros(mi.Point3f, SAMPLES)
    h = lattice._globe.altitude(p)
    node, inside = lattice.node(p, h, drawn(SAMPLES), mi.Bool(True))
    assert dr.all(inside)
    index = np.unravel_index(np.array(node), lattice.shape)
    low = np.array(lattice._low)
    q, _ = lattice._globe.relative(p)
    level = [float(dr.dot(q, mi.Vector3f(*map(float, axis)))[0]) for axis in lattice._axes]
    for axis, at in enumerate([*level, float(h[0])]):
        line = low[axis] + lattice.lines[axis]
        used = np.unique(index[axis])
        assert len(used) == 2 and line[used[0]] <= at <= line[used[1]] and used[1] == used[0] + 1
        share = np.mean(index[axis] == used[1])
        steps = np.array(lattice._warps)[axis * (BINS + 1) : (axis + 1) * (BINS + 1)]
        x = np.interp(at, low[axis] + lattice._size[axis] * np.linspace(0.0, 1.0, BINS + 1), steps) - 0.5
        assert share == pytest.approx(x - used[0], abs=0.01)


def test_places_outside_are_told(lattice):
    far = float(np.max(lattice._size)) * 2.0
    p = mi.Point3f([0.0, far, 0.0], [0.0, 0.0, far], [10.0, 10.0, 10.0])
    _, inside = lattice.node(p, lattice._globe.altitude(p), drawn(3), mi.Bool(True))
    assert np.array(inside).tolist() == [True, False, False]


def test_the_mean_of_directions_interpolates(plugins):
    from atmo_jit.plugins.lattice import unfolded_directions, unfolded_node

    mi.set_variant("llvm_ad_mono")
    nodes = unfolded_directions()
    assert np.allclose(np.linalg.norm(nodes, axis=1), 1.0)
    for d in np.random.default_rng(1).normal(size=(12, 3)):
        d /= np.linalg.norm(d)
        lane = dr.zeros(mi.Vector3f, SAMPLES) + mi.Vector3f(*map(float, d))
        chosen = np.array(unfolded_node(lane, drawn(SAMPLES), mi.Bool(True)))
        mean = nodes[chosen].mean(axis=0)
        assert len(np.unique(chosen)) <= 4
        assert mean / np.linalg.norm(mean) @ d > np.cos(np.radians(1.5))


def test_what_stands_for_a_node_is_the_nearest_in_the_air(plugins):
    from atmo_jit.plugins.hidden_light import nearest

    known = np.random.default_rng(2).random((5, 4, 3)) < 0.2
    lines = [np.array([0.0, 1.0, 4.0, 5.0, 9.0]), np.array([0.0, 2.0, 3.0, 7.0]), np.array([0.0, 1.5, 2.0])]
    found = nearest(known, lines).reshape(known.shape)
    there = list(zip(*np.nonzero(known), strict=True))
    for at in itertools.product(*map(range, known.shape)):
        distances = [
            sum(abs(lines[k][a] - lines[k][b]) for k, (a, b) in enumerate(zip(at, to, strict=True))) for to in there
        ]
        stands = np.unravel_index(found[at], known.shape)
        assert known[stands]
        own = sum(abs(lines[k][a] - lines[k][b]) for k, (a, b) in enumerate(zip(at, stands, strict=True)))
        assert own == pytest.approx(min(distances))
