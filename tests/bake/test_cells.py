"""Cells of two words a value: what a word keeps of its two floats, and interpolation against NumPy's."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from atmo_jit.backend import floats, types
from atmo_jit.bake.cells import Cells, last_bits, packed


@pytest.mark.parametrize(("bits", "first_error", "second_error"), [(12, 2.0**-12, 2.0**-4), (16, 2.0**-8, 2.0**-8)])
def test_words_keep_both(bits, first_error, second_error):
    rng = np.random.default_rng(0)
    first, second = (rng.choice([-1, 1], 4000) * 10.0 ** rng.uniform(-6, 6, 4000) for _ in range(2))
    word = packed(floats(first), floats(second), bits)
    dr.eval(word)
    assert np.abs(word.numpy() / first - 1.0).max() <= first_error
    assert np.abs(last_bits(word, bits).numpy() / second - 1.0).max() <= second_error


def test_zeros_stay_next_to_nothing():
    """The sign of a zero is the first of the last bits, less than any float that is not denormal."""
    word = packed(floats([0.0, 0.0]), floats([0.0, -0.0]), 12)
    assert np.abs(word.numpy()).max() < 1e-38 and last_bits(word, 12).numpy().tolist() == [0.0, 0.0]


def test_bilinear_within_sheets():
    """Two sheets of 3 and 4 rows that are not joined, five values of which three words are padding."""
    rng, shape = np.random.default_rng(1), (7, 6, 5)
    rows, columns, count = np.indices(shape)
    values = 1.0 + 0.1 * rows + 0.05 * columns + 0.2 * count + 0.01 * rng.random(shape)
    cells = Cells([floats(values[..., n]) for n in range(shape[2])], shape[1], (3, 4))
    i, j, y, x = rng.integers(0, 7, 500), rng.integers(0, 6, 500), rng.random(500), rng.random(500)
    below, right = np.where(np.isin(i, (2, 6)), i, i + 1), np.minimum(j + 1, 5)
    corners = (values[i, j], values[i, right], values[below, j], values[below, right])
    weights = ((1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x)
    expected = sum(w[:, None] * v for w, v in zip(weights, corners, strict=True))
    t = types()
    found = cells.at(t.Int(i.astype(np.int32)), floats(y), t.Int(j.astype(np.int32)), floats(x))
    np.testing.assert_allclose(np.stack([v.numpy() for v in found], axis=-1), expected, rtol=2e-3)
    assert cells.nbytes == 7 * 6 * 16 * 4
