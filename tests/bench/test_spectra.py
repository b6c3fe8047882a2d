"""The spectra that come along are those of colour-science."""

from __future__ import annotations

import numpy as np

from atmo_jit.spectrum import DATA
from bench.spectra import tables


def test_the_file_is_what_the_library_has():
    with np.load(DATA) as held:
        made = tables()
        assert set(held.files) == set(made)
        assert all(np.array_equal(held[name], values) for name, values in made.items())
