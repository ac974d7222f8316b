// A studio for pictures: a paper roll behind, a floor below, the sun's shadow and a contact shadow on it.
in vec2 picture_place;
out vec4 result;

uniform mat4 world_from_clip;     // world: origin at the eye
uniform vec3 floor_point;         // a point of the floor under the character, from the eye
uniform float floor_size;         // metres: about the character's own size
uniform vec3 background_top;      // encoded colours
uniform vec3 background_bottom;
uniform vec3 floor_color;
uniform sampler2D sun_depth;      // what the sun sees, and how to get there from the world
uniform mat4 sun_clip_from_world;
uniform sampler2D below_depth;    // what is seen from below the floor, straight up
uniform mat4 below_clip_from_world;
uniform float sun_softness;       // penumbra a metre of height
uniform float depth_range_m;      // metres from depth 0 to 1 of both

const int NUM_TAPS = 48;

float hash(vec2 p) {
    return fract(sin(dot(p, vec2(12.9898, 78.233))) * 43758.5453);
}

vec2 disc_tap(int i, float turn) {
    float angle = float(i) * 2.39996323 + turn;
    return sqrt((float(i) + 0.5) / float(NUM_TAPS)) * vec2(cos(angle), sin(angle));
}

vec3 to_depth(mat4 clip_from_world, vec3 p) {
    return (clip_from_world * vec4(p, 1.0)).xyz * 0.5 + 0.5;
}

// Share of the sun that is hidden: taps in a disc as wide as the blocker is high.
float sun_shadow(vec3 p, float turn) {
    vec3 at = to_depth(sun_clip_from_world, p);
    if (any(lessThan(at.xy, vec2(0.0))) || any(greaterThan(at.xy, vec2(1.0)))) return 0.0;
    float search = 0.035;
    float height = 0.0, found = 0.0;
    for (int i = 0; i < NUM_TAPS; ++i) {
        float blocker = texture(sun_depth, at.xy + disc_tap(i, turn) * search).r;
        if (blocker < at.z - 0.002) { height += at.z - blocker; found += 1.0; }
    }
    if (found == 0.0) return 0.0;
    float radius = clamp(height / found * sun_softness, 0.004, 0.06);
    float hidden = 0.0;
    for (int i = 0; i < NUM_TAPS; ++i) {
        hidden += texture(sun_depth, at.xy + disc_tap(i, turn) * radius).r < at.z - 0.002 ? 1.0 : 0.0;
    }
    return hidden / float(NUM_TAPS);
}

// Ambient light that what stands close above takes away.
float contact_shadow(vec3 p, float turn) {
    vec3 at = to_depth(below_clip_from_world, p);
    float hidden = 0.0;
    for (int i = 0; i < NUM_TAPS; ++i) {
        vec2 offset = disc_tap(i, turn) * 0.10;
        float height = (texture(below_depth, at.xy + offset).r - at.z) * depth_range_m / floor_size;
        float away = length(offset) * 6.0;
        hidden += 1.0 / (1.0 + 60.0 * height * height + 3.0 * away * away) * step(height, 0.6);
    }
    return clamp(1.7 * hidden / float(NUM_TAPS), 0.0, 1.0);
}

void main() {
    vec4 far_point = world_from_clip * vec4(picture_place, 1.0, 1.0);
    vec4 near_point = world_from_clip * vec4(picture_place, -1.0, 1.0);
    vec3 ray = normalize(far_point.xyz / far_point.w - near_point.xyz / near_point.w);
    float vertical = picture_place.y * 0.5 + 0.5;
    vec3 color = mix(background_bottom, background_top, smoothstep(0.0, 1.0, vertical));
    color *= 1.0 - 0.10 * dot(picture_place, picture_place) * 0.5;
    float turn = hash(gl_FragCoord.xy) * 6.2831853;
    if (ray.y < -1e-4 && floor_point.y < 0.0) {
        vec3 p = ray * (floor_point.y / ray.y);
        float away = length(p - floor_point) / floor_size;
        float near_floor = exp(-0.22 * away * away);
        vec3 lit = mix(color, floor_color, near_floor * 0.85);
        float shadow = sun_shadow(p, turn) * 0.42;
        float contact = contact_shadow(p, turn) * 0.62;
        color = lit * (1.0 - shadow * near_floor) * (1.0 - contact * near_floor);
    }
    color += (hash(gl_FragCoord.xy + 0.5) - 0.5) / 255.0;  // no bands in the gradients
    result = vec4(color, 1.0);
}
