"""Registration, and the emitter in every kind of variant of Mitsuba."""

from __future__ import annotations

import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from emitters import sun

VARIANTS = [
    "llvm_ad_rgb",
    "llvm_ad_mono",
    "llvm_ad_mono_polarized",
    "llvm_ad_spectral",
    "llvm_ad_spectral_polarized",
    "scalar_rgb",
    "scalar_spectral",
    "scalar_spectral_polarized",
]
# Single precision in two orders of summation, and 1 nm against 5 nm of colour matching functions in Mitsuba's film.
SAME, COLOUR = 1e-4, 0.01
NM = [440.0, 500.0, 550.0, 680.0]


def available() -> list[str]:
    return [v for v in VARIANTS if v in mi.variants()]


def load():
    return mi.load_dict({"type": "atmosphere", "sun_direction": sun(30.0)})


def look(emitter, direction: list[float]) -> np.ndarray:
    """Radiance [channels] of one direction in the current variant; where polarised, the intensity, after a check."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -mi.Vector3f(direction)
    if mi.is_spectral:
        si.wavelengths = NM
    value = emitter.eval(si)
    if mi.is_polarized:
        rest = np.array([value[i, j] for i in range(4) for j in range(4) if i or j])
        assert np.all(rest == 0.0)
        value = value[0, 0]
    return np.array(value, dtype=np.float64).ravel()


def test_variants_agree(plugins) -> None:
    from atmo_jit.spectrum import SpectralBasis

    basis = SpectralBasis.of("earth")
    directions = sun(60.0, 120.0), sun(30.0), sun(-20.0, 60.0)
    found = {}
    for variant in available():
        mi.set_variant(variant)
        emitter = load()
        found[variant] = [look(emitter, d) for d in directions]
    for i in range(len(directions)):
        kinds = [[found[v][i] for v in found if kind in v] for kind in ("rgb", "mono", "spectral")]
        for values in kinds:
            for other in values[1:]:
                np.testing.assert_allclose(other, values[0], rtol=SAME)
        rgb, mono, spectral = (values[0] for values in kinds)
        radiance = spectral[[3, 2, 0]]  # at the wavelengths of the preset
        np.testing.assert_allclose(basis.to_srgb(radiance), rgb, rtol=SAME)
        np.testing.assert_allclose(basis.xyz_matrix[1] @ radiance, mono[0], rtol=SAME)
        np.testing.assert_allclose(basis.matrix([500.0]) @ radiance, spectral[1], rtol=1e-3)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral_polarized"])
def test_sampling_in_other_variants(plugins, variant: str) -> None:
    if variant not in mi.variants():
        pytest.skip(f"this Mitsuba has no {variant}")
    mi.set_variant(variant)
    emitter = load()
    it = dr.zeros(mi.Interaction3f)
    it.wavelengths = NM if mi.is_spectral else []
    for point in ([0.3, 0.4], [0.97, 0.2], [0.999, 0.9]):
        ds, weight = emitter.sample_direction(it, mi.Point2f(point), True)
        pdf = np.array(ds.pdf).ravel()
        np.testing.assert_allclose(np.array(emitter.pdf_direction(it, ds, True)).ravel(), pdf, rtol=1e-5)
        radiance = np.array(emitter.eval_direction(it, ds, True))
        np.testing.assert_allclose(np.array(weight), radiance / pdf, rtol=1e-4)
        assert dr.all(ds.emitter == (mi.EmitterPtr(emitter) if dr.is_jit_v(mi.Float) else emitter))
    emitter.set_scene(mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 3.0}}))
    ray, weight = emitter.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.7), mi.Point2f(0.2, 0.6), True)
    assert np.array(dr.norm(ray.o)).ravel()[0] >= 3.0 and np.isfinite(np.array(weight)).all()


@pytest.mark.parametrize("variant", ["scalar_rgb", pytest.param("scalar_spectral", marks=pytest.mark.slow)])
def test_scalar_variants_render_the_same_picture(plugins, variant: str) -> None:
    def picture(variant: str, spp: int) -> np.ndarray:
        mi.set_variant(variant)
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 3},
                "light": {"type": "atmosphere", "sun_direction": sun(30.0)},
                "ball": {"type": "sphere"},
                "sensor": {
                    "type": "perspective",
                    "to_world": mi.ScalarTransform4f().look_at([5, 1, 1], [0, 0, 0], [0, 0, 1]),
                    "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
                },
            }
        )
        return np.array(mi.render(scene, spp=spp)).reshape(-1, 3).mean(axis=0)

    np.testing.assert_allclose(picture(variant, 64), picture("llvm_ad_rgb", 1024), rtol=0.05)


def test_spectral_film_shows_the_rgb_values(plugins) -> None:
    def pixel(variant: str) -> np.ndarray:
        mi.set_variant(variant)
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path"},
                "light": {"type": "atmosphere", "sun_direction": sun(30.0)},
                "sensor": {
                    "type": "radiancemeter",
                    "origin": [0, 0, 0],
                    "direction": sun(50.0, 90.0),
                    "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}},
                },
            }
        )
        return np.array(mi.render(scene, spp=1 << 17)).ravel()[:3]

    np.testing.assert_allclose(pixel("llvm_ad_spectral"), pixel("llvm_ad_rgb"), rtol=COLOUR)


def test_registering_again_and_switching_back(plugins) -> None:
    mi.set_variant("llvm_ad_rgb")
    first = look(load(), sun(60.0, 120.0))
    for variant in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
        plugins.register()
        mi.set_variant(variant)
        plugins.register()
    np.testing.assert_array_equal(look(load(), sun(60.0, 120.0)), first)
    # The class is one per variant, and carries its reference page.
    emitter = mi.load_dict({"type": "atmosphere", "sun_direction": [0, 0, 1]})
    assert type(emitter) is type(mi.load_dict({"type": "atmosphere", "sun_direction": [0, 1, 1]}))
    assert isinstance(emitter, mi.Emitter) and ".. pluginparameters::" in type(emitter).__doc__


def test_mitsuba_writes_pictures_where_there_is_one_processor(tmp_path) -> None:
    """Its writer of OpenEXR waits without end for a second thread of Dr.Jit's pool."""
    code = """
import sys
import drjit as dr
dr.set_thread_count(1)
import atmo_jit.plugins
import mitsuba as mi
mi.set_variant("scalar_rgb")
atmo_jit.plugins.register()
mi.Bitmap(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, [320, 180]).write(sys.argv[1])
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.exr")], check=True, timeout=60)


def test_register_before_any_variant_and_without_side_effects() -> None:
    # In a process of its own: what an import does not do cannot be seen in this one.
    code = """
import sys
import atmo_jit.plugins
assert "mitsuba" not in sys.modules and "drjit" not in sys.modules and "colour" not in sys.modules
atmo_jit.plugins.register()
import mitsuba as mi
assert mi.variant() is None
mi.set_variant("scalar_rgb")
print(mi.load_dict({"type": "atmosphere", "sun_direction": [0, 0, 1]}).is_environment())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True" and done.stderr == ""
