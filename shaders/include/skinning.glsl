// A point of the animated surface from its place in the atlas (paper, sections 7 and 8).
//
// Positions are one bilinear sample. Joint weights come in records a 2 x 2 cell of the weight map (runtime/gpu/weight_records.py):
// a palette of joints, and the weights of these at the cell's four texels. All four texels share the palette, so the
// blend is exact, with any number of joints, and continuous from cell to cell. A record is one fetch: three joints with
// their weights, and the last of a cell's records names one more joint, to which goes what the others left of one.
// Where the map is too coarse, a cell's record names four others, one a quarter (runtime/asset/weight_quadtree.py).
#ifndef SKINNING_GLSL
#define SKINNING_GLSL

#include "texels.glsl"

#ifdef POSITION_WORDS
uniform usampler2D position_texture;   // x, y and z in one word (runtime/asset/packed_positions.py)
uniform uvec3 position_shifts;
uniform uvec3 position_masks;
#else
uniform sampler2D position_texture;
#endif
uniform vec3 position_scale;           // metres = texel * scale + offset
uniform vec3 position_offset;
uniform usampler2D weight_cells;       // number of the first record of each cell
uniform usampler2D weight_records;     // four bytes of joints, then for three joints a byte a texel
#ifdef WIDE_JOINTS
uniform usampler2D joint_records;      // the joints where a byte is too few
#endif
uniform ivec2 weight_size;             // of the weight map, texels
uniform uint first_divided_record;     // from here on records are four numbers of records, one a quarter
uniform sampler2D joint_texture;       // three rows of a matrix a joint along x, one pose a row

const uint MORE_RECORDS = 255u;        // in place of the fourth joint: further records follow
const int RECORDS_WIDTH_LOG2 = 6;      // records are stored in rows of 64

// Matrices of 3 rows and 4 columns are held as mat3x4, a row of mathematics in each of its three vec4.
vec3 transform_point(mat3x4 rows, vec3 point) {
    PRECISE vec3 moved = vec4(point, 1.0) * rows;
    return moved;
}

mat3x4 joint_matrix(int joint, int pose) {
    ivec2 at = ivec2(3 * joint, pose);
    return mat3x4(
        texelFetch(joint_texture, at, 0),
        texelFetch(joint_texture, at + ivec2(1, 0), 0),
        texelFetch(joint_texture, at + ivec2(2, 0), 0));
}

vec4 unpack_weights(uint packed_weights) {
    return vec4((uvec4(packed_weights) >> uvec4(0u, 8u, 16u, 24u)) & 255u) * (1.0 / 255.0);
}

ivec2 record_texel(uint record) {
    return ivec2(int(record) & ((1 << RECORDS_WIDTH_LOG2) - 1), int(record) >> RECORDS_WIDTH_LOG2);
}

// What the four texels of a cell, (0,0), (1,0), (0,1), (1,1), count at a place in it.
vec4 texel_shares(vec2 fraction) {
    vec2 onwards = 1.0 - fraction;
    PRECISE vec4 shares = vec4(onwards.x, fraction.x, onwards.x, fraction.x)
                        * vec4(onwards.y, onwards.y, fraction.y, fraction.y);
    return shares;
}

// The first record at a place of the atlas, and what the four corners of its cell, or part of a cell, count there.
uint find_record(vec2 uv, out vec4 shares) {
    TexelCell cell = texel_cell(uv, weight_size);
    vec2 fraction = cell.fraction;
    uint record = texelFetch(weight_cells, cell.corner, 0).r;
    while (record >= first_divided_record) {
        ivec2 quarter = ivec2(greaterThanEqual(fraction, vec2(0.5)));
        fraction = fraction * 2.0 - vec2(quarter);
        record = texelFetch(weight_records, record_texel(record), 0)[quarter.x + 2 * quarter.y];
    }
    shares = texel_shares(fraction);
    return record;
}

