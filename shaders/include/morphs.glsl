// How an actor's morph targets (blend shapes) displace a place of the atlas: the sum of its targets, weighted, is made
// ready once a picture (runtime/asset/morphs.py), three texels for each texel of the position texture that any target
// touches. It is read as positions are, four texels blended, so that copies of a point stay one to the bit.
#ifndef MORPHS_GLSL
#define MORPHS_GLSL

#include "texels.glsl"

uniform usampler2D morph_numbers;  // of each cell of the position texture the numbers of its four texels, 0 for none
uniform sampler2D morph_sums;      // three rows of four a number: turn of the normal, shift
uniform int morph_height;          // rows that an actor's sums take

const int MORPHS_WIDTH_LOG2 = 10;  // sums a row

mat3x4 morph_texel(uint number, int actor) {
    if (number == 0u) {
        return mat3x4(0.0);
    }
    int place = int(number) - 1;
    ivec2 at = ivec2(3 * (place & ((1 << MORPHS_WIDTH_LOG2) - 1)), actor * morph_height + (place >> MORPHS_WIDTH_LOG2));
    return mat3x4(
        texelFetch(morph_sums, at, 0),
        texelFetch(morph_sums, at + ivec2(1, 0), 0),
        texelFetch(morph_sums, at + ivec2(2, 0), 0));
}

// Turn and shift at a place, rows of mathematics: zero where nothing moves.
mat3x4 morph_at(vec2 uv, ivec2 position_size, int actor) {
    TexelCell cell = texel_cell(uv, position_size);
    uvec4 numbers = texelFetch(morph_numbers, cell.corner, 0);
    if (numbers == uvec4(0u)) {
        return mat3x4(0.0);
    }
    mat3x4 t00 = morph_texel(numbers.x, actor);
    mat3x4 t10 = morph_texel(numbers.y, actor);
    mat3x4 t01 = morph_texel(numbers.z, actor);
    mat3x4 t11 = morph_texel(numbers.w, actor);
    return mat3x4(
        blend_cell(t00[0], t10[0], t01[0], t11[0], cell.fraction),
        blend_cell(t00[1], t10[1], t01[1], t11[1], cell.fraction),
        blend_cell(t00[2], t10[2], t01[2], t11[2], cell.fraction));
}

vec3 morphed_point(mat3x4 morph, vec3 point) {
    PRECISE vec3 moved = point + vec3(morph[0].w, morph[1].w, morph[2].w);
    return moved;
}

// What turns normals before the pose does: n + T n.
mat3 morph_turn(mat3x4 morph) {
    return mat3(1.0) + transpose(mat3(morph[0].xyz, morph[1].xyz, morph[2].xyz));
}

#endif
