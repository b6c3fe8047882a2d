"""Tables of Hillaire's layout and of powers: values against the solution."""

from __future__ import annotations

import json

import numpy as np
import pytest

from atmo_jit.backend import doubles
from atmo_jit.errors import InputError
from atmo_jit.export import Options, export
from atmo_jit.export.containers import read_exr
from atmo_jit.export.hillaire import AERIAL, multiple_scattering
from atmo_jit.mapping import Hillaire
from atmo_jit.solved import Sky


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hillaire")
    export("earth", "hillaire", folder, Options(sun_zenith_deg=40.0, altitude_m=500.0))
    return folder


def test_sizes_and_files(folder):
    shapes = {"transmittance": (64, 256, 3), "multi_scattering": (32, 32, 3), "sky_view": (108, 192, 3)}
    for name, shape in (shapes | {"aerial_perspective": (*AERIAL, 4)}).items():
        table = np.load(folder / f"{name}.npy")
        assert table.shape == shape and table.dtype == np.float32 and np.all(table >= 0.0)
        assert np.array_equal(read_exr(folder / f"{name}.exr").ravel(), table.astype(np.float16).ravel())


def test_transmittance_to_the_zenith(folder, earth):
    """Texels without a half-texel remap, the first column looks up: closed forms of the three columns."""
    table = np.load(folder / "transmittance.npy").astype(float)
    to = Hillaire(6_360_000.0, 6_420_000.0)
    h, mu = to.transmittance_inverse((np.arange(64) + 0.5) / 64, np.full(64, 0.5 / 256))
    rayleigh = 8e3 * (np.exp(-h / 8e3) - np.exp(-60e3 / 8e3))
    depth = np.outer(rayleigh, earth["rayleigh"]["scattering_per_m"])
    depth += np.outer(1.2e3 * (np.exp(-h / 1.2e3) - np.exp(-60e3 / 1.2e3)), np.full(3, 3.996e-6 / 0.9))
    x = (np.clip(h, 10e3, 40e3) - 25e3) / 15e3
    ozone = 15e3 * (0.5 - x * (1 - np.abs(x) / 2))
    depth += np.outer(ozone, earth["ozone"]["absorption_per_m"])
    assert -np.log(table[:, 0]) * mu[:, None] == pytest.approx(depth, rel=0.02, abs=2e-4)


def test_multiple_scattering_is_the_mean_over_directions(folder):
    """The table against radiance of the sky and ground averaged over directions, sun apart."""
    sky = Sky("earth")
    table = multiple_scattering(sky, Hillaire(6_360_000.0, 6_420_000.0))
    i, j = 2, 28
    h, mu_s = 60e3 * i / 31, 2 * j / 31 - 1
    edge = -np.sqrt(h * (2 * 6.36e6 + h)) / (6.36e6 + h)
    x, w = np.polynomial.legendre.leggauss(24)
    mu = np.concatenate([edge + (1 - edge) * (x + 1) / 2, -1 + (1 + edge) * (x + 1) / 2])
    w = np.concatenate([(1 - edge) * w, (1 + edge) * w]) / 4
    phi = np.pi * (np.arange(24) + 0.5) / 24
    a, b = (v.ravel() for v in np.meshgrid(mu, phi, indexing="ij"))
    views = [doubles(v) for v in (np.full(a.shape, h), np.full(a.shape, np.arccos(mu_s)), np.arccos(a), b)]
    radiance = np.stack([v.numpy() for v in sky.rays(*views).radiance], axis=-1).reshape(48, 24, 3)
    exact = np.einsum("vpc,v->c", radiance, w) / 24 / sky.atmosphere.solar_irradiance
    assert table[i, j] == pytest.approx(exact, rel=0.02)


def test_sky_view_and_slices_are_the_solution(folder):
    estimate = json.loads((folder / "params.json").read_text())["metadata"]["errorEstimate"]["skyView"]
    assert estimate["median"] < 1e-3 and estimate["p99"] < 0.02
    aerial = np.load(folder / "aerial_perspective.npy")
    assert np.all(np.diff(aerial[:, 8, 16, 3]) < 0.0) and np.all(np.diff(aerial[:, 8, 16, 2]) > 0.0)


def test_powers(tmp_path):
    report = export("earth", "power3d", tmp_path, Options(size=(16, 32, 16), precision="float"))
    assert read_exr(tmp_path / "horizon.exr").dtype == np.float32
    assert np.load(tmp_path / "power.npy").shape == (16, 32, 16, 4)
    assert all(e["median"] < 0.1 for e in report.error.values())
    with pytest.raises(InputError, match="three whole numbers"):
        export("earth", "power3d", tmp_path, Options(size=(16, 32)))
    with pytest.raises(InputError, match="no such choice"):
        export("earth", "power3d", tmp_path, Options(mu_s_min=-0.2))
