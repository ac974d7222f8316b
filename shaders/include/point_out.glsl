// The last step of both ways to draw: a place of the atlas, skinned, moved to the world and projected.
#ifndef POINT_OUT_GLSL
#define POINT_OUT_GLSL

#include "joint_color.glsl"
#ifdef MORPHS
#include "morphs.glsl"
#endif

out vec2 surface_uv;
#ifdef NORMAL_UV
out vec2 surface_normal_uv;  // emit_point leaves it to its caller
#endif
out vec3 surface_position;
out mat3 surface_normal_matrix;
out vec3 surface_rest;
flat out vec4 surface_tint;
flat out int surface_level;
#ifdef SHOW_WEIGHTS
out vec3 surface_joint_color;
#endif

invariant gl_Position;

#ifdef SHOW_WEIGHTS
vec3 blend_joint_colors(vec2 uv) {
    vec4 shares;
    uint record = find_record(uv, shares);
    vec3 color = vec3(0.0);
    float left = 1.0;
    bool more = true;
    while (more) {
        uvec4 joints;
        vec4 weights;
        more = read_record(record, shares, left, joints, weights);
        color += joint_color(joints.x) * weights.x + joint_color(joints.y) * weights.y
               + joint_color(joints.z) * weights.z + joint_color(joints.w) * weights.w;
        record += 1u;
    }
    return color;
}
#endif

void emit_point(vec2 uv, vec2 geometry_uv, mat3x4 world_from_object, vec4 tint, ivec2 numbers) {
    vec3 rest = rest_position(geometry_uv);
    mat3x4 pose = blend_joints(geometry_uv, numbers.x);
#ifdef MORPHS
    mat3x4 morph = morph_at(geometry_uv, textureSize(position_texture, 0), numbers.x);
    rest = morphed_point(morph, rest);
#endif
    PRECISE vec3 position = transform_point(world_from_object, transform_point(pose, rest));
    PRECISE vec4 projected = clip_from_world * vec4(position, 1.0);
    gl_Position = projected;
    surface_uv = uv;
    surface_position = position;
    surface_normal_matrix = normal_matrix(world_from_object) * pose_normal_matrix(pose);
#ifdef MORPHS
    surface_normal_matrix = surface_normal_matrix * morph_turn(morph);
#endif
    surface_rest = rest;
    surface_tint = tint;
    surface_level = numbers.y;
#ifdef SHOW_WEIGHTS
    surface_joint_color = blend_joint_colors(geometry_uv);
#endif
}

#endif
