// What is the same for everything drawn in one call of Renderer.draw. "World" is the caller's world seen from the
// eye: its origin is the eye, its axes are the world's, so far-away scenes keep their precision.
#ifndef FRAME_GLSL
#define FRAME_GLSL

layout(std140) uniform Frame {
    mat4 clip_from_world;
    vec4 eye;             // xyz: where the eye is in the caller's world
    vec4 viewport_px;     // width, height, pixels a metre at depth one, 1 where the projection is perspective
    vec4 sun_direction;   // xyz: unit vector towards the sun
    vec4 sun_color;       // rgb: radiance of a white sheet facing it; w: exposure
    vec4 tessellation;    // wanted segment in pixels, largest factor, fixed factor (0: adaptive), texels a segment
};

#endif
