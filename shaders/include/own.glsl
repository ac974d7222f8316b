// Where a vertex samples its material: its own uv.
#ifndef OWN_GLSL
#define OWN_GLSL

#ifdef UV_STEPS
in uvec2 in_uv_steps;  // 65535ths

vec2 own_uv() {
    PRECISE vec2 uv = vec2(in_uv_steps) / 65535.0;
    return uv;
}
#else
in vec2 in_uv;

vec2 own_uv() {
    return in_uv;
}
#endif

#endif
