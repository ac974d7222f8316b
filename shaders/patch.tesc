// How finely each edge of a patch is divided.
//
// A patch is 12 points: 3 corners, then for each edge (from corner k to corner k + 1) the two ends of its owning edge,
// the one half-edge of the two that meet there at whose uvs both triangles evaluate what lies between (Castaño 2008,
// "Next-generation hardware rendering of displaced subdivision surfaces"), and then for each corner the copy of it at
// whose own uv it is fetched; one that is no copy leaves it at its canonical uv (runtime/gpu/patches.py). An edge's
// factor comes from these ends and the corners' canonical uvs alone, which both triangles have identically, by
// arithmetic that does not care which end is first: so both divide it alike.
#include "include/frame.glsl"
#include "include/skinning.glsl"
#ifdef MORPHS
#include "include/morphs.glsl"
#endif

layout(vertices = 3) out;

in vec2 point_uv[];
in vec2 point_canonical_uv[];
#ifdef NORMAL_UV
in vec2 point_normal_uv[];
#endif
in vec4 point_world_row0[];
in vec4 point_world_row1[];
in vec4 point_world_row2[];
in vec4 point_tint[];
flat in ivec2 point_pose_and_level[];

out vec2 corner_uv[];
out vec2 corner_canonical_uv[];
#ifdef NORMAL_UV
out vec2 corner_normal_uv[];
#endif
out vec4 corner_edge_uvs[];  // ends of the owning edge that starts at this corner
out vec3 corner_position[];
patch out vec4 patch_world_row0;
patch out vec4 patch_world_row1;
patch out vec4 patch_world_row2;
patch out vec4 patch_tint;
patch out ivec2 patch_pose_and_level;

vec3 moved_rest(vec2 place, int corner) {
#ifdef MORPHS
    return morphed_point(
        morph_at(place, textureSize(position_texture, 0), point_pose_and_level[corner].x), rest_position(place));
#else
    return rest_position(place);
#endif
}

float edge_factor(vec3 a, vec3 b, vec4 edge_uvs) {
    if (edge_uvs.xy == edge_uvs.zw) {  // an edge that is to stay whole (runtime/gpu/patch_validation.py)
        return 1.0;
    }
    if (fixed_factor > 0.0) {
        return fixed_factor;
    }
    PRECISE vec3 middle = (a + b) * 0.5;
    vec3 along = a - b;
    PRECISE float length_m = sqrt(dot(along, along));
    vec4 depth_row = vec4(clip_from_world[0].w, clip_from_world[1].w, clip_from_world[2].w, clip_from_world[3].w);
    PRECISE float depth = dot(depth_row, vec4(middle, 1.0));
    // The sphere around the edge: its nearest point decides, so an edge that passes the eye is still fine enough.
    PRECISE float nearest = max(depth - 0.5 * length_m * depth_per_metre, 1e-3 * length_m + 1e-30);
    PRECISE float by_pixels = length_m * pixels_per_metre / (nearest * segment_px);
    vec2 across = abs(edge_uvs.xy - edge_uvs.zw) * vec2(textureSize(position_texture, 0));
    PRECISE float by_texels = max(across.x, across.y) / texels_per_segment;
    return clamp(min(by_pixels, by_texels), 1.0, largest_factor);
}

void main() {
    int corner = gl_InvocationID;  // outputs are indexed by the built-in name alone
    mat3x4 world = mat3x4(point_world_row0[corner], point_world_row1[corner], point_world_row2[corner]);
    vec2 place = point_canonical_uv[corner] == point_canonical_uv[9 + corner] ? point_uv[9 + corner] : point_canonical_uv[corner];
    corner_uv[gl_InvocationID] = point_uv[corner];
    corner_canonical_uv[gl_InvocationID] = place;
#ifdef NORMAL_UV
    corner_normal_uv[gl_InvocationID] = point_normal_uv[corner];
#endif
    corner_edge_uvs[gl_InvocationID] = vec4(point_uv[3 + 2 * corner], point_uv[4 + 2 * corner]);
    corner_position[gl_InvocationID] = fixed_factor > 0.0
        ? vec3(0.0)
        : transform_point(world, transform_point(blend_joints(place, point_pose_and_level[corner].x), moved_rest(place, corner)));
    barrier();
    if (corner == 0) {
        patch_world_row0 = point_world_row0[0];
        patch_world_row1 = point_world_row1[0];
        patch_world_row2 = point_world_row2[0];
        patch_tint = point_tint[0];
        patch_pose_and_level = point_pose_and_level[0];
        // The outer level k belongs to the edge opposite corner k.
        float factors[3];
        for (int edge = 0; edge < 3; ++edge) {
            int next = (edge + 1) % 3;
            factors[edge] = edge_factor(corner_position[edge], corner_position[next], corner_edge_uvs[edge]);
        }
        gl_TessLevelOuter[2] = factors[0];
        gl_TessLevelOuter[0] = factors[1];
        gl_TessLevelOuter[1] = factors[2];
        gl_TessLevelInner[0] = max(max(factors[0], factors[1]), factors[2]);
    }
}
