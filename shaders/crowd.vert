// One actor of a crowd, an instance: its pose is a row of the baked clips, or the blend of two.
//
// A level's vertices were expanded once from the textures (crowd_expand.vert): position at rest and the strongest
// joints. That is what static.vert fetches for every actor anew.
#include "include/frame.glsl"
#include "include/skinning.glsl"

in vec3 in_position;
in uvec4 in_joints;
in vec4 in_weights;
#ifdef EIGHT_JOINTS
in uvec4 in_more_joints;
in vec4 in_more_weights;
#endif
in vec2 in_uv;
in vec4 in_world_row0;   // once an instance: object space to world (seen from the eye)
in vec4 in_world_row1;
in vec4 in_world_row2;
in float in_row;         // of the baked clips; the fraction lies on the way to the next one
in vec4 in_tint;
uniform int crowd_level;

out vec2 surface_uv;
out vec3 surface_position;
out mat3 surface_normal_matrix;
out vec3 surface_rest;
out vec4 surface_tint;
flat out int surface_level;
#ifdef SHOW_WEIGHTS
out vec3 surface_joint_color;
#endif

mat3x4 blend_row(int row) {
    mat3x4 pose = joint_matrix(int(in_joints.x), row) * in_weights.x
                + joint_matrix(int(in_joints.y), row) * in_weights.y
                + joint_matrix(int(in_joints.z), row) * in_weights.z
                + joint_matrix(int(in_joints.w), row) * in_weights.w;
#ifdef EIGHT_JOINTS
    pose += joint_matrix(int(in_more_joints.x), row) * in_more_weights.x
          + joint_matrix(int(in_more_joints.y), row) * in_more_weights.y
          + joint_matrix(int(in_more_joints.z), row) * in_more_weights.z
          + joint_matrix(int(in_more_joints.w), row) * in_more_weights.w;
#endif
    return pose;
}

void main() {
    int row = int(in_row);
    mat3x4 pose = blend_row(row);
#ifndef NEAREST_FRAME
    float onwards = in_row - float(row);
    if (onwards > 0.0) {
        pose = pose * (1.0 - onwards) + blend_row(row + 1) * onwards;
    }
#endif
    mat3x4 world = mat3x4(in_world_row0, in_world_row1, in_world_row2);
    surface_position = transform_point(world, transform_point(pose, in_position));
    gl_Position = clip_from_world * vec4(surface_position, 1.0);
    surface_uv = in_uv;
    surface_normal_matrix = normal_matrix(world) * normal_matrix(pose);
    surface_rest = in_position;
    surface_tint = in_tint;
    surface_level = crowd_level;
#ifdef SHOW_WEIGHTS
    surface_joint_color = vec3(0.8);
#endif
}
