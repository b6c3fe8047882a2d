// Linear sRGB of any range to the screen: exposure, highlights, gamut and transfer curve of atmo_jit/image.py.
uniform highp sampler2D picture;
uniform float exposure;
in vec2 place;
out vec4 colour;

const vec3 LUMINANCE = vec3(0.2126390, 0.7151687, 0.0721923);

vec3 srgb_curve(vec3 linear) {
    vec3 power = 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055;
    return mix(power, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
}

void main() {
    vec3 light = texture(picture, 0.5 * place + 0.5).rgb;
    if (any(isnan(light)) || any(isinf(light))) {
        colour = vec4(1.0, 0.0, 1.0, 1.0);
        return;
    }
    vec3 exposed = light * exposure;
    float before = dot(exposed, LUMINANCE);
    vec3 shown = vec3(0.0);
    if (before > 0.0) {
        // 1 - exp(-Y), by its series where the difference has no digits left.
        float after = before < 1e-3 ? before * (1.0 - 0.5 * before) : 1.0 - exp(-before);
        // From the grey of the same luminance, in the colour's direction until a channel meets 0 or 1.
        vec3 away = exposed * (after / before) - after;
        vec3 room = mix(vec3(after), vec3(1.0 - after), greaterThan(away, vec3(0.0)));
        vec3 reach = min(room / max(abs(away), vec3(1e-30)), vec3(1.0));
        shown = clamp(after + away * min(reach.r, min(reach.g, reach.b)), 0.0, 1.0);
    }
    colour = vec4(srgb_curve(shown), 1.0);
}
