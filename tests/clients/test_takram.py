"""npm's @takram/three-atmosphere, unmodified, in headless Chromium: does it show what our files hold?"""

from __future__ import annotations

import json

import numpy as np
import pytest

from atmo_jit import mapping
from atmo_jit.bake.client import SCATTERING
from atmo_jit.export import TEXELS, Options, export, read, takram
from atmo_jit.export.colour import channels
from atmo_jit.export.containers import read_exr
from atmo_jit.export.family import client_tables
from atmo_jit.export.lookup import packed
from atmo_jit.export.parameters import aerosol
from atmo_jit.solved import Sky
from bench import client
from bench.export import quantiles, truth

pytestmark = pytest.mark.client

NEAR_HORIZON = np.radians(0.1)  # the client's radii in single precision are half a metre wrong


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    reason = client.missing()
    if reason is not None:
        if client.required():
            pytest.fail(reason)
        pytest.skip(reason)
    return {t: export("earth", "takram", tmp_path_factory.mktemp(t), Options(texels=t)).folder for t in TEXELS}


@pytest.fixture(scope="module")
def pixels(exports, tmp_path_factory):
    """Pictures from every container, by "tables/kind/view"."""
    folder = exports["exact"]
    parameters = json.loads((folder / "params.json").read_text())
    del parameters["metadata"]
    tables = read(folder)
    floats = tmp_path_factory.mktemp("float")
    sky = Sky("earth")
    made = client_tables(sky, channels(sky.atmosphere, "samples"), aerosol(sky.atmosphere), takram.MU_S_MIN, SCATTERING)
    sizes = {"transmittance": (256, 64), "irradiance": (64, 16)}
    named = {}
    for name in takram.ROLES:
        packed(getattr(made, takram.TABLE.get(name, name))).tofile(floats / f"{name}.dat")
        first, *rest = name.split("_")
        key = "".join([first, *(word.title() for word in rest), "Texture"])
        named[key] = (f"{name}.dat", *sizes.get(name, (256, 128, 32)))
    common = {"parameters": parameters}
    jobs = {
        "binary": {"format": "binary", "type": "float", "url": "/exact", "snippet": "/exact/atmosphere_lookup.glsl"},
        "exr": {"format": "exr", "type": "half", "url": "/exact"},
        "raw": {"float": named, "url": "/floats"},
        "fitted": {"format": "binary", "type": "float", "url": "/fitted"},
        "shipped": {"format": "binary", "type": "float", "url": "/shipped"},
    }
    folders = {**exports, "floats": floats, "shipped": client.shipped()}
    return client.draw({n: j | common for n, j in jobs.items()}, folders), tables


def relative_rms(found, exact):
    return np.sqrt(np.sum((found - exact) ** 2) / np.sum(exact**2))


@pytest.mark.parametrize("view", client.VIEWS, ids=lambda view: view.name)
@pytest.mark.parametrize("kind", ["binary/client", "exr/client", "binary/snippet"])
def test_pixels_are_those_of_our_evaluator(pixels, view, kind):
    """Rays above the ground: those to the horizon's far side are a few metres long at an altitude of 2 m."""
    found, tables = pixels
    zenith, azimuth = view.angles()
    edge = np.arccos(mapping.horizon(tables.mapping.bottom, np.float64(view.altitude_m)))
    kept = zenith < edge - NEAR_HORIZON
    if kind == "binary/snippet" and view.name == "space":
        pytest.skip("the snippet is for observers in the air")
    exact = tables.rays(view.altitude_m, np.radians(view.sun_zenith_deg), zenith, azimuth)[kept]
    assert exact.max() > 1e-6
    assert relative_rms(found[f"{kind}/{view.name}"][kept], exact) < (1e-5 if kind.endswith("snippet") else 1e-3)


@pytest.mark.parametrize("view", client.VIEWS, ids=lambda view: view.name)
def test_half_precision_is_enough(pixels, view):
    """Against the same tables as float32 textures."""
    found, tables = pixels
    half, whole = (found[f"{name}/client/{view.name}"] for name in ("binary", "raw"))
    kept = view.angles()[0] < np.arccos(mapping.horizon(tables.mapping.bottom, np.float64(view.altitude_m)))
    assert relative_rms(half[kept], whole[kept]) < 2e-4


def test_the_exr_is_not_upside_down(exports):
    """What the test above would miss, were the client's loader changed: a flipped scattering table is another one."""
    exr = read_exr(exports["exact"] / "scattering.exr").astype(float)
    assert not np.allclose(exr, exr[::-1])


def test_tables_are_those_that_the_client_computes(exports):
    """Up to the error of its quadratures (0.7 to 7.7 % of single scattering) and of its four orders."""
    parameters = json.loads((exports["exact"] / "params.json").read_text())
    ours, theirs = (takram.read(folder, parameters) for folder in (exports["exact"], client.shipped()))
    assert np.percentile(np.abs(ours.transmittance - theirs.transmittance), 99) < 2e-3
    for name, median, high in (("scattering", 0.03, 0.06), ("single_mie", 0.01, 0.08), ("irradiance", 0.03, 0.05)):
        a, b = getattr(ours, name), getattr(theirs, name)
        bright = a > 0.01 * a.max()
        error = np.abs(a - b)[bright] / a[bright]
        assert np.median(error) < median and np.percentile(error, 98) < high


@pytest.mark.parametrize("view", [v for v in client.VIEWS if v.name in ("sunset", "twilight")], ids=lambda v: v.name)
def test_closer_to_the_truth_than_the_clients_own(pixels, view):
    found, _ = pixels
    exact, kept = truth(Sky("earth", tolerance=0.001), view)
    medians = {}
    for name in ("fitted", "shipped"):
        error = np.abs(found[f"{name}/client/{view.name}"] - exact) / np.maximum(exact, 1e-3 * exact.max())
        medians[name] = quantiles(error[kept])[0]
    assert 3.0 * medians["fitted"] < medians["shipped"]
