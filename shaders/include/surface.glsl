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
flat in vec4 surface_tint;
flat in int surface_level;        // level of detail

uniform sampler2D normal_texture;
uniform sampler2D base_color_texture;
uniform sampler2D orm_texture;
uniform sampler2D emissive_texture;
uniform vec4 base_color_factor;
uniform vec4 surface_factors;     // occlusion strength, roughness, metallic; alpha cutoff (below 0: none)
uniform vec3 emissive_factor;
uniform bool surface_blended;

// Programs for materials that lack a thing are compiled without it: NO_ALPHA_TEST (alpha mode MASK), NO_BLEND (alpha mode
// BLEND), NO_FACTOR (a base colour factor), NO_ROUGHNESS_FACTOR, NO_EMISSION, NO_OCCLUSION, NO_METAL, NO_ORM (an
// occlusion-roughness-metallic texture), ONE_SIDED. UNLIT materials have a colour alone. What varies of occlusion,
// roughness and metallic may lie in alpha channels (runtime/gpu/material_packing.py): ROUGHNESS_IN_COLOR,
// OCCLUSION_IN_NORMAL, METALLIC_IN_NORMAL. A driver that runs shaders on the processor reads every uniform anew in
// every invocation: there are few on purpose.

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
    return mix(low, high, greaterThan(encoded, vec3(0.04045)));
}

vec3 encode_srgb(vec3 linear_color) {
    vec3 low = linear_color * 12.92;
    vec3 root = sqrt(max(linear_color, 0.0));
    vec3 high = ((((root * 0.51730323 - 1.62365937) * root + 2.03157544) * root - 1.40273690) * root + 1.51795101) * root
        - 0.04010961;
    return mix(low, high, greaterThan(linear_color, vec3(0.0031308)));
}

// A normal texel's vector as stored, turned to world axes and made unit: object space normals, filtered as vectors.
vec3 world_normal(vec3 texel) {
#ifdef FLOAT_NORMALS
    vec3 normal = surface_normal_matrix * texel;
#else
    vec3 normal = surface_normal_matrix * (texel - 0.5);  // half as long, and made unit
#endif
    normal *= inversesqrt(max(dot(normal, normal), 1e-30));
#ifdef ONE_SIDED
    return normal;
#else
    return gl_FrontFacing ? normal : -normal;
#endif
}

vec3 shading_normal() {
    return world_normal(texture(normal_texture, surface_normal_uv).xyz);
}

// Colours are blended in the encoding they are stored in, in which their seams were closed, and then decoded.
vec4 alpha_test(vec4 texel) {
#if defined(NO_ALPHA_TEST) && defined(NO_BLEND)
    return vec4(texel.rgb, 1.0);
#else
    float alpha = texel.a * base_color_factor.a * surface_tint.a;
#ifndef NO_ALPHA_TEST
    if (alpha < surface_factors.w) discard;
#endif
    return vec4(texel.rgb, surface_blended ? alpha : 1.0);
#endif
}

vec4 encoded_base_color() {
    return alpha_test(texture(base_color_texture, surface_color_uv));
}

// What a stored base colour is multiplied with, linear.
vec3 color_factor() {
#ifdef NO_FACTOR
    return surface_tint.rgb;
#else
    return surface_tint.rgb * base_color_factor.rgb;
#endif
}

Surface read_surface() {
    Surface s;
    vec4 color_texel = texture(base_color_texture, surface_color_uv);
    vec4 normal_texel = texture(normal_texture, surface_normal_uv);
    vec4 encoded = alpha_test(color_texel);
#ifdef NO_ORM
    vec3 orm = vec3(1.0);
#else
    vec3 orm = texture(orm_texture, surface_color_uv).rgb;
#endif
#ifdef ROUGHNESS_IN_COLOR
    orm.g = color_texel.a;
#endif
#ifdef OCCLUSION_IN_NORMAL
    orm.r = normal_texel.a;
#endif
#ifdef METALLIC_IN_NORMAL
    orm.b = normal_texel.a;
#endif
    s.uv = surface_uv;
    s.position = surface_position;
    s.normal = world_normal(normal_texel.xyz);
    s.view = -normalize(surface_position);
    s.encoded = encoded.rgb;
    s.base_color = vec4(decode_srgb(encoded.rgb) * color_factor(), encoded.a);
#ifdef NO_OCCLUSION
    s.occlusion = 1.0;
#else
    s.occlusion = 1.0 + surface_factors.x * (orm.r - 1.0);
#endif
#ifdef NO_ROUGHNESS_FACTOR
    s.roughness = max(orm.g, 0.045);
#else
    s.roughness = max(orm.g * surface_factors.y, 0.045);
#endif
#ifdef NO_METAL
    s.metallic = 0.0;
#else
    s.metallic = orm.b * surface_factors.z;
#endif
#ifdef NO_EMISSION
    s.emissive = vec3(0.0);
#else
    s.emissive = decode_srgb(texture(emissive_texture, surface_color_uv).rgb) * emissive_factor;
#endif
#ifdef UNLIT
    s.unlit = true;
#else
    s.unlit = false;
#endif
    return s;
}

#endif
