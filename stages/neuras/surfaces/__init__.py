"""From points to a scaffold, and from a scaffold to an atlas (section 3.1).

``reconstruct``  a surface through points: screened Poisson, or a terrain by Delaunay
``surfels``      squares at points that the surface passes by, and which of them photos see through
``simplify``     near vertices welded, quadric edge collapse
``visibility``   faces that no camera sees go
``unfold``       charts by xatlas, tile by tile, packed into one texture
``planar``       the same without xatlas, quicker and less well
"""
