"""Neural rasterization: feature textures on a mesh and on skyboxes, and the small networks that shade them (ICCV 2023)."""
