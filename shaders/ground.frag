// Paving in the evening: the sun's shadow map, a lantern's light, mist towards the horizon (demos).
uniform mat4 sun_from_world;     // seen from the eye -> the shadow map's clip space
uniform sampler2D sun_depth;
uniform vec3 eye;                // in the world: keeps the paving in its place
uniform vec3 lantern_position;   // seen from the eye
uniform float unit_m;            // height of a character
uniform vec3 sun_light;          // radiance of a white sheet on the ground
uniform vec3 sky_light;
uniform vec3 lantern_light;
uniform vec3 horizon_color;      // encoded

in vec3 ground_position;
out vec4 result;

float hash(vec2 p) {
    return fract(sin(dot(p, vec2(12.9898, 78.233))) * 43758.5453);
}

// Share of the sun that arrives: nine comparisons around the place in the map.
float sunlight() {
    vec3 place = (sun_from_world * vec4(ground_position, 1.0)).xyz * 0.5 + 0.5;
    if (any(lessThan(place, vec3(0.0))) || any(greaterThan(place, vec3(1.0)))) return 1.0;
    vec2 texel = 1.0 / vec2(textureSize(sun_depth, 0));
    float lit = 0.0;
    for (int y = -1; y <= 1; y++) {
        for (int x = -1; x <= 1; x++) {
            lit += step(place.z, texture(sun_depth, place.xy + vec2(x, y) * texel).r + 0.0015);
        }
    }
    return lit / 9.0;
}

void main() {
    vec2 world = (ground_position.xz + eye.xz) / (0.6 * unit_m);
    vec2 slab = floor(world + vec2(0.5 * mod(floor(world.y), 2.0), 0.0));
    vec2 inside = fract(world + vec2(0.5 * mod(floor(world.y), 2.0), 0.0)) - 0.5;
    float away = length(ground_position) / unit_m;
    float joint = smoothstep(0.47, 0.485 + 0.002 * away, max(abs(inside.x), abs(inside.y)));
    float shade = mix(0.28 + 0.09 * hash(slab), 0.14, joint * exp(-0.04 * away));
    vec3 to_lantern = lantern_position - ground_position;
    float distance_units = length(to_lantern) / unit_m;
    vec3 lamp = lantern_light * max(to_lantern.y / (distance_units * unit_m), 0.0) / (0.15 + distance_units * distance_units);
    vec3 radiance = shade * vec3(0.95, 0.93, 0.90) * (sun_light * sunlight() + sky_light + lamp);
    vec3 color = pow(radiance / (radiance + 0.35), vec3(1.0 / 2.2));
    result = vec4(mix(color, horizon_color, 1.0 - exp(-0.0006 * away * away)), 1.0);
}
