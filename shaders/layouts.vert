// Other ways to store joint weights, to compare with (python -m benchmarks draw): otherwise as static.vert.
//
// LAYOUT_LISTS: joints and weights a texel, up to LISTS of four each, the four texels blended by hand.
// LAYOUT_DENSE: a channel a joint, four joints a layer, LAYERS layers under one another.
#include "include/frame.glsl"
#include "include/instance.glsl"
#include "include/skinning.glsl"
#include "include/vertex_uvs.glsl"


out vec2 surface_uv;
out vec3 surface_position;
out mat3 surface_normal_matrix;
out vec3 surface_rest;
flat out vec4 surface_tint;
flat out int surface_level;

#ifdef LAYOUT_LISTS
uniform usampler2D texel_joints;
uniform sampler2D texel_weights;

mat3x4 blend_texel(ivec2 at, int pose, float share) {
    mat3x4 blended = mat3x4(0.0);
    for (int list = 0; list < LISTS; ++list) {
        ivec2 here = at + ivec2(0, list * weight_size.y);
        uvec4 joints = texelFetch(texel_joints, here, 0);
        vec4 weights = texelFetch(texel_weights, here, 0) * share;
        blended += joint_matrix(int(joints.x), pose) * weights.x + joint_matrix(int(joints.y), pose) * weights.y
                 + joint_matrix(int(joints.z), pose) * weights.z + joint_matrix(int(joints.w), pose) * weights.w;
    }
    return blended;
}

mat3x4 blend_all(vec2 uv, int pose) {
    TexelCell cell = texel_cell(uv, weight_size);
    vec4 shares = texel_shares(cell.fraction);
    return blend_texel(cell.corner, pose, shares.x) + blend_texel(cell.corner + ivec2(1, 0), pose, shares.y)
         + blend_texel(cell.corner + ivec2(0, 1), pose, shares.z) + blend_texel(cell.corner + ivec2(1, 1), pose,
         shares.w);
}
#else
uniform sampler2D dense_weights;

mat3x4 blend_all(vec2 uv, int pose) {
    TexelCell cell = texel_cell(uv, weight_size);
    mat3x4 blended = mat3x4(0.0);
    for (int layer = 0; layer < LAYERS; ++layer) {
        ivec2 at = cell.corner + ivec2(0, layer * weight_size.y);
        vec4 weights = blend_cell(
            texelFetch(dense_weights, at, 0), texelFetch(dense_weights, at + ivec2(1, 0), 0),
            texelFetch(dense_weights, at + ivec2(0, 1), 0), texelFetch(dense_weights, at + ivec2(1, 1), 0),
            cell.fraction);
        blended += joint_matrix(4 * layer, pose) * weights.x + joint_matrix(4 * layer + 1, pose) * weights.y
                 + joint_matrix(4 * layer + 2, pose) * weights.z + joint_matrix(4 * layer + 3, pose) * weights.w;
    }
    return blended;
}
#endif

void main() {
    vec3 rest = rest_position(canonical_uv());
    mat3x4 pose = blend_all(canonical_uv(), in_pose_and_level.x);
    mat3x4 world = mat3x4(in_world_row0, in_world_row1, in_world_row2);
    vec3 position = transform_point(world, transform_point(pose, rest));
    gl_Position = clip_from_world * vec4(position, 1.0);
    surface_uv = own_uv();
    surface_position = position;
    surface_normal_matrix = normal_matrix(world) * pose_normal_matrix(pose);
    surface_rest = rest;
    surface_tint = in_tint;
    surface_level = in_pose_and_level.y;
}
