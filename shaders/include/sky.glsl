// An evening or a day: what is seen in a direction above the horizon, encoded colours (demos).
#ifndef SKY_GLSL
#define SKY_GLSL

uniform vec3 sky_horizon;
uniform vec3 sky_zenith;
uniform vec3 sky_glow;        // around the sun
uniform vec3 sky_sun;         // towards it, unit

vec3 sky_color(vec3 direction) {
    float up = max(direction.y, 0.0);
    float facing = max(dot(direction, sky_sun), 0.0);
    vec3 color = mix(sky_horizon, sky_zenith, 1.0 - pow(1.0 - up, 3.0));
    return color + sky_glow * (0.55 * pow(facing, 6.0) + 0.45 * pow(facing, 48.0)) * (1.0 - 0.6 * up);
}

// A number from a place, so that gradients show no bands.
float place_noise(vec2 place) {
    return fract(52.9829189 * fract(dot(place, vec2(0.06711056, 0.00583715))));
}

#endif
