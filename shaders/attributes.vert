// Ordinary skinning, to compare with: position, joints and weights are vertex attributes (python -m benchmarks draw).
#include "include/frame.glsl"
#include "include/instance.glsl"

in vec3 in_position;
in vec2 in_uv;
in vec4 in_weights;
in uvec4 in_joints;

layout(std140) uniform Joints { vec4 joint_block[JOINT_BLOCK_ROWS]; };

out vec2 surface_uv;
out vec3 surface_position;
out mat3 surface_normal_matrix;
out vec3 surface_rest;
flat out vec4 surface_tint;
flat out int surface_level;

mat3x4 joint_matrix(uint joint) {
    uint first = 3u * joint;
    return mat3x4(joint_block[first], joint_block[first + 1u], joint_block[first + 2u]);
}

mat3 normal_matrix(mat3x4 rows) {
    vec3 x = rows[0].xyz, y = rows[1].xyz, z = rows[2].xyz;
    vec3 yz = cross(y, z);
    float handedness = dot(x, yz) < 0.0 ? -1.0 : 1.0;
    return transpose(mat3(yz, cross(z, x), cross(x, y))) * handedness;
}

void main() {
    mat3x4 pose = joint_matrix(in_joints.x) * in_weights.x + joint_matrix(in_joints.y) * in_weights.y
                + joint_matrix(in_joints.z) * in_weights.z + joint_matrix(in_joints.w) * in_weights.w;
    mat3x4 world = mat3x4(in_world_row0, in_world_row1, in_world_row2);
    vec3 position = vec4(vec4(in_position, 1.0) * pose, 1.0) * world;
    gl_Position = clip_from_world * vec4(position, 1.0);
    surface_uv = in_uv;
    surface_position = position;
    surface_normal_matrix = normal_matrix(world) * normal_matrix(pose);
    surface_rest = in_position;
    surface_tint = in_tint;
    surface_level = in_pose_and_level.y;
}
