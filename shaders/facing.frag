// White where a surface faces the eye, red where it turns its back: shows what should never be seen.
//
// At a silhouette a front and a back face meet at one depth; the back one is put a little behind, so that rounding of
// depths is not taken for a hole.
#include "include/surface.glsl"

out vec4 result;

void main() {
    float behind = gl_FragCoord.z + 1e-4 + fwidth(gl_FragCoord.z);
    gl_FragDepth = gl_FrontFacing ? gl_FragCoord.z : behind;
    result = gl_FrontFacing ? vec4(1.0) : vec4(1.0, 0.0, 0.0, 1.0);
}
