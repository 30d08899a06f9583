"""Triangles of a USD stage, by the package usd-core, which is optional.

Opens one file and the layers that it is composed of, which must lie inside the given root. Reads meshes, shapes by formula and
point instancers as they stand at the first time of the stage; a subdivision surface is its cage. Design choice: layers are
looked at one by one before the stage is composed, since composing would open whatever they name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry import colours
from stages.graphics.geometry.colours import as_colour
from stages.graphics.geometry.formats.parts import Part, Source, checked_part
from stages.graphics.geometry.formats.usd_shapes import placed_prims, polygons
from stages.graphics.geometry.paths import check_path, inside

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
INSTALL = "USD files need the package usd-core: pip install usd-core"
TEXTURES = {"diffuseColor": "colour", "emissiveColor": "emission"}
COORDINATES = ("st", "UVMap", "st0", "map1")  # texture coordinates, the usual names
WRAPS = {"clamp": "clamp", "mirror": "mirror"}  # all others repeat


@dataclass
class UsdPart:
    """Triangles of one prim (``name``: its path) with one material, in the stage's world: points (V, 3), triangles (F, 3).

    uv (F, 3, 2): v runs down. normals (F, 3, 3). tint (F, 3, 3): linear. inputs, textures: of its UsdPreviewSurface; a
    texture is (image, wrap, transform).
    """

    name: str
    points: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None
    tint: np.ndarray | None = None
    material: str = ""
    inputs: dict[str, Any] = field(default_factory=dict)
    textures: dict[str, tuple[np.ndarray, tuple[str, str], np.ndarray]] = field(default_factory=dict)


def read(data: bytes, source: Source) -> list[Part]:
    """The triangles of a stage, turned so that y is up, as it is in the other formats."""
    stage = open_stage(source.path, source.root)
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) if z_up(stage) else np.eye(3)
    found = []
    for part in parts(stage, source.root, source.max_bytes, source.max_faces, source.images):
        vertex, face = f"{part.name}: point {{}}".format, f"{part.name}: triangle {{}}".format
        out = checked_part(part.points @ turn.T, part.triangles, vertex, face)
        if source.images is not None:
            image, wrap, transform = part.textures.get("colour", (None, ("repeat", "repeat"), np.eye(3)[:2]))
            stated = part.inputs.get("diffuseColor")
            colour = (1.0, 1.0, 1.0) if stated is None else as_colour(np.array(stated), part.name, source.note)
            material = colours.Material(tuple(map(float, colour)), image, wrap, transform, stated is not None)
            out.look = colours.Look(material, part.uv, None if part.material else part.tint)
        found.append(out)
    return found


def open_stage(path: Path, root: Path) -> Any:
    """The composed stage; a Reject where the package is missing, or the file or a layer of it cannot or may not be read."""
    try:
        from pxr import Sdf, Tf, Usd
    except ImportError:
        raise Reject("needs_package", INSTALL) from None
    layers(path, root)
    try:
        return Usd.Stage.Open(Sdf.Layer.FindOrOpen(str(path)))
    except Tf.ErrorException as error:
        raise Reject("unreadable", f"not a USD file that can be read: {str(error).splitlines()[-1].strip()[:160]}") from None


def z_up(stage: Any) -> bool:
    """Whether z points up; else y does."""
    from pxr import UsdGeom

    return UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z


def layers(path: Path, root: Path) -> list[Path]:
    """The other layers that the file is composed of, checked and sorted; a Reject where one lies outside the root."""
    try:
        from pxr import Sdf, Tf
    except ImportError:
        return []
    found: set[Path] = set()
    queue = [path.resolve()]
    for current in queue:  # grows while it is walked
        try:
            layer = Sdf.Layer.OpenAsAnonymous(str(current))
        except Tf.ErrorException:
            layer = None
        if layer is None:
            raise Reject("unreadable", f"{current.name} is not a USD file that can be read")
        for name in [*layer.GetCompositionAssetDependencies(), *layer.subLayerPaths]:
            if not name or current.suffix.lower() == ".usdz":  # a package refers to what it holds
                continue
            target = check_path(name, current.parent, root).resolve()
            if target.suffix.lower() not in SUFFIXES:
                raise Reject("unsupported", f"is composed with {name[:80]!r}, which is no USD file")
            if not target.is_file():
                raise Reject("unreadable", f"is composed with {name[:80]!r}, which is missing")
            if target not in found:
                found.add(target)
                queue.append(target)
    return sorted(found - {path.resolve()})


def parts(stage: Any, root: Path, max_bytes: int, max_faces: int, images: colours.Images | None) -> Iterator[UsdPart]:
    """The stage's visible surfaces, a part for each material. ``images`` collects textures and notes; None: neither is read."""
    from pxr import Usd, UsdGeom, UsdShade

    def note(text: str) -> None:
        if images is not None and text not in images.notes:
            images.notes.append(text)

    time = Usd.TimeCode.EarliestTime()
    faces_so_far = points_so_far = 0
    for prim, matrix, is_copy in placed_prims(stage, time, max_faces):
        imageable = UsdGeom.Imageable(prim)
        if not imageable or imageable.ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        if imageable.ComputePurpose() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
            continue
        shape = polygons(prim, time, note)
        if shape is None:
            continue
        faces_so_far += len(shape.face)
        points_so_far += len(shape.points) * is_copy
        if max(faces_so_far, points_so_far / 3) > max_faces:
            raise Reject("too_large", f"states over {max_faces} faces")
        index, corner, face = shape.index, shape.corner, shape.face
        if not len(corner):
            continue
        if index.min() < 0 or index.max() >= len(shape.points):
            raise Reject(
                "bad_indices", f"{prim.GetPath()}: indices {index.min()}..{index.max()} for {len(shape.points)} vertices"
            )
        mesh = UsdGeom.Mesh(prim)
        left_handed = bool(mesh) and mesh.GetOrientationAttr().Get(time) == "leftHanded"
        if left_handed != (np.linalg.det(matrix[:3, :3]) < 0):
            corner = corner[:, ::-1]
        part = UsdPart(str(prim.GetPath()), shape.points @ matrix[:3, :3].T + matrix[:3, 3], index[corner])
        primvars = UsdGeom.PrimvarsAPI(prim)
        part.uv = _primvar(primvars, COORDINATES, 2, corner, index, face, time)
        if part.uv is not None:
            part.uv = part.uv * [1, -1] + [0, 1]
        part.tint = _primvar(primvars, ("displayColor",), 3, corner, index, face, time)
        if shape.normals is not None:
            part.normals = shape.normals[index[corner]] @ np.linalg.pinv(matrix[:3, :3])
        elif mesh:
            part.normals = _normals(mesh, matrix, corner, index, face, time)
        for rows, material in _materials(prim, len(shape.counts), face, UsdGeom, UsdShade):
            yield _with_material(part, rows, material, root, max_bytes, images, note)


