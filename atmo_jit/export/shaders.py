"""Look-ups of Bruneton's tables as GLSL ES 3.0 (WebGL2) and HLSL.

The maps are printed by running :class:`atmo_jit.mapping.Bruneton` on names (:mod:`.shading`); what stands around them
is the same text in both languages. Names begin with ``atm_``. Altitudes ``h`` are in metres above the ground: a radius
in single precision is half a metre wrong. The caller declares nothing: samplers are declared here.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from ..mapping import Bruneton, horizon, texture_coordinate
from .shading import Block, Value, text

_GLSL_HEAD = """\
// {title}
// GLSL ES 3.0. Bind: atm_transmittance_texture, atm_irradiance_texture (2-D), atm_scattering_texture,
// atm_single_mie_texture (3-D), all with linear filters and clamped to the edge.
uniform highp sampler2D atm_transmittance_texture;
uniform highp sampler2D atm_irradiance_texture;
uniform highp sampler3D atm_scattering_texture;
uniform highp sampler3D atm_single_mie_texture;
#define ATM_SAMPLE(table, uv) texture(table, uv).rgb
"""
_HLSL_HEAD = """\
// {title}
// HLSL. Bind the textures, and atm_linear: linear filters, clamped to the edge.
Texture2D atm_transmittance_texture;
Texture2D atm_irradiance_texture;
Texture3D atm_scattering_texture;
Texture3D atm_single_mie_texture;
SamplerState atm_linear;
#define ATM_SAMPLE(table, uv) table.SampleLevel(atm_linear, uv, 0.0).rgb
"""
_COMMON = """
// Phase functions (1/sr) of air and of the aerosol.
float atm_rayleigh_phase(float nu) {
    return 0.0596831037 * (1.0 + nu * nu);
}

float atm_mie_phase(float nu, float g) {
    float square = 1.0 + g * g - 2.0 * g * nu;
    return 0.119366207 * (1.0 - g * g) / (2.0 + g * g) * (1.0 + nu * nu) / (square * sqrt(square));
}

// Transmittance from altitude h (m) along the zenith cosine mu to the top; rays that miss the ground.
vec3 atm_transmittance(float h, float mu) {
    return ATM_SAMPLE(atm_transmittance_texture, atm_transmittance_uv(h, mu));
}

// Irradiance of the sky on a horizontal surface.
vec3 atm_irradiance(float h, float mu_s) {
    return ATM_SAMPLE(atm_irradiance_texture, atm_irradiance_uv(h, mu_s));
}

// Radiance scattered toward (h, mu) under the sun cosine mu_s, at the angle of cosine nu from the sun; the ground's own
// is not in it. ground: whether the ray ends there (atm_meets_ground).
vec3 atm_radiance(float h, float mu, float mu_s, float nu, bool ground) {
    vec4 at = atm_scattering_uvwz(h, mu, mu_s, nu, ground);
    float place = at.x * (ATM_NU_SIZE - 1.0);
    float low = min(floor(place), ATM_NU_SIZE - 2.0);
    float share = place - low;
    vec3 uvw0 = vec3((low + at.y) / ATM_NU_SIZE, at.z, at.w);
    vec3 uvw1 = vec3((low + 1.0 + at.y) / ATM_NU_SIZE, at.z, at.w);
    vec3 air = lerp(ATM_SAMPLE(atm_scattering_texture, uvw0), ATM_SAMPLE(atm_scattering_texture, uvw1), share);
    vec3 mie = lerp(ATM_SAMPLE(atm_single_mie_texture, uvw0), ATM_SAMPLE(atm_single_mie_texture, uvw1), share);
    return air * atm_rayleigh_phase(nu) + mie * atm_mie_phase(nu, ATM_MIE_G);
}
"""
_TO_GLSL = {"lerp": "mix"}
_TO_HLSL = {"vec2": "float2", "vec3": "float3", "vec4": "float4"}


def glsl(to: Bruneton, g: float, size: tuple[int, int, int, int]) -> str:
    """A look-up for tables with these maps, aerosol asymmetry and numbers of scattering texels (altitudes, view
    cosines, angles, suns). ``#define ATM_MIE_G`` before it, a uniform's name for instance, to change g at run time."""
    return _GLSL_HEAD.format(title=_title(to)) + _renamed(_body(to, g, size), _TO_GLSL)