// A record's joints. The fourth is the last record's alone.
uvec4 record_joints(uint joint_bytes, ivec2 at) {
#ifdef WIDE_JOINTS
    return texelFetch(joint_records, at, 0);
#else
    return (uvec4(joint_bytes) >> uvec4(0u, 8u, 16u, 24u)) & 255u;
#endif
}

bool has_more(uint joint_bytes) {
    return (joint_bytes >> 24u) == MORE_RECORDS;
}

// Weights of a record's first three joints.
vec3 given_weights(uvec4 words, vec4 shares) {
    PRECISE vec3 given = vec3(
        dot(unpack_weights(words.y), shares), dot(unpack_weights(words.z), shares), dot(unpack_weights(words.w), shares));
    return given;
}

// Read a record whole: its four joints with their weights. `left` is what they leave of one, and whether more records
// follow is the result. Before the last record the fourth weight is zero.
bool read_record(uint record, vec4 shares, inout float left, out uvec4 joints, out vec4 weights) {
    ivec2 at = record_texel(record);
    uvec4 words = texelFetch(weight_records, at, 0);
    vec3 given = given_weights(words, shares);
    left -= given.x + given.y + given.z;
    bool more = has_more(words.x);
    joints = record_joints(words.x, at);
    joints.w = more ? 0u : joints.w;
    weights = vec4(given, more ? 0.0 : left);
    return more;
}

#ifdef DUAL_QUATERNIONS
// A blend of dual quaternions and stretches (runtime/animation/dual_quaternions.py).
struct DualBlend {
    vec4 real;
    vec4 dual;
    mat3 stretch;  // rows as columns
};

void add_joint(inout DualBlend blend, int joint, int pose, float weight) {
    ivec2 at = ivec2(5 * joint, pose);
    vec4 real = texelFetch(joint_texture, at, 0);
    PRECISE float signed_weight = dot(real, blend.real) < 0.0 ? -weight : weight;  // q and -q turn alike
    blend.real += real * signed_weight;
    blend.dual += texelFetch(joint_texture, at + ivec2(1, 0), 0) * signed_weight;
    blend.stretch += mat3(
        texelFetch(joint_texture, at + ivec2(2, 0), 0).xyz,
        texelFetch(joint_texture, at + ivec2(3, 0), 0).xyz,
        texelFetch(joint_texture, at + ivec2(4, 0), 0).xyz) * weight;
}

mat3x4 dual_matrix(DualBlend blend) {
    float scale = inversesqrt(max(dot(blend.real, blend.real), 1e-30));
    PRECISE vec4 q = blend.real * scale;
    PRECISE vec4 d = blend.dual * scale;
    PRECISE vec3 moved = 2.0 * (q.w * d.xyz - d.w * q.xyz + cross(q.xyz, d.xyz));
    vec3 twice = 2.0 * q.xyz;
    vec3 x = vec3(1.0 - twice.y * q.y - twice.z * q.z, twice.x * q.y - twice.z * q.w, twice.x * q.z + twice.y * q.w);
    vec3 y = vec3(twice.x * q.y + twice.z * q.w, 1.0 - twice.x * q.x - twice.z * q.z, twice.y * q.z - twice.x * q.w);
    vec3 z = vec3(twice.x * q.z - twice.y * q.w, twice.y * q.z + twice.x * q.w, 1.0 - twice.x * q.x - twice.y * q.y);
    return mat3x4(
        vec4(blend.stretch * x, moved.x), vec4(blend.stretch * y, moved.y), vec4(blend.stretch * z, moved.z));
}

