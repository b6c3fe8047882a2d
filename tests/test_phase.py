"""Phase functions: they integrate to 1, their moments are those of their values, and Dr.Jit agrees with NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import FLOAT64, PHASE_FLOAT32, PHASE_GRADIENT, PHASE_QUADRATURE, PHASE_TABLE

import atmo_jit
from atmo_jit.backend import row_size, types
from atmo_jit.errors import AtmosphereError
from atmo_jit.optics import Optics
from atmo_jit.phase import (
    CornetteShanks,
    HenyeyGreenstein,
    Isotropic,
    LegendrePhase,
    RayleighPhase,
    TabulatedPhase,
    phase_from_dict,
)
from atmo_jit.phase_series import phase_node

# Corners of the table lie on panel boundaries of the quadrature below.
TABLE = TabulatedPhase([-1.0, -0.5, 0.5, 0.75, 1.0], [0.3, 0.1, 0.4, 2.0, 9.0])
SHORT_TABLE = TabulatedPhase([-0.5, 0.5], [3.0, 1.0])
LEGENDRE = LegendrePhase([1.0, 0.6, 0.3, 0.1])
SMOOTH = [
    CornetteShanks(0.8),
    CornetteShanks(-0.4),
    CornetteShanks(0.0),
    HenyeyGreenstein(0.9),
    HenyeyGreenstein(-0.5),
    RayleighPhase(),
    Isotropic(),
    LEGENDRE,
]
ALL = [*SMOOTH, TABLE, SHORT_TABLE]
NAMES = [f"{type(p).__name__}-{getattr(p, 'g', i)}" for i, p in enumerate(ALL)]


def quadrature():
    """Nodes and weights on [-1, 1]: Gauss-Legendre with 60 nodes on each eighth."""
    x, weight = np.polynomial.legendre.leggauss(60)
    edges = np.linspace(-1.0, 1.0, 9)
    half = np.diff(edges)[:, None] / 2.0
    return (edges[:-1, None] + half * (1.0 + x)).ravel(), (half * weight).ravel()


@pytest.mark.parametrize("phase", ALL, ids=NAMES)
def test_moments_are_those_of_the_values(phase):
    nu, weight = quadrature()
    legendre = np.polynomial.legendre.legvander(nu, 12)
    numerical = 2.0 * np.pi * (weight * phase.value(nu)) @ legendre
    assert numerical[0] == pytest.approx(1.0, abs=PHASE_QUADRATURE)
    assert np.allclose(phase.moments(12), numerical, rtol=0, atol=PHASE_QUADRATURE)


@pytest.mark.parametrize("phase", ALL, ids=NAMES)
def test_any_number_of_moments(phase):
    many = phase.moments(20)
    assert many.shape == (21,) and many.dtype == np.float64 and many[0] == 1.0
    for order in (0, 1, 2, 7):
        assert np.allclose(phase.moments(order), many[: order + 1], rtol=0, atol=FLOAT64)


@pytest.mark.parametrize("g", [-0.9, -0.3, 0.0, 0.5, 0.76, 0.97])
def test_cornette_shanks_mean_cosine_closed_form(g):
    assert CornetteShanks(g).moments(1)[1] == pytest.approx(
        3.0 * g * (4.0 + g * g) / (5.0 * (2.0 + g * g)), abs=FLOAT64
    )


def test_cornette_shanks_without_asymmetry_is_rayleigh():
    nu = np.linspace(-1.0, 1.0, 11)
    assert np.allclose(CornetteShanks(0.0).value(nu), RayleighPhase().value(nu), rtol=FLOAT64)
    assert np.allclose(CornetteShanks(0.0).moments(6), RayleighPhase().moments(6), atol=FLOAT64)


@pytest.mark.parametrize("g", [-0.6, 0.0, 0.4, 0.8])
def test_published_forms(g):
    nu = np.linspace(-1.0, 1.0, 21)
    peak = (1.0 + g * g - 2.0 * g * nu) ** -1.5
    henyey = (1.0 - g * g) / (4.0 * np.pi) * peak
    cornette = 3.0 / (8.0 * np.pi) * (1.0 - g * g) * (1.0 + nu * nu) / (2.0 + g * g) * peak
    assert np.allclose(HenyeyGreenstein(g).value(nu), henyey, rtol=FLOAT64)
    assert np.allclose(CornetteShanks(g).value(nu), cornette, rtol=FLOAT64)


def test_a_long_legendre_series_reproduces_its_source():
    source = HenyeyGreenstein(0.7)
    nu = np.linspace(-1.0, 1.0, 101)
    # The first omitted term is (2 l + 1) / (4 pi) g^l = 2e-12 for l = 80.
    assert np.allclose(LegendrePhase(source.moments(80)).value(nu), source.value(nu), atol=1e-10)


def test_a_series_that_dips_below_0_is_0_there():
    nu = np.linspace(-1.0, 1.0, 101)
    given = (1.0 + 3.0 * 0.9 * nu) / (4.0 * np.pi)
    assert np.allclose(LegendrePhase([1.0, 0.9]).value(nu), np.maximum(given, 0.0), atol=FLOAT64)
    phase = {"type": "legendre", "moments": [1.0, 0.9, 0.0, -0.5]}
    air = atmo_jit.Atmosphere.load("earth").replace({"mie.phase": phase, "mie.scattering_per_m": 1e-3})
    zenith = np.arange(0.0, 90.0, 5.0)
    views = {"altitude_m": 0.0, "sun_zenith_deg": 40.0, "view_zenith_deg": zenith, "azimuth_deg": 180.0}
    assert atmo_jit.sky(air, views).radiance.min() >= 0.0


def test_a_table_scales_and_holds_its_ends():
    assert np.allclose(TabulatedPhase(TABLE.cos_theta, TABLE.values * 1e200).values, TABLE.values, rtol=FLOAT64)
    nu = np.array([-1.0, -0.75, -0.5, 0.0, 0.5, 1.0])
    assert np.allclose(SHORT_TABLE.value(nu) / SHORT_TABLE.value(0.0), [1.5, 1.5, 1.5, 1.0, 0.5, 0.5], rtol=FLOAT64)


def test_one_g_per_wavelength():
    g = [0.7, 0.8]
    phase, nu = CornetteShanks(g), np.array([[-1.0, 0.2, 1.0]])
    assert phase.value(nu).shape == (1, 3, 2) and phase.moments(4).shape == (5, 2)
    for index, each in enumerate(g):
        assert np.array_equal(phase.value(nu)[..., index], CornetteShanks(each).value(nu))
        assert np.array_equal(phase.moments(4)[:, index], CornetteShanks(each).moments(4))
        assert phase.at(index).g == each
    assert phase.to_dict() == {"type": "cornette_shanks", "g": g}


@pytest.mark.parametrize("phase", [*ALL, HenyeyGreenstein(0.95)], ids=[*NAMES, "HenyeyGreenstein-0.95"])
def test_drjit_agrees_with_numpy(phase):
    import drjit as dr
    from drjit.llvm.ad import Float

    nu = np.concatenate((np.linspace(-1.0, 1.0, 101), [0.999, 0.9999, 0.99999])).astype(np.float32)
    value = dr.zeros(Float, len(nu)) + phase.value(Float(nu))
    assert np.allclose(value.numpy(), phase.value(nu), rtol=PHASE_FLOAT32, atol=1e-7)


def test_drjit_values_for_one_g_per_wavelength():
    from drjit.llvm.ad import Float

    phase, nu = HenyeyGreenstein([0.3, -0.6]), np.linspace(-1.0, 1.0, 5)
    values = phase.value(Float(nu))
    assert len(values) == 2
    assert np.allclose(np.stack([v.numpy() for v in values], axis=-1), phase.value(nu), rtol=PHASE_FLOAT32)


@pytest.mark.parametrize("make", [CornetteShanks, HenyeyGreenstein])
@pytest.mark.parametrize("g", [-0.7, 0.0, 0.7])
def test_derivatives_by_g(make, g):
    import drjit as dr
    from drjit.llvm.ad import Float

    step = 1e-6
    parameter = Float(g)
    dr.enable_grad(parameter)
    phase = make(parameter)

    moments = phase.moments(5)
    assert len(moments) == 6 and all(type(chi) is Float for chi in moments)
    slopes = (make(g + step).moments(5) - make(g - step).moments(5)) / (2 * step)
    weights = np.arange(1.0, 7.0)
    dr.backward(sum(float(w) * chi for w, chi in zip(weights, moments, strict=True)))
    assert dr.grad(parameter)[0] == pytest.approx(weights @ slopes, rel=PHASE_GRADIENT)

    for nu in (-0.9, 0.1, 0.9):
        dr.clear_grad(parameter)
        dr.backward(phase.value(Float(nu)))
        slope = (make(g + step).value(nu) - make(g - step).value(nu)) / (2 * step)
        assert dr.grad(parameter)[0] == pytest.approx(slope, rel=PHASE_GRADIENT)


@pytest.mark.parametrize("phase", ALL, ids=NAMES)
def test_to_dict_round_trip(phase):
    again = phase_from_dict(phase.to_dict(), 1)
    nu = np.linspace(-1.0, 1.0, 33)
    assert type(again) is type(phase)
    assert np.allclose(again.value(nu), phase.value(nu), rtol=FLOAT64, atol=FLOAT64)


@pytest.mark.parametrize(
    ("description", "field"),
    [
        (None, "phase"),
        ({}, "phase.type"),
        ({"type": "mie"}, "phase.type"),
        ({"type": ["rayleigh"]}, "phase.type"),
        ({"type": "rayleigh", "g": 0.1}, "phase.g"),
        ({"type": "cornette_shanks"}, "phase.g"),
        ({"type": "cornette_shanks", "g": 1}, "phase.g"),
        ({"type": "cornette_shanks", "g": -1.0}, "phase.g"),
        ({"type": "henyey_greenstein", "g": "0.5"}, "phase.g"),
        ({"type": "henyey_greenstein", "g": True}, "phase.g"),
        ({"type": "henyey_greenstein", "g": [0.1]}, "phase.g"),
        ({"type": "henyey_greenstein", "g": [0.1, float("nan")]}, "phase.g[1]"),
        ({"type": "tabulated", "cos_theta": [-1, 1]}, "phase.values"),
        ({"type": "tabulated", "cos_theta": [1, -1], "values": [1, 1]}, "phase.cos_theta[1]"),
        ({"type": "tabulated", "cos_theta": [-1, -1, 1], "values": [1, 1, 1]}, "phase.cos_theta[1]"),
        ({"type": "tabulated", "cos_theta": [-1.1, 1], "values": [1, 1]}, "phase.cos_theta[0]"),
        ({"type": "tabulated", "cos_theta": [0], "values": [1]}, "phase.cos_theta"),
        ({"type": "tabulated", "cos_theta": [-1, 1], "values": [1, -1]}, "phase.values[1]"),
        ({"type": "tabulated", "cos_theta": [-1, 1], "values": [1, 1, 1]}, "phase.values"),
        ({"type": "tabulated", "cos_theta": [-1, 1], "values": [0, 0]}, "phase.values"),
        ({"type": "legendre", "moments": []}, "phase.moments"),
        ({"type": "legendre", "moments": [0.5]}, "phase.moments[0]"),
        ({"type": "legendre", "moments": [1, 1.01]}, "phase.moments[1]"),
        ({"type": "legendre", "moments": [1, float("inf")]}, "phase.moments[1]"),
    ],
)
def test_refusals_name_the_field(description, field):
    with pytest.raises(AtmosphereError) as caught:
        phase_from_dict(description, 2)
    assert caught.value.field == field


@pytest.mark.parametrize("g", [-0.85, 0.0, 0.5, 0.85])
def test_the_table_of_order_1_is_the_closed_form_between_its_nodes(g):
    """As many moments as a peak of g = 0.85 has, interpolated as the light of order 1 does."""
    phase = {"type": "henyey_greenstein", "g": g}
    air = atmo_jit.Atmosphere.load("earth").replace({"rayleigh": None, "mie.phase": phase})
    rows = Optics(air, np.arange(1)).phase_table(100).numpy()[:: row_size(1)]
    theta = np.concatenate([np.linspace(0.0, 0.2, 4000), np.linspace(0.2, np.pi - 0.2, 4000)])
    nu = np.cos(np.concatenate([theta, np.pi - theta[:4000]]))
    place = phase_node(types().Float(nu)).numpy()
    found = np.interp(place, np.arange(len(rows)), rows)
    closed = (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * nu) ** 1.5)
    assert found == pytest.approx(closed, rel=PHASE_TABLE)
