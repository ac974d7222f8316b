// One actor of a crowd, an instance: its pose lies at a row of the baked clips, or between two.
//
// A level's vertices were expanded once from the textures (crowd_expand.vert): position at rest and the strongest
// joints. That is what static.vert fetches for every actor anew. Of a coarse level the places of all vertices in all
// poses are ready-made (runtime/crowd/vertex_animation_texture.py): VERTEX_ANIMATION.
#include "include/frame.glsl"
#include "include/skinning.glsl"
#include "include/joint_color.glsl"
#ifdef MORPHS
#include "include/morphs.glsl"
#endif

in vec3 in_position;
in uvec4 in_joints;      // the strongest first
in vec4 in_weights;
#ifdef EIGHT_JOINTS
in uvec4 in_more_joints;
in vec4 in_more_weights;
#endif
in vec2 in_uv;
#ifdef NORMAL_UV
in uvec2 in_normal_uv;  // steps
#endif
in vec4 in_world_row0;   // once an instance: object space to world (seen from the eye)
in vec4 in_world_row1;
in vec4 in_world_row2;
in float in_pose_row;         // of the baked clips; the fraction lies on the way to the next one
in vec4 in_tint;
uniform int crowd_level;
#ifdef VERTEX_ANIMATION
in uint in_column;
uniform usampler2D vertex_animation_texture;   // a place along x, a pose a row: 11, 11 and 10 bits
uniform vec3 vertex_animation_scale;           // metres = whole number * scale + offset
uniform vec3 vertex_animation_offset;
#endif

#ifdef MORPHS
in uvec2 in_morph_list;                // first record, how many (runtime/crowd/morphs.py)
in float in_actor;                     // number in the crowd
uniform sampler2D crowd_morphs;        // four texels a record: three rows, and the morph's number
uniform sampler2D clip_morph_weights;  // a morph along x, a row of the baked clips along y
uniform sampler2D own_morph_weights;   // of one actor after the other, far beyond all weights where it is the clip's
uniform int num_morphs;
uniform bool has_own_morphs;

const int MORPH_ROW_LOG2 = 10;
const int MORPH_ROW_MASK = (1 << MORPH_ROW_LOG2) - 1;

float morph_weight(int morph, int row, int next, float onwards) {
    if (has_own_morphs) {
        int place = int(in_actor) * num_morphs + morph;
        float own = texelFetch(own_morph_weights, ivec2(place & MORPH_ROW_MASK, place >> MORPH_ROW_LOG2), 0).r;
        if (own < 1e8) {
            return own;
        }
    }
    float here = texelFetch(clip_morph_weights, ivec2(morph, row), 0).r;
    return onwards > 0.0 ? mix(here, texelFetch(clip_morph_weights, ivec2(morph, next), 0).r, onwards) : here;
}

mat3x4 listed_morphs(int row, int next, float onwards) {
    mat3x4 sum = mat3x4(0.0);
    for (uint number = 0u; number < in_morph_list.y; ++number) {
        int record = int(in_morph_list.x + number);
        ivec2 at = ivec2(4 * (record & MORPH_ROW_MASK), record >> MORPH_ROW_LOG2);
        float weight = morph_weight(int(texelFetch(crowd_morphs, at + ivec2(3, 0), 0).r), row, next, onwards);
        if (weight != 0.0) {
            sum += weight * mat3x4(
                texelFetch(crowd_morphs, at, 0),
                texelFetch(crowd_morphs, at + ivec2(1, 0), 0),
                texelFetch(crowd_morphs, at + ivec2(2, 0), 0));
        }
    }
    return sum;
}
#endif

out vec2 surface_uv;
#ifdef NORMAL_UV
out vec2 surface_normal_uv;
#endif
out vec3 surface_position;
out mat3 surface_normal_matrix;
out vec3 surface_rest;
flat out vec4 surface_tint;
flat out int surface_level;
#ifdef SHOW_WEIGHTS
out vec3 surface_joint_color;
#endif

#ifdef VERTEX_ANIMATION
vec3 whole_place(int row) {
    uint packed_place = texelFetch(vertex_animation_texture, ivec2(int(in_column), row), 0).r;
    return vec3(uvec3(packed_place & 2047u, (packed_place >> 11u) & 2047u, packed_place >> 22u));
}

vec3 posed_point(int row, int next, float onwards) {
    return mix(whole_place(row), whole_place(next), onwards) * vertex_animation_scale + vertex_animation_offset;
}

// What turns normals: the two strongest joints, in the nearest row.
mat3x4 posed_frame(int row, int next, float onwards) {
    int nearest = onwards < 0.5 ? row : next;
    return joint_matrix(int(in_joints.x), nearest) * in_weights.x
         + joint_matrix(int(in_joints.y), nearest) * in_weights.y;
}
#else
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

mat3x4 posed_frame(int row, int next, float onwards) {
    mat3x4 pose = blend_row(row);
    if (onwards > 0.0) {
        pose = pose * (1.0 - onwards) + blend_row(next) * onwards;
    }
    return pose;
}
#endif

void main() {
    int row = int(in_pose_row);
    float onwards = in_pose_row - float(row);
    int next = row + int(onwards > 0.0);  // a clip's last row has no next
    mat3x4 pose = posed_frame(row, next, onwards);
#ifdef VERTEX_ANIMATION
    vec3 point = posed_point(row, next, onwards);
#else
    vec3 rest = in_position;
#ifdef MORPHS
    mat3x4 morph = listed_morphs(row, next, onwards);
    rest = morphed_point(morph, rest);
#endif
    vec3 point = transform_point(pose, rest);
#endif
    mat3x4 world = mat3x4(in_world_row0, in_world_row1, in_world_row2);
    surface_position = transform_point(world, point);
    gl_Position = clip_from_world * vec4(surface_position, 1.0);
    surface_uv = in_uv;
#ifdef NORMAL_UV
    surface_normal_uv = vec2(in_normal_uv) / float(NORMAL_UV);
#endif
    surface_normal_matrix = normal_matrix(world) * pose_normal_matrix(pose);
#if defined(MORPHS) && !defined(VERTEX_ANIMATION)
    surface_normal_matrix = surface_normal_matrix * morph_turn(morph);
#endif
    surface_rest = in_position;
    surface_tint = in_tint;
    surface_level = crowd_level;
#ifdef SHOW_WEIGHTS
    surface_joint_color = joint_color(in_joints.x) * in_weights.x + joint_color(in_joints.y) * in_weights.y
                        + joint_color(in_joints.z) * in_weights.z + joint_color(in_joints.w) * in_weights.w;
#ifdef EIGHT_JOINTS
    surface_joint_color +=
        joint_color(in_more_joints.x) * in_more_weights.x + joint_color(in_more_joints.y) * in_more_weights.y
      + joint_color(in_more_joints.z) * in_more_weights.z + joint_color(in_more_joints.w) * in_more_weights.w;
#endif
#endif
}
