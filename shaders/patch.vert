// A control point of a patch: nothing is computed yet, only passed on.
#include "include/instance.glsl"
#include "include/vertex_uvs.glsl"

#ifdef NORMAL_UV
in uvec2 in_normal_uv;  // steps
#endif

out vec2 point_uv;
out vec2 point_canonical_uv;
#ifdef NORMAL_UV
out vec2 point_normal_uv;
#endif
out vec4 point_world_row0;
out vec4 point_world_row1;
out vec4 point_world_row2;
out vec4 point_tint;
flat out ivec2 point_pose_and_level;

void main() {
    point_uv = own_uv();
    point_canonical_uv = canonical_uv();
#ifdef NORMAL_UV
    point_normal_uv = uv_of_steps(in_normal_uv, NORMAL_UV);
#endif
    point_world_row0 = in_world_row0;
    point_world_row1 = in_world_row1;
    point_world_row2 = in_world_row2;
    point_tint = in_tint;
    point_pose_and_level = in_pose_and_level;
}
