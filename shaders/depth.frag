// Depth alone: shadows and picking. Cut-outs count, colour is not written.
#include "include/surface.glsl"

void main() {
    encoded_base_color();
}