def hlsl(to: Bruneton, g: float, size: tuple[int, int, int, int]) -> str:
    """The same in HLSL."""
    return _HLSL_HEAD.format(title=_title(to)) + _renamed(_body(to, g, size), _TO_HLSL)


def _title(to: Bruneton) -> str:
    lowest = f"{to.mu_s_min:.6g}"
    return f"Look-up of atmosphere tables: ground at {to.bottom:.9g} m, top at {to.top:.9g} m, mu_s_min {lowest}."


def _body(to: Bruneton, g: float, size: tuple[int, int, int, int]) -> str:
    from ..bake.client import IRRADIANCE, TRANSMITTANCE

    altitudes, rows, angles, suns = size

    def transmittance(h: Value, mu: Value) -> list[Value]:
        x_r, x_mu = to.transmittance(h, mu)
        return [texture_coordinate(x_mu, TRANSMITTANCE[1]), texture_coordinate(x_r, TRANSMITTANCE[0])]

    def irradiance(h: Value, mu_s: Value) -> list[Value]:
        x_r, x_mu_s = to.irradiance(h, mu_s)
        return [texture_coordinate(x_mu_s, IRRADIANCE[1]), texture_coordinate(x_r, IRRADIANCE[0])]

    def scattering(h: Value, mu: Value, mu_s: Value, nu: Value, ground: Value) -> list[Value]:
        x_r, _ = to.transmittance(h, mu)
        u_mu = to.view_row(to.view(h, mu, ground), ground, rows)
        u_mu_s = texture_coordinate(to.sun(mu_s), suns)
        return [to.angle(nu), u_mu_s, u_mu, texture_coordinate(x_r, altitudes)]

    def meets_ground(h: Value, mu: Value) -> list[Value]:
        return [(mu < 0.0) & (mu <= horizon(to.bottom, h))]

    return "\n".join(
        [
            "#ifndef ATM_MIE_G",
            f"#define ATM_MIE_G {text(g)}",
            "#endif",
            f"#define ATM_NU_SIZE {text(angles)}",
            f"#define ATM_BOTTOM_M {text(to.bottom)}",
            f"#define ATM_TOP_M {text(to.top)}",
            "",
            "// Whether the ray (h, mu) meets the ground.",
            _function("atm_meets_ground", meets_ground, ("h", "mu")),
            _function("atm_transmittance_uv", transmittance, ("h", "mu")),
            _function("atm_irradiance_uv", irradiance, ("h", "mu_s")),
            "// Texture coordinates of angle (to be split over ATM_NU_SIZE pictures), sun, view and altitude.",
            _function("atm_scattering_uvwz", scattering, ("h", "mu", "mu_s", "nu", "ground")),
        ]
    ) + _COMMON


def _function(name: str, compute: Callable[..., list[Value]], arguments: tuple[str, ...]) -> str:
    block = Block()
    kinds = ["bool" if a == "ground" else "float" for a in arguments]
    found = compute(*(block.name(a, kind) for a, kind in zip(arguments, kinds, strict=True)))
    kind = found[0].kind if len(found) == 1 else f"vec{len(found)}"
    result = found[0].text if len(found) == 1 else f"{kind}({', '.join(v.text for v in found)})"
    head = ", ".join(f"{kind} {a}" for a, kind in zip(arguments, kinds, strict=True))
    lines = [*block.lines, f"return {result};"]
    return "\n".join([f"{kind} {name}({head}) {{", *(f"    {line}" for line in lines), "}\n"])


def _renamed(source: str, names: dict[str, str]) -> str:
    return re.sub(r"\b(" + "|".join(names) + r")\b", lambda match: names[match[0]], source)

