// glTF's metallic-roughness model under one directional light and an environment.
//
// Sources: glTF 2.0 specification, appendix B (the model); Walter et al. 2007 (GGX); Heitz 2014 (height-correlated
// masking); Karis 2013 (reflection as prefiltered radiance times an integral of the BRDF alone; the fit of that integral
// below is ours); Heidrich and Seidel 1998 (two half spheres); Lagarde and de Rousiers 2014 (specular occlusion).
#ifndef LIGHTING_GLSL
#define LIGHTING_GLSL

#include "surface.glsl"

// Light by direction (runtime/gpu/environment_map.py): tiles of two half spheres laid flat stereographically, the upper one left.
// Mirrored light has a tile for each of 33 steps of roughness, in three columns of which each is half as large as the
// one before; one more tile holds the light from all around on a white sheet. No smaller levels: a driver that filters
// on the processor samples a texture that has some at twice the price, even where it is told which to take.
uniform sampler2D reflection_texture;
const float STEPS_PER_LEVEL = 8.0;
const float FIRST_STEP = STEPS_PER_LEVEL;
const float LAST_STEP = 5.0 * STEPS_PER_LEVEL;
const float MAP_REACH = 0.8;  // of a half sphere's square; what is beyond belongs to the other one
const vec4 DIFFUSE_TILE = vec4(0.5, 0.625, 0.3, 0.075);  // corner and size in the map

// Where the light from a direction, a unit vector, lies in a tile.
vec2 map_location(vec3 direction) {
    float scale = MAP_REACH * 0.5 / (1.0 + abs(direction.y));
    return direction.xz * vec2(0.5 * scale, scale) + vec2(direction.y < 0.0 ? 0.75 : 0.25, 0.5);
}

// Light from all around on a diffuse surface of this normal, as the radiance of a white sheet.
vec3 environment_diffuse(vec3 normal) {
    return textureLod(reflection_texture, map_location(normal) * DIFFUSE_TILE.zw + DIFFUSE_TILE.xy, 0.0).rgb;
}

// What a surface of roughness (nth / LAST_STEP)^2 mirrors at a place of its tile.
vec3 specular_radiance(vec2 place, float nth) {
    vec2 column = nth < 15.5 ? vec2(1.0, 8.0) : nth < 23.5 ? vec2(0.5, 16.0) : vec2(0.25, 24.0);  // size, first step
    vec2 tile = vec2(1.0 - column.x, (nth - column.y) * 0.125 * column.x);
    return textureLod(reflection_texture, tile + place * (column.x * vec2(0.5, 0.125)), 0.0).rgb;
}

// Metal mirrors enough to show every step, so it blends the two whole levels around its roughness. Of what else there is
// the nearest step does.
vec3 environment_reflection(vec3 direction, float roughness) {
    vec2 place = map_location(direction);
    float nth = clamp(sqrt(roughness) * LAST_STEP, FIRST_STEP, LAST_STEP);
#ifdef NO_METAL
    return specular_radiance(place, floor(nth + 0.5));
#else
    float sharper = min(floor(nth / STEPS_PER_LEVEL) * STEPS_PER_LEVEL, LAST_STEP - STEPS_PER_LEVEL);
    return mix(specular_radiance(place, sharper), specular_radiance(place, sharper + STEPS_PER_LEVEL),
               (nth - sharper) / STEPS_PER_LEVEL);
#endif
}

// Scale and bias of the reflectance at normal incidence, after the BRDF is integrated over a constant environment: a fit
// to the integral by 2048 samples, off by 0.11 and 0.06 at most (at grazing angles, elsewhere by 0.07). A power of
// 1 - n.v that depends on roughness is closest, but two whole ones come within 0.003 of it at half the price.
vec2 environment_brdf(float n_dot_v, float roughness) {
    float v = n_dot_v, r = roughness;
    float total = 1.0 - r * r * (0.469 - 0.387 * r + v * (1.124 + 0.183 * r + v * (-1.555 + 0.895 * r)));
    vec2 powers = vec2(-0.208, 1.308) + r * (vec2(9.712, -12.287) + r * (vec2(-29.695, 31.277)
        + r * (vec2(31.065, -31.043) + r * vec2(-10.885, 10.844))));
    float grazing = 1.0 - v;
    float grazing_sq = grazing * grazing;
    float bias = grazing_sq * grazing_sq * (powers.x + grazing * powers.y);
    return vec2(max(total - bias, 0.0), max(bias, 0.0));
}

