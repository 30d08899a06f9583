"""Readers of mesh files: bytes of one format to triangles, colours and where a fault lies.

``faults``  rejects that name their place; the one translator of what parsers and libraries raise
``parts``   what a reader gets and gives: Source, Part
``text``    words, numbers and lines of text formats
``gltf``    glTF 2: its tree, buffers, accessors and nodes (``Gltf``); with ``json_values``, ``draco``, ``gltf_materials``, and
``gltf_pose``, by which skins, morph targets and instances get their places
``gltf_mesh``  ``obj``  ``off``  ``ply``  ``stl``

Each module of the last line has ``read(data, source) -> list[Part]``. Parts are in the file's units and axes.
"""
