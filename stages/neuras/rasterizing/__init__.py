"""What a camera sees of a mesh: one hit per pixel, by casting rays (embree) or by drawing triangles (OpenGL)."""
