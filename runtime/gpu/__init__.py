"""What lies in GPU memory: textures, buffers of levels, programs, the uniform block of a frame."""
