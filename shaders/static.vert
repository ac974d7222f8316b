// A level of detail as it is: one vertex a corner of its triangles, everything but its uvs fetched from textures.
//
// Every copy of a surface point has the same canonical uv and so computes the same bits (docs/method.md, section 6);
// the material is sampled at the copy's own uv.
#include "include/frame.glsl"
#include "include/instance.glsl"
#include "include/skinning.glsl"
#include "include/point_out.glsl"
#include "include/vertex_uvs.glsl"

#ifdef NORMAL_UV
in uvec2 in_normal_uv;  // steps
#endif

void main() {
#ifdef WITHOUT_CANONICAL_UVS
    vec2 geometry_uv = own_uv();
#else
    vec2 geometry_uv = canonical_uv();
#endif
    emit_point(own_uv(), geometry_uv, mat3x4(in_world_row0, in_world_row1, in_world_row2), in_tint, in_pose_and_level);
#ifdef NORMAL_UV
    surface_normal_uv = uv_of_steps(in_normal_uv, NORMAL_UV);
#endif
}
