// What a fragment shader gets, a caller's own too: include this file and call read_surface().
#ifndef SURFACE_GLSL
#define SURFACE_GLSL

#include "frame.glsl"

in vec2 surface_uv;               // place in the atlas
#ifdef NORMAL_UV
in vec2 surface_normal_uv;        // where the normal texture is sampled: beside hard edges a texel further inwards
#else
#define surface_normal_uv surface_uv
#endif
#ifdef COLOR_AT_NORMAL_UV
#define surface_color_uv surface_normal_uv
#else
#define surface_color_uv surface_uv
#endif
in vec3 surface_position;         // metres, world axes, from the eye
in mat3 surface_normal_matrix;    // object space at rest -> world, not normalised
in vec3 surface_rest;             // object space at rest, metres
in vec4 surface_tint;
flat in int surface_level;        // level of detail

uniform sampler2D normal_texture;
uniform sampler2D base_color_texture;
uniform sampler2D orm_texture;
uniform sampler2D emissive_texture;
uniform vec2 normal_decode;       // normal = texel * x + y
uniform vec4 base_color_factor;
uniform vec4 surface_factors;     // occlusion strength, roughness, metallic; alpha cutoff (below 0: none)
uniform vec3 emissive_factor;
uniform int surface_flags;        // bit 0: blended, bit 1: unlit

// Programs for materials that lack a thing are compiled without it: NO_CUTOUT (alpha mode MASK), NO_EMISSION, NO_ORM (no
// occlusion-roughness-metallic texture).

struct Surface {
    vec2 uv;
    vec3 position;     // metres, world axes, from the eye
    vec3 normal;       // unit, world axes, facing the eye's side of a double-sided surface
    vec3 view;         // unit, towards the eye
    vec4 base_color;   // linear rgb, alpha
    vec3 encoded;      // base colour's rgb as stored (sRGB), before decoding
    float occlusion;
    float roughness;   // perceptual
    float metallic;
    vec3 emissive;     // linear
    bool unlit;
};

// sRGB's curves without powers: fits over [0, 1] that are off by 0.05 and 0.1 of an 8-bit step at most.
vec3 decode_srgb(vec3 encoded) {
    vec3 low = encoded * (1.0 / 12.92);
    vec3 high = (((encoded * -0.11678043 + 0.52647363) * encoded + 0.56040372) * encoded + 0.02839627) * encoded
        + 0.00104673;
    return mix(low, high, step(0.04045, encoded));
}

vec3 encode_srgb(vec3 linear_color) {
    vec3 low = linear_color * 12.92;
    vec3 root = sqrt(max(linear_color, 0.0));
    vec3 high = root * 0.83372401 + sqrt(root) * 0.29814008 - linear_color * 0.05531354 - 0.07691190;
    return mix(low, high, step(0.0031308, linear_color));
}

// The texture's vector as stored, turned to world axes and made unit: object space normals, filtered as vectors.
vec3 shading_normal() {
    vec3 at_rest = texture(normal_texture, surface_normal_uv).xyz * normal_decode.x + normal_decode.y;
    vec3 normal = surface_normal_matrix * at_rest;
    normal *= inversesqrt(max(dot(normal, normal), 1e-30));
    return gl_FrontFacing ? normal : -normal;
}

// Colours are blended in the encoding they are stored in, in which their seams were closed, and then decoded.
vec4 encoded_base_color() {
    vec4 texel = texture(base_color_texture, surface_color_uv);
    float alpha = texel.a * base_color_factor.a * surface_tint.a;
#ifndef NO_CUTOUT
    if (alpha < surface_factors.w) discard;
#endif
    return vec4(texel.rgb, (surface_flags & 1) != 0 ? alpha : 1.0);
}

Surface read_surface() {
    Surface s;
    vec4 encoded = encoded_base_color();
#ifdef NO_ORM
    vec3 orm = vec3(1.0);
#else
    vec3 orm = texture(orm_texture, surface_color_uv).rgb;
#endif
    s.uv = surface_uv;
    s.position = surface_position;
    s.normal = shading_normal();
    s.view = -normalize(surface_position);
    s.encoded = encoded.rgb;
    s.base_color = vec4(decode_srgb(encoded.rgb) * base_color_factor.rgb * surface_tint.rgb, encoded.a);
    s.occlusion = 1.0 + surface_factors.x * (orm.r - 1.0);
    s.roughness = clamp(orm.g * surface_factors.y, 0.045, 1.0);
    s.metallic = clamp(orm.b * surface_factors.z, 0.0, 1.0);
#ifdef NO_EMISSION
    s.emissive = vec3(0.0);
#else
    s.emissive = decode_srgb(texture(emissive_texture, surface_color_uv).rgb) * emissive_factor;
#endif
    s.unlit = (surface_flags & 2) != 0;
    return s;
}

#endif
