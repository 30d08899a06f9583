"""Meshes of collect, remesh and decimate: the result beside what it was made from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from stages.graphics.arrays import unpack_json
from stages.graphics.geometry.records import MeshRecord, TextureRecord
from stages.graphics.panels import Facts, Lazy, Pane, Shown, Space, Surface, general
from stages.renderformer.inference.room import Z_UP
from stages.renderformer.objects.rungs import load_rungs


def collected(shown: Shown) -> Iterator[Any]:
    """A mesh as it was collected, with its base colours where it has some."""
    if shown.record_id is None or "mesh.npz" not in shown.members():
        yield from general.panels(shown)
        return
    mesh = MeshRecord.from_record(shown.record())
    beside = mesh.id + TextureRecord.SUFFIX
    colours = {}
    if beside in shown.artifact and "texture.npz" in shown.artifact.row(beside).members:
        colours["base colour"] = face_colours(TextureRecord.from_record(shown.artifact.read(beside)))
    yield Space("Mesh", [Pane("collected", [surface("collected", mesh.vertices, mesh.faces, colours)])], up_of(mesh.meta))
    yield Facts("Facts", mesh.meta)


def remeshed(shown: Shown) -> Iterator[Any]:
    """The new surface beside the old."""
    if shown.record_id is None:
        yield from general.panels(shown)
        return
    mesh = MeshRecord.from_record(shown.record())
    panes = [*original(shown), Pane("remeshed", [surface("remeshed", mesh.vertices, mesh.faces)])]
    yield Space("Original and result", panes, up_of(mesh.meta))
    yield Facts("Facts", mesh.meta)


def original(shown: Shown) -> Iterator[Pane]:
    """A pane of the collected mesh, if it is still in the store."""
    collect = shown.input("collect")
    if collect is not None and shown.record_id in collect:
        mesh = MeshRecord.from_record(collect.read(shown.record_id))
        yield Pane("collected", [surface("collected", mesh.vertices, mesh.faces)])


def decimated(shown: Shown) -> Iterator[Any]:
    """The ladder of rungs, beside the mesh that it was made from."""
    if shown.record_id is None:
        yield from general.panels(shown)
        return
    record = shown.record()
    meta = unpack_json(record.members["meta.json"])
    rungs = [surface(f"rung of {budget:,}", *arrays) for budget, arrays in load_rungs(record).items()]
    panes = []
    remesh = shown.input("remesh")
    if remesh is not None and shown.record_id in remesh:
        mesh = MeshRecord.from_record(remesh.read(shown.record_id))
        panes.append(Pane("remeshed", [surface("remeshed", mesh.vertices, mesh.faces)]))
        panes = [*original(Shown(shown.store, remesh, shown.record_id)), *panes]
    yield Space("The ladder of rungs", [*panes, Pane("decimated", rungs)], up_of(meta))
    yield Facts("Facts", meta)


def up_of(meta: Mapping[str, Any]) -> tuple[float, float, float]:
    """The axis that points up in most files of the kind: collect keeps a file's own axes."""
    source = str(meta.get("source", ""))
    return (0.0, 0.0, 1.0) if source == "procedural" or source.lower().endswith(Z_UP) else (0.0, 1.0, 0.0)


def surface(name: str, vertices: np.ndarray, faces: np.ndarray, colours: dict[str, np.ndarray] | None = None) -> Surface:
    """A mesh with what can be asked of its faces: whether one is hidden from outside, or passes through another."""
    values = {
        "hidden (1) or seen (0)": Lazy(lambda: hidden(vertices, faces)),
        "crossing another face (1)": Lazy(lambda: crossing(vertices, faces)),
    }
    return Surface(name, vertices.astype(np.float32), faces.astype(np.int32), colours=colours or {}, values=values)


def hidden(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) float32: 1 where no ray from outside reaches the middle of a face."""
    from stages.graphics.geometry import measure

    vertices = vertices.astype(np.float64)
    centres = measure.corners_of(vertices, faces).mean(axis=1)
    normals = measure.face_normals(measure.corners_of(vertices, faces))
    return (~measure.Visibility(vertices, faces).outer(centres, normals)).astype(np.float32)


def crossing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) float32: 1 where a face passes through another one."""
    from stages.graphics.geometry import measure

    return measure.crossing_faces(vertices, faces).astype(np.float32)


def face_colours(texture: TextureRecord) -> np.ndarray:
    """(F, 3) float32, linear: the base colour at each face's middle, by the nearest texel."""
    from stages.graphics.tonemap import srgb_decode

    colours = texture.colour[texture.material].astype(np.float32)
    middle = texture.uv.mean(axis=1)
    for number, image in enumerate(texture.images):
        faces = np.flatnonzero(texture.image[texture.material] == number)
        size = np.array(image.shape[1::-1])
        texel = np.floor(np.mod(middle[faces], 1) * size).astype(int).clip(0, size - 1)
        colours[faces] *= srgb_decode(image[texel[:, 1], texel[:, 0], :3] / 255.0)
    return colours.clip(0, 1)
