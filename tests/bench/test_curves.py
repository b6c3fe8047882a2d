"""Curves of cost: what is varied, how lines are fitted, what is said of them."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from atmo_jit.atmosphere import Atmosphere
from bench import curves
from bench.worlds import WORLDS


def test_the_line_through_costs():
    rows = [{"views": n, "cpu_s": 0.02 + 3e-6 * n} for n in (100, 1000, 10**6)]
    found = curves._line(rows, "views")
    assert found["fixed_cpu_s"] == pytest.approx(0.02) and found["each_cpu_s"] == pytest.approx(3e-6)
    assert found["deviation"] < 1e-9
    rows[1]["cpu_s"] *= 1.5
    assert curves._line(rows, "views")["deviation"] > 0.1


def test_atmospheres_of_more_wavelengths():
    air = Atmosphere(WORLDS["two aerosols, five wavelengths"])
    many = curves.spectral(air, 9)
    assert len(many.wavelengths_nm) == 9 and many.wavelengths_nm[0] == 680 and many.wavelengths_nm[-1] == 440
    blue = (many.rayleigh.scattering_per_m[-1], air.rayleigh.scattering_per_m[-1])
    assert blue[0] == pytest.approx(blue[1])
    assert np.all(np.diff(many.rayleigh.scattering_per_m) > 0)
    assert len(many.mie[0].phase.g) == 9 and many.mie[1].phase.moments(2)[1] == air.mie[1].phase.moments(2)[1]
    one = curves.spectral(Atmosphere.load("earth"), 1)
    assert one.wavelengths_nm.tolist() == [550] and one.rayleigh.scattering_per_m[0] == pytest.approx(13.558e-6)


def test_resolutions_converge():
    """Errors fall and costs rise with the resolution."""
    air = Atmosphere(WORLDS["one gas, one wavelength"])
    found = curves.resolutions(air, (0.5, 1.0), 2.0, 100)
    coarse, fine = found["rows"]
    assert fine["p95"] < coarse["p95"] and found["order"] > 0.5
    slope = np.log(coarse["p95"] / fine["p95"]) / np.log(2.0)
    assert found["order"] == pytest.approx(slope)


def test_threads_are_set_back():
    before = dr.thread_count()
    rows = curves.threads(Atmosphere(WORLDS["one gas, one wavelength"]), 1)
    assert dr.thread_count() == before and [row["threads"] for row in rows] == sorted({1, before})


def test_views_and_what_is_said():
    found = curves.views(Atmosphere(WORLDS["one gas, one wavelength"]), 1000, 1)
    assert [row["views"] for row in found["rows"]] == [100, 1000] and found["rows"][0]["cpu_s"] > 0
    line = {"fixed_cpu_s": 0.1, "each_cpu_s": 0.05, "deviation": 0.07}
    row = {"cpu_s": 1.0, "wall_s": 0.6}
    made = {
        "resolution": {
            "rows": [{"factor": 1.0, **row, "median": 0.1, "p95": 0.5}], "finest": 2.8, "order": 2.25, "cost_power": 3.5
        },
        "wavelengths": {"rows": [{"wavelengths": 3, **row}], **line},
        "views": {"rows": [{"views": 100, **row}], **line},
        "threads": [{"threads": 1, **row}],
        "cuda": {"warm": {"wall_s": 0.0123}},
    }  # fmt: skip
    text = curves.section(made)
    for words in ("power 2.25", "power 3.50", "0.100 + 0.0500 W", "within 7 %", "0.0123 s", "| 100 |"):
        assert words in text
    assert any("order of convergence 2.25" in line for line in curves.in_words(made))