// The joints' motions blended with the weights at a place of the atlas (dual quaternion skinning).
mat3x4 blend_joints(vec2 uv, int pose) {
    vec4 shares;
    uint record = find_record(uv, shares);
    DualBlend blend = DualBlend(vec4(0.0), vec4(0.0), mat3(0.0));
    float left = 1.0;
    bool more = true;
    while (more) {
        uvec4 joints;
        vec4 weights;
        more = read_record(record, shares, left, joints, weights);
        add_joint(blend, int(joints.x), pose, weights.x);
        add_joint(blend, int(joints.y), pose, weights.y);
        add_joint(blend, int(joints.z), pose, weights.z);
        add_joint(blend, int(joints.w), pose, weights.w);
        record += 1u;
    }
    return dual_matrix(blend);
}
#else
// The joints' matrices blended with the weights at a place of the atlas (linear blend skinning).
// Mesa's software rasteriser runs this form of the loop a tenth faster than one over read_record().
mat3x4 blend_joints(vec2 uv, int pose) {
    vec4 shares;
    uint record = find_record(uv, shares);
    PRECISE mat3x4 blended = mat3x4(0.0);
    float left = 1.0;
    for (;;) {
        ivec2 at = record_texel(record);
        uvec4 words = texelFetch(weight_records, at, 0);
        vec3 given = given_weights(words, shares);
        uvec4 joints = record_joints(words.x, at);
        blended += joint_matrix(int(joints.x), pose) * given.x;
        blended += joint_matrix(int(joints.y), pose) * given.y;
        blended += joint_matrix(int(joints.z), pose) * given.z;
        left -= given.x + given.y + given.z;
        if (!has_more(words.x)) {
            blended += joint_matrix(int(joints.w), pose) * left;
            break;
        }
        record += 1u;
    }
    return blended;
}
#endif

#ifdef POSITION_WORDS
vec4 position_texel(ivec2 at) {
    return vec4(vec3((uvec3(texelFetch(position_texture, at, 0).r) >> position_shifts) & position_masks), 0.0);
}

vec4 fetch_position(vec2 uv) {
    ivec2 size = textureSize(position_texture, 0);
    TexelCell cell = texel_cell(uv, size);
    ivec2 far_corner = min(cell.corner + 1, size - 1);
    return blend_cell(
        position_texel(cell.corner),
        position_texel(ivec2(far_corner.x, cell.corner.y)),
        position_texel(ivec2(cell.corner.x, far_corner.y)),
        position_texel(far_corner),
        cell.fraction);
}
#else
vec4 fetch_position(vec2 uv) {
    return fetch_bilinear(position_texture, uv);
}
#endif

// Position at rest, object space, metres.
vec3 rest_position(vec2 uv) {
    PRECISE vec3 position = fetch_position(uv).xyz * position_scale + position_offset;
    return position;
}

// product of two such matrices, the second applied first
mat3x4 compose(mat3x4 outer, mat3x4 inner) {
    mat4 full = mat4(inner[0], inner[1], inner[2], vec4(0.0, 0.0, 0.0, 1.0));
    return mat3x4(full * outer[0], full * outer[1], full * outer[2]);
}

// What turns normals: the cofactors of the 3 x 3 part, which is its inverse transpose up to length, the right way
// round where the matrix mirrors.
mat3 normal_matrix(mat3x4 rows) {
    vec3 x = rows[0].xyz, y = rows[1].xyz, z = rows[2].xyz;
    vec3 yz = cross(y, z);
    float handedness = dot(x, yz) < 0.0 ? -1.0 : 1.0;
    return transpose(mat3(yz, cross(z, x), cross(x, y))) * handedness;
}

// The same of a pose. A part that joints mirror shows its back faces, whose normals are turned if it is drawn from both
// sides: there the plain cofactors, which point inwards, make the outside the outside again (glTF 2.0, section 3.7.4).
mat3 pose_normal_matrix(mat3x4 rows) {
#ifdef ONE_SIDED
    return normal_matrix(rows);
#else
    vec3 x = rows[0].xyz, y = rows[1].xyz, z = rows[2].xyz;
    return transpose(mat3(cross(y, z), cross(z, x), cross(x, y)));
#endif
}

#endif
