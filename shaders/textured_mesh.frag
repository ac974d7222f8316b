// Its texture under a lamp behind the eye.
in vec3 normal;
in vec2 uv;
out vec4 result;

uniform sampler2D color_texture;
uniform vec3 to_light;

void main() {
    float light = 0.3 + 0.7 * max(dot(normalize(normal), to_light), 0.0);
    result = vec4(texture(color_texture, uv).rgb * light, 1.0);
}
