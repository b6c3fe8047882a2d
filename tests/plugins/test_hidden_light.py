"""Light that shapes keep from the air of later orders: against path-traced air, and the steps by which its table is
made."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
import pytest
from towers import DUST, HAZE, LOW_SUN, SUN, passes, shaded, tiles
from ztests import of_passes

THICK = {**HAZE, "mie": {**HAZE["mie"], "scattering_per_m": [3e-4]}}


@pytest.mark.parametrize(
    ("orders", "grey", "air", "sun", "share"),
    [
        (2, 0.0, DUST, LOW_SUN, 1 / 16),
        pytest.param(3, 0.0, DUST, LOW_SUN, 1 / 16, marks=pytest.mark.slow),
        pytest.param(None, 0.4, DUST, LOW_SUN, 1 / 16, marks=pytest.mark.slow),
        pytest.param(None, 0.2, THICK, SUN, 1 / 8, marks=pytest.mark.slow),
    ],
    ids=["two", "three", "all", "haze"],
)
def test_scattered_light_is_shaded_like_that_of_path_traced_air(plugins, orders, grey, air, sun, share):
    """Dust in which a low sun's beam is spent: nearly all light is of order 2 and more, and the towers hide where it
    comes from also where they cast no shadow. In thick haze their shadow is many free paths long."""
    mi.set_variant("llvm_ad_mono")
    scenes = [shaded(f"atmosphere_{name}", orders, grey, air=air, sun=sun) for name in ("path", "volpath")]
    samples = (16, 128) if orders else (128, 1024)
    own, truth = (of_passes(tiles(passes(scene, 16, n), 8)) for scene, n in zip(scenes, samples, strict=True))
    free = shaded("atmosphere_path", orders, grey, air=air, sun=sun, shaft_samples=0)
    without = tiles(passes(free, 1, 8), 8)[0]
    # Within 3 %, and a share of what shapes take: rays from nodes are few, and at the edge of a sharp shadow, as in
    # haze, light changes from node to node.
    allowed = 0.03 * truth.mean + share * np.maximum(without - truth.mean, 0.0)
    assert np.all(np.abs(own.mean - truth.mean) < allowed + 3.0 * np.sqrt(own.variance + truth.variance))
    # Shapes take light away, in some places most of it, and what is known of it is known well.
    assert np.max(without / truth.mean) > 2.0
    assert np.median(np.sqrt(truth.variance) / truth.mean) < 0.02


def test_light_from_all_directions_is_scattered_in_all(plugins):
    """The same radiance from everywhere stays what it is, whatever scatters it; that of one direction goes on as the
    phase function says."""
    from atmo_jit.plugins import unfolded
    from atmo_jit.plugins.hidden_light import Phases, scatter

    rng = np.random.default_rng(4)
    rows, directions, parts = 10, 40, [(0, 4), (4, 10)]
    full = rng.random((2, directions, unfolded.COUNT)).astype(np.float32)
    full /= full.sum(axis=1, keepdims=True)
    few = rng.random((2, directions, 9)).astype(np.float32)
    low = rng.random((2, 9, unfolded.COUNT)).astype(np.float32)
    low /= (few @ low).sum(axis=1, keepdims=True)
    phases = [Phases([None, few], np.concatenate([full, low], axis=1))]
    shares = rng.random((2, 1, rows, 1)).astype(np.float32)
    shares /= shares.sum(axis=0)
    found = [np.full((rows, unfolded.COUNT), np.nan, dtype=np.float32)]
    scatter(np.full((1, rows, directions), 3.0, dtype=np.float32), phases, shares, parts, found)
    np.testing.assert_allclose(found[0], 3.0, rtol=1e-5)
    one = np.zeros((1, rows, directions), dtype=np.float32)
    one[:, :, 7] = 1.0
    scatter(one, phases, shares, parts, found)
    for row in range(rows):
        s = int(row >= 4)
        expected = shares[0, 0, row] * full[s, 7] + shares[1, 0, row] * (few[s] @ low[s])[7]
        np.testing.assert_allclose(found[0][row], expected, rtol=1e-4)


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
