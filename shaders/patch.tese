// A point of a tessellated patch: where in the atlas it lies, then as any other point.
//
// A corner is evaluated at its canonical uv, a point of an edge at the owning edge's uvs, a point inside at the patch's
// own. Both triangles of an edge so start from the same bits; ends are put in one order before they are blended, so
// they also do the same arithmetic, whichever way round they see the edge.
#ifdef EQUAL_SPACING
layout(triangles, equal_spacing, ccw) in;
#else
layout(triangles, fractional_odd_spacing, ccw) in;
#endif
#include "include/frame.glsl"
#include "include/skinning.glsl"
#include "include/point_out.glsl"

in vec2 corner_uv[];
in vec2 corner_canonical_uv[];
#ifdef NORMAL_UV
in vec2 corner_normal_uv[];
#endif
in vec4 corner_edge_uvs[];
in vec3 corner_position[];
patch in vec4 patch_world_row0;
patch in vec4 patch_world_row1;
patch in vec4 patch_world_row2;
patch in vec4 patch_tint;
patch in ivec2 patch_pose_and_level;

bool comes_first(vec2 a, vec2 b) {
    return a.x < b.x || (a.x == b.x && a.y < b.y);
}

// A point of an edge with these ends, the second as far as its share says. Symmetric to the bit.
vec2 edge_point(vec2 a, vec2 b, float share_a, float share_b) {
    bool keep = comes_first(a, b);
    vec2 first = keep ? a : b;
    vec2 second = keep ? b : a;
    float share = keep ? share_b : share_a;
    PRECISE vec2 point = first + (second - first) * share;
    return point;
}

vec2 geometry_place(vec3 at, vec2 own_uv) {
#ifdef WITHOUT_CANONICAL_UVS
    return own_uv;
#else
    if (at.x == 1.0) return corner_canonical_uv[0];
    if (at.y == 1.0) return corner_canonical_uv[1];
    if (at.z == 1.0) return corner_canonical_uv[2];
    if (at.z == 0.0) return edge_point(corner_edge_uvs[0].xy, corner_edge_uvs[0].zw, at.x, at.y);
    if (at.x == 0.0) return edge_point(corner_edge_uvs[1].xy, corner_edge_uvs[1].zw, at.y, at.z);
    if (at.y == 0.0) return edge_point(corner_edge_uvs[2].xy, corner_edge_uvs[2].zw, at.z, at.x);
    return own_uv;
#endif
}

void main() {
    vec3 at = gl_TessCoord;
    PRECISE vec2 own_uv = corner_uv[0] * at.x + corner_uv[1] * at.y + corner_uv[2] * at.z;
    mat3x4 world = mat3x4(patch_world_row0, patch_world_row1, patch_world_row2);
    emit_point(own_uv, geometry_place(at, own_uv), world, patch_tint, patch_pose_and_level);
#ifdef NORMAL_UV
    surface_normal_uv = corner_normal_uv[0] * at.x + corner_normal_uv[1] * at.y + corner_normal_uv[2] * at.z;
#endif
}
