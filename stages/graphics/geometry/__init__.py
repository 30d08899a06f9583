"""Geometry: what *collect*, *remesh* and *decimate* compute.

``load``        a mesh file of any supported format as checked arrays, or a Reject; its readers are in ``formats``
``colours``     base colours of a mesh file, their images and record
``side_files``  the files beside a mesh file that decide what is made of it
``measure``     areas, volumes, manifoldness, distances, visibility
``remesher``    unsigned distance, flood fill from outside, marching cubes, pull-back
``decimator``   quadric edge collapse to a ladder of budgets
``sheet``       contact sheets

Meshes are (V, 3) float64 vertices and (F, 3) int64 faces inside this package, float32 and int32 in records.
"""

from __future__ import annotations

import os

from threadpoolctl import threadpool_limits


def one_thread() -> None:
    """Keep native libraries to one thread in this process: workers are the parallelism, and sums in another order round
    differently. Those that are loaded already are told, the others read the environment.
    """
    for name in ("OMP_NUM_THREADS", "IGL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    threadpool_limits(1)
