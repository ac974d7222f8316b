// What is the same for all vertices of one actor: vertex attributes that advance once an instance.
#ifndef INSTANCE_GLSL
#define INSTANCE_GLSL

in vec4 in_world_row0;  // object space to world (seen from the eye), three rows of a matrix
in vec4 in_world_row1;
in vec4 in_world_row2;
in vec4 in_tint;        // rgb multiplies the base colour, a fades
in ivec2 in_pose_and_level;    // row of the joint texture; level of detail

#endif
