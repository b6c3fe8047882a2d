// Linear sRGB radiance of one view ray. Stands behind "#version", lookup.glsl and the constants of the page.
uniform vec3 forward, right, up;      // axes of the picture; right and up reach to its edges
uniform vec3 sun;                     // unit vector toward the sun; z is up
uniform float altitude;               // of the observer, m
uniform vec3 solar, albedo;
uniform float sun_radius;             // rad, 0: a point
uniform mat3 to_srgb;
uniform highp sampler2D to_ground_texture;
in vec2 place;                        // -1 to 1 over the picture
out vec4 colour;

const float PI = 3.14159265;
const float THICKNESS = ATM_TOP_M - ATM_BOTTOM_M;

// Mean of max(mu, 0) over the sun's disc about mu_s (atmo_jit.single_scattering.disc_cosine).
float disc_cosine(float mu_s) {
    float x = clamp(mu_s / max(sun_radius, 1e-7), -1.0, 1.0);
    float side = sqrt(max(1.0 - x * x, 0.0));
    float part = x * (0.5 + (asin(x) + x * side) / PI) + side * side * side * 2.0 / (3.0 * PI);
    return abs(x) < 1.0 ? sun_radius * max(part, 0.0) : max(mu_s, 0.0);
}

// The Lambertian ground where the ray (h, mu) meets it, seen through the air.
vec3 ground_radiance(float h, float mu, float mu_s, float nu, vec4 at) {
    float along = (ATM_BOTTOM_M + h) * mu;
    float square = h * (2.0 * ATM_BOTTOM_M + h);
    float d = square / (sqrt(max(along * along - square, 0.0)) - along);
    float mu_g = clamp(mu_s + (h * mu_s + d * nu) / ATM_BOTTOM_M, -1.0, 1.0);
    vec3 light = solar * disc_cosine(mu_g) * atm_transmittance(0.0, mu_g) + atm_irradiance(0.0, mu_g);
    vec3 through = texture(to_ground_texture, vec2(2.0 * at.z, at.w)).rgb;
    return through * albedo / PI * light;
}

void main() {
    vec3 ray = normalize(forward + place.x * right + place.y * up);
    float pixel = max(length(dFdx(ray)), 1e-6);
    float h = altitude, mu = ray.z, mu_s = sun.z, nu = dot(ray, sun);
    bool in_air = true;
    if (h > THICKNESS) {
        // Where the ray enters the air, from its distance to the planet's centre at its nearest.
        float r = ATM_BOTTOM_M + h;
        float nearest = r * length(ray.xy);
        in_air = mu < 0.0 && nearest < ATM_TOP_M;
        float inside = sqrt(max((ATM_TOP_M - nearest) * (ATM_TOP_M + nearest), 0.0));
        float gap = -r * mu - inside;
        mu_s = clamp((r * mu_s + gap * nu) / ATM_TOP_M, -1.0, 1.0);
        mu = -inside / ATM_TOP_M;
        h = THICKNESS;
    }
    vec3 light = vec3(0.0);
    bool ground = in_air && atm_meets_ground(h, mu);
    if (in_air) {
        light = atm_radiance(h, mu, mu_s, nu, ground);
        if (ground) light += ground_radiance(h, mu, mu_s, nu, atm_scattering_uvwz(h, mu, mu_s, nu, ground));
    }
    if (!ground && sun_radius > 0.0) {
        // A uniform disc; the chord keeps the digits that 1 - nu loses. Its edge is a pixel wide.
        float angle = 2.0 * asin(min(0.5 * length(ray - sun), 1.0));
        float disc = clamp((sun_radius - angle) / pixel + 0.5, 0.0, 1.0);
        vec3 through = in_air ? atm_transmittance(h, mu) : vec3(1.0);
        float half_sine = sin(0.5 * sun_radius);
        light += disc * through * solar / (4.0 * PI * half_sine * half_sine);
    }
    colour = vec4(to_srgb * light, 1.0);
}
