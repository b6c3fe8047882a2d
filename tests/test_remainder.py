"""All orders that follow at once, in white clouds, and their derivatives."""

import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import floats, traversing
from atmo_jit.fits.light import RayLight
from atmo_jit.multiple_scattering import _Steps
from atmo_jit.remainder import Remainder, parted
from bench.worlds import world

VIEWS = {
    "altitude_m": [0.0, 0.0, 20000.0, 20000.0],
    "sun_zenith_deg": [60.0, 30.0, 60.0, 85.0],
    "view_zenith_deg": [0.0, 45.0, 120.0, 140.0],
    "azimuth_deg": 90.0,
}


def cloud(depth=40.0, wavelengths=1, **changes):
    """Nearly white droplets over bright ground."""
    droplets = {
        "scattering_per_m": [0.9999 * depth / 2000.0, *[1e-5] * (wavelengths - 1)],
        "absorption_per_m": [0.0001 * depth / 2000.0, *[1e-6] * (wavelengths - 1)],
        "scale_height_m": 2000,
        "phase": {"type": "henyey_greenstein", "g": 0.6},
    }
    names = np.linspace(550.0, 450.0, wavelengths).tolist() if wavelengths > 1 else [550]
    return world(wavelengths_nm=names, solar_irradiance=1, rayleigh=None, mie=droplets, ground_albedo=0.8, **changes)


@pytest.fixture(scope="module")
def solved():
    return atmo_jit.linearize(cloud(), VIEWS)


def equation(sky):
    """Of a sky's only band."""
    band = sky.solutions[0]
    tail, known = parted(band.field.shares)[1], band.field.known
    steps = _Steps(band.optics, band.columns, sky.grid, sky.resolution)
    values = band.optics.values(sky.resolution.degrees, sky.resolution.phase_degree)
    count = len(known["later"])
    done = steps.started(values, steps.first(values), count)
    gather = steps._gather(band.optics, band.field.reference, count + 1, done["gather"])
    return Remainder(gather, steps._project(count + 1), tail), *known["later"][-2:]


def test_the_remainder_solves_its_equation(solved):
    """x = K (u + x), to what is left of it at the tolerance of a linearization."""
    of, last, light = equation(solved.sky)
    again = of.moments(of.step(last + light)).numpy()
    light = of.moments(light).numpy()
    suns = solved.sky.grid.shape[1]
    scale = np.abs(light[:, :1, :suns]).max(axis=0)
    # The last suns are in the planet's shadow.
    assert (np.abs(again - light)[:, :, :suns] / scale)[:, :, : suns - 8].max() < 2e-5


def test_the_transposed_solution(solved):
    """<(I - K)^-1 a, b> = <a, (I - K')^-1 b>."""
    of, last, _ = equation(solved.sky)
    rng = np.random.default_rng(3)
    shape = of.moments(last).numpy().shape
    a, b = (rng.normal(size=shape).astype(np.float32) for _ in range(2))
    a[:, :, solved.sky.grid.shape[1] :] = b[:, :, solved.sky.grid.shape[1] :] = 0.0
    with traversing():
        forward = of.solved(floats(a)).numpy().astype(float)
        back = of.solved(floats(b), transposed=True).numpy().astype(float)
    size = np.linalg.norm(forward) * np.linalg.norm(b)
    assert abs(forward @ b.ravel().astype(float) - back @ a.ravel().astype(float)) < 1e-5 * size


@pytest.mark.parametrize("name", ["ground_albedo", "mie.absorption_per_m"])
def test_derivatives_are_those_of_differences(solved, name):
    base = float(np.ravel(getattr(solved.atmosphere, name, 0.0001 * 40.0 / 2000.0))[0])
    step = {"ground_albedo": 0.04, "mie.absorption_per_m": 0.8 * base}[name]

    def radiance(change):
        there = solved.moved({name: base + change})
        return there.value["radiance"][:, 0].astype(float)

    far, near = (radiance(s) - radiance(-s) for s in (step, 0.5 * step))
    want = (8.0 * near - far) / (6.0 * step)
    assert solved.jacobian([name])[name][:, 0] == pytest.approx(want, rel=1e-3, abs=1e-3 * np.abs(want).max())


def test_forward_and_reverse_agree(solved):
    names = ["ground_albedo", "mie.absorption_per_m", "mie.phase.g"]
    rng = np.random.default_rng(0)
    weights = {output: rng.normal(size=solved.value[output].shape) for output in ("radiance", "sky_irradiance")}
    pulled = solved.vjp(weights, names)
    for name in names:
        moved = solved.jvp({name: 1.0})
        terms = [weights[output] * moved[output] for output in weights]
        size = sum(np.abs(part).sum() for part in terms)
        assert abs(sum(part.sum() for part in terms) - np.sum(pulled[name])) < 1e-4 * size


def test_orders_that_are_asked_for_are_summed():
    """45 of them, more than are solved one by one where all are wanted."""
    shares = atmo_jit.Sky(cloud(), orders=45).solutions[0].field.shares
    assert len(shares) == 44 and parted(shares)[1] is None


def test_clear_wavelengths_beside_a_cloud():
    """A fit takes the wavelengths in other bands than the solve: here that of the cloud and one of the others."""
    air = cloud(wavelengths=6)
    sky = atmo_jit.Sky(air)
    assert [parted(band.field.shares)[1] is None for band in sky.solutions] == [False, True]
    views = VIEWS["altitude_m"], *(np.radians(VIEWS[name]) for name in ("view_zenith_deg", "sun_zenith_deg"))
    height, view, sun = (np.asarray(v) for v in views)
    turn = np.full(4, np.radians(VIEWS["azimuth_deg"]))
    parts = {name: [air["mie"][name][c] for c in (5, 0)] for name in ("scattering_per_m", "absorption_per_m")}
    own = atmo_jit.Atmosphere.load({**air, "wavelengths_nm": [450, 550], "mie": {**air["mie"], **parts}})
    light = RayLight(sky, own, np.array([5, 0]), height, view, sun, turn)(own, sun, turn)
    assert light == pytest.approx(atmo_jit.sky(air, VIEWS, method="march").radiance[:, [5, 0]], rel=2e-3)
