// A colour for every joint, so that neighbours differ: the view of weights.
#ifndef JOINT_COLOR_GLSL
#define JOINT_COLOR_GLSL

vec3 joint_color(uint joint) {
    float hue = fract(float(joint) * 0.61803399);
    vec3 pure = clamp(abs(fract(hue + vec3(0.0, 2.0, 1.0) / 3.0) * 6.0 - 3.0) - 1.0, 0.0, 1.0);
    return mix(vec3(1.0), pure, 0.55 + 0.4 * float((joint / 2u) % 2u)) * (0.6 + 0.4 * float(joint % 3u) / 2.0);
}

#endif
