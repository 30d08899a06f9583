"""Scenes: sampling laws (``laws``), meshes made by code (``meshes``), and arrays from a plan (``assemble``).

A scene is first a *plan*, a small table of drawn numbers that costs microseconds, and only then triangles. Tests and
statistics look at plans; everything that a plan holds is also in the record's ``meta``.
"""
