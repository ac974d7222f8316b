// A plain mesh with vertex attributes, for pictures of meshes that are no characters.
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;

uniform mat4 clip_from_world;  // world: origin at the eye
uniform vec3 eye;

out vec3 normal;
out vec2 uv;

void main() {
    normal = in_normal;
    uv = in_uv;
    gl_Position = clip_from_world * vec4(in_position - eye, 1.0);
}
