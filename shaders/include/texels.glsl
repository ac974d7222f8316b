// The one rule that ties uv to texels, on the GPU. Its CPU twin is preprocess/mesh/texels.py; one test compares the two.
//
// uv: origin at the top left of the image, v down. Texel (i, j) has its centre at ((i + 1/2) / W, (j + 1/2) / H).
// Filtering is four fetches and an explicit blend, so that no result depends on the precision of filtering hardware.
#ifndef TEXELS_GLSL
#define TEXELS_GLSL

struct TexelCell {
    ivec2 corner;   // texel (0, 0) of the 2 x 2 cell
    vec2 fraction;  // place in the cell, 0 to 1
};

// Continuous texel coordinates in which the centre of texel (i, j) is (i, j).
vec2 uv_to_px(vec2 uv, ivec2 size) {
    PRECISE vec2 px = uv * vec2(size) - 0.5;
    return px;
}

// The 2 x 2 cell that a bilinear sample reads. Samples outside the outermost centres clamp to the edge.
TexelCell texel_cell(vec2 uv, ivec2 size) {
    PRECISE vec2 px = clamp(uv_to_px(uv, size), vec2(0.0), vec2(size - 1));
    ivec2 corner = min(ivec2(floor(px)), max(size - 2, ivec2(0)));
    PRECISE vec2 fraction = px - vec2(corner);
    return TexelCell(corner, fraction);
}

// Blend of the texels (0,0), (1,0), (0,1), (1,1) of a cell.
vec4 blend_cell(vec4 t00, vec4 t10, vec4 t01, vec4 t11, vec2 fraction) {
    PRECISE vec4 top = t00 + (t10 - t00) * fraction.x;
    PRECISE vec4 bottom = t01 + (t11 - t01) * fraction.x;
    PRECISE vec4 blended = top + (bottom - top) * fraction.y;
    return blended;
}

vec4 fetch_bilinear(sampler2D image, vec2 uv) {
    ivec2 size = textureSize(image, 0);
    TexelCell cell = texel_cell(uv, size);
    ivec2 far_corner = min(cell.corner + 1, size - 1);
    return blend_cell(
        texelFetch(image, cell.corner, 0),
        texelFetch(image, ivec2(far_corner.x, cell.corner.y), 0),
        texelFetch(image, ivec2(cell.corner.x, far_corner.y), 0),
        texelFetch(image, far_corner, 0),
        cell.fraction);
}

#endif
