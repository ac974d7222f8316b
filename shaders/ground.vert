// A square of ground around the eye, two triangles without a vertex buffer (demos).
uniform mat4 clip_from_world;   // world axes, origin at the eye
uniform vec3 ground_centre;     // seen from the eye
uniform float ground_size;      // half a side, metres

out vec3 ground_position;       // seen from the eye

void main() {
    vec2 corner = vec2((gl_VertexID & 1) * 2 - 1, 1 - (gl_VertexID & 2));
    ground_position = ground_centre + vec3(corner.x, 0.0, corner.y) * ground_size;
    gl_Position = clip_from_world * vec4(ground_position, 1.0);
}
