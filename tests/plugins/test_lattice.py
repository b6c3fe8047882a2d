"""Where the light that shapes keep from the air is known: nodes, and interpolation between them by chance."""

from __future__ import annotations

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


def test_nodes_are_dense_near_shapes(lattice):
    """On a level axis more of them lie within the block's own width of it than its share of the length, and gaps grow
    with the distance."""
    for axis, (first, last) in enumerate([(100.0, 500.0), (100.0, 300.0)]):
        at, wide = lattice._low[axis] + lattice.lines[axis], last - first
        near = np.mean((at > first - wide) & (at < last + wide))
        assert near > 1.3 * 3.0 * wide / lattice._size[axis]
        gaps = np.diff(at)
        assert gaps.max() > 2.0 * gaps.min() and gaps.argmax() in (0, len(gaps) - 1)


def test_shadows_are_among_the_nodes(plugins):
    """Of a low sun in thin air: the shadow is long, but no longer than light goes."""
    from atmo_jit.plugins.globe import Globe
    from atmo_jit.plugins.lattice import FREE_PATHS, Lattice

    mi.set_variant("llvm_ad_mono")
    block = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 250]).scale([50, 50, 250])}
    scene = mi.load_dict({"type": "scene", "block": block})
    air = atmo_jit.Atmosphere.load("earth")
    globe = Globe(air, np.array([0.0, 0.0, -air.bottom_radius_m]), 1.0)
    sun = np.array([0.995, 0.0, 0.1])
    for reach, expected in ((1e5, 500.0 * 9.95), (1e3, FREE_PATHS * 1e3)):
        nodes = Lattice(scene, globe, 500.0, sun / np.linalg.norm(sun), reach, 3)
        p = nodes._axes.T @ nodes._low[:2]
        assert p[0] == pytest.approx(-expected - 50.0, rel=0.02)
