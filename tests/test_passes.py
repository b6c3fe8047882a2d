"""Pictures in passes and strips: one estimate, its standard error, and interruptions between passes."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.commands.render import _load, _mitsuba
from atmo_jit.passes import PASS_SAMPLES, Passes, pass_sizes, strips
from atmo_jit.scenes import find

mi = pytest.importorskip("mitsuba")


def box():
    """A sphere under a constant sky."""
    mi.set_variant("llvm_ad_rgb")
    look = mi.ScalarTransform4f().look_at(origin=[0, -5, 1], target=[0, 0, 0.5], up=[0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "to_world": look,
                "film": {"type": "hdrfilm", "width": 16, "height": 8, "pixel_format": "rgb"},
                "sampler": {"type": "independent", "sample_count": 8},
            },
            "emitter": {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
        }
    )


def test_passes_add_up_to_one_estimate():
    scene = box()
    seen = []
    passes = Passes(scene, 64)
    for _ in passes.run(seen.append):
        continue
    reference = np.array(mi.render(scene, spp=4096, seed=9))
    assert passes.samples == 64 and seen[-1] == 1.0 and seen == sorted(seen) and len(seen) == 16
    error = passes.picture().rgb - reference
    assert abs(error).max() < 0.3
    assert abs(error.mean()) < 0.01


def test_pass_sizes():
    for spp in (1, 3, 4, 7, 64, 100, 1000, 4096):
        for pixels in (1, 640 * 360, 10**7):
            sizes = list(pass_sizes(spp, pixels))
            assert sum(sizes) == spp
            assert all(size & (size - 1) == 0 for size in sizes)
            assert max(sizes) == 1 or max(sizes) * pixels <= PASS_SAMPLES
    assert list(pass_sizes(64, 640 * 360)) == [4] * 16


def test_strips_cover_the_film():
    for width, height, limit in ((3840, 2160, 2**19), (7, 5, 1), (640, 360, 2**21), (10, 9, 25)):
        parts = list(strips(width, height, limit))
        assert [first for first, _ in parts] == list(np.cumsum([0, *(rows for _, rows in parts)])[:-1])
        assert sum(rows for _, rows in parts) == height
        assert all(rows * width <= limit or rows == 1 for _, rows in parts)


def test_large_films_are_rendered_in_strips(monkeypatch):
    """The same picture, within its noise, whether a pass is of the whole film or of a few rows; the film is left as it
    was.
    """
    with _mitsuba("llvm_ad_rgb"):
        scene, _ = _load(find("ball"), {}, 24, 14, False)
        pictures, errors = [], []
        for most in (2**21, 24 * 4):
            passes = Passes(scene, 64, most)
            for _ in passes.run(lambda fraction: None):
                continue
            pictures.append(passes.picture().pixels[..., :3])
            errors.append(passes.standard_error().pixels[..., :3])
            assert tuple(scene.sensors()[0].film().crop_size()) == (24, 14)
    difference, sigma = pictures[0] - pictures[1], np.hypot(*errors)
    assert pictures[0].shape == pictures[1].shape == (14, 24, 3)
    assert np.sqrt(np.mean((difference / np.maximum(sigma, 1e-3 * pictures[0])) ** 2)) < 1.5


def test_standard_error_is_the_scatter_of_repeated_renders(tmp_path):
    with _mitsuba("llvm_ad_rgb"):
        scene, _ = _load(find("ball"), {}, 16, 9, True)
        pictures, errors = [], []
        for first in range(24):
            passes = Passes(scene, 64)
            passes.seed = 1000 * first
            for _ in passes.run(lambda fraction: None):
                continue
            pictures.append(passes.picture().pixels)
            errors.append(passes.standard_error().pixels)
    ratio = np.std(pictures, axis=0, ddof=1).mean() / np.sqrt(np.mean(np.square(errors), axis=0)).mean()
    assert 0.85 < ratio < 1.15


@pytest.mark.parametrize("scatter", [False, True])
def test_passes_go_on_from_what_was_kept(scatter):
    """At every pass another ``Passes`` takes over; the end is that of one that did all."""
    whole = Passes(box(), 64, scatter=scatter)
    for _ in whole.run(lambda fraction: None):
        continue
    done, seen = Passes(box(), 64, scatter=scatter), []
    for _ in range(16):
        next(done.run(seen.append))
        other = Passes(box(), 64, scatter=scatter)
        other.restore(done.state())
        done = other
    assert seen[-1] == 1.0 and seen == sorted(seen) and done.samples == whole.samples
    assert np.allclose(done.picture().pixels, whole.picture().pixels, rtol=1e-6, atol=0.0)
    if scatter:
        assert np.allclose(done.standard_error().pixels, whole.standard_error().pixels, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        {"counts": np.array([0, 8, 0])},
        {"counts": np.array([99, 8, 0])},
        {"counts": np.array([1.0, 8.0, 0.0])},
        {"channels": np.array(["R", "G", "B", "A", "A"])},
        {"channels": np.array([1, 2, 3])},
        {"sums": np.zeros((9, 16, 5))},
        {"squares": np.zeros((2, 2))},
    ],
)
def test_passes_do_not_go_on_from_anything_else(change):
    passes = Passes(box(), 64)
    next(passes.run(lambda fraction: None))
    with pytest.raises(ValueError):
        Passes(box(), 64).restore(passes.state() | change)
