"""Mitsuba meshes, materials and cameras straight from a SceneRecord's arrays: no mesh file between the renderer and the
data.

The material diffuse / pi + specular * GGX is ``twosided(blendbsdf(diffuse, roughconductor))`` with the two
reflectances divided by their blend weights. Emitting triangles are black. Vertices are unshared, so that face
attributes and corner normals hold.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.records import SceneRecord

MIN_ALPHA = 1e-4  # GGX width below which the lobe is numerically a mirror
MAX_WEIGHT = 0.999  # largest blend weight of the specular lobe; also its sampling probability


def face_normals(triangles: np.ndarray) -> np.ndarray:
    """(F, 3) geometric normals of (F, 3, 3) triangles, their length twice the area."""
    edges = triangles[:, 1:].astype(np.float64) - triangles[:, :1]
    return np.cross(edges[:, 0], edges[:, 1])


def material(albedo_only: bool = False) -> mi.BSDF:
    """The two-sided GGX material that reads face attributes; ``albedo_only``: a diffuse one for first-hit channels."""

    def attribute(name: str) -> dict:
        return {"type": "mesh_attribute", "name": f"face_{name}"}

    diffuse = {"type": "diffuse", "reflectance": attribute("diffuse")}
    if albedo_only:
        return mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": attribute("albedo")}})
    # `material: none` is a perfect mirror: no Fresnel term.
    specular = {
        "type": "roughconductor",
        "distribution": "ggx",
        "material": "none",
        "alpha": attribute("alpha"),
        "specular_reflectance": attribute("specular"),
    }
    blend = {"type": "blendbsdf", "weight": attribute("weight"), "bsdf_0": diffuse, "bsdf_1": specular}
    return mi.load_dict({"type": "twosided", "bsdf": blend})


def surface_mesh(scene: SceneRecord, faces: np.ndarray, bsdf: mi.BSDF | None = None, albedo_only: bool = False) -> mi.Mesh:
    """The triangles ``faces`` (indices) as one mesh; triangle i of the mesh is faces[i]."""
    emits = scene.light_index[faces] >= 0
    black = np.where(emits, np.float32(0), np.float32(1))[:, None]
    diffuse, specular = scene.diffuse[faces] * black, scene.specular[faces] * black
    mesh = mesh_of(scene.triangles[faces], scene.vertex_normals[faces], bsdf or material(albedo_only))
    if albedo_only:
        attributes = {"albedo": diffuse + specular}
    else:
        weight = np.clip(specular.max(axis=1), 0, MAX_WEIGHT)
        attributes = {
            "diffuse": diffuse / (1 - weight)[:, None],
            "specular": specular / np.where(weight > 0, weight, 1)[:, None],
            "weight": weight,
            "alpha": np.maximum(scene.roughness[faces] ** 2, MIN_ALPHA),
        }
    for name, values in attributes.items():
        mesh.add_attribute(f"face_{name}", values.shape[1] if values.ndim > 1 else 1, floats(values))
    return mesh


def mesh_of(
    triangles: np.ndarray, normals: np.ndarray | None, bsdf: mi.BSDF | None = None, emitter: mi.Emitter | None = None
) -> mi.Mesh:
    """(F, 3, 3) triangles with corner normals (None: flat) as a Mitsuba mesh with unshared vertices."""
    props = mi.Properties()
    if bsdf is not None:
        props["bsdf"] = bsdf
    if emitter is not None:
        props["emitter"] = emitter
    count = len(triangles)
    mesh = mi.Mesh("triangles", 3 * count, count, props=props, has_vertex_normals=normals is not None)
    params = mi.traverse(mesh)
    params["vertex_positions"] = floats(triangles)
    params["faces"] = np.arange(3 * count, dtype=np.uint32) if _scalar() else mi.UInt32(np.arange(3 * count, dtype=np.uint32))
    if normals is not None:
        params["vertex_normals"] = floats(normals)
    params.update()
    return mesh


def _scalar() -> bool:
    return mi.variant().startswith("scalar")


def floats(values: np.ndarray):
    flat = np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
    return flat if _scalar() else dr.auto.ad.Float(flat)
