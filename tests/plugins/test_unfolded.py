"""Directions of the square that an octahedron unfolds to: interpolation by chance, and values that it flattens less."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

SAMPLES = 1 << 17


def drawn(count: int) -> mi.Sampler:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, count)
    return sampler


def test_the_mean_of_directions_interpolates(plugins):
    from atmo_jit.plugins import unfolded

    mi.set_variant("llvm_ad_mono")
    nodes = unfolded.directions()
    assert np.allclose(np.linalg.norm(nodes, axis=1), 1.0)
    for d in np.random.default_rng(1).normal(size=(12, 3)):
        d /= np.linalg.norm(d)
        lane = dr.zeros(mi.Vector3f, SAMPLES) + mi.Vector3f(*map(float, d))
        chosen = np.array(unfolded.node(lane, drawn(SAMPLES), mi.Bool(True)))
        mean = nodes[chosen].mean(axis=0)
        assert len(np.unique(chosen)) <= 4
        assert mean / np.linalg.norm(mean) @ d > np.cos(np.radians(1.5))


def test_a_constant_stays_when_it_is_sharpened(plugins):
    from atmo_jit.plugins import unfolded

    np.testing.assert_allclose(unfolded.sharpened(np.full((2, unfolded.COUNT), 3.0)), 3.0, rtol=1e-12)


@pytest.mark.parametrize("edge", [0, -1])
def test_a_smooth_function_is_hardly_changed_across_an_edge(plugins, edge):
    """Second differences there are as small as elsewhere: neighbours beyond an edge are those of the sphere."""
    from atmo_jit.plugins import unfolded

    d = unfolded.directions()
    value = d @ np.array([0.3, -0.5, 0.8])
    change = np.abs(unfolded.sharpened(value) - value).reshape(unfolded.SIDE, unfolded.SIDE)
    step = 4.0 / unfolded.SIDE
    assert change[edge].max() < step**2 and change[:, edge].max() < step**2


def test_interpolated_peaks_are_as_high_as_they_are(plugins):
    """Henyey and Greenstein's of g = 0.775, averaged over where its axis lies between nodes: plain values would make
    its top a fifth too low."""
    from atmo_jit.phase import HenyeyGreenstein
    from atmo_jit.plugins import unfolded

    mi.set_variant("llvm_ad_mono")
    rng, phase = np.random.default_rng(0), HenyeyGreenstein(0.775)
    axes = rng.normal(size=(256, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    plain = np.asarray(phase.value(np.clip(axes @ unfolded.directions().T, -1.0, 1.0)))
    lane = np.repeat(np.arange(len(axes)), 64)
    sampler = drawn(len(lane))
    errors = []
    for degrees in (0.0, 5.0, 10.0, 20.0, 40.0, 90.0):
        across = np.cross(axes, rng.normal(size=axes.shape))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        angle = np.radians(degrees)
        d = (np.cos(angle) * axes + np.sin(angle) * across)[lane]
        chosen = np.array(unfolded.node(mi.Vector3f(*(mi.Float(v) for v in d.T)), sampler, mi.Bool(True)))
        expected = float(phase.value(np.cos(angle)))
        errors.append([values[lane, chosen].mean() / expected - 1.0 for values in (plain, unfolded.sharpened(plain))])
    errors = np.array(errors)
    assert errors[0, 0] < -0.15
    assert np.abs(errors[:, 1]).max() < 0.08
