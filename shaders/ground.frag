// Paving: the sun through two shadow maps, a lantern's light, mist towards the horizon (demos).
#include "include/sky.glsl"

uniform mat4 near_sun_from_world;   // seen from the eye -> the clip space of the sharp map, around what is looked at
uniform mat4 far_sun_from_world;    // and of the wide one
uniform sampler2D near_sun_depth;
uniform sampler2D far_sun_depth;
uniform vec3 eye;                // in the world: keeps the paving in its place
uniform vec3 lantern_position;   // seen from the eye
uniform float unit_m;            // height of a character
uniform vec3 sun_light;          // radiance of a white sheet on the ground
uniform vec3 sky_light;
uniform vec3 lantern_light;
uniform float mist;              // a unit of distance squared

in vec3 ground_position;
out vec4 result;

const int NUM_TAPS = 16;

float hash(vec2 p) {
    return fract(sin(dot(p, vec2(12.9898, 78.233))) * 43758.5453);
}

// Share of the sun that arrives, over a disc of `radius` (of the map), and where the map ends it is all.
float sunlight(sampler2D depths, mat4 sun_from_world, float radius, float turn, out float inside) {
    vec3 place = (sun_from_world * vec4(ground_position, 1.0)).xyz * 0.5 + 0.5;
    vec3 from_middle = abs(place - 0.5) * 2.0;
    inside = 1.0 - smoothstep(0.85, 0.98, max(from_middle.x, max(from_middle.y, from_middle.z)));
    float lit = 0.0;
    for (int i = 0; i < NUM_TAPS; i++) {
        float angle = float(i) * 2.39996323 + turn;
        vec2 tap = sqrt((float(i) + 0.5) / float(NUM_TAPS)) * radius * vec2(cos(angle), sin(angle));
        lit += step(place.z, texture(depths, place.xy + tap).r + 0.0002);
    }
    return lit / float(NUM_TAPS);
}

void main() {
    vec2 world = (ground_position.xz + eye.xz) / (0.6 * unit_m);
    vec2 slab = floor(world + vec2(0.5 * mod(floor(world.y), 2.0), 0.0));
    vec2 inside = fract(world + vec2(0.5 * mod(floor(world.y), 2.0), 0.0)) - 0.5;
    float away = length(ground_position) / unit_m;
    vec2 pixel = fwidth(world) + 1e-4;
    float coarse = max(pixel.x, pixel.y);  // slabs a pixel: what is finer than a pixel fades into its mean
    vec2 edge = smoothstep(0.485 - 1.2 * pixel, vec2(0.485) + 0.3 * pixel, abs(inside)) / (1.0 + 12.0 * pixel);
    float joint = max(edge.x, edge.y) * exp(-8.0 * coarse * coarse);
    float grain = (hash(floor(world * 40.0)) - 0.5) * max(1.0 - 40.0 * coarse, 0.0);
    float shade = mix(0.30 + 0.07 * (hash(slab) - 0.5) * exp(-4.0 * coarse) + 0.02 * grain, 0.13, joint);
    float turn = 6.2831853 * place_noise(gl_FragCoord.xy);
    float near_share, far_share;
    float near_lit = sunlight(near_sun_depth, near_sun_from_world, 0.0016, turn, near_share);
    float far_lit = sunlight(far_sun_depth, far_sun_from_world, 0.0009, turn, far_share);
    float lit = mix(mix(1.0, far_lit, far_share), near_lit, near_share);
    float open = mix(1.0, sunlight(near_sun_depth, near_sun_from_world, 0.008, turn, near_share), 0.35);
    vec3 to_lantern = lantern_position - ground_position;
    float distance_units = length(to_lantern) / unit_m;
    float facing = max(to_lantern.y / (distance_units * unit_m), 0.0);
    vec3 lamp = lantern_light * facing / (0.15 + distance_units * distance_units);
    vec3 radiance = shade * vec3(0.95, 0.93, 0.90) * (sun_light * lit + sky_light * open + lamp);
    vec3 color = pow(radiance / (radiance + 0.35), vec3(1.0 / 2.2));
    vec3 towards = normalize(vec3(ground_position.x, 1e-4, ground_position.z));
    result = vec4(mix(color, sky_color(towards), 1.0 - exp(-mist * away * away)), 1.0);
}
