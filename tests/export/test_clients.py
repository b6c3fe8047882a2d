"""Files of Bruneton's clients: sizes, values, what is refused, and the way back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from atmo_jit.bake.client import SCATTERING, bruneton_tables, scattering_nodes
from atmo_jit.cli import main
from atmo_jit.errors import InputError
from atmo_jit.export import Options, export, read
from atmo_jit.export.containers import document, exr_header, read_exr, write_all

SMALL = Options(size=(4, 8, 4, 8))
BYTES = {"transmittance": 131072, "scattering": 8388608, "irradiance": 8192}
BYTES |= dict.fromkeys(("single_mie_scattering", "higher_order_scattering"), 8388608)


def texels(folder, name, shape, kind="<f2"):
    return np.fromfile(folder / name, kind).reshape(*shape, 4).astype(float)


def test_takram_files_are_of_the_clients_sizes(takram):
    for name, size in BYTES.items():
        assert (takram.folder / f"{name}.bin").stat().st_size == size
        exr = read_exr(takram.folder / f"{name}.exr")
        assert exr.dtype == np.float16
        rows = {"transmittance": (64, 256), "irradiance": (16, 64)}.get(name, (4096, 256))
        assert exr.shape == (*rows, 4)
        np.testing.assert_array_equal(exr[::-1], texels(takram.folder, f"{name}.bin", rows))
    assert {p.name for p in takram.folder.iterdir()} == set(takram.files)


def test_takram_values(takram):
    """Texels of @takram/three-atmosphere 0.19.1 where it computes the same quantity."""
    found = texels(takram.folder, "transmittance.bin", (64, 256))
    for at, exact in {(0, 0): (0.94038, 0.86766, 0.76241), (0, 128): (0.55629, 0.26258, 0.070853)}.items():
        assert found[at][:3] == pytest.approx(exact, rel=1e-3)
    scattering = texels(takram.folder, "scattering.bin", (32, 128, 256))
    mie = texels(takram.folder, "single_mie_scattering.bin", (32, 128, 256))
    assert scattering[4, 100, 255] == pytest.approx((0.85771, 1.86726, 2.84126, 0.047378), rel=0.05)
    assert np.array_equal(scattering[..., 3], mie[..., 0])
    assert all(np.all(np.isfinite(v)) and np.all(v >= 0.0) for v in (scattering, mie))


def test_takram_says_what_it_holds(takram):
    parameters = json.loads((takram.folder / "params.json").read_text())
    assert parameters["muSMin"] == pytest.approx(-0.5) and parameters["miePhaseFunctionG"] == 0.8
    assert parameters["rayleighScattering"] == pytest.approx([0.005802, 0.013558, 0.0331])
    assert parameters["absorptionDensity"][0] == pytest.approx(
        {"width": 25, "expTerm": 0, "expScale": 0, "linearTerm": 1 / 15, "constantTerm": -2 / 3}
    )
    # Constants of the client, from another solar spectrum.
    assert parameters["skyRadianceToLuminance"] == pytest.approx([114974.9, 71306.0, 65310.5], rel=0.03)
    estimate = parameters["metadata"]["errorEstimate"]
    assert set(estimate) == {"day", "sunset", "twilight"} and estimate["day"]["median"] < 0.02
    assert {"altitudeM", "viewZenithDeg"} <= set(estimate["day"]["where"])
    header = exr_header(takram.folder / "scattering.exr")
    assert json.loads(header["atmo_jit.errorEstimate"]) == estimate
    assert any("half precision" in w for w in takram.warnings)


def test_takram_comes_back(takram, earth_sky):
    tables = read(takram.folder)
    assert tables.scattering.shape == (*SCATTERING, 3)
    rng = np.random.default_rng(0)
    altitude, sun = rng.uniform(0, 3e4, 500), np.radians(rng.uniform(0, 80, 500))
    view, azimuth = np.radians(rng.uniform(0, 85, 500)), rng.uniform(0, np.pi, 500)
    exact = np.stack([v.numpy() for v in earth_sky.rays(altitude, sun, view, azimuth).radiance], axis=-1)
    error = np.abs(tables.rays(altitude, sun, view, azimuth) - exact) / exact
    assert np.median(error) < 0.01
    # From space, the ray starts where it enters.
    assert np.all(tables.rays(4e5, 0.5, np.pi - 0.3, 0.0) > 0.0) and not tables.rays(4e5, 0.5, 1.0, 0.0).any()


def test_fitted_files_hold_exact_single_scattering(takram, earth_sky):
    """What the fit changes counts as light of higher orders, in half precision."""
    tables, exact = read(takram.folder), bruneton_tables(earth_sky)
    single = tables.scattering - tables.higher
    lit = exact.rayleigh > 1e-6 * exact.rayleigh.max()
    digits = 1e-3 * tables.scattering + 6e-8  # two roundings, and the step of the smallest halves
    assert np.percentile((np.abs(single - exact.rayleigh) / (3e-3 * exact.rayleigh + digits))[lit], 99) < 1.0
    lit = exact.mie > 1e-4 * exact.mie.max()
    assert np.percentile(np.abs(tables.single_mie - exact.mie)[lit] / exact.mie[lit], 99) < 3e-3
    assert not np.allclose(tables.scattering, exact.scattering, rtol=0.05)
    assert tables.higher.min() >= 0.0


def test_bruneton_comes_back_exactly(tmp_path):
    report = export("earth", "bruneton", tmp_path, SMALL)
    tables = read(tmp_path)
    assert tables.mapping.mu_s_min == pytest.approx(np.cos(np.radians(102.0)))
    scattering = texels(tmp_path, "scattering.dat", (4, 8, 4, 8), "<f4")
    np.testing.assert_array_equal(tables.scattering, scattering[..., :3])
    np.testing.assert_array_equal(tables.single_mie[..., 0], scattering[..., 3])
    constants = (tmp_path / "atmosphere_shader.txt").read_text()
    assert "const int SCATTERING_TEXTURE_MU_S_SIZE = 8;" in constants and "6360.0" in constants
    (tmp_path / "scattering.dat").write_bytes(b"\0" * 16)
    with pytest.raises(InputError, match="has 16 bytes"):
        read(tmp_path)
    assert report.nbytes > 0
    for text in ("[]", "{}", '{"metadata": {"layout": "bruneton"}}', "nonsense"):
        (tmp_path / "params.json").write_text(text)
        with pytest.raises(InputError, match=r"params\.json|layout"):
            read(tmp_path)


def test_cosmoscout(tmp_path):
    export("earth", "cosmoscout", tmp_path, SMALL)
    import tifffile

    pages = tifffile.imread(tmp_path / "multiple_scattering.tif")
    assert pages.shape == (4, 8, 32, 3) and pages.dtype == np.float32
    phase = tifffile.imread(tmp_path / "phase.tif").astype(float)
    angle = np.linspace(0, np.pi, phase.shape[1])
    assert 2 * np.pi * np.trapezoid(phase[..., 0] * np.sin(angle), angle, axis=1) == pytest.approx(1.0, rel=2e-3)
    metadata = json.loads((tmp_path / "metadata.json").read_text())
    # The sun from above the air, in lux: 1361 W/m^2 at 98 lm/W.
    assert np.dot([0.2126, 0.7152, 0.0722], metadata["sunIlluminance"]) == pytest.approx(1.3e5, rel=0.05)


def test_an_aerosol_that_clients_do_not_have_keeps_its_radiance(earth, tmp_path):
    earth["mie"] = [earth["mie"], {**earth["mie"], "phase": {"type": "henyey_greenstein", "g": 0.6}}]
    report = export(earth, "bruneton", tmp_path, Options(size=(8, 32, 8, 16)))
    assert any("2 species" in w for w in report.warnings)
    tables = read(tmp_path)
    from atmo_jit.backend import doubles
    from atmo_jit.solved import Sky

    h, mu, mu_s, nu = scattering_nodes(tables.mapping, (8, 32, 8, 16))
    at = (4, 28, 7, 15)  # a texel that looks 15 degrees past the sun, which is overhead
    place = h[at[0], 0, 0, 0], mu[at[0], at[1], 0, 0], mu_s[at[3]], nu[at]
    views = (place[0], np.arccos(place[2]), np.arccos(place[1]), 0.0)
    exact = [v.numpy()[0] for v in Sky(earth).rays(*map(doubles, views), ground=False).radiance]
    assert tables.radiance(*place) == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({"wavelengths_nm": [440, 550, 680]}, {}, "red before green"),
        ({"sun_angular_radius_deg": 7.0}, {}, "sun_angular_radius_deg"),
        ({"solar_irradiance": 3e6}, {}, "half precision holds"),
        ({}, {"size": (32, 64, 8, 32)}, "32x128x8x32"),
        ({}, {"precision": "float"}, "half"),
        ({}, {"mu_s_min": 0.2}, "mu-s-min"),
        ({}, {"colour": "sepia"}, "colour"),
    ],
)
def test_refused_where_it_would_be_silently_wrong(earth, tmp_path, change, options, words):
    with pytest.raises(InputError, match=words):
        export(earth | change, "takram", tmp_path / "out", Options(**options))
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_what_does_not_read_back_gets_no_name(tmp_path):
    (tmp_path / "a.json").write_text("before")
    good, bad = document("a.json", {}), document("b.json", {})
    object.__setattr__(bad, "content", "something else")
    with pytest.raises(OSError, match="b.json: does not read back"):
        write_all(tmp_path, [good, bad])
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"] and (tmp_path / "a.json").read_text() == "before"


def test_the_command(tmp_path, capsys):
    arguments = ["export", "--atmosphere", "earth", "--layout", "bruneton", "--out", str(tmp_path / "t")]
    assert main([*arguments, "--size", "4x8x4x8", "--mu-s-min", "-0.3"]) == 0
    assert "p99" in capsys.readouterr().out
    assert json.loads((tmp_path / "t" / "params.json").read_text())["muSMin"] == -0.3
    assert main([*arguments, "--size", "4,8"]) == 2
    assert main([*arguments, "--precision", "half"]) == 2
    (tmp_path / "file").touch()
    assert main([*arguments[:-1], str(tmp_path / "file" / "t")]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 3 and all(line.startswith("atmo-jit: ") for line in err)
