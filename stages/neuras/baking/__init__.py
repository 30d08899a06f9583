"""From a fitted scene to what any engine draws: shaders, textures, a web page; and OpenGL's own picture of them (section 3.4).

``shaders``  both networks as GLSL constants, for OpenGL 3.3 and WebGL 2 from one text
``site``     the folder of the page: geometry, codes, codebooks, shaders
``drawing``  the same shaders drawn by OpenGL without a window
"""