def _spread(values: Any, interpolation: str, corner: np.ndarray, index: np.ndarray, face: np.ndarray) -> np.ndarray | None:
    """(F, 3, n) values at the corners; None where there are not enough of them."""
    values = np.asarray(values, np.float64)
    where = {
        "constant": np.zeros_like(corner), "uniform": np.repeat(face[:, None], 3, axis=1), "vertex": index[corner],
        "varying": index[corner], "faceVarying": corner,
    }.get(interpolation)  # fmt: skip
    if where is None or values.ndim != 2 or where.max(initial=0) >= len(values):
        return None
    return values[where]


def _primvar(api: Any, names: tuple[str, ...], width: int, corner, index, face, time) -> np.ndarray | None:
    for name in names:
        primvar = api.GetPrimvar(name)
        values = primvar.ComputeFlattened(time) if primvar else None
        if values:
            spread = _spread(values, primvar.GetInterpolation(), corner, index, face)
            if spread is not None and spread.shape[2] == width:
                return spread
    return None


def _normals(mesh: Any, matrix: np.ndarray, corner, index, face, time) -> np.ndarray | None:
    values = mesh.GetNormalsAttr().Get(time)
    spread = _spread(values, mesh.GetNormalsInterpolation(), corner, index, face) if values else None
    return None if spread is None else spread @ np.linalg.pinv(matrix[:3, :3])


