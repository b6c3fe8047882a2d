"""Light at a table's nodes, played back from a recording: right for other suns and other atmospheres."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import floats
from atmo_jit.bake.ray_pieces import Rays
from atmo_jit.bake.sightlines import Sightlines, in_steps
from atmo_jit.bake.sky_view import SkyView
from atmo_jit.grid import Grid
from atmo_jit.optics import Optics
from atmo_jit.solved import Sky

EARTH = Atmosphere.load("earth")
# Sun (deg) and what differs from the earth: first the same, then everything; in thicker air rays have more pieces.
CASES = [
    (40.0, {}),
    (41.0, {}),
    (70.0, {"mie.scattering_per_m": 5e-6, "mie.phase.g": 0.7}),
    (20.0, {"ground_albedo": 0.6, "rayleigh.scattering_per_m": [5.2e-6, 1.2e-5, 3.1e-5]}),
    (95.0, {}),
    (40.0, {"mie.scattering_per_m": 2e-4, "mie.absorption_per_m": 1e-5}),
]
SIZE = (24, 16, 12)


def picture(sun_deg: float, changes: dict, ground: bool) -> np.ndarray:
    view = SkyView(Sky(EARTH.replace(changes), orders=3), 5.0, np.radians(sun_deg), SIZE, ground=ground)
    zenith, azimuth = floats(np.linspace(0.02, 3.1, 60)), floats(np.linspace(0.0, 9.0, 60))
    return np.array([v.numpy() for v in (*view.radiance(zenith, azimuth), *view.transmittance(zenith))])


@pytest.mark.parametrize("ground", [True, False])
def test_a_recording_gives_what_was_recorded(ground):
    """The first bake is plain, the second recorded, later ones played back."""
    plain = []
    for sun_deg, changes in CASES:
        Grid._known.clear()
        Rays._known.clear()
        plain.append(picture(sun_deg, changes, ground))
    Grid._known.clear()
    for _ in range(3):
        for case, want in zip(CASES, plain, strict=True):
            # Words of cells round: the same light has the same words, but for what threads add in another order.
            got = picture(*case, ground)
            np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-6 * want.max(), err_msg=str(case))


def test_a_small_change_of_the_air_moves_no_nodes():
    def lines(factor: float) -> Sightlines:
        air = EARTH.replace({"mie.scattering_per_m": 1e-4 * factor})
        return Sightlines(Optics(air, np.arange(3)), np.full(50, 2.0), np.cos(np.linspace(0.0, 3.1, 50)))

    kept = [lines(factor).at for factor in (1.0, 1.01, 1.02, 1.03)]
    assert sum(a is not b for a, b in zip(kept, kept[1:], strict=False)) <= 1
    assert lines(8.0).at is not kept[-1]


def test_all_bands_have_the_same_nodes(odd_sky):
    """Else one band's would be made anew after every other's."""
    found = [Sightlines(band.optics, np.full(9, 2.0), np.linspace(-1.0, 1.0, 9)) for band in odd_sky.solutions]
    assert len(found) == 2 and found[0].at is found[1].at


def test_steps_are_on_the_safe_side():
    values = np.array([0.0, 1e-30, 3e-6, 1.0, 7.0])
    up, down = in_steps(values, up=True), in_steps(values, up=False)
    assert np.all(up >= values * (1 - 1e-12)) and np.all(down <= values * (1 + 1e-12))
    assert np.all(up <= 1.2 * values) and np.all(down >= values / 1.2)
