"""The printed maps do in single precision what the maps themselves do."""

from __future__ import annotations

import re

import numpy as np
import pytest

from atmo_jit.export.shaders import glsl, hlsl
from atmo_jit.export.shading import Block, text
from atmo_jit.mapping import Bruneton, Hillaire, Power3D, texture_coordinate

EARTH = Bruneton(6_360_000.0, 6_420_000.0)
SIZE = (32, 128, 8, 32)
NAMES = {"max": np.maximum, "min": np.minimum, "clamp": np.clip, "sqrt": np.sqrt, "where": np.where}


def run(source, name, **arguments):
    """A function of the snippet, line by line in float32."""
    body = re.search(rf"\b{name}\([^)]*\) {{\n(.*?)\n}}", source, re.DOTALL)[1].splitlines()
    values = NAMES | {k: v if v.dtype == bool else v.astype(np.float32) for k, v in arguments.items()}
    for line in body[:-1]:
        kind, target, expression = re.fullmatch(r" +(float|bool) (\w+) = (.*);", line).groups()
        expression = re.sub(r"(\S+) \? (\S+) : (\S+)", r"where(\1, \2, \3)", expression)
        expression = re.sub(r"(?<![\w.])(-?\d+\.?\d*(?:e[-+]?\d+)?)(?![\w.])", r"float32(\1)", expression)
        value = eval(expression.replace("&&", "&").replace("!", "~"), {"float32": np.float32}, values)
        values[target] = value
        assert kind == "bool" or np.asarray(value).dtype == np.float32
    result = re.fullmatch(r" +return (?:\w+\()?(.*?)\)?;", body[-1])[1].split(", ")
    return [values[v] for v in result]


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(0)
    h = 60e3 * rng.random(4000) ** 3
    mu, mu_s = rng.uniform(-1, 1, 4000), rng.uniform(-0.49, 1, 4000)
    edge = -np.sqrt(h * (2 * EARTH.bottom + h)) / (EARTH.bottom + h)
    kept = np.abs(mu - edge) > 1e-4
    ground = mu < edge
    return {"h": h[kept], "mu": mu[kept], "mu_s": mu_s[kept], "ground": ground[kept]}


def test_scattering_coordinates(rays):
    h, mu, mu_s, ground = rays.values()
    nu = np.cos(np.linspace(0, np.pi, len(h)))
    found = run(glsl(EARTH, 0.8, SIZE), "atm_scattering_uvwz", **rays, nu=nu)
    x_r, _ = EARTH.transmittance(h, mu)
    exact = [
        EARTH.angle(nu),
        texture_coordinate(EARTH.sun(mu_s), 32),
        EARTH.view_row(EARTH.view(h, mu, ground), ground, 128),
        texture_coordinate(x_r, 32),
    ]
    np.testing.assert_allclose(found, exact, atol=2e-5)  # a texel of 128 is 8e-3 wide


def test_the_ground_is_where_it_is(rays):
    (found,) = run(glsl(EARTH, 0.8, SIZE), "atm_meets_ground", h=rays["h"], mu=rays["mu"])
    np.testing.assert_array_equal(found, rays["ground"])


def test_both_languages_hold_the_same_arithmetic():
    a, b = glsl(EARTH, 0.8, SIZE), hlsl(EARTH, 0.8, SIZE)
    assert "vec" not in re.sub(r"//.*", "", b) and "float2 atm_transmittance_uv" in b and "mix(" in a
    lines = [[line for line in s.splitlines() if re.match(r" +(float|bool) t\d", line)] for s in (a, b)]
    assert lines[0] == lines[1] and len(lines[0]) > 60


def test_other_maps_can_be_printed_too():
    block = Block()
    names = [block.name(n) for n in ("h", "mu", "mu_s")]
    assert len(Power3D(6.36e6, 6.42e6, about_horizon=True).coordinates(*names)) == 3
    Hillaire(6.36e6, 6.42e6).sky_view(names[0], names[1], names[2], block.name("ground", "bool"))
    assert any("pow(" in line for line in block.lines) and any("acos(" in line for line in block.lines)


def test_numbers_a_shader_cannot_hold():
    assert text(1.0) == "1.0" and text(1e-9) == "1e-09" and text(6360000.0) == "6360000.0"
    with pytest.raises(ValueError, match="cannot be written"):
        text(np.inf)
