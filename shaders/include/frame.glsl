// What is the same for everything drawn in one call of Renderer.draw. "World" is the caller's world seen from the
// eye: its origin is the eye, its axes are the world's, so far-away scenes keep their precision.
#ifndef FRAME_GLSL
#define FRAME_GLSL

// Members are the fields of runtime/gpu/frame_uniforms.py.
layout(std140) uniform Frame {
    mat4 clip_from_world;
    vec3 eye;                  // where the eye is in the caller's world
    float pixels_per_metre;    // that a metre covers at depth (w) one
    vec3 sun_direction;        // unit vector towards the sun
    float exposure;            // multiplies radiance before tone mapping
    vec3 sun_color;            // radiance of a white sheet that faces it
    float depth_per_metre;     // that a metre along the view adds to w: 0 without perspective
    float fixed_factor;        // divides every tessellated edge; 0: as its length on the screen asks
    float largest_factor;
    float segment_px;          // wanted length of a divided edge's pieces
    float texels_per_segment;  // and the shortest, in texels of the position texture
};

#endif