// Radiance that the sun's light gives. With half vector h of the unit vectors l and v, |l + v|^2 = 2 (1 + l.v), so that
// (n.h)^2 and (v.h)^2 need no normalising; distribution and masking share one division.
vec3 light_directly(Surface s, vec3 diffuse_color, vec3 f0) {
    vec3 to_light = sun_direction;
    float towards_light = dot(s.normal, to_light);
    float towards_eye = dot(s.normal, s.view);
    float n_dot_l = max(towards_light, 0.0);
    float n_dot_v = max(abs(towards_eye), 1e-3);
    float sum_sq = max(2.0 + 2.0 * dot(to_light, s.view), 1e-4);
    float n_dot_sum = max(towards_light + towards_eye, 0.0);
    float alpha = s.roughness * s.roughness;
    float alpha_sq = alpha * alpha;
    float lobe = n_dot_sum * n_dot_sum * (alpha_sq - 1.0) + sum_sq;  // times |l + v|^2
    float masking = n_dot_l * sqrt(n_dot_v * n_dot_v * (1.0 - alpha_sq) + alpha_sq)
        + n_dot_v * sqrt(n_dot_l * n_dot_l * (1.0 - alpha_sq) + alpha_sq);
    float distribution = 0.5 * alpha_sq * sum_sq * sum_sq / (lobe * lobe * masking);  // in a white sheet's radiance
    float grazing = 1.0 - 0.5 * sqrt(sum_sq);
    float grazing_sq = grazing * grazing;
    vec3 fresnel = f0 + (1.0 - f0) * (grazing_sq * grazing_sq * grazing);
    return (diffuse_color * (1.0 - fresnel) + fresnel * distribution) * sun_color * n_dot_l;
}

// How much of what is mirrored reaches a surface that its surroundings shade: (n.v + o)^(2 r) - 1 + o, the power as the
// first terms of its series, which are exact for exponents 0, 1 and 2.
float reflection_occlusion(float n_dot_v, float occlusion, float roughness) {
    float over = n_dot_v + occlusion - 1.0;
    return clamp(2.0 * roughness * over * (1.0 + over * (roughness - 0.5)) + occlusion, 0.0, 1.0);
}

// Radiance towards the eye, linear.
vec3 shade(Surface s) {
    if (s.unlit) {
        return s.base_color.rgb;
    }
    vec3 f0 = mix(vec3(0.04), s.base_color.rgb, s.metallic);
    vec3 diffuse_color = s.base_color.rgb * (1.0 - s.metallic);
    float towards_eye = dot(s.normal, s.view);
    float n_dot_v = abs(towards_eye);
    vec2 share = environment_brdf(n_dot_v, s.roughness);
    vec3 reflectance = f0 * share.x + share.y;
    vec3 around = environment_diffuse(s.normal) * diffuse_color * (1.0 - reflectance);
    vec3 from = s.normal * (2.0 * towards_eye) - s.view;
    vec3 mirrored = environment_reflection(from, s.roughness) * reflectance;
#ifndef NO_OCCLUSION
    around *= s.occlusion;
    mirrored *= reflection_occlusion(n_dot_v, s.occlusion, s.roughness);
#endif
    vec3 radiance = light_directly(s, diffuse_color, f0) + around + mirrored;
#ifndef NO_EMISSION
    radiance += s.emissive;
#endif
    return radiance;
}

// Radiance to a displayable encoded colour: exposure, a shoulder that keeps hue, then goes to white, sRGB.
vec3 tone_map(vec3 radiance) {
    const float linear_part = 0.72;
    const float shoulder = 1.0 - linear_part;
    vec3 color = radiance * exposure;
    float peak = clamp(max(max(color.r, color.g), color.b), 1e-6, 1e8);
    float over = max(peak - linear_part, 0.0);
    float below = over + shoulder;
    float mapped = min(peak, linear_part) * below + shoulder * over;  // peak after the shoulder, times `below`
    float lost = 0.15 * (peak * below - mapped);                      // so is this
    float share = mapped / (peak * below * (below + lost));
    return encode_srgb(color * (share * below) + share * lost * peak);  // what is lost turns white
}

#endif
