// Where a vertex fetches its geometry: at its owner's uv, the same bits for every copy of a surface point.
#ifndef OWNER_GLSL
#define OWNER_GLSL

#ifdef OWNER_STEPS
in uvec2 in_owner_steps;  // 65535ths

vec2 owner_uv() {
    PRECISE vec2 uv = vec2(in_owner_steps) / 65535.0;
    return uv;
}
#else
in vec2 in_owner_uv;

vec2 owner_uv() {
    return in_owner_uv;
}
#endif

#endif
