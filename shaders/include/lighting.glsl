// glTF's metallic-roughness model under one directional light and an environment.
//
// Sources: glTF 2.0 specification, appendix B (the model); Walter et al. 2007 (GGX); Heitz 2014 (height-correlated
// masking); Ramamoorthi and Hanrahan 2001 (irradiance by nine spherical harmonics); Karis 2013 (reflection as
// prefiltered radiance times an integral of the BRDF alone; the fit of that integral below is ours).
#ifndef LIGHTING_GLSL
#define LIGHTING_GLSL

#include "surface.glsl"

uniform sampler2D reflection_texture;  // radiance by direction (longitude, latitude); six levels by roughness
const float PI = 3.14159265;

// Light from all around on a diffuse surface of this normal, as the radiance of a white sheet.
vec3 environment_diffuse(vec3 n) {
    vec3 sum = irradiance[0].rgb
        + irradiance[1].rgb * n.y + irradiance[2].rgb * n.z + irradiance[3].rgb * n.x
        + irradiance[4].rgb * (n.x * n.y) + irradiance[5].rgb * (n.y * n.z)
        + irradiance[6].rgb * (3.0 * n.z * n.z - 1.0)
        + irradiance[7].rgb * (n.x * n.z) + irradiance[8].rgb * (n.x * n.x - n.y * n.y);
    return max(sum, 0.0);
}

vec3 environment_reflection(vec3 direction, float roughness) {
    vec2 uv = vec2(atan(direction.x, -direction.z) / (2.0 * PI) + 0.5, acos(clamp(direction.y, -1.0, 1.0)) / PI);
    const float levels = 6.0;
    return textureLod(reflection_texture, uv, sqrt(roughness) * (levels - 1.0)).rgb;
}

// Scale and bias of the reflectance at normal incidence, after the BRDF is integrated over a constant environment: a fit
// by least squares to the integral by 2048 samples, off by 0.09 and 0.05 at most (at grazing angles).
vec2 reflected_share(float n_dot_v, float roughness) {
    float v = n_dot_v, r = roughness;
    float total = 1.0 - r * r * (0.469 - 0.387 * r + v * (1.124 + 0.183 * r + v * (-1.555 + 0.895 * r)));
    float bias = (1.097 + r * (-2.537 + 1.532 * r)) * pow(max(1.0 - v, 1e-4), 5.100 + r * (-7.785 + 8.335 * r));
    return vec2(max(total - bias, 0.0), max(bias, 0.0));
}

vec3 light_directly(Surface s, vec3 diffuse_color, vec3 f0) {
    vec3 to_light = sun_direction.xyz;
    vec3 half_way = normalize(to_light + s.view);
    float n_dot_l = max(dot(s.normal, to_light), 0.0);
    float n_dot_v = max(abs(dot(s.normal, s.view)), 1e-3);
    float n_dot_h = clamp(dot(s.normal, half_way), 0.0, 1.0);
    float v_dot_h = clamp(dot(s.view, half_way), 0.0, 1.0);
    float alpha = s.roughness * s.roughness;
    float alpha_sq = alpha * alpha;
    float lobe = n_dot_h * n_dot_h * (alpha_sq - 1.0) + 1.0;
    float distribution = alpha_sq / (PI * lobe * lobe);
    float visibility = 0.5 / max(
        n_dot_l * sqrt(n_dot_v * n_dot_v * (1.0 - alpha_sq) + alpha_sq)
        + n_dot_v * sqrt(n_dot_l * n_dot_l * (1.0 - alpha_sq) + alpha_sq), 1e-5);
    float grazing = 1.0 - v_dot_h;
    vec3 fresnel = f0 + (1.0 - f0) * (grazing * grazing * (grazing * grazing) * grazing);
    vec3 reflected = fresnel * (distribution * visibility * PI);  // sun_color is in units of a white sheet's radiance
    return (diffuse_color * (1.0 - fresnel) + reflected) * sun_color.rgb * n_dot_l;
}

// Radiance towards the eye, linear.
vec3 shade(Surface s) {
    if (s.unlit) {
        return s.base_color.rgb;
    }
    vec3 f0 = mix(vec3(0.04), s.base_color.rgb, s.metallic);
    vec3 diffuse_color = s.base_color.rgb * (1.0 - s.metallic);
    float n_dot_v = clamp(abs(dot(s.normal, s.view)), 0.0, 1.0);
    vec2 share = reflected_share(n_dot_v, s.roughness);
    vec3 reflectance = f0 * share.x + share.y;
    vec3 around = environment_diffuse(s.normal) * diffuse_color * (1.0 - reflectance);
    vec3 mirrored = environment_reflection(reflect(-s.view, s.normal), s.roughness) * reflectance;
    float reflection_occlusion = clamp(pow(n_dot_v + s.occlusion, 2.0 * s.roughness) - 1.0 + s.occlusion, 0.0, 1.0);
    return light_directly(s, diffuse_color, f0) + around * s.occlusion + mirrored * reflection_occlusion + s.emissive;
}

// Radiance to a displayable encoded colour: exposure, a shoulder that keeps hue, sRGB.
vec3 tone_map(vec3 radiance) {
    const float linear_part = 0.72;
    vec3 color = max(radiance * sun_color.w, 0.0);
    float peak = max(max(color.r, color.g), max(color.b, 1e-6));
    if (peak > linear_part) {
        float mapped = 1.0 - (1.0 - linear_part) * (1.0 - linear_part) / (peak + 1.0 - 2.0 * linear_part);
        color *= mapped / peak;
        color = mix(color, vec3(mapped), 1.0 - 1.0 / (1.0 + 0.15 * (peak - mapped)));  // towards white as it burns out
    }
    return encode_srgb(color);
}

#endif
