// Vertices of a level read from the textures once, by transform feedback: position at rest, and one record of joints
// and weights. The very functions that static.vert uses, so that nothing differs.
#include "include/skinning.glsl"
#include "include/vertex_uvs.glsl"

uniform int record_number;   // which record of a cell, 0 for the first

out vec3 rest;
out vec4 joints;
out vec4 weights;

void main() {
    rest = rest_position(canonical_uv());
    joints = vec4(0.0);
    weights = vec4(0.0);
    vec4 shares;
    uint record = find_record(canonical_uv(), shares);
    float left = 1.0;
    bool more = true;
    for (int number = 0; more; number++) {
        uvec4 its_joints;
        vec4 its_weights;
        more = read_record(record + uint(number), shares, left, its_joints, its_weights);
        if (number == record_number) {
            joints = vec4(its_joints);
            weights = its_weights;
        }
    }
    gl_Position = vec4(0.0);
}
