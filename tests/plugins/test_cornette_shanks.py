"""The phase function ``cornette_shanks``: value, density and sampling."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")

ASYMMETRIES = (-0.9, -0.3, 0.0, 1e-4, 0.3, 0.76, 0.9)


def at(cosine):
    """An interaction whose ray goes along +z, and directions at these scattering cosines."""
    cosine = mi.Float(cosine)
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(cosine))
    mei.wi = mi.Vector3f(0, 0, -1)
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei, mi.Vector3f(dr.safe_sqrt(1 - cosine * cosine), 0, cosine)


@pytest.mark.parametrize("g", ASYMMETRIES)
def test_value_is_the_formula_and_integrates_to_one(rgb, g):
    phase = mi.load_dict({"type": "cornette_shanks", "g": g})
    nu, weight = np.polynomial.legendre.leggauss(200)
    mei, wo = at(nu)
    value = np.array(phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)[0][1], dtype=np.float64)
    formula = 3 / (8 * np.pi) * (1 - g**2) * (1 + nu**2) / ((2 + g**2) * (1 + g**2 - 2 * g * nu) ** 1.5)
    np.testing.assert_allclose(value, formula, rtol=2e-5)
    assert 2 * np.pi * weight @ value == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("g", ASYMMETRIES)
def test_directions_follow_the_density(rgb, g):
    from mitsuba.chi2 import ChiSquareTest, PhaseFunctionAdapter, SphericalDomain

    sample, density = PhaseFunctionAdapter("cornette_shanks", {"type": "cornette_shanks", "g": g})
    test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=3, sample_count=200_000, res=51, ires=32)
    assert test.run(), test.messages


@pytest.mark.parametrize("g", ASYMMETRIES)
def test_weight_is_value_over_density(rgb, g):
    phase = mi.load_dict({"type": "cornette_shanks", "g": g})
    context = mi.PhaseFunctionContext()
    mei, _ = at(np.zeros(1000))
    random = mi.PCG32(size=1000)
    wo, weight, pdf = phase.sample(context, mei, 0.5, mi.Point2f(random.next_float32(), random.next_float32()))
    value, density = phase.eval_pdf(context, mei, wo)
    np.testing.assert_allclose(np.array(pdf), np.array(density), rtol=2e-3)
    np.testing.assert_allclose(np.array(weight[0] * pdf), np.array(value[0]), rtol=2e-3)
    assert 0.49 < dr.min(weight[0])[0] and dr.max(weight[0])[0] < 1.51


def test_g_is_exposed_and_differentiable(rgb):
    phase = mi.load_dict({"type": "cornette_shanks", "g": 0.6})
    parameters = mi.traverse(phase)
    mei, wo = at([-0.5, 0.2, 0.9])
    context = mi.PhaseFunctionContext()

    def value(g):
        parameters["g"] = mi.Float(g)
        parameters.update()
        return phase.eval_pdf(context, mei, wo)[0][0]

    difference = (np.array(value(0.61)) - np.array(value(0.59))) / 0.02
    g = mi.Float(0.6)
    dr.enable_grad(g)
    parameters["g"] = g
    parameters.update()
    result = phase.eval_pdf(context, mei, wo)[0][0]
    for i in range(3):
        dr.set_grad(g, 0.0)
        weight = mi.Float([float(i == j) for j in range(3)])
        dr.backward(result * weight, flags=dr.ADFlag.ClearInterior)
        assert dr.grad(g)[0] == pytest.approx(difference[i], rel=2e-3)


def test_scalar_variant(plugins):
    mi.set_variant("scalar_rgb")
    phase = mi.load_dict({"type": "cornette_shanks", "g": 0.5})
    mei = mi.MediumInteraction3f()
    mei.wi = [0, 0, 1]
    mei.sh_frame = mi.Frame3f(mei.wi)
    wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(), mei, 0.1, [0.2, 0.3])
    value, density = phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)
    assert density == pytest.approx(pdf, rel=1e-5)
    assert value[0] == pytest.approx(weight[0] * pdf, rel=1e-5)


@pytest.mark.parametrize("g", [1.0, -1.0, 2.0])
def test_g_outside_its_range_is_refused(rgb, g):
    with pytest.raises(RuntimeError, match=r"g.*\(-1, 1\)"):
        mi.load_dict({"type": "cornette_shanks", "g": g})