def _materials(prim: Any, polygons: int, face: np.ndarray, geom: Any, shade: Any) -> Iterator[tuple[np.ndarray, Any]]:
    """(rows of triangles, bound material or None), of the whole prim or of its subsets and the rest."""
    binding, left = shade.MaterialBindingAPI(prim), np.ones(polygons, bool)
    for subset in geom.Subset.GetGeomSubsets(geom.Imageable(prim), geom.Tokens.face, "materialBind"):
        chosen = np.zeros(polygons, bool)
        chosen[np.asarray(subset.GetIndicesAttr().Get() or [], np.int64)] = True
        rows = np.flatnonzero((chosen & left)[face])
        left &= ~chosen
        if len(rows):
            yield rows, shade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
    rows = np.flatnonzero(left[face])
    if len(rows):
        yield rows, binding.ComputeBoundMaterial()[0]


def _with_material(
    part: UsdPart,
    rows: np.ndarray,
    material: Any,
    root: Path,
    max_bytes: int,
    images: Any,
    note: Callable[[str], None],
) -> UsdPart:
    def of_rows(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[rows]

    out = UsdPart(part.name, part.points, part.triangles[rows], of_rows(part.uv), of_rows(part.normals), of_rows(part.tint))
    shader = material.ComputeSurfaceSource()[0] if material else None
    if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
        if material:
            note(f"material {material.GetPrim().GetName()!r}: it has no UsdPreviewSurface, and its colour is not read")
        return out
    out.material = material.GetPrim().GetName()
    for stated in shader.GetInputs():
        name = stated.GetBaseName()
        sources = stated.GetConnectedSources()[0] if stated.HasConnectedSource() else []
        if not sources:
            out.inputs[name] = stated.Get()
            continue
        out.inputs[name] = None  # given by what follows, if that is known
        if name in TEXTURES and images is not None:
            texture = _texture(sources[0].source.GetPrim(), root, max_bytes, images)
            if texture is None:
                note(f"material {out.material!r}: what gives its {name} is not read")
            elif out.uv is None:
                note(f"{out.name}: no texture coordinates ({', '.join(COORDINATES)}): its image is left out")
            else:
                out.textures[TEXTURES[name]] = texture
    return out


def _texture(prim: Any, root: Path, max_bytes: int, images: colours.Images) -> Any:
    """(image, wrap, transform) of a UsdUVTexture; None for other nodes and where the image cannot be had."""
    from pxr import Ar, UsdShade

    shader = UsdShade.Shader(prim)
    if shader.GetIdAttr().Get() != "UsdUVTexture":
        return None
    asset = shader.GetInput("file").Get() if shader.GetInput("file") else None
    if asset is None:
        return None

    def read() -> bytes:
        resolved = asset.resolvedPath
        packaged = Ar.IsPackageRelativePath(resolved)
        outer = Path(Ar.SplitPackageRelativePathOuter(resolved)[0] if packaged else resolved)
        if not resolved or not inside(outer, root):
            raise Reject("unreadable", "it is missing, or outside the folder of the file")
        if packaged:
            return bytes(Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved)).GetBuffer())
        if outer.suffix.lower() not in colours.IMAGE_FORMATS or outer.stat().st_size > max_bytes:
            raise Reject("unsupported", "no image that is read, or too large")
        return outer.read_bytes()

    image = images.get(str(asset.path), read)
    stated = [shader.GetInput(name) for name in ("wrapS", "wrapT")]
    wrap = tuple(WRAPS.get(str(one.Get()), "repeat") if one else "repeat" for one in stated)
    return None if image is None else (image, wrap, _transform(shader))


def _transform(texture: Any) -> np.ndarray:
    """(2, 3) of (u, v, 1) with v running down, of the UsdTransform2d that a texture's coordinates pass through, if any."""
    from pxr import UsdShade

    given = texture.GetInput("st")
    sources = given.GetConnectedSources()[0] if given and given.HasConnectedSource() else []
    shader = UsdShade.Shader(sources[0].source.GetPrim()) if sources else None
    if not shader or shader.GetIdAttr().Get() != "UsdTransform2d":
        return np.eye(3)[:2]

    def value(name: str, default: Any) -> np.ndarray:
        stated = shader.GetInput(name).Get() if shader.GetInput(name) else None
        return np.asarray(default if stated is None else stated, np.float64)

    angle, scale, move = np.radians(value("rotation", 0.0)), value("scale", (1, 1)), value("translation", (0, 0))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    upward, flip = np.eye(3), np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
    upward[:2, :2], upward[:2, 2] = turn * scale, move
    return (flip @ upward @ flip)[:2]
