"""The statistical tests themselves: they pass what is right as often as they claim, and fail what is not."""

from __future__ import annotations

import numpy as np
import pytest
from ztests import Estimate, assert_agree, limit, of_passes, z_scores

RANDOM = np.random.default_rng(7)


def estimate(shift: np.ndarray | float = 0.0) -> Estimate:
    return of_passes(5.0 + shift + RANDOM.normal(0.0, 1.0, (64, 10, 10)))


def test_limit_of_one_number_is_the_normal_quantile():
    assert limit(1, 0.05) == pytest.approx(1.959964, abs=1e-6)


def test_largest_of_many_exceeds_its_limit_as_often_as_claimed():
    draws = np.abs(RANDOM.standard_normal((4000, 200))).max(axis=1)
    assert abs(np.mean(draws > limit(200, 0.05)) - 0.05) < 3 * np.sqrt(0.05 * 0.95 / 4000)


def test_equal_pictures_agree():
    assert_agree(estimate(), estimate())


def test_one_wrong_pixel_is_found():
    shift = np.zeros((10, 10))
    shift[3, 4] = 2.0
    with pytest.raises(AssertionError, match="number 34 of 100"):
        assert_agree(estimate(), estimate(shift))


def test_bias_below_the_noise_of_every_pixel_is_found():
    with pytest.raises(AssertionError, match="together"):
        assert_agree(estimate(), estimate(0.08))


def test_exact_numbers_must_be_equal():
    one = Estimate(np.array([1.0, 2.0]), np.zeros(2))
    assert_agree(one, one)
    assert np.isinf(z_scores(one, Estimate(np.array([1.0, 3.0]), np.zeros(2)))[1])


def test_saved_estimates_come_back(tmp_path):
    one = estimate()
    one.save(tmp_path / "one.npz")
    back = Estimate.load(tmp_path / "one.npz")
    np.testing.assert_allclose(back.mean, one.mean, rtol=1e-7)
    np.testing.assert_allclose(back.variance, one.variance, rtol=1e-7)
