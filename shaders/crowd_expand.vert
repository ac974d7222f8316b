// Vertices of a level read from the textures once, by transform feedback: position at rest, and one record of joints
// and weights. The very functions that static.vert uses, so that nothing differs.
#include "include/skinning.glsl"

in vec2 in_owner_uv;
uniform int record_number;   // which record of a cell, 0 for the first

out vec3 rest;
out vec4 joints;
out vec4 weights;

void main() {
    rest = rest_position(in_owner_uv);
    joints = vec4(0.0);
    weights = vec4(0.0);
    TexelCell cell = texel_cell(in_owner_uv, weight_size);
    uint record = texelFetch(weight_cells, cell.corner, 0).r;
    for (int number = 0; ; number++) {
        ivec2 at = record_texel(record);
        uvec4 palette = texelFetch(joint_records, at, 0);
        if (number == record_number) {
            uvec4 four = texelFetch(weight_records, at, 0);
            weights = blend_cell(unpack_weights(four.x), unpack_weights(four.y), unpack_weights(four.z),
                                 unpack_weights(four.w), cell.fraction);
            joints = vec4(uvec4(palette.x & (MORE_RECORDS - 1u), palette.yzw));
            break;
        }
        if (palette.x < MORE_RECORDS) break;
        record += 1u;
    }
    gl_Position = vec4(0.0);
}
