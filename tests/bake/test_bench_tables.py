"""The peers in ``bench.tables``: how their tables are interpolated, and what they hold at their own nodes."""

from __future__ import annotations

import numpy as np

from atmo_jit.backend import doubles, floats
from atmo_jit.mapping import texels
from bench import tables as bench


def test_interpolation_is_exact_for_products():
    x, y, z = np.meshgrid(texels(4), texels(7), texels(3), indexing="ij")
    values = np.stack([1.0 + 2.0 * x * y - z, x + y * z], axis=-1)
    rng = np.random.default_rng(0)
    u, v, w = rng.random((3, 50))
    found = bench._interpolate(values, u, v, w)
    np.testing.assert_allclose(found, np.stack([1.0 + 2.0 * u * v - w, u + v * w], axis=-1), atol=1e-12)


def test_hillaires_view_is_the_solution_at_its_nodes(earth_sky):
    view = bench.HillaireView(earth_sky, 500.0, 0.8)
    v, u = texels(108)[[5, 30, 80, 100]], texels(192)[[3, 60, 120, 190]]
    mu, cos_phi, _ = view.to.sky_view_inverse(np.full(4, 500.0), v, u)
    zenith, azimuth = np.arccos(mu), np.arccos(cos_phi)
    exact = earth_sky.rays(*map(doubles, (np.full(4, 500.0), np.full(4, 0.8), zenith, azimuth))).radiance
    for a, b in zip(view.radiance(floats(zenith), floats(azimuth)), exact, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=2e-3)


def test_rows_are_told_in_one_line_each(earth_sky):
    rows = list(bench.froxels(earth_sky, "earth"))[:1]
    assert "froxels" in bench.line(rows[0]) and "worst" in bench.line(rows[0])
    assert "ms CPU" in bench.line({"what": "a", "where": "b", "wall_ms": 1.0, "cpu_ms": 2.0})
