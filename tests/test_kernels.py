"""What compiles kernels: the make-up of an atmosphere and its resolution, never its numbers."""

import drjit as dr
import numpy as np
import pytest

import atmo_jit


def compiled(air, **views):
    """Kernels compiled for a sky."""
    views = {"altitude_m": 10.0, "sun_zenith_deg": 40.0, "view_zenith_deg": 80.0, "azimuth_deg": 30.0} | views
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        atmo_jit.sky(air, {name: np.full(8, value) for name, value in views.items()})
        return sum(not kernel["cache_hit"] for kernel in dr.kernel_history([dr.KernelType.JIT]))


@pytest.fixture(scope="module")
def known():
    """The description of an atmosphere whose kernels are there; the second sky of a kind runs some of its own."""
    air = atmo_jit.presets.read("earth")
    for top in (6_420_000, 6_420_001, 6_420_001):
        compiled(air | {"top_radius_m": top})
    return air


CHANGES = {
    "coefficient": {"mie": {"scattering_per_m": 4.1e-6}},
    "albedo of aerosol": {"mie": {"single_scattering_albedo": 0.88}},
    "asymmetry": {"mie": {"phase": {"type": "cornette_shanks", "g": 0.802}}},
    "scale heights": {"mie": {"scale_height_m": 1250}, "rayleigh": {"scale_height_m": 8400}},
    "ozone layer": {"ozone": {"center_m": 24_000, "half_width_m": 14_000}},
    "ground": {"ground_albedo": 0.3},
    "sun": {"solar_irradiance": 1.0, "sun_angular_radius_deg": 0.3},
    "wavelengths": {"wavelengths_nm": [650, 530, 460]},
    "radii": {"bottom_radius_m": 6_371_000.3, "top_radius_m": 6_431_000.7},
    # More levels at which rays are cut.
    "thickness": {"top_radius_m": 6_460_000},
}


@pytest.mark.parametrize("name", CHANGES)
def test_other_numbers_compile_no_kernel(known, name):
    change = CHANGES[name]
    parts = {key: known[key] | value if isinstance(value, dict) else value for key, value in change.items()}
    assert compiled(known | parts) == 0


@pytest.mark.parametrize("view", [{"altitude_m": 3e5}, {"sun_zenith_deg": 95.0}, {"view_zenith_deg": 120.0}])
def test_other_places_compile_no_kernel(known, view):
    assert compiled(known, **view) == 0
