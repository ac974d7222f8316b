// Warm glass, dark metal (demos).
in float glow;
out vec4 result;

void main() {
    result = vec4(mix(vec3(0.10, 0.08, 0.07), vec3(1.0, 0.93, 0.70), sqrt(glow)), 1.0);
}
