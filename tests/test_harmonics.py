"""The harmonics against SciPy's and against the addition theorem."""

import numpy as np
import pytest
from scipy.special import eval_legendre, sph_harm_y

from atmo_jit.harmonics import legendre, pair_count, pairs


@pytest.mark.parametrize("degree", [0, 2, 7, 24])
def test_values_are_those_of_real_spherical_harmonics(degree):
    mu = np.linspace(-1.0, 1.0, 23)
    ours = legendre(degree, mu)
    assert ours.shape == (23, pair_count(degree))
    for index, (l_, m) in enumerate(zip(*pairs(degree), strict=True)):
        theirs = np.real(sph_harm_y(l_, m, np.arccos(mu), 0.0)) * (-1.0) ** m * (np.sqrt(2.0) if m else 1.0)
        assert ours[:, index] == pytest.approx(theirs, abs=1e-10)


def test_addition_theorem():
    """sum_m P_lm(a) P_lm(b) cos(m phi) = (2 l + 1) / (4 pi) P_l(cos of the angle between)."""
    degree, a, b, phi = 9, 0.3, -0.65, 1.1
    nu = a * b + np.sqrt((1 - a * a) * (1 - b * b)) * np.cos(phi)
    l_, m = pairs(degree)
    product = legendre(degree, np.array(a)) * legendre(degree, np.array(b)) * np.cos(m * phi)
    for n in range(degree + 1):
        assert product[l_ == n].sum() == pytest.approx((2 * n + 1) / (4 * np.pi) * eval_legendre(n, nu), abs=1e-12)
